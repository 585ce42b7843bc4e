"""Emulated robots behind the real protocols, in this process, for the benchmarks."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.hardware.feetech.registers import STS3215
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.esp32 import ImuProxy, ProxyEmulator
from pupper_sysid.sim.emulator.esp32_socket import ProxySocket
from pupper_sysid.sim.emulator.faults import BusFaults
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.feetech_pty import FeetechPty
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.emulator.servos.bench import ServoBench
from pupper_sysid.sim.walking.robot import WalkingRobot

KINDS = ("feetech", "esp32")


SPECS = {
    "esp32": RobotSpec(),
    # read directly, a servo answers for the very moment: no polls in between, none lost
    "feetech": RobotSpec(poll_period_s=0.0, loss=0.0, quantum_rad=0.0),
}


def in_process(kind: str, seed: int) -> EmulatedBus:
    """The same robot as `served`, without a protocol and in virtual time."""
    rng = np.random.default_rng(seed)
    robot = draw_robot(rng, SPECS[kind])
    if kind == "feetech":
        robot = replace(robot, spec=replace(SPECS[kind], quantum_rad=2 * np.pi / 4096))
    return EmulatedBus(robot, rng)


@contextmanager
def served(
    kind: str, seed: int, faults: BusFaults | None = None
) -> Iterator[tuple[FeetechPty | ProxySocket, str, Path]]:
    """A running server of one emulated robot, what to write after --bus, and its folder."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="robot") as name:
        folder = Path(name)
        robot = draw_robot(rng, SPECS[kind])
        layout = load_joint_map("mini_pupper_2" if kind == "esp32" else "sts3215")
        bench = ServoBench(robot, layout, rng.spawn(1)[0])
        if kind == "esp32":
            server = ProxySocket(ProxyEmulator(bench, rng, faults), folder / "socket")
            where = f"esp32:{folder / 'socket'}"
        else:
            server = FeetechPty(
                FeetechEmulator(bench, STS3215, rng, faults=faults), folder / "servos"
            )
            where = f"feetech:{folder / 'servos'}"
        thread = threading.Thread(target=server.serve, daemon=True)
        thread.start()
        try:
            yield server, where, folder
        finally:
            server.stop()
            thread.join(5.0)
            server.close()


def hurry() -> None:
    """Real-time priority for the threads that serve: servos are no program on a busy machine."""
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and thread.native_id:
            with suppress(OSError, AttributeError):
                how = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(thread.native_id, how, os.sched_param(10))


def walking_servers(
    kind: str, seed: int, folder: Path
) -> tuple[WalkingRobot, ServoBench, FeetechEmulator | ProxyEmulator, list[Any]]:
    """A robot that stands on the ground behind a real protocol, served by threads.

    Returns its body, its servos, the emulator that answers for them, and the servers: the one of
    the servos first, at `folder`/socket or `folder`/servos; a serial line's IMU is at
    `folder`/socket.
    """
    rng = np.random.default_rng(seed)
    drawn = draw_robot(rng, SPECS[kind])
    own, imu, shown = rng.spawn(3)
    plant = WalkingRobot(drawn, imu)
    layout = load_joint_map("mini_pupper_2" if kind == "esp32" else "sts3215")
    bench = ServoBench(drawn, layout, own, keep_log=False, plant=plant)
    faults = BusFaults.parse("", rng)
    servers: list[Any] = []
    if kind == "esp32":
        emulator = ProxyEmulator(bench, rng, faults)
        servers.append(ProxySocket(emulator, folder / "socket"))
    else:
        emulator = FeetechEmulator(bench, STS3215, rng, faults=faults)
        servers.append(FeetechPty(emulator, folder / "servos"))
        polled = ServoBench(
            draw_robot(np.random.default_rng(seed)), load_joint_map("mini_pupper_2"), shown,
            keep_log=False, plant=plant,
        )  # fmt: skip
        servers.append(ProxySocket(ImuProxy(polled, shown.spawn(1)[0]), folder / "socket"))
    for server in servers:
        threading.Thread(target=server.serve, daemon=True).start()
    return plant, bench, emulator, servers
