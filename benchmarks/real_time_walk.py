"""Ten minutes of a walk in real time: is every deadline kept, and if not, whose fault is it?

    .venv/bin/python benchmarks/real_time_walk.py --minutes 10

`pupper-sysid emulate esp32 --walking` runs in a process of its own; the shipped LSTM walks it, at
25 Hz on the readings and at 50 Hz through the full LSTM stack (twelve servo networks). Per tick
the driver's own processor time and the time that the hypervisor gave to others ("steal") are kept:
a deadline that was missed while the driver needed less than a period of processor time is the
host's, the emulated robot's on the same machine, or the hypervisor's.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_guarded
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.policies.deploy.assembly import assemble
from pupper_sysid.policies.deploy.commands import constant
from pupper_sysid.policies.deploy.deployment import Tick, deploy
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.network.policy_file import load_policy

POLICY, CALIBRATION = Path("data/samples/policies/lstm"), "data/samples/calibrated.yaml"
_LATE = 1.5  # of a period between two ticks: the one between was left out


def _before_others() -> None:
    """The emulator stands for a robot: what else this machine does must not slow it down."""
    with suppress(PermissionError):
        os.nice(-15)


def stolen_s() -> float:
    """What the hypervisor gave to others, of all processors together."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


class Account:
    """Per tick: when, the driver's processor time so far, and steal so far."""

    def __init__(self, controller):
        self.rows: list[tuple[float, float, float]] = []
        self.steps: list[tuple[float, float]] = []
        inner = controller.step

        def timed(senses):
            wall, busy = time.perf_counter(), time.thread_time()
            decision = inner(senses)
            self.steps.append((time.perf_counter() - wall, time.thread_time() - busy))
            return decision

        controller.step = timed

    def __call__(self, tick: Tick) -> None:
        self.rows.append((tick.elapsed_s, time.thread_time(), stolen_s()))

    def row(self, period_s: float, misses: int) -> str:
        """Missed deadlines by cause, and the controller's step."""
        elapsed, busy, stolen = np.diff(np.array(self.rows), axis=0).T
        late = elapsed > _LATE * period_s
        own = int((late & (busy >= period_s)).sum())
        wall, cpu = 1e3 * np.array(self.steps).T
        steal = 100 * stolen.sum() / (elapsed.sum() * (os.cpu_count() or 1))
        cells = [
            len(self.rows), misses, own, int((late & (stolen > 0)).sum()), f"{steal:.1f}",
            f"{1e3 * np.median(busy):.1f}",
            " / ".join(f"{x:.2f}" for x in np.quantile(wall, [0.5, 0.99])),
            " / ".join(f"{x:.2f}" for x in np.quantile(cpu, [0.5, 0.99])),
        ]  # fmt: skip
        return " | ".join(map(str, cells))


def walk(stack_name: str, rate_hz: float, servo: Path | None, seconds: float, socket: Path) -> str:
    """One walk: its row of the table."""
    stack = replace(STACKS[stack_name], rate_hz=rate_hz)
    layout = load_joint_map("mini_pupper_2")
    parts = assemble(load_policy(POLICY), stack, layout, CALIBRATION, servo)
    account = Account(parts.controller)
    address = parse_address(f"esp32:{socket}")
    with closing(open_guarded(address, layout)) as bus, real_time_priority():
        outcome = deploy(
            bus, bus.bus, parts.controller, constant((0.15, 0.0, 0.0)), seconds,
            socket.with_name(f"{stack_name}.csv"), parts.header, None, [account], force=True,
        )  # fmt: skip
    row = account.row(parts.controller.period_s, outcome.deadline_misses)
    return f"| {stack_name} | {rate_hz:g} | {row} | {outcome.stop_reason} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--servo", type=Path, help="servo model for the LSTM stack")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| stack | Hz | ticks | missed | with a period of own CPU | beside steal | steal % | "
        "CPU per tick ms | step ms p50 / p99 | its CPU ms p50 / p99 | end |"
    )
    print("|" + "---|" * 11)
    runs: list[tuple[str, float, Path | None]] = [("closed-loop", 25.0, None)]
    if options.servo:
        runs.append(("lstm-servo", 50.0, options.servo))
    with tempfile.TemporaryDirectory(prefix="rt") as name:
        socket = Path(name) / "socket"
        emulator = subprocess.Popen(
            [
                sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid",
            "emulate", "esp32", "--walking",
                "--seed", "0", "--socket", socket,
            ],
            stdout=subprocess.DEVNULL, preexec_fn=_before_others,
        )  # fmt: skip
        try:
            while not socket.exists():
                if emulator.poll() is not None:
                    raise SystemExit("the emulated robot did not start.")
                time.sleep(0.1)
            for stack, rate, servo in runs:
                print(walk(stack, rate, servo, 60 * options.minutes, socket), flush=True)
        finally:
            emulator.kill()
            emulator.wait()


if __name__ == "__main__":
    main()
