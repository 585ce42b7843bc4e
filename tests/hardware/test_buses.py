"""What every bus promises, whatever its servos speak: one table of buses, one test per claim."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.hardware import esp32 as esp32_proxy
from pupper_sysid.hardware.bus import header_entries
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.feetech import SCS0009, STS3215, FeetechBus, Series
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from, load_joint_map
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator
from support.servo_servers import (
    LAYOUTS,
    StillBench,
    bench_of,
    on_a_port,
    on_a_socket,
    still_servos,
)
from support.stopwatch import wait_until

STANDING = np.array([0.0, 0.785, -1.57] * 4)


@dataclass
class Line:
    """Emulated servos without physics behind their port or socket."""

    emulator: Any
    open: Callable[..., Any]
    """Opens the bus, with a joint map if one is passed."""
    silence: Callable[[int], object]
    """Makes the servo of an id stop answering."""
    layout: JointMap
    """Of the servos, as the bus uses it by default."""
    unfit_maps: dict[str, JointMap]
    """Maps that do not fit these servos, by words of the refusal."""

    @property
    def bench(self) -> StillBench:
        """Its goals and torques are those that reached the servos."""
        return bench_of(self.emulator)


def edited(preset: str, **changes: Any) -> JointMap:
    """A preset with other entries of its file."""
    return joint_map_from(load_joint_map(preset).file.model_dump(by_alias=True) | changes, "mine")


@contextmanager
def feetech(series: Series) -> Iterator[Line]:
    servos, preset = still_servos(series), LAYOUTS[series.name]
    other = load_joint_map("mini_pupper_2_direct" if series is STS3215 else "sts3215")
    unfit = {
        "holds counts of the robot's proxy": load_joint_map("mini_pupper_2"),
        f"of {other.file.counts} counts; these {series.name} have {series.counts}": other,
    }
    if series is STS3215:
        unfit["is for STS3250 servos; these are STS3215"] = edited(preset, servo="STS3250")
    with on_a_port(servos) as server:
        yield Line(
            servos, lambda *layout: FeetechBus(server.device, 1_000_000, *layout),
            servos.servos.pop, load_joint_map(preset).per_servo(), unfit,
        )  # fmt: skip


class PartlyDeafProxy(ProxyEmulator):
    """A proxy that has heard nothing from some servos yet: their counts are zero."""

    def __init__(self):
        super().__init__(StillBench("mini_pupper_2"), np.random.default_rng(0))
        self.silent: set[int] = set()

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        reply = bytearray(super().answer(request, previous, now))
        for servo in self.silent if request[1] == esp32_proxy.GET_POSITION else ():
            reply[2 * servo : 2 * servo + 2] = b"\0\0"
        return bytes(reply)


@contextmanager
def esp32() -> Iterator[Line]:
    proxy, preset = PartlyDeafProxy(), "mini_pupper_2"
    joints = load_joint_map(preset).file.model_dump(by_alias=True)["joints"]
    beyond = edited(preset, joints=joints | {"RB_hip": joints["RB_hip"] | {"id": 13}})
    unfit = {
        "holds raw counts, and the proxy uses": load_joint_map("mini_pupper_2_direct"),
        "of 4096 counts; the proxy's have 1024": edited("sts3215", frame="proxy"),
        "the proxy drives the servos 1 to 12 together": beyond,
    }
    with tempfile.TemporaryDirectory(prefix="px", dir="/tmp") as folder:  # a socket's path is short
        path = Path(folder) / "s"
        with on_a_socket(proxy, path):
            yield Line(
                proxy, lambda *layout: Esp32Bus(path, *layout), proxy.silent.add,
                load_joint_map(preset).per_servo(), unfit,
            )  # fmt: skip


BUSES: dict[str, Callable[[], Any]] = {
    "STS3215": lambda: feetech(STS3215),
    "SCS0009": lambda: feetech(SCS0009),
    "esp32": esp32,
}


@pytest.fixture(params=BUSES)
def line(request, monkeypatch) -> Iterator[Line]:
    # the servos share this process and a busy machine
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.4)
    monkeypatch.setattr(esp32_proxy, "TIMEOUT_S", 0.3)
    with BUSES[request.param]() as served:
        yield served


def counts_of(bus) -> dict[int, int]:
    """The reading of each servo by its id."""
    return dict(zip(bus.joint_map.ids, bus.read().position_count.tolist(), strict=True))


def test_goals_reach_the_servo_of_their_joint_within_its_limits(line):
    bus, layout = line.open(), line.layout
    near = STANDING + 0.01 * np.arange(12.0)
    expected = np.rint(layout.to_counts(near)).astype(int).tolist()
    assert np.isfinite(bus.write(near).time_s)
    assert wait_until(lambda: len(line.bench.goals) >= 12)
    assert dict(line.bench.goals) == dict(zip(layout.ids, expected, strict=True))
    for angle in (100.0, -100.0):
        line.bench.goals.clear()
        bus.write(np.full(12, angle))
        entries = layout.file.joints.values()
        ends = {e.id: e.limits_counts[int(e.sign * angle > 0)] for e in entries}
        assert wait_until(lambda ends=ends: dict(line.bench.goals) == ends)
    bus.close()


def test_commands_that_are_not_one_finite_angle_per_joint_are_refused_and_nothing_is_sent(line):
    bus = line.open()
    for bad in (np.full(12, np.nan), np.full(12, np.inf), np.zeros(11), np.zeros((1, 12))):
        with pytest.raises(BusError, match="must be 12 finite angles"):
            bus.write(bad)
    bus.close()
    assert line.bench.goals == []


def test_readings_are_those_of_their_joint_and_a_servo_that_is_silent_has_none(line):
    bus = line.open()
    line.bench.counts = {i: 500 + i for i in range(1, 13)}
    assert wait_until(lambda: counts_of(bus) == line.bench.counts)
    sample = bus.read()
    counts = np.array([500 + i for i in line.layout.ids])
    assert sample.position_rad == pytest.approx(line.layout.to_angles(counts))
    line.silence(5)
    assert wait_until(lambda: counts_of(bus)[5] == -1)
    sample = bus.read()
    silent = np.array(line.layout.ids) == 5
    assert np.isnan(sample.position_rad[silent]).all()
    assert sample.position_count[~silent].tolist() == counts[~silent].tolist()
    bus.close()


def test_torque_off_lets_all_go_and_on_holds_them_where_they_are_then(line):
    bus = line.open()
    assert bus.torque(False)
    assert dict(line.bench.torques) == dict.fromkeys(range(1, 13), False)
    line.bench.counts = {i: 520 + i for i in range(1, 13)}  # moved by hand while limp
    assert wait_until(lambda: counts_of(bus) == line.bench.counts)
    line.bench.torques.clear()
    line.bench.goals.clear()
    assert bus.torque(True)
    bus.close()
    assert dict(line.bench.goals) == line.bench.counts
    assert dict(line.bench.torques) == dict.fromkeys(range(1, 13), True)


def test_a_line_that_was_pulled_and_plugged_in_again_is_found_again(line):
    def read() -> np.ndarray:
        return bus.read().position_rad

    bus = line.open()
    assert wait_until(lambda: bool(np.isfinite(read()).all()))
    line.emulator.unplug_for_s = 0.3
    assert wait_until(lambda: bool(np.isnan(read()).all()))
    assert np.isnan(bus.write(STANDING).time_s)
    assert wait_until(lambda: bool(np.isfinite(read()).all()), 5.0)
    assert wait_until(lambda: bool(np.isfinite(bus.write(STANDING).time_s)))
    bus.close()
    bus.close()
    assert np.isnan(read()).all()


def test_a_second_program_is_refused_until_the_first_lets_go_and_does_not_disturb_it(line):
    bus = line.open()
    with pytest.raises(BusError, match=r"[Aa]nother (program|pupper-sysid)"):
        line.open()
    assert wait_until(lambda: min(counts_of(bus).values()) > 0)
    bus.close()
    line.open().close()


def test_a_joint_map_that_does_not_fit_is_refused_and_the_line_is_free_again(line):
    for words, layout in line.unfit_maps.items():
        with pytest.raises(InputError, match=words):
            line.open(layout)
    line.open().close()


def test_the_header_of_a_recording_names_the_bus_its_map_and_how_it_reads(line):
    bus = line.open()
    entries = header_entries(bus)
    bus.close()
    assert entries["readings"] == ("polled" if bus.name == "esp32" else "live")
    about = entries["bus"]
    assert about["name"] == bus.name and about["joint_map"] == line.layout.file.name
    assert about["speed_limit_rad_s"] > 0 and about["real_time"] is True
    assert not about.get("echo"), "no adapter here echoes"
