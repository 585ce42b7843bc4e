"""Registers are judged before the torque is switched on: each fault is named, with its cure."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.dynamixel import DynamixelBus
from pupper_sysid.hardware.feetech import FAMILY, HD1910, SCS0009, STS3215, FeetechBus
from pupper_sysid.hardware.joint_map import joint_map_from
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.serial_servos.scan import scan_line
from pupper_sysid.sim.emulator.serial_line import LineEmulator
from support.command_line import run
from support.servo_servers import (
    bench_of,
    dynamixel_map,
    map_of,
    still_dynamixels,
    still_servos,
)
from support.virtual_line import on_a_virtual_line

IDS = (4, 5)


@pytest.fixture
def lines(tmp_path) -> Iterator[dict]:
    """A line of each family: a test changes registers."""
    lines = (still_servos(STS3215, IDS), still_servos(SCS0009, IDS), still_dynamixels(IDS))
    with on_a_virtual_line(tmp_path, *lines) as devices:
        yield {
            servos.series.name: (servos, device)
            for servos, device in zip(lines, devices, strict=True)
        }


@contextmanager
def set_to(servos: LineEmulator, servo: int, **registers: int) -> Iterator[None]:
    """Registers of a servo for the block."""
    kept = bytes(servos.servos[servo].memory)
    for name, value in registers.items():
        servos._set(servo, name, value)
    bench_of(servos).torques.clear()
    bench_of(servos).goals.clear()
    try:
        yield
    finally:
        servos.servos[servo].memory[:] = kept


def refusal(device: str, series) -> str:
    """Sentence with which the torque is refused."""
    if series.name.startswith("XL"):
        bus = GuardedBus(DynamixelBus(device, 1_000_000, dynamixel_map(*IDS)))
    else:
        bus = GuardedBus(FeetechBus(device, 1_000_000, map_of(*IDS, series=series)))
    try:
        with pytest.raises(BusError) as refused:
            bus.torque(True)
    finally:
        bus.close()
    return str(refused.value)


CASES = [
    ("STS3215", {"mode": 1}, "mode (address 33) is 1: wheel mode", "Write 0 into mode"),
    ("STS3215", {"mode": 2}, "mode (address 33) is 2: PWM mode", "Write 0 into mode"),
    ("STS3215", {"mode": 9}, "mode (address 33) is 9: a mode that is not known", "Write 0"),
    ("STS3215", {"max_angle": 0}, "min_angle and max_angle (address 9, 11) is 0", "0 and 4095"),
    ("STS3215", {"max_angle": 2100}, "max_angle (address 11) is 2100", "limits_counts"),
    ("STS3215", {"min_angle": 1900}, "min_angle (address 9) is 1900", "limits_counts"),
    ("STS3215", {"homing_offset": 2047, "phase": 28}, "homing_offset (address 31) is 2047",
     "Write 0 into homing_offset"),
    ("STS3215", {"response_level": 0}, "response_level (address 8) is 0", "Write 1"),
    ("SCS0009", {"min_angle": 0, "max_angle": 0}, "with both at 0 the servo is a wheel",
     "Write 0 and 1023"),
    ("SCS0009", {"max_angle": 520}, "max_angle (address 11) is 520", "limits_counts"),
    ("SCS0009", {"response_level": 0}, "response_level (address 8) is 0", "Write 1"),
    ("XL330-M288", {"secondary_id": 5}, "secondary_id (address 12) is 5", "Write 255"),
    ("XL330-M288", {"operating_mode": 1}, "operating_mode (address 11) is 1: velocity mode",
     "Write 3 into operating_mode"),
    ("XL330-M288", {"operating_mode": 0}, "operating_mode (address 11) is 0: current mode",
     "Write 3 into operating_mode"),
    ("XL330-M288", {"max_position_limit": 2100}, "max_position_limit (address 48) is 2100",
     "limits_counts"),
    ("XL330-M288", {"min_position_limit": 0, "max_position_limit": 0},
     "min_position_limit and max_position_limit (address 52, 48) is 0", "0 and 4095"),
    ("XL330-M288", {"homing_offset": -2000}, "homing_offset (address 20) is -2000",
     "Write 0 into homing_offset"),
    ("XL330-M288", {"status_return_level": 1}, "status_return_level (address 68) is 1", "Write 2"),
    ("XL330-M288", {"status_return_level": 0}, "status_return_level (address 68) is probably 0",
     "Write 2"),
    ("XL330-M288", {"operating_mode": 4, "homing_offset": 4096}, "present_position",
     "Write 0 into homing_offset"),
]  # fmt: skip


@pytest.mark.parametrize(("series", "registers", "named", "cure"), CASES)
def test_a_servo_that_must_not_be_driven_is_refused_by_its_register(
    lines, series, registers, named, cure
):
    servos, device = lines[series]
    with set_to(servos, 4, **registers):
        sentence = refusal(device, servos.series)
        assert named in sentence and cure in sentence and "LF_hip:" in sentence
        assert "LF_thigh" not in sentence, "the other servo is as it should be"
        assert (4, True) not in bench_of(servos).torques and bench_of(servos).goals == []


@pytest.mark.parametrize("series", ["STS3215", "SCS0009"])
@pytest.mark.parametrize(("volts", "cure"), [(3.3, "Charge the battery"), (16.8, "Switch the")])
def test_a_supply_out_of_range_is_refused_on_either_side(lines, series, volts, cure):
    servos, device = lines[series]
    servos.bench.supply_v = volts
    try:
        sentence = refusal(device, servos.series)
    finally:
        servos.bench.supply_v = 7.4
    assert "present_voltage (address 62)" in sentence and f"{volts:.1f} V" in sentence
    assert cure in sentence and (4, True) not in bench_of(servos).torques


@pytest.mark.parametrize("count", [-44, 4354])
def test_a_count_beyond_the_encoder_is_a_value_and_its_offset_is_named(lines, count):
    servos, device = lines["STS3215"]
    with set_to(servos, 4, homing_offset=int(np.clip(2048 - count, -2047, 2047)), phase=28):
        bench_of(servos).counts[4] = count + servos._get(4, "homing_offset")
        try:
            bus = FeetechBus(device, 1_000_000, map_of(*IDS))
            sample = bus.read()
            remarks = " ".join(bus.remarks())
            bus.close()
            sentence = refusal(device, STS3215)
        finally:
            bench_of(servos).counts[4] = 2048
    assert sample.position_count[0] == count and np.isfinite(sample.position_rad).all()
    assert f"is {count}: outside the encoder's 0 to 4095" in sentence
    assert "homing_offset" in sentence and str(count) in remarks


def test_an_offset_of_a_servo_whose_counts_wrap_is_no_reason_to_refuse(lines):
    servos, device = lines["STS3215"]
    with set_to(servos, 4, homing_offset=1800):
        bench_of(servos).counts[4] = 2048 + 1800
        bus = GuardedBus(FeetechBus(device, 1_000_000, map_of(*IDS)))
        remarks = " ".join(bus.bus.remarks())
        assert "wrap there" in remarks and "if the joint map was made with this offset" in remarks
        assert bus.torque(True)
        bus.close()
        # a map that states the offset was made with it, and a scan has no map
        stated = map_of(*IDS).file.model_dump(by_alias=True)
        stated["joints"]["LF_hip"]["homing_offset"] = 1800
        joints = joint_map_from(stated, "stated").select(["LF_hip", "LF_thigh"])
        plain = FeetechBus(device, 1_000_000, joints)
        assert "homing_offset" not in " ".join(plain.remarks())
        plain.close()
        scanned = scan_line(replace(FAMILY, highest_id=6), device, 1_000_000).servos
        assert [servo.faults for servo in scanned] == [(), ()]
        bench_of(servos).counts[4] = 2048


def test_ramps_are_said_and_are_in_the_header(lines):
    servos, device = lines["STS3215"]
    with set_to(servos, 4, acceleration=254, goal_speed=400):
        bus = FeetechBus(device, 1_000_000, map_of(*IDS))
        remarks, setup = bus.remarks(), bus.servo_setups()["LF_hip"]
        bus.refuse_unfit()
        bus.close()
    assert any("acceleration (address 41) is 254" in r and "39.0 rad/s²" in r for r in remarks)
    assert any("goal_speed (address 46) is 400" in r and "0.61 rad/s" in r for r in remarks)
    # 254 units of 100 counts/s², 400 counts/s; 4096 counts are a turn
    assert setup["set_point_acceleration_rad_s2"] == pytest.approx(25_400 * 2 * np.pi / 4096, 1e-4)
    assert setup["set_point_speed_rad_s"] == pytest.approx(400 * 2 * np.pi / 4096, 1e-4)
    assert setup["registers"]["acceleration"] == 254


@pytest.mark.parametrize("series", [STS3215, SCS0009, None])
def test_two_servos_of_one_id_are_named_instead_of_the_cables(tmp_path, series):
    ids, bus = (4, 5, 6), FeetechBus if series else DynamixelBus
    if series:
        servos, layout = still_servos(series, ids, doubled=[5]), map_of(*ids, series=series)
    else:
        servos, layout = still_dynamixels(ids, doubled=[5]), dynamixel_map(*ids)
    with (
        on_a_virtual_line(tmp_path, servos) as (device,),
        pytest.raises(BusError, match="two servos") as refused,
    ):
        bus(device, 1_000_000, layout)
    assert "id 5 (register id)" in str(refused.value) and "another id" in str(refused.value)
    assert (5, True) not in bench_of(servos).torques


def test_two_servos_of_one_id_whose_pings_never_come_through_are_named_as_well(tmp_path):
    servos = still_dynamixels((4, 5), doubled=[5])
    servos._rng = SimpleNamespace(integers=lambda low, high: high - 1)  # one clock always is late
    with (
        on_a_virtual_line(tmp_path, servos) as (device,),
        pytest.raises(BusError, match="two servos .* id 5"),
    ):
        DynamixelBus(device, 1_000_000, dynamixel_map(4, 5))


def test_without_a_map_servos_of_another_robot_are_never_moved(lines):
    servos, device = lines["STS3215"]
    bench_of(servos).goals.clear()
    for joints in (None, ["LF_thigh"]):
        with pytest.raises(InputError, match="init-robot") as refused:
            FeetechBus(device, 1_000_000, joints=joints)
        assert "ids 4, 5" in str(refused.value) and "scan --bus feetech:" in str(refused.value)
    assert bench_of(servos).goals == []


def test_a_servo_without_a_published_model_number_is_driven_by_the_map_that_names_it(tmp_path):
    servos = still_servos(HD1910, IDS)
    for servo in IDS:
        servos._set(servo, "model", 3333)
        servos.servos[servo].memory[50:52] = bytes([16, 8])  # in use; 21 and 22 are loaded from
    data = map_of(*IDS).file.model_dump(by_alias=True) | {"servo": "HD-1910"}
    layout = joint_map_from(data, "microduck").per_servo().select(["LF_hip", "LF_thigh"])
    with on_a_virtual_line(tmp_path, servos) as (device,):
        with pytest.raises(InputError, match="is for STS3215 servos; these are HLS"):
            FeetechBus(device, 1_000_000, map_of(*IDS))
        bus = GuardedBus(FeetechBus(device, 1_000_000, layout))
        assert bus.torque(True)
        setup = bus.servo_setups()["LF_hip"]
        bus.close()
    assert (setup["model"], setup["p_gain"], setup["d_gain"]) == ("HD-1910", 16, 8)


@pytest.mark.parametrize("kind", ["feetech", "dynamixel"])
@pytest.mark.parametrize("words", ["sweep --freqs 1-8 --joints", "calibrate-joints --joints"])
def test_an_unknown_name_on_a_line_without_a_map_is_blamed_on_the_missing_map(
    capsys, here, kind, words
):
    servos = still_servos(STS3215, IDS) if kind == "feetech" else still_dynamixels(IDS)
    with on_a_virtual_line(here, servos) as (device,):
        bus = f"{kind}:{device}@1000000"
        code, _, err = run(capsys, *words.split(), "pan", "--bus", bus)
        model = servos.series.name.lower()
        assert code and "no joint map says" in err and f"init-robot --servo {model}" in err
        assert "--joint-map" in err and "pupper-sysid scan" in err and "'pan'" not in err
        dynamixel_map(*IDS, model=servos.series.name).save(here / "map.yaml")
        code, _, err = run(
            capsys, *words.split(), "LF_tigh", "--bus", bus, "--joint-map", "map.yaml"
        )
        assert code and "Did you mean LF_thigh?" in err and "no joint map" not in err
    assert bench_of(servos).goals == [] and not any(on for _, on in bench_of(servos).torques)


@pytest.mark.parametrize(
    "servos", [still_dynamixels([4]), still_servos(STS3215, [4]), still_servos(SCS0009, [4])]
)
def test_a_servo_that_lost_its_supply_has_the_registers_with_which_it_was_powered(servos):
    memory = servos.servos[4].memory
    torque = servos.series.register("torque_enable").address
    memory[torque] = 0  # the only change that a power failure makes to an unwritten servo
    powered = bytes(memory)
    servos.brown_out(1.0, 0.5)
    assert bytes(memory) == powered


@pytest.mark.parametrize("series", ["STS3215", "XL330-M288"])
def test_a_servo_of_another_rate_is_named_with_its_rate(lines, series):
    servos, device = lines[series]
    bus_class, chosen = FeetechBus, map_of(*IDS)
    if series != "STS3215":
        bus_class, chosen = DynamixelBus, dynamixel_map(*IDS)
    with set_to(servos, 5, baud=servos.rates.index(115_200)):
        with pytest.raises(BusError, match="At 115200 baud id 5 answers"):
            bus_class(device, joint_map=chosen, joints=["LF_hip", "LF_thigh"])
    with pytest.raises(BusError, match="does not answer at 1000000 baud. Check"):
        whole = map_of(4, 6) if series == "STS3215" else dynamixel_map(4, 6)
        bus_class(device, joint_map=whole, joints=["LF_hip", "LF_calf"])
