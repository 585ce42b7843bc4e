"""How well does the control loop keep 50 Hz with twelve servos on a 1 Mbaud line?

The emulated line runs in a process of its own, at the pace of its baud rate and with the servos'
default return delay. The same loop runs first with nothing to do, then with a guarded write and a
read of all servos per tick; the difference is the bus, the rest is the host's scheduler.

    .venv/bin/python benchmarks/loop_jitter.py --seconds 60
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.clock import HostClock
from pupper_sysid.hardware.connect import open_guarded
from pupper_sysid.hardware.loop import FixedRateLoop, real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus

PERIOD_S = 0.02
POSE = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])


def busy(bus: GuardedBus, seconds: float) -> tuple[FixedRateLoop, list[float]]:
    """The loop with a bus: all joints swing. Also how long each tick's exchange took."""
    while not np.isfinite(bus.read().position_rad).all():
        pass
    bus.torque(True)
    loop, spent = FixedRateLoop(bus, PERIOD_S), []
    for elapsed in loop.ticks(seconds):
        begun = bus.now()
        bus.write(POSE + 0.2 * np.sin(2 * np.pi * elapsed) * min(elapsed, 1.0))
        bus.read()
        spent.append(bus.now() - begun)
    return loop, spent


def row(name: str, loop: FixedRateLoop, missing: str, spent: list[float]) -> str:
    """One line of the table."""
    late = loop.jitter
    exchange = f"{1e3 * np.median(spent):.1f}" if spent else "–"
    return (
        f"| {name} | {loop.ticks_done} | {loop.missed_deadlines} | {1e3 * late.quantile(0.5):.3f} "
        f"| {1e3 * late.quantile(0.99):.3f} | {1e3 * late.largest_s:.2f} | {exchange} | {missing} |"
    )


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="jitter") as name, real_time_priority() as priority:
        link = Path(name) / "servos"
        emulator = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "pupper_sysid.cli.programs.pupper_sysid",
                "emulate",
                "feetech",
                "--link",
                str(link),
            ],
            stdout=subprocess.DEVNULL,
        )
        try:
            while not link.exists():
                time.sleep(0.05)
            print("| loop | ticks | missed deadlines | jitter ms: median | p99 | worst "
                  "| exchange ms | missing readings |")  # fmt: skip
            print("|---|---|---|---|---|---|---|---|")
            empty = FixedRateLoop(HostClock(), PERIOD_S, most_misses=10**9)
            for _ in empty.ticks(options.seconds):
                pass
            print(row("empty", empty, "–", []), flush=True)
            bus = open_guarded(parse_address(f"feetech:{link}"))
            try:
                loop, spent = busy(bus, options.seconds)
            finally:
                bus.close()
            print(row("12 servos, 1 Mbaud", loop, str(bus.report.missing), spent))
            print(f"\n{priority}.")
        finally:
            emulator.terminate()
            emulator.wait()


if __name__ == "__main__":
    main()
