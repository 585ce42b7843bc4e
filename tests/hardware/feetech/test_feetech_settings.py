"""What a servo is set to is read once, and what is changed for a while is set back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.bus import header_entries
from pupper_sysid.hardware.connect import open_guarded
from pupper_sysid.hardware.feetech import line as feetech_line
from pupper_sysid.hardware.feetech.bus import FeetechBus
from pupper_sysid.hardware.feetech.registers import SCS0009, STS3215
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup
from support.servo_servers import on_a_port, still_servos

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def sts(monkeypatch):
    monkeypatch.setattr(feetech_line, "REPLY_TIMEOUT_S", 0.04)
    with on_a_port(still_servos(STS3215, ids=[1])) as server:
        yield server


def p_of(server) -> int:
    return server.emulator.servos[1].memory[21]


def test_a_header_has_model_firmware_gains_registers_supply_and_temperature(sts):
    bus = FeetechBus(sts.device)
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
    guard = GuardedBus(FeetechBus(sts.device))
    guard.set_register("RF_hip", "p", 8)
    guard.set_register("RF_hip", "p", 16)
    assert p_of(sts) == 16
    # the memory is locked again
    assert sts.emulator.servos[1].memory[STS3215.lock_address] == 1
    guard.close()
    assert p_of(sts) == 32


def test_a_register_that_does_not_take_its_value_is_an_error(sts):
    bus = FeetechBus(sts.device)
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
    monkeypatch.setattr(feetech_line, "REPLY_TIMEOUT_S", 0.04)
    with on_a_port(still_servos(SCS0009, ids=[1], baud=500_000)) as server:
        bus = FeetechBus(server.device)
        bus.set_register("RF_hip", "p", 20)
        assert bus.register("RF_hip", "p") == 20
        assert server.emulator.servos[1].memory[48] == 1
        assert "torque_limit" not in bus.servo_setups()["RF_hip"]["registers"]
        bus.close()


CHANGED = """
import sys, time
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_guarded
bus = open_guarded(parse_address(sys.argv[1]))
bus.set_register("RF_hip", "p", 8)
print("changed", flush=True)
time.sleep(60)
"""


@pytest.mark.wall_clock
def test_the_watchdog_sets_registers_back_if_the_driver_is_killed(sts):
    process = subprocess.Popen(
        [sys.executable, "-c", CHANGED, f"feetech:{sts.device}"], stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None and process.stdout.readline() == b"changed\n"
    assert p_of(sts) == 8
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    until = time.monotonic() + 8.0
    while p_of(sts) != 32:
        assert time.monotonic() < until, "the gain was not set back"
        time.sleep(0.02)


@pytest.mark.wall_clock
def test_registers_of_servos_that_were_unplugged_are_set_back_once_they_return(sts):
    guard = open_guarded(parse_address(f"feetech:{sts.device}"))
    guard.set_register("RF_hip", "p", 8)
    sts.emulator.unplug_for_s = 2.0
    time.sleep(0.1)
    guard.close()
    until = time.monotonic() + 8.0
    while p_of(sts) != 32:
        assert time.monotonic() < until, "the gain was not set back"
        time.sleep(0.02)
