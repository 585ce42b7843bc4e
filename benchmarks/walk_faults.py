"""What a fault in the middle of a walk does: how soon the robot is limp, and what the log says.

    .venv/bin/python benchmarks/walk_faults.py

An emulated robot on the ground is walked by `pupper-deploy` in a process of its own, in real time;
two seconds into the walk something happens to it. Printed per protocol and fault: the time until
no servo has torque, and none gets it again (or the walk went on), how much of the last second is
missing in the log, how far the robot is from upright, and the log's last line.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from emulators import KINDS, walking_servers

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.deploy.walk_log import read_walk
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator
from pupper_sysid.sim.emulator.faults import BusFaults

ROOT = Path(__file__).resolve().parents[1]
POLICY, CALIBRATION = ROOT / "data/samples/policies/lstm", ROOT / "data/samples/calibrated.yaml"
_BEGIN_S, _LASTS_S, _PATIENCE_S = 2.0, 3.0, 6.0

Strike = Callable[[Any, list[Any], subprocess.Popen], None]


def _bus(kind: str) -> Strike:
    """A fault of the bus's own kinds, once, lasting."""

    def strike(emulator: Any, servers: list[Any], process: subprocess.Popen) -> None:
        emulator.faults = BusFaults({kind: 1.0}, emulator.faults.rng, lasts_s=_LASTS_S)
        while not emulator.faults.counts:
            time.sleep(0.001)
        emulator.faults = BusFaults({}, emulator.faults.rng, lasts_s=_LASTS_S)

    return strike


def _frozen(joint: str) -> Strike:
    """A servo whose reading stays as it is, although it goes on."""

    def strike(emulator: Any, servers: list[Any], process: subprocess.Popen) -> None:
        k = JOINT_NAMES.index(joint)
        if isinstance(emulator, ProxyEmulator):
            emulator._stuck_until[emulator.bench.map.ids[k] - 1] = np.inf
        else:
            servo = emulator.servos[emulator.bench.map.ids[k]]
            servo.frozen_count = emulator.bench.count(k, servers[0].now())
            servo.frozen_until = np.inf

    return strike


def _imu(emulator: Any, servers: list[Any], process: subprocess.Popen) -> None:
    servers[-1].emulator._imu = lambda now: b""


def _stall(emulator: Any, servers: list[Any], process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.3)
    process.send_signal(signal.SIGCONT)


def _signal(number: int) -> Strike:
    return lambda emulator, servers, process: process.send_signal(number)


FAULTS: dict[str, Strike] = {
    "thigh frozen": _frozen("LF_thigh"), "hip frozen": _frozen("LF_hip"),
    "brown-out": _bus("brown-out"), "unplugged": _bus("unplugged"),
    "IMU lost": _imu, "host stalls 300 ms": _stall, "Ctrl-C": _signal(signal.SIGINT),
    "SIGTERM": _signal(signal.SIGTERM), "SIGKILL": _signal(signal.SIGKILL),
}  # fmt: skip


def walk(kind: str, strike: Strike) -> str:
    """One walk with one fault: a row of the table without its first cells."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plant, bench, emulator, servers = walking_servers(kind, 0, folder)
        bus = f"esp32:{folder}/socket" if kind == "esp32" else f"feetech:{folder}/servos"
        process = subprocess.Popen(
            [
                sys.executable, "-m", "pupper_sysid.cli.programs.pupper_deploy",
            POLICY, "--actuator", CALIBRATION,
                "--bus", bus, "--imu", folder / "socket", "--seconds", "20", "--name", "w",
            ],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        log = folder / "walks/w/walk.csv"
        while not (log.exists() and log.read_text().count("\n") > 50 * _BEGIN_S):
            if process.poll() is not None:
                raise SystemExit(f"the walk over {bus} ended before the fault.")
            time.sleep(0.01)
        begun = time.monotonic()
        strike(emulator, servers, process)
        held = begun
        while time.monotonic() - begun < _PATIENCE_S:
            if any(map(bench.is_on, range(len(JOINT_NAMES)))):
                held = time.monotonic()
            time.sleep(0.002)
        took = held - begun
        upright = plant.trunk(servers[0].now()).upright
        process.send_signal(signal.SIGINT)
        process.wait(10)
        found = read_walk(log)
        for server in servers:
            server.stop()
    end = "goes on" if took > _PATIENCE_S - 0.1 else f"{took:.2f}"
    return (
        f"{end} | {found.senses[-1].elapsed_s:.2f} | {upright:.2f} | "
        f"{found.ended or 'none: the log is whole up to its last tick'}"
    )


def main() -> None:
    """Print the table."""
    print("| protocol | fault | limp after s | last tick s | upright | last line |")
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        for name, strike in FAULTS.items():
            print(f"| {kind} | {name} | {walk(kind, strike)} |", flush=True)


if __name__ == "__main__":
    main()
