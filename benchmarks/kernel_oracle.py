"""Does the compiled simulation change a calibration? Every reported number against NumPy's.

    .venv/bin/python benchmarks/kernel_oracle.py

The three functions of `sysid.identify.candidates.simulation` that run the compiled kernel are
replaced by the definition of the models (`CandidateModel.simulate`, NumPy), and a joint of a short
emulated sweep is calibrated both ways. Printed: the largest difference of a number in units of its
interval's width, and of a score relative to itself; processor time of both.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delay_line import fractional_shift
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.identify import output_error, posterior, search
from pupper_sysid.sysid.identify.calibrate import CalibrationResult, calibrate
from pupper_sysid.sysid.identify.candidates.models import CandidateModel
from pupper_sysid.sysid.identify.candidates.simulation import (
    LONGEST_DEAD_TIME_S,
    TrialData,
    look_up,
)
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.sweep.excitation import parse_frequencies, plan
from pupper_sysid.sysid.sweep.recorder import record

JOINT = "LF_hip"


def tracks(model: CandidateModel, values: NDArray, trial: TrialData) -> NDArray[np.float64]:
    """Positions at step edges by NumPy, shape (steps + 1, candidates)."""
    steps, rest = len(trial.command), int(LONGEST_DEAD_TIME_S / trial.step_s) + 4
    history = np.concatenate([np.zeros(rest), trial.command])[:, None]
    found = np.zeros((steps + 1, len(values)))
    late = values[:, 0] / trial.step_s
    found[1:] = fractional_shift(history, steps, late, np.zeros(len(values), int))
    model.simulate(np.ascontiguousarray(values[:, 1:-1].T), found[1:])
    return found


def residuals(model: CandidateModel, values: NDArray, trials) -> NDArray[np.float64]:
    """As `simulation.residuals`."""
    parts = [np.empty((len(values), 0))]
    for t in trials:
        model_rad = look_up(tracks(model, values, t), t.sample_step).T
        parts.append(model_rad + values[:, -1:] - t.sample_rad)
    return np.concatenate(parts, axis=1)


def free_run(model: CandidateModel, values: NDArray, trials) -> list[NDArray[np.float64]]:
    """As `simulation.free_run`."""
    return [tracks(model, values[None], t)[:, 0] + values[-1] for t in trials]


def moments_if_later(model: CandidateModel, values: NDArray, trial: TrialData, later: NDArray):
    """As `simulation.moments_if_later`."""
    track = tracks(model, values, trial)
    seen = [look_up(track, np.maximum(trial.sample_step - d, 0.0)).T for d in later]
    error = np.stack(seen) - trial.sample_rad
    return error.sum(axis=-1), np.square(error).sum(axis=-1)


def timed(recording) -> tuple[CalibrationResult, float]:
    """A calibration and its processor time [s]."""
    begun = time.process_time()
    return calibrate(recording, [JOINT]), time.process_time() - begun


def main() -> None:
    """Print the comparison."""
    rng = np.random.default_rng(20261122)
    with tempfile.TemporaryDirectory() as folder:
        bus = EmulatedBus(draw_robot(rng), rng)
        record(bus, plan("sine", [JOINT], parse_frequencies("1,2,4")), Path(folder) / "sweep.csv")
        recording = load(Path(folder) / "sweep.csv")
    calibrate(recording, [JOINT])  # compiles
    compiled, fast = timed(recording)
    # half steps are the posterior's; the NumPy models know steps of 2 ms only
    with (
        patch.object(output_error, "residuals", residuals),
        patch.object(output_error, "moments_if_later", moments_if_later),
        patch.object(search, "free_run", free_run),
        patch.object(posterior, "in_half_steps", lambda trials: trials),
    ):
        numpy, slow = timed(recording)
    with patch.object(posterior, "in_half_steps", lambda trials: trials):
        compiled, fast = timed(recording)
    differences, scores = [], []
    for name, one in compiled[JOINT].candidate_models.items():
        other = numpy[JOINT].candidate_models[name]
        for key, p in one.parameters.items():
            width = max(p.high - p.low, 1e-12)
            q = other.parameters[key]
            ends = (p.value - q.value, p.low - q.low, p.high - q.high)
            differences.append((max(map(abs, ends)) / width, f"{name}.{key}"))
        for key in ("rmse_fresh_rad", "rmse_held_rad", "rmse_leave_one_frequency_out_rad"):
            a, b = getattr(one.scores, key), getattr(other.scores, key)
            scores.append((abs(a / b - 1), f"{name}.{key}"))
    print("| | |\n|---|---|")
    print(f"| numbers compared | {len(differences)} parameters, {len(scores)} scores |")
    print(f"| largest difference, share of the interval | {max(differences)[0]:.2g} "
          f"({max(differences)[1]}) |")  # fmt: skip
    print(f"| largest relative difference of a score | {max(scores)[0]:.2g} ({max(scores)[1]}) |")
    print(f"| processor time, compiled and NumPy | {fast:.1f} s, {slow:.1f} s |")


if __name__ == "__main__":
    main()
