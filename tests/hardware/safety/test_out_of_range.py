"""A voltage or temperature outside its range on either side, or that is no number, is a fault."""

import struct
from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from pupper_sysid.common.data_sheet import supply_range
from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.feetech import FAMILY, STS3215
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import HostClock
from pupper_sysid.hardware.safety.guard import GuardedBus, GuardLimits
from pupper_sysid.hardware.serial_servos.settings import supply_band
from support.following_bus import FollowingBus
from support.refusals import assert_each_refused

PERIOD_S = 0.02
NO_NUMBERS = [np.nan, np.inf, -np.inf]
NO_MEASUREMENT = "That is no measurement"


class Servos(FollowingBus):
    """Two servos at rest, whose second reports what it is set to."""

    def __init__(self, band: list[float] | None = None):
        super().__init__(("LF_hip", "LF_thigh"))
        self.metadata = {} if band is None else {"voltage_band_v": band}
        self.ticks, self.volts, self.degrees, self.load = 0, 7.4, 30.0, 0.1
        self.lost = lambda tick: False

    def read(self) -> BusSample:
        self.ticks += 1
        if self.lost(self.ticks):
            none = np.full(2, np.nan)
            return self.sample(none, voltage_v=none, temperature_c=none, load=none)
        return self.sample(
            np.zeros(2), voltage_v=np.array([7.4, self.volts]),
            temperature_c=np.array([30.0, self.degrees]), load=np.array([0.1, self.load]),
        )  # fmt: skip


def hold(bus: Servos, seconds: float, limits: GuardLimits | None = None) -> GuardedBus:
    """Hold the pose for a time; a fault is raised."""
    guard = GuardedBus(bus, limits)
    guard.torque(True)
    for k in range(round(seconds / PERIOD_S)):
        guard.sleep_until((k + 1) * PERIOD_S)
        guard.write(np.zeros(2))
        guard.read()
    return guard


@pytest.mark.parametrize("band", [[4.2, 8.7], None])
@pytest.mark.parametrize(
    ("volts", "cure"),
    [(3.0, "Charge the battery"), (30.0, "Switch the supply off"), (-1.0, NO_MEASUREMENT),
     *((number, NO_MEASUREMENT) for number in NO_NUMBERS)],
)  # fmt: skip
def test_a_supply_out_of_range_on_either_side_or_none_stops_the_robot(band, volts, cure):
    bus = Servos(band)
    bus.volts = volts
    with pytest.raises(SafetyStop, match=rf"LF_thigh: the supply is {volts:.1f} V.*{cure}"):
        hold(bus, 1.0)
    assert bus.time < 0.5


@pytest.mark.parametrize("volts", [3.7, 5.0, 7.4, 12.6, 14.0])
def test_every_supply_that_a_hobby_servo_runs_at_is_in_range_where_the_bus_states_none(volts):
    bus = Servos()
    bus.volts = volts
    hold(bus, 1.0)


@pytest.mark.parametrize("degrees", [66.0, 255.0, -40.0, *NO_NUMBERS])
def test_a_temperature_out_of_range_on_either_side_or_none_stops_the_robot(degrees):
    bus = Servos()
    bus.degrees = degrees
    cure = "cool down" if 65 < degrees < 300 else "no measurement"
    with pytest.raises(SafetyStop, match=f"LF_thigh is at {degrees:.0f} °C.*{cure}"):
        hold(bus, 1.0)


@pytest.mark.parametrize(("name", "usual"), [("volts", 7.4), ("degrees", 30.0)])
def test_a_number_that_is_none_for_a_moment_or_with_its_whole_reading_is_a_lost_one(name, usual):
    bus = Servos()
    setattr(bus, name, np.nan)
    guard = hold(bus, 0.2)
    setattr(bus, name, usual)
    for _ in range(50):
        guard.sleep_until(guard.now() + PERIOD_S)
        guard.read()
    lossy = Servos()
    lossy.lost = lambda tick: tick % 25 > 5  # 0.4 s of each half second
    hold(lossy, 3.0)


@pytest.mark.parametrize("load", NO_NUMBERS)
def test_a_load_that_is_none_neither_begins_an_overload_nor_ends_one(load):
    bus = Servos()
    bus.load = load
    hold(bus, 3.0)
    bus, read = Servos(), Servos.read

    def overloaded():
        sample = read(bus)
        return replace(sample, load=np.array([0.1, load if bus.ticks % 3 else -0.95]))

    bus.read = overloaded
    with pytest.raises(SafetyStop, match="LF_thigh has worked at 95 % of full duty"):
        hold(bus, 3.0)


def test_a_threshold_that_compares_as_false_or_a_range_that_no_number_can_leave_is_refused():
    names = ("load", "temperature_c", "frozen_after_s", "speed_rad_s")
    cases = [({name: x}, f"GuardLimits: {name} is") for name in names for x in (nan, inf, -1.0)]
    ranges = ((8.7, 4.2), (nan, 8.0), (4.0, inf), (5.0, 5.0))
    cases += [({"voltage_v": ends}, "voltage_v") for ends in ranges]
    assert_each_refused(cases, lambda limits: GuardLimits(**limits))


@pytest.mark.parametrize(
    ("model", "registers", "band"),
    [
        ("STS3215", {"min_voltage": 40, "max_voltage": 80}, (4.0, 8.0)),
        ("STS3215", {"min_voltage": 40, "max_voltage": 140}, (4.0, 14.0)),
        # registers that protect from nothing: the data sheet's range holds
        ("STS3215", {"min_voltage": 0, "max_voltage": 255}, supply_range("STS3215")),
        ("STS3215", {"min_voltage": 90, "max_voltage": 50}, supply_range("STS3215")),
        ("SCS0009", {}, supply_range("SCS0009")),
        ("another", {"min_voltage": 45, "max_voltage": 90}, (4.5, 9.0)),
        ("another", {}, None),
    ],
)
def test_the_band_of_a_servo_is_its_registers_within_its_data_sheet(model, registers, band):
    found = supply_band(FAMILY, replace(STS3215, name=model), registers)
    assert found == (band if band is None else pytest.approx(band))


@pytest.mark.parametrize("volts", [30.0, -1.0, np.nan])
def test_a_voltage_that_cannot_be_replaces_the_last_one_of_the_proxy(volts):
    """The proxy's divider ends at 10.3 V; what it held before must not hide what it says now."""
    answers = {
        esp32.GET_POSITION: struct.pack("<BB12H", 26, esp32.GET_POSITION, *[512] * 12),
        esp32.GET_LOAD: struct.pack("<BB12h", 26, esp32.GET_LOAD, *[0] * 12),
    }
    bus = Esp32Bus.__new__(Esp32Bus)
    HostClock.__init__(bus)
    bus.joint_map = load_joint_map("mini_pupper_2").per_servo()
    bus.joint_names, bus._by_id = bus.joint_map.joint_names, np.array(bus.joint_map.ids) - 1
    bus._socket, bus._supply_v, bus._supply_s = None, None, -np.inf
    bus._exchange = lambda request: answers[request[1]]

    def voltage(present: float) -> np.ndarray:
        bus._supply_s = -np.inf  # it is asked for twice a second
        answers[esp32.GET_POWER] = struct.pack("<BB2f", 10, esp32.GET_POWER, present, 0.5)
        return bus.read().voltage_v

    assert voltage(7.5) == pytest.approx(7.5)
    assert np.isnan(voltage(volts)).all()
    assert voltage(7.5) == pytest.approx(7.5)
