"""Compare servo models on recordings: the same free run, the same readings, side by side.

Models are folders of `fit-servo` and calibrations (their DelayedPD, with the feedback's offset).
Beside them stand a linear filter fitted to the recording's other groups, persistence, and the
robot's repeatability. A note names models that were fitted to a recording they are compared on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.calibration.calibration import PRESETS, Calibration, load_calibration
from pupper_sysid.servo_models.control_rate import AtControlRate, substeps
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.servo_file import SavedModel, load_servo_model
from pupper_sysid.sysid.recordings.joints import Joints, Recordings, as_sequence, chosen_joints
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR, ModelScores
from pupper_sysid.sysid.servo_fit.windows import everything, grouped, merged_groups, only, samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PUBLISHED, FITTED = "DelayedPD, published", "DelayedPD, fitted here"
_TRAIN_SHARE = 2 / 3  # of a recording without loops, in `four_way`


@dataclass(frozen=True, kw_only=True)
class Comparison(Result):
    """Servo models on the same readings.

    Attributes
    ----------
    models : dict of str to ModelScores
    persistence_rmse_rad, repeatability_rad : dict of str to float
        Per joint.
    time_step_s : float
        Time between commands.
    notes : tuple of str
    data : ServoData
    tracks : dict of str to Tracks
        Free run of each model.
    bands : dict of str to (dict of str to Band)
        By model, of those that have a predictive band, then joint.
    """

    models: dict[str, ModelScores]
    persistence_rmse_rad: dict[str, float]
    repeatability_rad: dict[str, float]
    time_step_s: float
    notes: tuple[str, ...]
    data: ServoData = internal()
    tracks: dict[str, scores.Tracks] = internal()
    bands: dict[str, dict[str, scores.Band]] = internal()

    def to_frame(self) -> pd.DataFrame:
        """Scores, one row per joint and model."""
        nothing = (float("nan"), float("nan"))
        rows = []
        for joint in self.data.joints:
            for name, model in self.models.items():
                noise, timing = self.bands.get(name, {}).get(joint, nothing)
                rows.append(
                    {"joint": joint, "model": name}
                    | asdict(model.joints[joint])
                    | {
                        "persistence_rmse_rad": self.persistence_rmse_rad[joint],
                        "repeatability_rad": self.repeatability_rad[joint],
                        "band_noise_rad": noise, "band_timing_s": timing,
                    }
                )  # fmt: skip
        return pd.DataFrame(rows).set_index(["joint", "model"])

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per joint.

        Parameters
        ----------
        joints : sequence of str, optional
            By default all.
        """
        from pupper_sysid.sysid.servo_fit.figures import free_run_figure

        errors = {name: model.errors for name, model in self.models.items()}
        shown = {name: track for name, track in self.tracks.items() if name != LINEAR}
        return free_run_figure(self.data, shown, errors, self.bands, joints)


def compare(
    recordings: Recordings,
    models: Sequence[str | Path | Calibration | ServoFit],
    joints: Joints = None,
    readings: str = "auto",
    seed: int = 0,
) -> Comparison:
    """Run servo models over recordings and score them on the same readings.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        At one rate.
    models : sequence of str, Path, Calibration or ServoFit
        Models, or names of servo model folders, calibration files and presets.
    joints : str or sequence of str, optional
        By default all that were recorded.
    readings : {"auto", "fresh", "all"}
        Which readings count, see `sysid.servo_fit.data`.
    seed : int
        Of the bootstrap.

    Returns
    -------
    Comparison
        Scores and free runs of the models, and of a linear filter fitted here.

    Raises
    ------
    InputError
        If a model cannot be read, or is for another rate or other joints.
    """
    recordings, names = as_sequence(recordings), chosen_joints(recordings, joints)
    data = merged_groups(servo_data(recordings, names, readings, seed))
    found: dict[str, ServoModel] = {}
    bands, notes = {}, []
    inputs = {r.sha256: r.name for r in recordings}
    for given in models:
        model, name, used, band = _open(given, data)
        shown = given if isinstance(given, str | Path) else name
        if name in found:
            name = f"{name} ({shown if shown != name else len(found) + 1})"
        found[name] = model
        if band:
            bands[name] = band
        notes += [
            f"{shown} was fitted to {inputs[h]}: its errors here are too small. Its contract "
            "holds those on unseen data."
            for h in used
            if h in inputs
        ]
    tracks = {name: scores.tracks(model, data) for name, model in found.items()}
    errors = {
        name: scores.errors(model, tracks[name], data, everything) for name, model in found.items()
    }
    tracks[LINEAR], errors[LINEAR] = _linear(data, seed)
    return Comparison(
        models={name: ModelScores.of(own, seed) for name, own in errors.items()},
        persistence_rmse_rad=scores.persistence(data, everything),
        repeatability_rad=scores.repeatability(data, everything),
        time_step_s=data.period_s, notes=tuple(notes), data=data, tracks=tracks, bands=bands,
    )  # fmt: skip


def _open(
    given: str | Path | Calibration | ServoFit, data: ServoData
) -> tuple[ServoModel, str, list[str], dict[str, scores.Band]]:
    """Model, a name for tables, hashes of what it was fitted to, and its band."""
    if isinstance(given, ServoFit):
        if missing := [j for j in data.joints if j not in given.joints]:
            raise InputError(f"The {given.arch} model has no joint {', '.join(missing)}.")
        with TemporaryDirectory() as folder:
            given.save(folder, force=True)
            return _open(folder, data)
    if isinstance(given, Calibration):
        return _calibrated(given, "DelayedPD", data)
    path = Path(given)
    if path.is_dir():
        saved: SavedModel = load_servo_model(path, data.joints, data.period_s)
        contract = saved.contract
        name = contract.arch.upper() if contract.arch in ("mlp", "lstm", "fir") else contract.arch
        name += " (paper)" if contract.preset == "paper" else ""
        band = {j: (c.band_noise_rad, c.band_timing_s) for j, c in contract.joints.items()}
        return saved.model, name, [r.sha256 for r in contract.recordings], band
    if str(given) in PRESETS or path.suffix.lower() in (".yaml", ".yml"):
        return _calibrated(load_calibration(given), f"DelayedPD ({path.name})", data)
    raise InputError(
        f"{given} is neither a servo model's folder, nor a calibration (.yaml), nor one of the "
        f"presets {', '.join(PRESETS)}. Make one with `pupper-sysid fit-servo` or `calibrate`."
    )


def _calibrated(
    calibration: Calibration, name: str, data: ServoData
) -> tuple[ServoModel, str, list[str], dict[str, scores.Band]]:
    model = calibrated(calibration, data.joints, data.period_s)
    return model, name, [f.sha256 for f in calibration.inputs], {}


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


def four_way(
    recording: Recording,
    joints: Sequence[str],
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Compare as the paper does: published DelayedPD, one fitted here, an MLP and an LSTM.

    Each runs free and one step ahead, on readings that none was fitted to: the last loop, or the
    last third of a recording without loops. (The published networks were scored on commands that
    they had been trained on.)

    Parameters
    ----------
    recording : Recording
    joints : sequence of str
    seed : int
    progress : callable, optional
        Called with what is being done and the share of it that is done.

    Raises
    ------
    InputError
        If the recording cannot support a fit.
    """
    split = _split(recording)
    fits: dict[str, ServoFit] = {
        arch: fit_servo(recording, joints, arch, split=split, seed=seed, progress=progress)
        for arch in ("lstm", "mlp")
    }
    mlp = fits["mlp"]
    published = calibrated(load_calibration("paper"), mlp.data.joints, mlp.time_step_s)
    track = scores.tracks(published, mlp.data)
    assert split.test is not None
    errors = scores.errors(published, track, mlp.data, split.test)
    return Comparison(
        models={
            PUBLISHED: scores.ModelScores.of(errors, seed),
            FITTED: mlp.scored["delayed-pd"],
            LINEAR: mlp.scored["linear"],
        }
        | {arch.upper(): fit.scored[arch] for arch, fit in fits.items()},
        persistence_rmse_rad={j: s.persistence_rmse_rad for j, s in mlp.joints.items()},
        repeatability_rad={j: s.repeatability_rad for j, s in mlp.joints.items()},
        time_step_s=mlp.time_step_s,
        notes=mlp.notes,
        data=mlp.data,
        tracks={PUBLISHED: track} | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        bands={},
    )


def _split(recording: Recording) -> Split:
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        return Split.by_trials(numbers[:-1], numbers[-1:])
    end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
    return Split.by_time(end, end)
