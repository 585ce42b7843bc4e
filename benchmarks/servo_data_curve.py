"""How much data does a servo model need? Error against samples, on the emulated robot.

A walking-like command (sums of sines of random frequency, amplitude and phase, 0.5 to 4 Hz) is
played on two joints of the emulated robot in loops that all differ. Models are fitted to
the first so many rows and scored, in free run, on loops that none of them was fitted to. The paper
guesses that its LSTM would overtake its MLP with thousands of samples.

    .venv/bin/python benchmarks/servo_data_curve.py --csv sysid/report/data/servo_data_curve.csv
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from shared import print_rows  # isort: skip

import numpy as np
import pandas as pd
import tyro

from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import ServoModel
from pupper_sysid.servo_models.servo_file import physical_model
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report.sections import MODELS as CURVES
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.fit import delayed_pd_fits
from pupper_sysid.sysid.servo_fit.networks import fit_network, fit_published, past_ticks
from pupper_sysid.sysid.servo_fit.windows import Part, grouped, merged_groups, samples
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S
from pupper_sysid.sysid.sweep.recorder import playback, record

JOINTS = ("LF_hip", "LF_calf")
PERIOD_S, LOOP_ROWS = 0.02, 500
SIZES = (30, 100, 390, 1000, 5000, 20000)
TEST_LOOPS = 6
PUBLISHED_MOST = 1000  # samples; the published number of epochs takes hours beyond
MODELS = (("fir", "default"), ("delayed-pd", "default"), ("mlp", "default"), ("lstm", "default"),
          ("mlp", "paper"), ("lstm", "paper"))  # fmt: skip


def commands(rng: np.random.Generator, loops: int) -> pd.DataFrame:
    """Rows of `loops` loops of LOOP_ROWS commands each."""
    t = PERIOD_S * np.arange(LOOP_ROWS)
    columns: dict[str, list] = {
        "time_s": [],
        "loop": [],
        **{f"{j}_command_rad": [] for j in JOINTS},
    }
    for loop in range(loops):
        columns["time_s"].append(t + loop * (LOOP_ROWS * PERIOD_S + 1.0))
        columns["loop"].append(np.full(LOOP_ROWS, loop))
        for joint in JOINTS:
            f, a = rng.uniform(0.5, 4.0, 5), rng.uniform(0.02, 0.12, 5)
            phase = rng.uniform(0, 2 * np.pi, 5)
            wave = (a * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
            columns[f"{joint}_command_rad"].append(
                DEFAULT_POSE[joint] + wave - wave[0] * np.exp(-t / 0.3)
            )
    return pd.DataFrame({k: np.concatenate(v) for k, v in columns.items()})


def recorded(seed: int, loops: int, folder: Path) -> Recording:
    """The emulated robot's recording of random commands."""
    file = folder / "commands.csv"
    commands(np.random.default_rng(seed), loops).to_csv(file, index=False)
    rng = np.random.default_rng(seed)
    bus = EmulatedBus(draw_robot(rng), rng)
    return load(record(bus, playback(file, list(JOINTS)), folder / "recording.csv"))


def fitted_model(arch: str, preset: str, data: ServoData, part: Part, seed: int) -> ServoModel:
    """One kind of model of every joint, fitted to a part."""
    if preset == "paper":
        return fit_published(arch, data, part, seed)
    if arch == "delayed-pd":
        return physical_model("delayed-pd", delayed_pd_fits(data, [part], seed)[0], data.period_s)
    ready = samples(data, part, past_ticks(data.period_s))
    return fit_network(arch, data.joints, data.period_s, ready, seed).model


def main(seed: int = 0, csv: Path | None = None, sizes: tuple[int, ...] = SIZES) -> None:
    """Print the table, and write it to the file `csv`."""
    last = -(-max(sizes) // LOOP_ROWS)  # first loop of the test
    with tempfile.TemporaryDirectory() as name:
        recording = recorded(seed, last + TEST_LOOPS, Path(name))
    rows = []

    def cells(size: int) -> Iterator[str]:
        loops, rest = divmod(size, LOOP_ROWS)
        stop = LEAD_IN_S + recording.loop_period_s * rest

        def first(number, elapsed, group):
            moving = elapsed >= LEAD_IN_S  # a loop starts with a stretch at rest, which says little
            return moving & ((number < loops) | ((number == loops) & (elapsed < stop)))

        def unseen(number, elapsed, group):
            return number >= last

        data = merged_groups(grouped(servo_data([recording], JOINTS), first)[0])
        yield f"{size:,}"
        for arch, preset in MODELS:
            if preset == "paper" and size > PUBLISHED_MOST:
                yield "–"
                continue
            started = time.perf_counter()
            fit = fitted_model(arch, preset, data, first, seed)
            seconds = time.perf_counter() - started
            errors = scores.errors(fit, scores.tracks(fit, data), data, unseen)
            error = float(np.mean([rms(e.free_run) for e in errors.values()]))
            rows.append(
                {"model": _key(arch, preset), "samples_per_joint": size,
                 "rmse_free_run_rad": error, "fit_s": round(seconds, 1)}
            )  # fmt: skip
            yield f"{1e3 * error:.1f} ({seconds:.0f} s)"

    print_rows(["samples per joint", *(CURVES[_key(*m)][0] for m in MODELS)], map(cells, sizes))
    if csv:
        pd.DataFrame(rows).to_csv(csv, index=False)


def _key(arch: str, preset: str) -> str:
    return arch if preset == "default" else f"{arch} paper"


if __name__ == "__main__":
    tyro.cli(main)
