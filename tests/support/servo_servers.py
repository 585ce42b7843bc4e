"""Emulated servos behind a real port or socket, in a thread of the test that talks to them."""

import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.dynamixel import SERIES as DYNAMIXELS
from pupper_sysid.hardware.feetech import SCS0009, STS3215, Frame, FrameReader, Series
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from, load_joint_map
from pupper_sysid.hardware.safety import watchdog
from pupper_sysid.hardware.safety.guard import GuardedBus, open_guarded
from pupper_sysid.sim.emulator.bench import BusFaults, ServoBench
from pupper_sysid.sim.emulator.dynamixel import DynamixelEmulator
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator, ProxySocket
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.pendulum import (
    BENCH_MAP,
    Pendulum,
    PendulumBench,
    draw_bench,
    dynamixel_bench,
)
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.emulator.serial_line import LineEmulator, SerialPty
from support.stopwatch import wait_until

LAYOUTS = {STS3215.name: "sts3215", SCS0009.name: "mini_pupper_2_direct", "proxy": "mini_pupper_2"}


class StillBench(ServoBench):
    """Servos that stand at the counts they are given, and keep their commands."""

    def __init__(self, layout: str):
        rng = np.random.default_rng(0)
        # the proxy polls; a direct bus measures when it is asked
        spec = RobotSpec(loss=0.0) if layout == LAYOUTS["proxy"] else exact_spec()
        super().__init__(draw_robot(rng, spec), load_joint_map(layout), rng)
        self.id_of_index = {k: i for i, k in self.index_of_id.items()}
        self.counts = {i: self.map.file.counts // 2 for i in self.index_of_id}
        self.loads = dict.fromkeys(self.index_of_id, 0)
        self.goals: list[tuple[int, int]] = []
        """Id and count of every goal."""
        self.torques: list[tuple[int, bool]] = []

    def command(self, index: int, time_s: float, count: int) -> None:
        self.goals.append((self.id_of_index[index], int(count)))

    def torque(self, index: int, time_s: float, on: bool) -> None:
        self.torques.append((self.id_of_index[index], on))

    def count(self, index: int, time_s: float) -> int:
        return self.counts[self.id_of_index[index]]

    def load(self, index: int) -> int:
        return self.loads[self.id_of_index[index]]


class Listening(FeetechEmulator):
    """Servos that keep what they received and sent."""

    def __init__(self, *args, **keywords):
        super().__init__(*args, **keywords)
        self.heard, self.said = b"", b""
        self.bauds: set[int | None] = set()

    def receive(
        self, data: bytes, now: float, baud: int | None = None
    ) -> list[tuple[float, bytes]]:
        pieces = super().receive(data, now, baud)
        self.said += b"".join(piece for _, piece in pieces)
        self.heard += data
        self.bauds.add(baud)
        return pieces


class Scripted(FeetechEmulator):
    """A line with the answers of a test: `answer(request)` gives pieces with their delays."""

    def __init__(self, answer: Callable[[Frame], list[tuple[float, bytes]]]):
        self.answers = answer
        self.unplug_for_s = 0.0
        self.faults = BusFaults({}, np.random.default_rng(0))
        self._requests = FrameReader()

    def receive(
        self, data: bytes, now: float, baud: int | None = None
    ) -> list[tuple[float, bytes]]:
        pieces = [p for frame in self._requests.feed(data) for p in self.answers(frame)]
        return [(now + delay, piece) for delay, piece in pieces]


class ScriptedProxy(ProxyEmulator):
    """A proxy with the answers of a test; None is silence."""

    def __init__(self, answers: Callable[[bytes], bytes | None]):
        self.answers = answers
        self.unplug_for_s = 0.0
        self.faults = BusFaults({}, np.random.default_rng(0))
        self.requests: list[bytes] = []

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        self.requests.append(request)
        return self.answers(request) or b""

    def resend(self, now: float) -> None:
        """See `ProxyEmulator`."""

    def inject_fault(self, now: float) -> str | None:
        return None

    def apply_fault(self, kind: str | None, reply: bytes) -> list[tuple[float, bytes]]:
        return [(0.0, reply)] if reply else []


def exact_spec() -> RobotSpec:
    """A robot with exact, fresh readings."""
    return RobotSpec(
        poll_period_s=0.0, loss=0.0, quantum_rad=0.0, reading_noise_rad=0.0, offset_sd_rad=0.0
    )


def still_servos(
    series: Series = STS3215, ids: Sequence[int] | None = None, **keywords
) -> Listening:
    """Servos without physics."""
    bench = StillBench(LAYOUTS.get(series.name, "sts3215"))
    return Listening(bench, series, np.random.default_rng(0), ids, **keywords)


def map_of(*ids: int, series: Series = STS3215) -> JointMap:
    """Joint map of these servos of the Mini Pupper's layout."""
    whole = load_joint_map(LAYOUTS[series.name]).per_servo()
    servos = dict(zip(whole.joint_names, whole.ids, strict=True))
    return whole.select([joint for joint, servo in servos.items() if servo in ids])


def dynamixel_map(*ids: int, model: str = "XL330-M288") -> JointMap:
    """Joint map of Dynamixel servos in the Mini Pupper's layout."""
    data = map_of(*ids).file.model_dump(by_alias=True) | {"servo": model}
    names = map_of(*ids).joint_names
    data["joints"] = {name: data["joints"][name] for name in names}
    return joint_map_from(data, model).per_servo()


def still_dynamixels(ids: Sequence[int], model: int = 1200, **keywords) -> DynamixelEmulator:
    """Dynamixel servos without physics."""
    bench = StillBench(LAYOUTS[STS3215.name])
    bench.supply_v = 5.0
    rng = np.random.default_rng(0)
    return DynamixelEmulator(bench, DYNAMIXELS[model], rng, ids, **keywords)


def moving_dynamixel(model: int = 1200, registers=None, seed: int = 0) -> DynamixelEmulator:
    """One Dynamixel on a bench, id 1, whose registers act."""
    rng, series = np.random.default_rng(seed), DYNAMIXELS[model]
    data = load_joint_map(BENCH_MAP).file.model_dump(by_alias=True) | {"servo": series.name}
    layout, spec = joint_map_from(data, series.name), dynamixel_bench(series.name)
    robot = draw_bench(rng, Pendulum(), spec, layout)
    bench = ServoBench(robot, layout, rng, plant=PendulumBench(robot))
    bench.supply_v = spec.supply_v
    return DynamixelEmulator(bench, series, rng, registers=registers)


def moving_servos(series: Series = STS3215, **keywords) -> Listening:
    """Servos with physics."""
    rng = np.random.default_rng(0)
    layout = load_joint_map(LAYOUTS[series.name])
    bench = ServoBench(draw_robot(rng, exact_spec()), layout, rng)
    return Listening(bench, series, rng, **keywords)


def bench_of(emulator: LineEmulator | ProxyEmulator) -> StillBench:
    """The bench of servos without physics."""
    assert isinstance(emulator.bench, StillBench)
    return emulator.bench


@contextmanager
def on_a_port(emulator: LineEmulator) -> Iterator[SerialPty]:
    """The servos behind a pseudo-terminal that is there for as long as the block."""
    with tempfile.TemporaryDirectory(prefix="fp") as folder:
        with _served(SerialPty(emulator, Path(folder) / "bus")) as server:
            yield server


@contextmanager
def on_a_socket(emulator: ProxyEmulator, path: Path) -> Iterator[ProxySocket]:
    """The proxy on its socket for as long as the block."""
    with _served(ProxySocket(emulator, path)) as server:
        yield server


@contextmanager
def _served(server):
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join(5)
        server.close()


@contextmanager
def robot_behind(kind: str, folder: Path) -> Iterator[tuple[SerialPty | ProxySocket, str]]:
    """A served robot whose servos are limp, behind `feetech` or `esp32`, and its address."""
    if kind == "feetech":
        with on_a_port(moving_servos()) as server:
            let_go(server)
            yield server, f"feetech:{server.device}"
        return
    rng = np.random.default_rng(3)
    bench = ServoBench(draw_robot(rng), load_joint_map(LAYOUTS["proxy"]), rng.spawn(1)[0])
    with on_a_socket(ProxyEmulator(bench, rng), folder / "s") as server:
        let_go(server)
        yield server, f"esp32:{folder / 's'}"


def switched_on(address: str) -> GuardedBus:
    """The robot at an address, driven by this process: its servos hold where they stand."""
    bus = open_guarded(parse_address(address))
    assert wait_until(lambda: bool(np.isfinite(bus.read().position_rad).all()))
    bus.torque(True)
    return bus


def driver_orders(kind: str, where: str, preset: str, driver: int = 0) -> dict:
    """First message of a driver to its watchdog."""
    return {
        "kind": kind, "where": where, "baud": 1_000_000, "driver": driver, "coordinates": "joint",
        "map": load_joint_map(preset).file.model_dump(mode="json", by_alias=True),
    }  # fmt: skip


def spare_this_process(patch: pytest.MonkeyPatch) -> None:
    """Have watchdogs kill no driver: where a test is the driver, a busy machine can hold it up."""
    unused_id = 2**22 + 1  # above the largest process id of Linux
    patch.setattr(watchdog, "os", SimpleNamespace(**vars(os) | {"getpid": lambda: unused_id}))


def limp(server: SerialPty | ProxySocket) -> bool:
    """Whether no servo has torque."""
    bench = server.emulator.bench
    return not any(bench.is_on(k) for k in bench.index_of_id.values())


def let_go(server: SerialPty | ProxySocket) -> None:
    """Switch all servos off, as after power-on: a driver that misses one does not drive it."""
    bench = server.emulator.bench
    for k in bench.index_of_id.values():
        bench.torque(k, server.now(), False)
