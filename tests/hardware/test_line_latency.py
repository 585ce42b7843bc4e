"""How late replies come is measured, and the patience follows; no servo is missed."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pupper_sysid.cli.commands import bus as scan_command
from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.dynamixel import FAMILY as DYNAMIXEL_FAMILY
from pupper_sysid.hardware.feetech import FAMILY, FeetechBus
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.hardware.serial_servos.line import line_remarks, slow_adapter
from pupper_sysid.hardware.serial_servos.scan import scan_line
from pupper_sysid.sim.emulator.serial_line import SerialPty
from support.command_line import json_of, run
from support.servo_servers import map_of, on_a_port, still_dynamixels, still_servos
from support.virtual_line import on_a_virtual_line
from support.virtual_time import VirtualTime


@contextmanager
def behind_adapter(emulator, latency_s: float) -> Iterator[SerialPty]:
    """The servos behind an adapter whose timer has this period."""
    with on_a_port(emulator) as server:
        server.latency_s = latency_s
        yield server


def test_a_slow_adapter_is_waited_for_and_named(tmp_path):
    servos = still_servos(ids=[4, 5, 6])
    with on_a_virtual_line(tmp_path, servos, latency_s=0.016) as (device,):
        bus = FeetechBus(device, 1_000_000, map_of(4, 5, 6))
        said, latency_s = slow_adapter(bus.line), bus.metadata["latency_s"]
        assert bus.line.patience_s > 0.016
        # with less patience the replies of one reading never all come
        assert np.isfinite(bus.read().position_rad).all()
        bus.close()
    # requests right after replies wait for a whole period of the timer
    assert latency_s == pytest.approx(0.016, abs=0.002)
    assert said and "later than bytes and servos need" in said


def test_replies_that_came_while_the_host_was_busy_are_read(tmp_path, monkeypatch):
    servos = still_servos(ids=[4])
    with on_a_virtual_line(tmp_path, servos) as (device,):
        bus = FeetechBus(device, 1_000_000, map_of(4))
        receive = servos.receive

        def busy(data: bytes, now: float, baud: int | None = None) -> list[tuple[float, bytes]]:
            serial_line.time.sleep(0.2)
            return receive(data, now, baud)

        monkeypatch.setattr(servos, "receive", busy)
        assert np.isfinite(bus.read().position_rad).all()
        monkeypatch.setattr(servos, "receive", lambda *_: [])
        assert np.isnan(bus.read().position_rad).all()
        bus.close()


def test_one_reply_that_a_busy_host_took_late_is_no_slow_adapter(monkeypatch):
    with on_a_port(still_servos(ids=[4])) as server:
        bus = FeetechBus(server.device, 1_000_000, map_of(4))
        clock = VirtualTime()
        took_s = iter([0.02])
        monkeypatch.setattr(
            bus.line,
            "model",
            lambda servo: clock.sleep_until(clock.time + next(took_s, 0.0)) or 777,
        )
        with monkeypatch.context() as patch:
            patch.setattr(serial_line, "time", SimpleNamespace(monotonic=clock.now))
            bus.line._measure_latency([4])
        assert slow_adapter(bus.line) is None and bus.line.patience_s > 0.02
        bus.close()


@pytest.mark.slow
@pytest.mark.wall_clock
@pytest.mark.parametrize("latency_ms", [0.2, 1, 3, 6, 16])
@pytest.mark.parametrize("known", [FAMILY, DYNAMIXEL_FAMILY], ids=lambda family: family.name)
def test_no_servo_is_missed_in_20_scans_whatever_the_adapter(known, latency_ms):
    family = replace(known, highest_id=40)
    servos = still_servos() if known is FAMILY else still_dynamixels(range(1, 13))
    with behind_adapter(servos, latency_ms / 1e3) as server:
        listed = [
            [servo.id for servo in scan_line(family, server.device, 1_000_000).servos]
            for _ in range(20)
        ]
    assert listed == [list(range(1, 13))] * 20


@pytest.mark.parametrize("text", [b"boot ok\r\n", b"\xff\xff\x01", b"\xff\xff\xfd\x00"])
@pytest.mark.parametrize("family", [FAMILY, DYNAMIXEL_FAMILY], ids=lambda family: family.name)
def test_a_chatty_adapter_is_no_second_servo_of_an_id(monkeypatch, family, text):
    """Its own firmware writes to the line behind whatever is sent and answered."""
    servos = still_servos(ids=[1, 2]) if family is FAMILY else still_dynamixels([1, 2])
    receive = servos.receive

    def chatty(data: bytes, now: float, baud: int | None = None) -> list[tuple[float, bytes]]:
        pieces = receive(data, now, baud)
        return [*pieces, (pieces[-1][0] if pieces else now, text)]

    monkeypatch.setattr(servos, "receive", chatty)
    register = servos.series.register("present_position")
    with on_a_port(servos) as server:
        line = family.open_line(server.device, 1_000_000, True)
        assert list(line.find([1, 2])) == [1, 2]
        line.garbled[9] = 5  # as after a scan of the gaps between ids
        assert line.doubled([1, 2, 9], register.address, register.size) == []
        assert "bytes come that belong to no reply" in line_remarks(line)[0]
        line.close()


def test_scan_without_a_bus_tries_every_port_and_says_what_answers_where(capsys, monkeypatch):
    with on_a_port(still_servos(ids=[3])) as server, on_a_port(still_servos(ids=[])) as empty:
        ports = [server.device, empty.device]
        monkeypatch.setattr(scan_command, "serial_ports", lambda: ports)
        monkeypatch.setattr(scan_command, "announced_devices", list)
        monkeypatch.setattr(scan_command, "SOCKET", scan_command.Path("/nowhere"))
        for kind in scan_command.KINDS.values():
            if kind.is_serial:
                cls = kind.bus_class()
                small = replace(cls.family, highest_id=4, rates=cls.family.rates[:1])
                monkeypatch.setattr(cls, "family", small)
        report = json_of(capsys, "scan")
        code, out, err = run(capsys, "scan")
    assert report["ports"] == ports and list(report["silent"]) == [empty.device]
    line = report["lines"][0]
    assert line["bus"] == f"feetech:{server.device}" and [s["id"] for s in line["servos"]] == [3]
    assert code == 0 and f"--bus feetech:{server.device}" in out and "nothing answers" in err


def test_what_lies_beside_a_port_is_no_port(monkeypatch, tmp_path):
    with on_a_port(still_servos(ids=[])) as server:
        (tmp_path / "ttyUSB0").symlink_to(server.device)
        (tmp_path / "ttyUSB0.joints.yaml").touch()
        listed = [SimpleNamespace(device=str(path)) for path in tmp_path.iterdir()]
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: listed)
        monkeypatch.setattr(scan_command, "announced_devices", list)
        assert scan_command.serial_ports() == [str(tmp_path / "ttyUSB0")]


def test_scan_without_ports_says_what_to_connect_and_a_boards_port_is_understood(
    capsys, monkeypatch
):
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    monkeypatch.setattr(scan_command, "announced_devices", list)
    monkeypatch.setattr(scan_command, "SOCKET", scan_command.Path("/nowhere"))
    code, _, err = run(capsys, "scan")
    assert code == 1 and "ports: none" in err and "emulate feetech" in err
    assert parse_address("feetech:ttyACM0").where == "/dev/ttyACM0"  # of an SO-101
    with pytest.raises(InputError, match="feetech:/dev/ttyACM0"):
        parse_address("/dev/ttyACM0")
