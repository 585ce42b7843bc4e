"""Emulated robots behind the real protocols, in this process, for the benchmarks."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hardware.feetech_registers import STS3215
from hardware.joint_map import load_joint_map
from sim.bus_faults import BusFaults
from sim.emulated_robot import RobotSpec, draw_robot
from sim.esp32_emulator import ProxyEmulator
from sim.esp32_socket import ProxySocket
from sim.feetech_emulator import FeetechEmulator
from sim.feetech_pty import FeetechPty
from sim.servo_bench import ServoBench

KINDS = ("feetech", "esp32")


@contextmanager
def served(
    kind: str, seed: int, faults: BusFaults | None = None
) -> Iterator[tuple[FeetechPty | ProxySocket, str, Path]]:
    """A running server of one emulated robot, what to write after --bus, and its folder."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="robot") as name:
        folder = Path(name)
        if kind == "esp32":
            bench = ServoBench(draw_robot(rng), load_joint_map("mini_pupper_2"), rng.spawn(1)[0])
            server = ProxySocket(ProxyEmulator(bench, rng, faults), folder / "socket")
            where = f"esp32:{folder / 'socket'}"
        else:
            # read directly, a servo answers for the very moment: no polls in between, none lost
            robot = draw_robot(rng, RobotSpec(poll_period_s=0.0, loss=0.0, quantum_rad=0.0))
            bench = ServoBench(robot, load_joint_map("sts3215"), rng.spawn(1)[0])
            emulator = FeetechEmulator(bench, STS3215, rng, faults=faults)
            server = FeetechPty(emulator, folder / "servos")
            where = f"feetech:{folder / 'servos'}"
        thread = threading.Thread(target=server.serve, daemon=True)
        thread.start()
        try:
            yield server, where, folder
        finally:
            server.stop()
            thread.join(5.0)
            server.close()
