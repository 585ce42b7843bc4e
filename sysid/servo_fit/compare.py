"""Compare servo models on recordings: the same free run, the same readings, side by side.

Models are folders of `fit-servo` and calibrations (their DelayedPD, with the feedback's offset). A
linear filter fitted to the recording's other groups stands beside them, "it stays where it was",
and how well the robot repeats itself. A model that was fitted to a recording it is compared on is
said to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import PRESETS, Calibration, load_calibration
from pupper_sysid.servo_models.control_rate import AtControlRate, substeps
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.servo_file import SavedModel, load_servo_model
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.windows import everything, grouped, merged_groups, only, samples

LINEAR = "linear, fitted here"


@dataclass(frozen=True)
class Comparison:
    """Models on the same readings.

    Attributes
    ----------
    tracks : dict of str to Tracks
        Free run of each model.
    errors : dict of str to (dict of str to Errors)
        By model, then joint.
    bands : dict of str to (dict of str to (float, float))
        Noise [rad] and timing [s] of the models that have a predictive band.
    persistence, repeatability : dict of str to float
        Per joint [rad].
    notes : tuple of str
    """

    data: ServoData
    tracks: dict[str, scores.Tracks]
    errors: dict[str, dict[str, scores.Errors]]
    bands: dict[str, dict[str, tuple[float, float]]]
    persistence: dict[str, float]
    repeatability: dict[str, float]
    notes: tuple[str, ...]


def compare(
    recordings: Sequence[Recording],
    joints: Sequence[str],
    models: Sequence[str],
    mode: str = "auto",
    seed: int = 0,
) -> Comparison:
    """Run every model over the recordings.

    Parameters
    ----------
    recordings : sequence of Recording
    joints : sequence of str
    models : sequence of str
        Servo model folders, calibration files or presets.
    mode : {"auto", "fresh", "all"}
        Which readings count, see `sysid.servo_fit.data`.
    seed : int

    Raises
    ------
    InputError
        If a model cannot be read, or is for another rate or other joints.
    """
    data = merged_groups(servo_data(recordings, joints, mode, seed))
    found: dict[str, ServoModel] = {}
    bands, notes = {}, []
    inputs = {r.sha256: r.name for r in recordings}
    for given in models:
        model, name, used, band = _open(given, data)
        if name in found:
            name = f"{name} ({given})"
        found[name] = model
        if band:
            bands[name] = band
        notes += [
            f"{given} was fitted to {inputs[h]}: its errors here flatter it. Its contract has "
            "those on unseen data."
            for h in used
            if h in inputs
        ]
    tracks = {name: scores.tracks(model, data) for name, model in found.items()}
    errors = {
        name: scores.errors(model, tracks[name], data, everything) for name, model in found.items()
    }
    tracks[LINEAR], errors[LINEAR] = _linear(data, seed)
    return Comparison(
        data, tracks, errors, bands, scores.persistence(data, everything),
        scores.repeatability(data, everything), tuple(notes),
    )  # fmt: skip


def to_json(found: Comparison, seed: int) -> dict[str, Any]:
    """Object of `compare --json`."""
    models = {}
    for name, errors in found.errors.items():
        joints = {
            j: {
                "rmse_free_run_rad": scores.rms(e.free_run),
                "rmse_held_rad": scores.rms(e.held),
                "rmse_raw_rad": scores.rms(e.raw),
                "rmse_one_step_rad": scores.rms(e.one_step),
            }
            for j, e in errors.items()
        }
        keys = next(iter(joints.values()))
        mean = {k: float(np.mean([entry[k] for entry in joints.values()])) for k in keys}
        models[name] = {
            "mean": mean | {"rmse_free_run_interval_rad": list(scores.interval(errors, seed))},
            "joints": joints,
        }
    return {
        "models": models,
        "persistence_rmse_rad": found.persistence,
        "repeatability_rad": found.repeatability,
        "time_step_s": found.data.period_s,
        "notes": list(found.notes),
    }


def _open(
    given: str, data: ServoData
) -> tuple[ServoModel, str, list[str], Mapping[str, tuple[float, float]]]:
    """Model, a name for tables, hashes of what it was fitted to, and its band."""
    path = Path(given)
    if path.is_dir():
        saved: SavedModel = load_servo_model(path, data.joints, data.period_s)
        contract = saved.contract
        name = contract.arch.upper() if contract.arch in ("mlp", "lstm", "fir") else contract.arch
        name += " (paper)" if contract.preset == "paper" else ""
        band = {j: (c.band_noise_rad, c.band_timing_s) for j, c in contract.joints.items()}
        return saved.model, name, [r.sha256 for r in contract.recordings], band
    if given in PRESETS or path.suffix.lower() in (".yaml", ".yml"):
        calibration = load_calibration(given)
        label = f"DelayedPD ({given if given in PRESETS else path.name})"
        return (
            calibrated(calibration, data.joints, data.period_s), label,
            [f.sha256 for f in calibration.inputs], {},
        )  # fmt: skip
    raise InputError(
        f"{given} is neither a servo model's folder, nor a calibration (.yaml), nor one of the "
        f"presets {', '.join(PRESETS)}. Make one with `pupper-sysid fit-servo` or `calibrate`."
    )


def calibrated(calibration: Calibration, joints: Sequence[str], period_s: float) -> AtControlRate:
    """DelayedPD of a calibration, one step per command, with the offset of its readings."""
    count = substeps(period_s)
    model = calibration.delayed_pd(joints, period_s / count)
    offset = [calibration.held_feedback(j).offset_rad for j in joints]
    return AtControlRate(model, count, np.array(offset))


def _linear(data: ServoData, seed: int) -> tuple[scores.Tracks, dict[str, scores.Errors]]:
    """The linear baseline, each group by a filter fitted to the others."""
    cut, _ = grouped(data, everything)
    ready = samples(cut, everything, past_ticks(data.period_s))
    fit = fit_network("fir", data.joints, data.period_s, ready, seed)
    parts = [
        scores.errors(model, scores.tracks(model, cut), cut, only(group))
        for group, model in fit.held_out.items()
    ]
    return scores.tracks(fit.model, data), scores.pooled(parts)


def band_half_width(
    band: tuple[float, float], track: NDArray[np.float64], period_s: float
) -> NDArray[np.float64]:
    """Half of the 90 % band about a free run [rad], from its speed."""
    speed = np.gradient(track) / period_s
    return 1.645 * np.sqrt(band[0] ** 2 + (band[1] * speed) ** 2)
