"""Are lag and dead time of a Dynamixel right, from sweep to calibration?

    .venv/bin/python benchmarks/dynamixel_lag.py --seeds 3

An emulated servo runs in a process of its own behind a pseudo-terminal, at the pace of 1 Mbaud, and
keeps the times of all commands and measurements. `sweep` records tones over the line; the lag of
each tone in the recording is compared with that between the servo's own times. `doctor`, `delay`,
`calibrate` and `compare-truth` follow, and their lag and dead time are compared with the truth.
Registers must be afterwards what they were before. Exits with 1 if a tone's lag is more than 0.3 ms
off, an identified number's interval misses the truth, or a register is not set back.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from pupper_sysid.hardware.dynamixel import SERIES
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.dynamixel import DynamixelEmulator
from pupper_sysid.sim.emulator.pendulum import (
    Pendulum,
    PendulumBench,
    draw_bench,
    dynamixel_bench,
)
from pupper_sysid.sim.emulator.serial_line import SerialPty
from pupper_sysid.sim.robot.robot_map import joint_map_of_servos
from pupper_sysid.sysid.recordings.files import load

PROGRAM = [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_sysid"]
MODELS = ("xl330-m288", "xm430-w350")
TONES_HZ = (1.0, 2.0, 3.0, 4.0, 6.0)
TOLERANCE_S = 3e-4
WIRE_S = 19 * 10 / 1_000_000
"""A sync write of one goal on the wire at 1 Mbaud."""
STATE = ("present", "goal_position", "torque_enable", "moving")
"""Beginnings of the names of registers that a sweep leaves otherwise."""


def serve(model: str, seed: int, folder: Path) -> None:
    """Serve one servo until SIGTERM; then write its times, truth and registers."""
    layout = joint_map_of_servos({"pan": 1}, model).joint_map
    layout.save(folder / "map.yaml")
    rng, spec = np.random.default_rng(seed), dynamixel_bench(model.upper())
    robot = draw_bench(rng, Pendulum(), spec, layout)
    bench = ServoBench(robot, layout, rng, plant=PendulumBench(robot))
    bench.supply_v = spec.supply_v
    series = next(s for s in SERIES.values() if s.name == model.upper())
    servos = DynamixelEmulator(bench, series, rng)
    before = _registers(servos)
    (folder / "a.truth.yaml").write_text(yaml.safe_dump(bench.truth(seed=seed), sort_keys=False))
    server = SerialPty(servos, folder / "line")
    signal.signal(signal.SIGTERM, lambda *_: server.stop())
    print("ready", flush=True)
    with real_time_priority():
        server.serve()
    server.close()
    np.savez(
        folder / "servo.npz",
        commands=np.array([(at, count) for at, _, count in bench.commands]),
        readings=np.array([(at, count) for at, _, count in servos.readings]),
        restored=_registers(servos) == before and not servos._get(1, "torque_enable"),
    )


def _registers(servos: DynamixelEmulator) -> dict[str, int]:
    names = [n for n in servos.series.registers if not n.startswith(STATE)]
    return {name: servos._get(1, name) for name in names}


def phase(times: np.ndarray, values: np.ndarray, frequency_hz: float) -> float:
    """Phase of the tone in samples, by least squares."""
    angle = 2 * np.pi * frequency_hz * times
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=1)
    sine, cosine, _ = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.arctan2(cosine, sine))


def lag_s(
    sent: np.ndarray, command: np.ndarray, read: np.ndarray, position: np.ndarray, hz: float
) -> float:
    """Lag of a tone [s]."""
    turn = phase(sent, command, hz) - phase(read, position, hz)
    return turn % (2 * np.pi) / (2 * np.pi * hz)


def tone_errors(folder: Path) -> list[float]:
    """Error of each tone's recorded lag [s], against the servo's own times."""
    layout = load_joint_map(folder / "map.yaml").per_servo()
    logged = np.load(folder / "servo.npz")
    commands, readings = logged["commands"], logged["readings"]
    errors = []
    for trial in load(folder / "a.csv").trials("pan"):
        here = np.isfinite(trial.position_rad)
        counts = layout.to_counts(trial.command_rad[:, None])[:, 0]
        # the trial's commands among all that arrived, by their counts
        windows = np.lib.stride_tricks.sliding_window_view(commands[:, 1], len(counts))
        first = int(np.argmin(np.abs(windows - np.round(counts)).sum(axis=1)))
        arrived = commands[first : first + len(counts)]
        begin, end = arrived[0, 0], arrived[-1, 0]
        measured = readings[(readings[:, 0] >= begin) & (readings[:, 0] <= end)]
        hz = float(trial.frequency_hz)
        recorded = lag_s(
            trial.send_time_s, counts, trial.read_time_s[here], trial.position_rad[here], hz
        )
        true = lag_s(arrived[:, 0] - WIRE_S, arrived[:, 1], measured[:, 0], measured[:, 1], hz)
        errors.append((recorded - true + 0.5 / hz) % (1 / hz) - 0.5 / hz)
    return errors


def once(model: str, seed: int) -> bool:
    """One servo from sweep to truth; prints its row, and whether all is right."""
    with tempfile.TemporaryDirectory(prefix="lag") as text:
        folder = Path(text)
        server = subprocess.Popen(
            [sys.executable, __file__, "--serve", model, "--seed", str(seed), "--folder", text],
            stdout=subprocess.PIPE,
        )
        assert server.stdout is not None
        server.stdout.readline()
        environment = os.environ | {"XDG_RUNTIME_DIR": text}

        def call(*words: str) -> str:
            return subprocess.run(
                [*PROGRAM, *words], cwd=folder, check=True, capture_output=True, text=True,
                env=environment,
            ).stdout  # fmt: skip

        call(
            "sweep", "--bus", "dynamixel:line@1000000", "--joint-map", "map.yaml", "--freqs",
            ",".join(f"{hz:g}" for hz in TONES_HZ), "--amplitude", "0.15", "--duration", "6",
            "--rate", "100", "--out", "a.csv",
        )  # fmt: skip
        server.terminate()
        server.wait()
        errors = np.array(tone_errors(folder))
        restored = bool(np.load(folder / "servo.npz")["restored"])
        verdict = json.loads(call("doctor", "a.csv", "--json"))
        usable = {joint["verdict"] for joint in verdict["joints"].values()} == {"use"}
        call("delay", "a.csv")
        call("calibrate", "a.csv", "--out", "c.yaml")
        rows = json.loads(call("compare-truth", "a.csv", "c.yaml", "--json"))["quantities"]
        named = {row["quantity"]: row for row in rows}
        identified = [row for row in rows if row["identified"] == "yes"]
        held = sum(row["held"] for row in identified)
        cells = []
        for name in ("lag_s", "dead_time_s"):
            row = named[name]
            off = 1e3 * (row["found"]["value"] - row["truth"])
            half = 1e3 * (row["found"]["high"] - row["found"]["low"]) / 2
            cells.append(f"{1e3 * row['truth']:.2f} | {off:+.2f} ± {half:.2f}")
        worst = np.abs(errors).max()
        print(
            f"| {model} | {seed} | {1e3 * np.median(np.abs(errors)):.2f} | {1e3 * worst:.2f} "
            f"| {' | '.join(cells)} | {held} of {len(identified)} | {'use' if usable else 'no'} "
            f"| {'yes' if restored else 'no'} |",
            flush=True,
        )
        return bool(worst <= TOLERANCE_S and held == len(identified) and usable and restored)


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description="Lag of an emulated Dynamixel.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--model", choices=MODELS)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve, options.seed, options.folder)
        return
    print("| servo | seed | recorded lag off by, ms: median tone | worst | true lag ms | `delay` "
          "off by | true dead time ms | `calibrate` off by | intervals that hold the truth "
          "| doctor | registers as before |")  # fmt: skip
    print("|" + "---|" * 11)
    started = time.monotonic()
    models = [options.model] if options.model else MODELS
    right = [once(model, seed) for model in models for seed in range(options.seeds)]
    load_there = " ".join(f"{x:.1f}" for x in os.getloadavg())
    took = time.monotonic() - started
    print(
        f"\n{sum(right)} of {len(right)} right, in {took:.0f} s. Load of the machine: {load_there}."
    )
    sys.exit(not all(right))


if __name__ == "__main__":
    main()
