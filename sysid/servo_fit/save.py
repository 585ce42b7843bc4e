"""What is kept and told of a servo fit: the folder of the model, and the JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.common.files import versions
from pupper_sysid.servo_models.calibration.calibration import utc_now
from pupper_sysid.servo_models.servo_file import input_names, save_servo_model
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.fit import ServoFit


def save_fit(
    folder: Path, fit: ServoFit, recordings: Sequence[Recording], seed: int, force: bool = False
) -> None:
    """Save the model with its contract: what it was fitted to, how, and how good it is.

    Raises
    ------
    InputError
        If the folder has a model and `force` is not given, or cannot be written.
    """
    found = to_json(fit, 0.0)["joints"]
    save_servo_model(
        folder,
        fit.parameters,
        {
            "arch": fit.arch, "preset": fit.preset, "created": utc_now(),
            "time_step_s": fit.data.period_s,
            "inputs": input_names(fit.parameters, fit.feedback),
            "feedback": fit.feedback, "warm_up": fit.warm_up,
            "joints": {
                j: {
                    "scores": {k: _known(v) for k, v in entry.items() if k.endswith("_rad")},
                    "band_noise_rad": _known(entry["band_noise_rad"]) or 0.0,
                    "band_timing_s": _known(entry["band_timing_s"]) or 0.0,
                    "readings": fit.readings[j],
                }
                for j, entry in found.items()
            },
            "readings_counted": fit.data.modes, "split": fit.split.name,
            "choices": {k: float(v) for k, v in fit.choices.items()},
            "recordings": [{"name": r.name, "sha256": r.sha256} for r in recordings],
            "seed": seed, "versions": versions("torch", "safetensors"),
            "notes": [fit.verdict, *fit.notes],
        },
        force,
    )  # fmt: skip


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def to_json(fit: ServoFit, elapsed_s: float) -> dict[str, Any]:
    """Object of `fit-servo --json`."""
    joints = {j: _joint_json(fit, j) for j in fit.data.joints}
    keys = [k for k, v in next(iter(joints.values())).items() if isinstance(v, float)]
    mean = {k: scores.mean_known([entry[k] for entry in joints.values()]) for k in keys}
    ours, linear = fit.scored[fit.arch], fit.scored["linear"]
    return {
        "arch": fit.arch,
        "preset": fit.preset,
        "elapsed_s": elapsed_s,
        "split": fit.split.name,
        "readings_counted": fit.data.modes,
        "groups": list(fit.data.groups),
        "time_step_s": fit.data.period_s,
        "choices": fit.choices,
        "mean": mean
        | {
            "rmse_free_run_interval_rad": list(ours.interval),
            "linear_interval_rad": list(linear.interval),
            "difference_to_linear_interval_rad": list(fit.difference[1:]),
            "coverage_of_90_percent_band": fit.coverage,
        },
        "joints": joints,
        "verdict": fit.verdict,
        "notes": list(fit.notes),
    }


def _joint_json(fit: ServoFit, joint: str) -> dict[str, float]:
    own = fit.scored[fit.arch].errors[joint]
    noise, timing = fit.band[joint]
    return {
        "rmse_one_step_rad": scores.rms(own.one_step),
        "rmse_free_run_rad": scores.rms(own.free_run),
        "rmse_held_rad": scores.rms(own.held),
        "rmse_raw_rad": scores.rms(own.raw),
        "linear_rmse_rad": fit.scored["linear"].free_run(joint),
        "delayed_pd_rmse_rad": fit.scored["delayed-pd"].free_run(joint),
        "persistence_rmse_rad": fit.persistence[joint],
        "repeatability_rad": fit.repeatability[joint],
        "band_noise_rad": noise,
        "band_timing_s": timing,
    }
