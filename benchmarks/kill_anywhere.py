"""Kill the recorder at random moments: what is lost, is the robot parked, does it go on?

An emulated robot runs in this process behind the real protocol; `pupper-sysid sweep` records from
it, is killed with SIGKILL, and is told to `--resume`, again and again, until the recording is
complete; then the next recording begins. At the end every complete recording is calibrated and
compared with the truth.

    .venv/bin/python benchmarks/kill_anywhere.py --kills 100
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from emulators import KINDS, in_process, served

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.sim.emulator.servos.bench import ServoBench
from pupper_sysid.sysid.identify.calibrate import calibrate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record

JOINT = "LF_hip"
SWEEP = ("sweep", "--joints", JOINT, "--freqs", "2,3,5", "--duration", "3")


def limp(bench: ServoBench) -> bool:
    """Whether the servo that is swept has been let go."""
    return not bench.is_on(JOINT_NAMES.index(JOINT))


def campaign(server, bus: str, folder: Path, kills: int, seed: int) -> dict:
    """Kill `kills` sweeps on one kind of bus."""
    rng = np.random.default_rng(seed)
    bench = server.emulator.bench
    for k in range(len(JOINT_NAMES)):
        bench.torque(k, server.now(), False)
    start = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])
    parked, silence, away, unreadable, complete = [], [], [], 0, []
    path, number, driven = folder / "sweep0.csv", 0, 0
    while len(parked) < kills:
        arguments = ["--resume", str(path)] if path.exists() else ["--bus", bus, "--out", str(path)]
        process = subprocess.Popen(
            [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid", *SWEEP, *arguments],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        # at any moment from the first row or, resumed, from the first torque on
        while (limp(bench) or not path.exists()) and process.poll() is None:
            time.sleep(0.005)
        driven += 1
        wait = float(rng.uniform(0.0, 9.0))
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.kill()
            killed, wall = time.monotonic(), time.time()
            process.wait()
            was_on = not limp(bench)
            while not limp(bench) and time.monotonic() - killed < 10:
                time.sleep(0.002)
            if was_on:
                parked.append(time.monotonic() - killed)
                time.sleep(0.1)  # the last servo is let go a moment after the first
                at = server.now()
                away.append(max(abs(bench.angle(k, at) - start[k]) for k in range(len(start))))
                if path.exists():
                    silence.append(wall - path.stat().st_mtime)
            try:
                if path.exists() and sum(1 for x in path.open() if x[0].isdigit()) > 20:
                    load(path)
            except Exception as error:
                unreadable += 1
                print("unreadable:", path, error)
            time.sleep(0.3)  # its watchdog lets go of the bus
            if not path.exists() or "# completed" not in path.read_text():
                continue
        error = process.stderr.read().decode() if process.stderr else ""
        if process.returncode > 0:
            raise SystemExit(f"{path}: the sweep ended with {process.returncode}: {error}")
        complete.append(path)
        number += 1
        path = folder / f"sweep{number}.csv"
    return {
        "parked": np.array(parked), "silence": np.array(silence), "away": np.array(away),
        "unreadable": unreadable, "complete": complete, "bench": bench, "runs": driven,
    }  # fmt: skip


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bus", choices=KINDS, help="only this one, with all kills")
    options = parser.parse_args()
    kinds = (options.bus,) if options.bus else KINDS
    print(
        "| bus | kills | parked after s: median | worst | rad from where it was found: worst "
        "| last row before the kill s: median | worst | files that do not read "
        "| recordings completed by resuming | their dead time ms | never interrupted, in process |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for kind in kinds:
        with served(kind, options.seed) as (server, bus, folder):
            result = campaign(server, bus, folder, options.kills // len(kinds), options.seed)
            p, s = result["parked"], result["silence"]
            delays = [1e3 * dead_time_s(load(path)) for path in result["complete"]]
            made = plan("sine", [JOINT], [2.0, 3.0, 5.0], duration_s=3.0)
            plain = load(record(in_process(kind, options.seed), made, folder / "plain.csv"))
            print(
                f"| {kind} | {len(p)} | {np.median(p):.2f} | {p.max():.2f} "
                f"| {max(result['away']):.3f} | {np.median(s):.2f} | {s.max():.2f} "
                f"| {result['unreadable']} | {len(delays)} "
                f"| {', '.join(f'{d:.1f}' for d in delays)} | {1e3 * dead_time_s(plain):.1f} |",
                flush=True,
            )


def dead_time_s(recording: Recording) -> float:
    """Dead time of the calibrated model [s]."""
    return calibrate([recording], seed=0)[JOINT].dead_time_s.value


if __name__ == "__main__":
    main()
