"""Dynamixel servos behind guard and watchdog: registers set, verified, and set back."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, SafetyStop
from pupper_sysid.hardware import dynamixel
from pupper_sysid.hardware.dynamixel import TRIGGERED, WATCHDOG_UNITS, DynamixelBus
from pupper_sysid.hardware.lock import notes, write_note
from pupper_sysid.hardware.safety.guard import GuardedBus, GuardLimits
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.sim.emulator.dynamixel import DynamixelEmulator
from pupper_sysid.sim.emulator.serial_line import SerialPty
from support.command_line import ran
from support.servo_servers import (
    bench_of,
    dynamixel_map,
    moving_dynamixel,
    on_a_port,
    still_dynamixels,
)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)


@pytest.fixture(scope="module")
def line():
    servos = still_dynamixels([4, 5])
    with on_a_port(servos) as server:
        yield servos, server.device


def opened(device: str, *ids: int) -> DynamixelBus:
    return DynamixelBus(device, 1_000_000, dynamixel_map(*(ids or (4, 5))))


def test_the_header_has_the_registers_that_shape_the_motion(line):
    servos, device = line
    servos._set(4, "profile_velocity", 100)
    servos._set(4, "profile_acceleration", 50)
    bus = opened(device)
    setup = bus.servo_setups()["LF_hip"]
    remarks = " ".join(bus.remarks())
    bus.close()
    servos._set(4, "drive_mode", 4)  # profiles by time
    bus = opened(device)
    timed = bus.servo_setups()["LF_hip"]
    bus.close()
    assert timed["set_point_duration_s"] == 0.1 and "set_point_speed_rad_s" not in timed
    servos._set(4, "drive_mode", 0)
    servos._set(4, "profile_velocity", 0)
    servos._set(4, "profile_acceleration", 0)
    assert (setup["model"], setup["firmware"]) == ("XL330-M288", "46")
    assert (setup["p_gain"], setup["i_gain"], setup["d_gain"]) == (400, 0, 0)
    # units of the manual: 0.229 rev/min and 214.577 rev/min²
    assert setup["set_point_speed_rad_s"] == pytest.approx(22.9 * 2 * np.pi / 60, 1e-3)
    assert setup["set_point_acceleration_rad_s2"] == pytest.approx(
        50 * 214.577 * 2 * np.pi / 3600, 1e-3
    )
    assert setup["registers"]["operating_mode"] == 3
    assert "profile_velocity (address 112) is 100" in remarks


def test_the_servos_own_watchdog_is_set_or_cleared_with_the_torque_and_off_again_at_the_end(line):
    servos, device = line
    guard = GuardedBus(opened(device))
    assert servos._get(4, "bus_watchdog") == 0
    guard.torque(True)
    assert servos._get(4, "bus_watchdog") == servos._get(5, "bus_watchdog") == WATCHDOG_UNITS
    guard.set_register("LF_hip", "p", 300)
    assert servos._get(4, "position_p_gain") == 300
    guard.close()
    assert (servos._get(4, "bus_watchdog"), servos._get(4, "position_p_gain")) == (0, 400)
    assert bench_of(servos).torques[-1][1] is False
    # one that acted is cleared before the servo is driven
    servos._set(4, "bus_watchdog", TRIGGERED)
    servos.servos[4].stopped = True
    guard = GuardedBus(opened(device))
    assert "bus_watchdog (address 98) is 255" in " ".join(guard.bus.remarks())
    guard.torque(True)
    assert servos._get(4, "bus_watchdog") == WATCHDOG_UNITS and not servos.servos[4].stopped
    guard.close()
    assert servos._get(4, "bus_watchdog") == 0


def test_a_servo_that_has_shut_down_is_refused_and_an_alert_is_named(line):
    servos, device = line
    servos._set(4, "hardware_error_status", 33)
    guard = GuardedBus(opened(device))
    try:
        sample = guard.bus.read()
        with pytest.raises(BusError, match=r"hardware_error_status \(address 70\) is 33"):
            guard.torque(True)
    finally:
        guard.close()
        servos._set(4, "hardware_error_status", 0)
    assert sample.status is not None and sample.status.tolist() == [33, 0]


def test_park_sets_registers_back_of_a_robot_whose_driver_and_watchdog_are_gone(
    line, capsys, tmp_path, monkeypatch
):
    servos, device = line
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    orders = {
        "kind": "dynamixel", "where": device, "baud": 1_000_000, "driver": 2**22 - 2,
        "coordinates": "servo",
        "map": dynamixel_map(4, 5).file.model_dump(mode="json", by_alias=True),
        "registers": {"LF_hip": {"bus_watchdog": 0, "position_p_gain": 400}},
    }  # fmt: skip
    for words in (("park",), ("park", "--bus", f"dynamixel:{device}@1000000")):
        servos._set(4, "bus_watchdog", WATCHDOG_UNITS)
        servos._set(4, "position_p_gain", 300)
        servos._set(4, "torque_enable", 1)
        write_note(orders, ["LF_hip"], 2**22 - 3)
        ran(capsys, *words)
        assert [servos._get(4, n) for n in ("torque_enable", "bus_watchdog")] == [0, 0]
        assert servos._get(4, "position_p_gain") == 400 and notes() == []


@pytest.mark.wall_clock
@pytest.mark.parametrize(("firmware", "request_"), [(44, "sync read"), (46, "fast sync read")])
def test_reading_times_are_those_of_the_measurement_within_0_3_ms(firmware, request_):
    servos = still_dynamixels([4, 5], registers={None: {"firmware": firmware}})
    with on_a_port(servos) as server:
        bus = opened(server.device)
        servos.readings.clear()
        samples, took = [], []
        for _ in range(60):
            began = time.monotonic()
            samples.append(bus.read())
            took.append(time.monotonic() - began)
        # both clocks are the host's, from different starts
        apart_s = bus._start - server._start
        bus.close()
    assert bus.metadata["read_by"] == request_
    for k, servo in enumerate((4, 5)):
        measured = np.array([at for at, which, _ in servos.readings if which == servo])
        times = np.array([sample.time_s[k] for sample in samples]) + apart_s
        error = np.abs(times - measured[: len(times)])
        # a busy host delivers some replies late: those exchanges last longer
        held_up = np.maximum(np.array(took) - 1e-3, 0.0)
        assert np.percentile(error - held_up, 25) < 3e-4


def stop_of(trouble: Callable[[DynamixelEmulator, SerialPty], object]) -> tuple[str, str]:
    """Sentence of the stop that some trouble makes while a servo moves, and its port."""
    servos = moving_dynamixel()
    with on_a_port(servos) as server:
        line = DynamixelBus(server.device, 1_000_000, servos.bench.map.per_servo())
        bus = GuardedBus(line, GuardLimits(astray_rad=9.0))
        bus.torque(True)
        here = bus.read().position_rad
        bus.write(here)
        trouble(servos, server)
        start = bus.now()
        with pytest.raises(SafetyStop) as stopped:
            while (elapsed := bus.now() - start) < 8:
                bus.write(here + 0.4 * np.sin(2 * elapsed))
                bus.sleep_until(start + elapsed + 0.02)
                bus.read()
        bus.close()
    return str(stopped.value), server.device


def test_a_servo_that_a_moment_without_supply_left_limp_is_named_as_limp():
    sentence, _ = stop_of(lambda servos, server: servos.brown_out(server.now(), 0.05))
    assert "Its torque is off although it was switched on" in sentence


def test_an_adapter_that_is_unplugged_is_named_in_one_sentence():
    sentence, device = stop_of(lambda servos, server: setattr(servos, "unplug_for_s", 2.0))
    assert sentence.startswith(f"{device} is gone: the adapter was unplugged")


@contextmanager
def served(**registers: int) -> Iterator[tuple[DynamixelEmulator, SerialPty]]:
    """Three servos; the last with these registers."""
    servos = still_dynamixels([4, 5, 6], registers={6: registers})
    with on_a_port(servos) as server:
        yield servos, server


@pytest.mark.parametrize(
    ("claimed", "real", "request_"),
    [(46, 46, "fast sync read"), (45, 45, "sync read"), (46, 45, "sync read")],
    ids=["all support it", "its firmware is too old", "it does not answer though it should"],
)
def test_servos_are_read_by_one_answer_where_all_support_it_and_the_header_says_so(
    monkeypatch, claimed, real, request_
):
    with served(firmware=real) as (servos, server):
        if claimed != real:
            monkeypatch.setattr(dynamixel, "has_fast_sync_read", lambda series, firmware: True)
            monkeypatch.setattr(servos, "_fast", partial(silenced, servos))
        bus = opened(server.device, 4, 5, 6)
        bench_of(servos).counts.update({4: 2000, 5: 2100, 6: 2200})
        counts, fast = bus.read().position_count, bus.line.fast
        bus.close()
    assert bus.metadata["read_by"] == request_ and counts.tolist() == [2000, 2100, 2200]
    assert (fast == {4, 5, 6}) is (request_ == "fast sync read")


def silenced(servos: DynamixelEmulator, ids: bytes, *request) -> list:
    """The answer that breaks off before the last servo."""
    return DynamixelEmulator._fast(servos, ids, *request)[: len(ids) - 1]


def test_a_servo_that_falls_silent_costs_one_reading_of_those_behind_it_and_comes_back(monkeypatch):
    with served() as (servos, server):
        bus = opened(server.device, 4, 5, 6)
        monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.25)
        bus.line.patience_s = 0.25
        servos._set(5, "status_return_level", 0)
        silent = [np.isfinite(bus.read().position_rad).tolist() for _ in range(3)]
        servos._set(5, "status_return_level", 2)
        bus.read()
        back = bus.read()
        fast = bus.line._was_fast
        bus.close()
    assert silent == [[True, False, False], [True, False, True], [True, False, True]]
    assert fast and np.isfinite(back.position_rad).all()
