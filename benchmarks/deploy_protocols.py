"""Deployment stacks on an emulated robot, in real time, over both protocols.

    .venv/bin/python benchmarks/deploy_protocols.py [--seconds 60] [--servo servo/]

The robot (physics, servos, polls, protocol) runs in a process of its own and writes down where its
trunk really goes; the stack drives it through `deploy`, as `pupper-deploy` does: forward, backward,
left, right, and a turn, `--seconds` each. Printed per stack, protocol and direction: falls, errors,
missed deadlines, the controller's step, and whether the log's replay repeats every action.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import tempfile
import time
from contextlib import closing
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
from emulators import KINDS, walking_servers

from pupper_sysid.cli.commands.model.fit_servo import FitServo
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_guarded
from pupper_sysid.hardware.esp32.bus import Esp32Bus
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.policies.deploy.assembly import assemble, reassemble
from pupper_sysid.policies.deploy.commands import constant
from pupper_sysid.policies.deploy.deployment import deploy
from pupper_sysid.policies.deploy.emulated_walk import walk_once
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.deploy.walk_log import read_walk, replay
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.sysid.recordings.files import RecordingWriter

CALIBRATION = "data/samples/calibrated.yaml"
POLICIES = Path("data/samples/policies")
DIRECTIONS = {
    "forward": (0.15, 0.0, 0.0), "backward": (-0.15, 0.0, 0.0), "left": (0.0, 0.08, 0.0),
    "right": (0.0, -0.08, 0.0), "turn": (0.0, 0.0, 0.4),
}  # fmt: skip
STACK_OF = (("lstm", "lstm-servo"), ("mlp", "mlp-observer"))
SEED = 0
_TRUNK_S = 0.02
_RECORD_S, _FIT_S = 8.0, 6.5


def robot(kind: str, folder: Path, stop) -> None:
    """Serve one walking robot until told to stop, and write down how its trunk moves."""
    with real_time_priority():  # the servers' threads have it, too
        plant, _, _, servers = walking_servers(kind, SEED, folder)
        with (folder / "trunk.csv").open("w", buffering=1) as file:
            (folder / "ready").touch()
            while not stop.is_set():
                trunk = plant.trunk(servers[0].now())
                moved = (*trunk.velocity_m_s[:2], trunk.yaw_rate_rad_s)
                print(time.monotonic(), *moved, sep=",", file=file)
                time.sleep(_TRUNK_S)
    for server in servers:
        server.stop()


def servo_model(folder: Path, seed: int) -> Path:
    """Servo networks of one robot, from walks of it that were recorded before."""
    policy = load_policy(POLICIES / "lstm")
    recordings = []
    for name, command in DIRECTIONS.items():
        path = folder / f"{name}.csv"
        about = {"bus": {"kind": "emulated walking robot", "coordinates": "servo"}}
        with RecordingWriter(path, about) as rows:
            walk_once(
                policy, STACKS["closed-loop"], command, _RECORD_S, seed, CALIBRATION, rows=rows
            )
            rows.close({})
        recordings.append(path)
    with contextlib.redirect_stdout(io.StringIO()):
        FitServo(
            recordings=tuple(recordings), arch="mlp", out=folder / "servo", json=True,
            train_before=_FIT_S, test_after=_FIT_S,
        ).run()  # fmt: skip
    return folder / "servo"


def drive(kind: str, seconds: float, servo: Path) -> None:
    """All stacks on one served robot; a row of the table each."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder, stop = Path(name), context.Event()
        process = context.Process(target=robot, args=(kind, folder, stop))
        process.start()
        while not (folder / "ready").exists():
            time.sleep(0.05)
        socket = folder / "socket"
        address = parse_address(
            f"esp32:{socket}" if kind == "esp32" else f"feetech:{folder / 'servos'}"
        )
        joint_map = load_joint_map("mini_pupper_2" if kind == "esp32" else "sts3215")
        for policy_name, stack in STACK_OF:
            policy = load_policy(POLICIES / policy_name)
            for direction, command in DIRECTIONS.items():
                log = folder / f"{policy_name}-{stack}-{direction}.csv"
                path = servo if stack == "lstm-servo" else None
                parts = assemble(policy, STACKS[stack], joint_map, CALIBRATION, path)
                ticks: list[float] = []
                with closing(open_guarded(address, joint_map)) as bus, real_time_priority():
                    imu = bus.bus if kind == "esp32" else Esp32Bus(socket)
                    outcome = deploy(
                        bus, imu, parts.controller, constant(command), seconds, log, parts.header,
                        None, [lambda tick, t=ticks: t.append(time.monotonic())],
                    )  # fmt: skip
                    if kind != "esp32":
                        imu.close()
                errors = ["–"] * 3
                if ticks:
                    # the last line may still be in the writing
                    lines = (folder / "trunk.csv").read_text().splitlines()[:-1]
                    trunk = np.array([line.split(",") for line in lines], float)
                    inside = trunk[(trunk[:, 0] >= ticks[0]) & (trunk[:, 0] <= ticks[-1])]
                    away = np.abs(inside[:, 1:] - np.array(command)).mean(axis=0)
                    errors = [f"{e:.3f}" for e in away]
                walk = read_walk(log)
                same = replay(walk, reassemble(policy, walk.header, log)) is None
                steps = outcome.steps
                print(
                    f"| {kind} | {policy_name}, {stack} | {direction} | {outcome.seconds:.0f} | "
                    f"{'yes' if outcome.fell else 'no'} | {' | '.join(errors)} | "
                    f"{outcome.deadline_misses} | {1e3 * steps.quantile(0.5):.2f} | "
                    f"{1e3 * steps.quantile(0.99):.2f} | {'equal' if same else 'differs'} | "
                    f"{outcome.stop_reason} |",
                    flush=True,
                )
        stop.set()
        process.join()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--protocol", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--servo", type=Path, help="servo model of robot 0; fitted if not given")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        servo = options.servo or servo_model(Path(name), SEED)
        print(
            "| protocol | policy, stack | direction | s | fell | forward m/s | sideways m/s | "
            "turn rad/s | misses | step p50 ms | p99 ms | replay | ended |"
        )
        print("|" + "---|" * 13)
        for kind in options.protocol:
            drive(kind, options.seconds, servo)


if __name__ == "__main__":
    main()
