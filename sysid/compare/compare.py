"""Compare servo models on recordings: the same free run, the same readings, side by side.

Models are folders of `fit-servo` and calibrations. Each predicts the readings of the recording's
bus, their age and their offset (`sysid.compare.readings`), by one rule for all. Beside them stand a
linear filter fitted to the recording's other groups, persistence, and the robot's repeatability. A
note names models that were fitted to a recording they are compared on.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    is_shipped,
    load_calibration,
)
from pupper_sysid.servo_models.cards.files import card_names
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.servo_file import SavedModel, load_servo_model
from pupper_sysid.sysid.compare.comparison import (
    ComparedModel,
    Comparison,
)
from pupper_sysid.sysid.compare.readings import (
    age_spread_rad,
    as_rows,
    calibrated_run,
    reading_rules,
    run_with_offset,
    shown,
    with_ages,
)
from pupper_sysid.sysid.compare.runs import RunComparison, compare_runs, refuse_missing_joints
from pupper_sysid.sysid.compare.under_load import needs_runs
from pupper_sysid.sysid.doctor.checks import cautions
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.recordings.joints import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    usable_trials,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR, ModelScores
from pupper_sysid.sysid.servo_fit.windows import everything, grouped, merged_groups, only, samples


def compare(
    recordings: Recordings,
    models: Sequence[str | Path | Calibration | ServoFit],
    joints: Joints = None,
    readings: str = "auto",
    seed: int = 0,
    lattices: Mapping[str, PollLattice] | None = None,
) -> Comparison:
    """Run servo models over recordings and score them on the same readings.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        At one rate.
    models : sequence of str, Path, Calibration or ServoFit
        Models, or names of servo model folders, calibration files and presets. Where the
        recordings do not show the poll of their bus, that of the first calibration is used.
    joints : str or sequence of str, optional
        By default all that were recorded.
    readings : {"auto", "fresh", "all"}
        Which readings count, see `sysid.servo_fit.data`.
    seed : int
        Of the bootstrap.
    lattices : mapping of joint to PollLattice, optional
        Poll of the same recordings, if it has been found already.

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
    calibrations = _calibrations(models)
    for name, calibration in calibrations.items():  # before the work, not after it
        refuse_missing_joints(calibration, name, names)
    trials = usable_trials(recordings, names)
    if needs_runs(recordings, names, list(calibrations.values())):
        found = compare_runs(recordings, calibrations, names, seed, lattices)
        return _with_learned(found, recordings, models, names, readings, seed, lattices)
    data = merged_groups(servo_data(recordings, names, readings, seed, lattices))
    opened, fitted_to = _opened(models, data, recordings)
    notes = [text for joint in names for text in cautions(joint, trials[joint])] + fitted_to
    if presets := [str(given) for given in models if str(given) in PRESETS]:
        notes.append(
            f"{', '.join(presets)}: published with ideal feedback. Where its delay stands for the "
            "age of readings, too, that age counts twice here."
        )
    known = {name: found.calibration for name, found in opened.items() if found.calibration}
    rules = reading_rules(data, ", ".join(r.name for r in recordings), known)
    data = with_ages(data, rules)
    made, tracks = _scored(opened, data, seed)
    tracks[LINEAR], errors = _linear(data, seed)
    made[LINEAR] = ComparedModel.scored(ModelScores.of(errors, seed), {}, {})
    return Comparison(
        models=made,
        readings=rules,
        persistence_rmse_rad=scores.persistence(data, everything),
        repeatability_rad=scores.repeatability(data, everything),
        time_step_s=data.period_s, notes=tuple(notes), data=data, tracks=tracks,
        bands={name: found.band for name, found in opened.items() if found.band},
    )  # fmt: skip


def _with_learned(
    found: RunComparison,
    recordings: Sequence[Recording],
    models: Sequence[str | Path | Calibration | ServoFit],
    joints: Sequence[str],
    readings: str,
    seed: int,
    lattices: Mapping[str, PollLattice] | None,
) -> RunComparison:
    """A comparison under load with the models of fit-servo and the linear filter beside.

    They know neither gain nor load: each run is predicted from its commands alone.
    """
    learned = [m for m in models if isinstance(m, ServoFit) or _is_folder(m)]
    try:
        data = merged_groups(servo_data(recordings, joints, readings, seed, lattices))
        baseline = _linear(data, seed)[1]
    except InputError as error:
        if learned:
            raise
        note = f"No linear filter beside, it cannot be fitted to these runs: {error}"
        return replace(found, notes=(*found.notes, note))
    opened, notes = _opened(learned, data, recordings)
    if learned and needs_runs(recordings, joints, []):
        notes.append(f"{', '.join(opened)}: knows neither the load nor the P gain of a run.")
    made, _ = _scored(opened, data, seed)
    made[LINEAR] = ComparedModel.scored(ModelScores.of(baseline, seed), {}, {})
    return replace(found, models=found.models | made, notes=(*found.notes, *notes))


def _is_folder(given: str | Path | Calibration) -> bool:
    return not isinstance(given, Calibration) and Path(given).is_dir()


def _scored(
    opened: Mapping[str, _Opened], data: ServoData, seed: int
) -> tuple[dict[str, ComparedModel], dict[str, scores.Tracks]]:
    """Scores and free runs of models on the same readings."""
    made: dict[str, ComparedModel] = {}
    tracks: dict[str, scores.Tracks] = {}
    for name, found in opened.items():
        own = as_rows(data, found.of_rows)
        track, offset = run_with_offset(found.run(own), own)
        errors = scores.errors(found.model, track, own, everything)
        made[name] = ComparedModel.scored(
            ModelScores.of(errors, seed), offset, age_spread_rad(track, own)
        )
        tracks[name] = shown(track, own)
    return made, tracks


def _opened(
    models: Sequence[str | Path | Calibration | ServoFit],
    data: ServoData,
    recordings: Sequence[Recording],
) -> tuple[dict[str, _Opened], list[str]]:
    """Models by label, and which of them were fitted to one of the recordings."""
    opened: dict[str, _Opened] = {}
    notes = []
    inputs = {r.sha256: r.name for r in recordings}
    for given in models:
        found = _open(given, data)
        called = given if isinstance(given, str | Path) else found.name
        name = found.name
        if name in opened:
            name = f"{name} ({called if called != name else len(opened) + 1})"
        opened[name] = found
        notes += [
            f"{called} was fitted to {inputs[h]}: its errors here are too small. Its file "
            "holds those on unseen data."
            for h in found.fitted_to
            if h in inputs
        ]
    return opened, notes


def _calibrations(
    models: Sequence[str | Path | Calibration | ServoFit],
) -> dict[str, Calibration]:
    """Calibrations and cards among the models, by label."""
    found: dict[str, Calibration] = {}
    for given in models:
        if isinstance(given, Calibration):
            calibration, called = given, ""
        elif isinstance(given, ServoFit) or _is_folder(given):
            continue
        elif not _is_calibration(given):
            raise InputError(_unknown(given))
        else:
            calibration, called = load_calibration(given), Path(given).name
        loaded = any(j.under_load for j in calibration.joints.values())
        kind = "servo under load" if loaded else "DelayedPD"
        label = f"{kind} ({called})" if called else kind
        if label in found:
            label = f"{kind} ({given if called else len(found) + 1})"
        found[label] = calibration
    return found


def _is_calibration(given: str | Path) -> bool:
    return is_shipped(given) or Path(given).suffix.lower() in (".yaml", ".yml", ".json")


@dataclass(frozen=True)
class _Opened:
    """A model to compare: a learned one, or a calibration."""

    name: str
    fitted_to: list[str]  # hashes
    model: ServoModel | None = None
    calibration: Calibration | None = None
    band: dict[str, scores.Band] = field(default_factory=dict)
    of_rows: tuple[str, ...] = ()  # joints fitted to rows as logged

    def run(self, data: ServoData) -> Callable[[NDArray[np.float64]], scores.Tracks]:
        """From where each run starts to the model's tracks."""
        if self.calibration:
            return calibrated_run(self.calibration, data)
        model = self.model
        assert model is not None
        return lambda start: scores.tracks(model, data, start)


def _open(given: str | Path | Calibration | ServoFit, data: ServoData) -> _Opened:
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
        return _Opened(
            name, [r.sha256 for r in contract.recordings], saved.model,
            band={j: (c.band_noise_rad, c.band_timing_s) for j, c in contract.joints.items()},
            of_rows=tuple(j for j, mode in contract.readings_counted.items() if mode == "all"),
        )  # fmt: skip
    return _calibrated(load_calibration(given), f"DelayedPD ({path.name})", data)


def _unknown(given: str | Path) -> str:
    """What to say of a model that is none."""
    shipped = (*PRESETS, *card_names())
    near = difflib.get_close_matches(str(given), shipped, n=1)
    advice = (
        f"Did you mean {near[0]}?"
        if near
        else "Make one with `pupper-sysid fit-servo` or `calibrate`."
    )
    return (
        f"{given} is neither a servo model's folder, nor a calibration (.yaml), nor a servo card "
        f"(`pupper-sysid servo list`), nor one of the presets {', '.join(PRESETS)}. {advice}"
    )


def _calibrated(calibration: Calibration, name: str, data: ServoData) -> _Opened:
    refuse_missing_joints(calibration, name, data.joints)
    return _Opened(name, [f.sha256 for f in calibration.inputs], calibration=calibration)


def _linear(data: ServoData, seed: int) -> tuple[scores.Tracks, dict[str, scores.Errors]]:
    """The linear baseline, each group by a filter fitted to the others."""
    # where all rows count it is fitted to them as logged, their age included
    own = as_rows(data, [j for j in data.joints if data.modes[j] == "all"])
    cut, _ = grouped(own, everything)
    ready = samples(cut, everything, past_ticks(data.period_s))
    fit = fit_network("fir", data.joints, data.period_s, ready, seed)
    parts = [
        scores.errors(model, scores.tracks(model, cut), cut, only(group))
        for group, model in fit.held_out.items()
    ]
    return scores.tracks(fit.model, own), scores.pooled(parts)
