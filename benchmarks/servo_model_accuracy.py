"""Servo models on the real walk: error of each kind, time to fit, time per control step.

Fits on loops 0 and 1 of `playback_lstm_25hz.csv`, scores on loop 2 in free run (raw rows, mean of
12 joints); then times one control step of 12 joints and of 1,024 environments x 12 joints on one
thread, beside the bare matrix products of the same layers in the same run.

    .venv/bin/python benchmarks/servo_model_accuracy.py [--paper-lstm]
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.servo_models.command_network import CommandNetwork
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo

REAL = Path(os.environ.get("PUPPER_REAL_DATA", Path(__file__).parents[2] / "shared" / "real"))
SPLIT = Split(
    "trained on loops 0 and 1, tested on 2",
    lambda number, elapsed, group: number < 2,
    lambda number, elapsed, group: number == 2,
)


def median_ms(work, repeats: int = 300) -> float:
    """Median time of a call [ms]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def step_times(model, environments: int) -> tuple[float, float | None]:
    """Median of one step, and of its bare matrix products if it is a feed-forward network [ms]."""
    rng = np.random.default_rng(0)
    command = rng.normal(0, 0.1, (environments, len(model.joints))).astype(np.float32)
    model.reset(command)
    own = median_ms(lambda: model.step(command))
    if not isinstance(model, CommandNetwork):
        return own, None
    p = model.parameters
    x = np.zeros((len(model.joints), model.taps, environments), np.float32)
    first = np.ascontiguousarray(np.swapaxes(p["weight_0"], 1, 2))
    second = np.ascontiguousarray(np.swapaxes(p["weight_1"], 1, 2))

    def products() -> None:
        np.matmul(p["fir"][:, None], x)
        for j in range(len(x)):
            second[j] @ (first[j] @ x[j])

    return own, median_ms(products)


def main() -> None:
    """Run it, print two tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--paper-lstm", action="store_true", help="also the assumed LSTM of the paper"
    )
    options = parser.parse_args()
    recording = load(REAL / "playback_lstm_25hz.csv")
    kinds = [("fir", "default"), ("delayed-pd", "default"), ("mlp", "paper"), ("lstm", "default"),
             ("mlp", "default")]  # fmt: skip
    if options.paper_lstm:
        kinds.append(("lstm", "paper"))
    print("| model | one step | free run | 90 % interval | worst joint | above the robot's own "
          "repeatability | seconds, DelayedPD and linear baseline included |")  # fmt: skip
    print("|---|---|---|---|---|---|---|")
    kept = {}
    for arch, preset in kinds:
        start = time.perf_counter()
        fit = fit_servo(recording, None, arch, preset, SPLIT)
        seconds = time.perf_counter() - start
        kept[arch, preset] = fit.model
        found, floor = fit.rmse_free_run_rad, fit.mean.repeatability_rad
        worst = max(s.rmse_free_run_rad for s in fit.joints.values())
        print(
            f"| {arch}{', as published' if preset == 'paper' else ''} "
            f"| {1e3 * fit.mean.rmse_one_step_rad:.1f} "
            f"| {1e3 * found.value:.1f} | {1e3 * found.low:.1f} … {1e3 * found.high:.1f} "
            f"| {1e3 * worst:.1f} | {1e3 * (found.value - floor):.1f} | {seconds:.0f} |",
            flush=True,
        )
    print("\n| model | environments | one step of 12 joints ms | bare products ms |")
    print("|---|---|---|---|")
    for name, sizes in ((("mlp", "default"), (1, 1024)), (("lstm", "default"), (1,))):
        for environments in sizes:
            own, bare = step_times(kept[name], environments)
            beside = "–" if bare is None else f"{bare:.3f}"
            print(f"| {name[0]} | {environments} | {own:.3f} | {beside} |")


if __name__ == "__main__":
    main()
