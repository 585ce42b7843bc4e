"""What a servo is set to is read once, and what is changed for a while is set back."""

import math
import os
import signal
import subprocess
import sys
import time

import pytest

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.bus import header_entries
from pupper_sysid.hardware.feetech import (
    FAMILY,
    HD1910,
    HLS3625,
    SCS0009,
    SERIES,
    STS3215,
    FeetechBus,
    profile,
)
from pupper_sysid.hardware.joint_map import joint_map_from
from pupper_sysid.hardware.safety.guard import GuardedBus, open_guarded
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.hardware.serial_servos.scan import scan_line
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup
from support.package import ROOT
from support.servo_servers import bench_of, map_of, on_a_port, spare_this_process, still_servos
from support.stopwatch import wait_until


@pytest.fixture
def sts(monkeypatch):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)
    with on_a_port(still_servos(STS3215, ids=[1])) as server:
        yield server


def p_of(server) -> int:
    return server.emulator.servos[1].memory[21]


def test_a_header_has_model_firmware_gains_registers_supply_and_temperature(sts):
    bus = FeetechBus(sts.device, joint_map=map_of(1))
    servos = header_entries(bus)["servos"]
    bus.close()
    # the emulator's settings (sim.emulator.feetech) are those of facts/hardware.md B3
    own = ServoSetup(**servos["RF_hip"])
    assert (own.model, own.firmware) == ("STS3215", "3.9")
    assert (own.p_gain, own.i_gain, own.d_gain) == (32, 0, 32)
    assert own.registers["min_start_force"] == 16 and own.registers["torque_limit"] == 1000
    assert own.registers["acceleration"] == own.registers["goal_speed"] == 0
    assert own.registers["dead_zone_cw"] == own.registers["dead_zone_ccw"] == 1
    assert own.supply_voltage_v == pytest.approx(7.4) and servos["RF_hip"]["temperature_c"] == 27


def test_a_gain_is_set_while_the_guard_exists_and_set_back_by_close(sts):
    guard = GuardedBus(FeetechBus(sts.device, joint_map=map_of(1)))
    guard.set_register("RF_hip", "p", 8)
    guard.set_register("RF_hip", "p", 16)
    assert p_of(sts) == 16
    # the memory is locked again
    assert sts.emulator.servos[1].memory[STS3215.lock_address] == 1
    guard.close()
    assert p_of(sts) == 32


def test_a_register_that_does_not_take_its_value_is_an_error(sts):
    bus = FeetechBus(sts.device, joint_map=map_of(1))
    store, servo = sts.emulator._store, sts.emulator.servos[1]

    def stubborn(servo_id: int, address: int, data: bytes, at: float) -> None:
        before = servo.memory[21]
        store(servo_id, address, data, at)
        servo.memory[21] = before

    sts.emulator._store = stubborn
    with pytest.raises(BusError, match="did not take the value 8"):
        bus.set_register("RF_hip", "p", 8)
    with pytest.raises(InputError, match="no register mode2"):
        bus.set_register("RF_hip", "mode2", 8)
    bus.close()


def test_the_other_series_keeps_its_lock_elsewhere(monkeypatch):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.04)  # of the search at other rates
    with on_a_port(still_servos(SCS0009, ids=[1], baud=500_000)) as server:
        bus = FeetechBus(server.device, joint_map=map_of(1, series=SCS0009))
        bus.line.patience_s = 0.4
        bus.set_register("RF_hip", "p", 20)
        assert bus.register("RF_hip", "p") == 20
        assert server.emulator.servos[1].memory[48] == 1
        assert "torque_limit" not in bus.servo_setups()["RF_hip"]["registers"]
        bus.close()


@pytest.mark.wall_clock
def test_registers_of_servos_that_were_unplugged_are_set_back_once_they_return(sts, monkeypatch):
    spare_this_process(monkeypatch)
    guard = open_guarded(parse_address(f"feetech:{sts.device}"), map_of(1))
    guard.set_register("RF_hip", "p", 8)
    sts.emulator.unplug_for_s = 1.0
    time.sleep(0.1)
    guard.close()
    assert wait_until(lambda: p_of(sts) == 32)


def set_protection(server, **values: int) -> None:
    for name, value in values.items():
        server.emulator._set(1, name, value)


def protection(server) -> dict[str, int]:
    return {name: server.emulator._get(1, name) for name in FACTORY}


FACTORY = {
    "unload_condition": 44, "protective_torque": 20, "protection_time": 200, "overload_torque": 80,
}  # fmt: skip
OFF = {
    "unload_condition": 8, "protective_torque": 100, "protection_time": 0, "overload_torque": 100,
}  # fmt: skip


def test_protections_of_the_factory_or_stronger_are_left_alone(sts):
    own = FACTORY | {"overload_torque": 25, "protective_torque": 10}
    set_protection(sts, **own)
    written, store = [], sts.emulator._store
    sts.emulator._store = lambda servo, at, *rest: (written.append(at), store(servo, at, *rest))
    guard = GuardedBus(FeetechBus(sts.device, joint_map=map_of(1)))
    guard.torque(True)
    guard.close()
    assert protection(sts) == own and min(written) >= STS3215.eeprom_end


def test_the_torque_stays_off_if_a_servo_does_not_take_its_protection(sts):
    set_protection(sts, **OFF)
    servo, store = sts.emulator.servos[1], sts.emulator._store

    def stubborn(servo_id: int, address: int, data: bytes, at: float) -> None:
        store(servo_id, address, data, at)
        servo.memory[19] = OFF["unload_condition"]

    sts.emulator._store = stubborn
    bench_of(sts.emulator).torques.clear()
    guard = GuardedBus(FeetechBus(sts.device, joint_map=map_of(1)))
    with pytest.raises(BusError, match="unload_condition did not take the value 44"):
        guard.torque(True)
    guard.close()
    assert (1, True) not in bench_of(sts.emulator).torques


CHANGED = """
import sys, time
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.safety.guard import open_guarded
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.serial_servos import line
line.REPLY_TIMEOUT_S = 0.1  # the servos share a busy machine with their driver
chosen = load_joint_map("sts3215").per_servo().select(["RF_hip"])
bus = open_guarded(parse_address(sys.argv[1]), chosen)
bus.set_register("RF_hip", "p", 8)
bus.torque(True)
print("changed", flush=True)
time.sleep(60)
"""


@pytest.mark.wall_clock
def test_the_watchdog_sets_registers_and_protections_back_if_the_driver_is_killed(sts):
    set_protection(sts, **OFF)
    process = subprocess.Popen(
        [sys.executable, "-c", CHANGED, f"feetech:{sts.device}"], stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None and process.stdout.readline() == b"changed\n"
    assert p_of(sts) == 8 and protection(sts) == FACTORY
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert wait_until(lambda: protection(sts) == OFF and p_of(sts) == 32)


def hls(**registers: int):
    """An HLS servo, id 4, with a model number that no source has."""
    servos = still_servos(HD1910, [4])
    for name, value in ({"model": 0x7A0A} | registers).items():
        servos._set(4, name, value)
    return servos


def hls_bus(server) -> FeetechBus:
    data = map_of(4).file.model_dump(by_alias=True) | {"servo": "HLS"}
    layout = joint_map_from(data, "an HLS").per_servo().select(["LF_hip"])
    with pytest.MonkeyPatch.context() as patch:  # on a busy machine 3 ms are missed
        patch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)
        return FeetechBus(server.device, 1_000_000, layout)


def test_a_servo_without_a_known_number_is_of_the_series_that_its_firmware_shows():
    servos = hls()
    memory = bytes(servos.servos[4].memory)
    with on_a_port(servos) as server:
        report = scan_line(FAMILY, server.device, 1_000_000).servos[0]
        bus = GuardedBus(hls_bus(server))
        assert bus.bus.servo_setups()["LF_hip"]["model"] == "HLS"
        assert bus.torque(True)
        # address 34 to 36 are gains here, and were three protections of an STS servo
        now = bytes(servos.servos[4].memory)
        assert now[34:40] == memory[34:40] and now[19] == 13
        bus.close()
    assert report.model == "HLS (31242)" and report.gains == (32, 40, 0)


def test_a_lost_answer_does_not_make_the_firmware_of_a_servo_unknown(monkeypatch):
    servos, lost = hls(), []
    receive = servos.receive

    def lossy(data: bytes, now: float, baud: int | None = None) -> list[tuple[float, bytes]]:
        pieces = receive(data, now, baud)
        if b"\x02\x00\x03" in data and not lost:  # a read of the firmware, at address 0
            lost.append(data)
            return []
        return pieces

    monkeypatch.setattr(servos, "receive", lossy)
    with on_a_port(servos) as server:
        bus = hls_bus(server)
        assert bus.servo_setups()["LF_hip"]["model"] == "HLS" and lost
        bus.close()


@pytest.mark.parametrize(
    ("registers", "sentence", "refused"),
    [
        ({"goal_current": 0}, "goal_current (address 44) is 0: the motor gets no current", True),
        ({"goal_speed": 0}, "goal_speed (address 46) is 0: by the vendor's table", False),
        ({"mode": 2}, "mode (address 33) is 2: ", True),
        ({"homing_offset": -3000}, "(its register homing_offset is -3000)", True),
    ],
)
def test_registers_with_which_an_hls_servo_does_not_move_are_judged(registers, sentence, refused):
    servos = hls(phase=16, **registers)
    with on_a_port(servos) as server:
        bus = hls_bus(server)
        remarks = " ".join(bus.remarks())
        assert sentence in remarks and "goal_time" not in remarks
        if refused:
            with pytest.raises(BusError, match="torque was not switched on"):
                GuardedBus(bus).torque(True)
        bus.close()


def test_a_speed_of_the_set_point_is_in_the_unit_of_the_series():
    # counts/s per unit: 1 of STS whose phase says so and of SCS, else 50
    cases = ((STS3215, 12, 1), (STS3215, 8, 50), (HLS3625, 12, 50), (SCS0009, 0, 1))
    for series, phase, counts_s in cases:
        speed = profile(series, {"goal_speed": 20, "phase": phase}).speed_rad_s
        turn = 1024 * 1.2 if series is SCS0009 else 4096
        assert speed == pytest.approx(20 * counts_s * 2 * math.pi / turn)


def test_every_feetech_servo_of_the_vendors_list_has_the_registers_of_its_series():
    # (3, 4) of the memory: number as little endian; LeRobot has 777, 2825, 1284 and 3338
    names = {number: SERIES[number].name for number in (777, 2825, 4 << 8 | 5, 3338)}
    assert names == {777: "STS3215", 2825: "STS3250", 1029: "SCS0009", 3338: "HLS3625"}
    assert SERIES[1029].model == 1284 and SERIES[0x0209].name == "STS3032"
    for series in SERIES.values():
        assert series.has("goal_current") == series.name.startswith("HLS")
        assert series.has("protective_torque") == series.name.startswith(("STS", "HTS"))
        assert series.big_endian == series.name.startswith("SCS")
