"""Compare servo models on recordings: the same free run, the same readings, side by side.

Models are folders of `fit-servo`, calibrations and servo cards. A calibration predicts each run as
its file says (`sysid.fit.predict`), independently of the others. Models of `fit-servo` know neither
gain nor load: each run is predicted from its commands alone. Beside them stand a linear filter
fitted to the recording's other groups, persistence, and the robot's repeatability. A note names
models that were fitted to a recording they are compared on. `four_way` compares as the paper does:
a published model, and three fitted here.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.border import refuse_other_kind
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import as_path
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    is_shipped,
    load_calibration,
    preset_notes,
)
from pupper_sysid.servo_models.cards.card import CardCalibration
from pupper_sysid.servo_models.cards.files import card_names
from pupper_sysid.servo_models.delayed_pd import ServoModel
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Joints, Recordings
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit import predict
from pupper_sysid.sysid.fit.calibrate import CalibrationResult
from pupper_sysid.sysid.fit.run import at_steps
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split, fit_servo
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.windows import everything, grouped, merged_groups, only, samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OFFSET_RULE = (
    "Offsets are of this recording: for every model the median of reading minus prediction."
)


@dataclass(frozen=True, kw_only=True)
class Comparison(Result):
    """Servo models on the same readings."""

    models: dict[str, scores.ModelScores]
    readings: dict[str, predict.ReadingRule]
    """By joint, when its readings were measured."""
    persistence_rmse_rad: dict[str, float]
    repeatability_rad: dict[str, float]
    """`persistence_rmse_rad` and `repeatability_rad`: per joint."""
    time_step_s: float
    """Time between commands."""
    notes: tuple[str, ...]
    data: ServoData = internal()
    tracks: dict[str, scores.Tracks] = internal()
    """Readings of each model in free run."""
    bands: dict[str, dict[str, scores.Band]] = internal()
    """By model, of those that have a predictive band, then joint."""
    runs: dict[str, list[predict.ComparedRun]] = internal(default_factory=dict)
    """By joint."""
    run_tracks: dict[str, dict[str, list[NDArray[np.float64]]]] = internal(default_factory=dict)
    """By calibration, then joint: predicted readings at the steps of each run."""

    def to_frame(self) -> pd.DataFrame:
        """Scores, one row per joint and model."""
        nan = float("nan")
        rows = []
        for joint in self.data.joints:
            for name, model in self.models.items():
                noise, timing = self.bands.get(name, {}).get(joint, (nan, nan))
                rows.append(
                    {"joint": joint, "model": name}
                    | asdict(model.joints[joint])
                    | {
                        "offset_rad": model.offset_rad.get(joint, nan),
                        "age_spread_rad": model.age_spread_rad.get(joint, nan),
                        "readings": model.readings.get(joint, self.readings[joint]).rule,
                        "persistence_rmse_rad": self.persistence_rmse_rad[joint],
                        "repeatability_rad": self.repeatability_rad[joint],
                        "band_noise_rad": noise, "band_timing_s": timing,
                    }
                )  # fmt: skip
        return pd.DataFrame(rows).set_index(["joint", "model"])

    def reading_notes(self) -> list[str]:
        """How readings were predicted, one sentence per rule, and which offsets were taken out."""
        known = [j for j, runs in self.runs.items() if all(r.offset_known for r in runs)]
        sentences = (
            [f"{', '.join(known)}: no offset is taken out, the load is known."] if known else []
        )
        if len(known) < len(self.data.joints):
            sentences.append(OFFSET_RULE)
        rules = [self.readings, *(m.readings for m in self.models.values() if m.readings)]
        if len(rules) > 1:  # calibrations say when readings were measured
            rules = rules[1:]
        return list(
            dict.fromkeys(
                [*sentences, *(text for rule in rules for text in predict.in_words(rule))]
            )
        )

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per joint."""
        from pupper_sysid.sysid.report.figures import free_run_figure

        every = [r for runs in self.runs.values() for r in runs]
        gains, loads = {r.run.p_gain for r in every}, [r.trial.load for r in every]
        if not self.data.runs or len(gains) > 1 or any(loads):
            return predict.run_figure(self.runs, self.run_tracks, joints)
        errors = {name: model.errors for name, model in self.models.items()}
        drawn = {name: track for name, track in self.tracks.items() if name != scores.LINEAR}
        return free_run_figure(self.data, drawn, errors, self.bands, joints)


Model = str | Path | Calibration | CalibrationResult | ServoFit
_ENDINGS = (".yaml", ".yml", ".json")  # of calibrations and of BAM's parameter files


def compare(
    recordings: Recordings,
    models: Model | Sequence[Model],
    joints: Joints = None,
    readings: str = "auto",
    seed: int = 0,
    lattices: Mapping[str, PollLattice] | None = None,
) -> Comparison:
    """Run servo models over recordings and score them on the same readings.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Of any rates, gains and loads; models of `fit-servo` need one rate.
    models : str, Path, Calibration, CalibrationResult or ServoFit, or a sequence of such
        Models, or names of servo model folders, calibration files, servo cards and presets. The
        score of each does not depend on the others.
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
    recordings, names = checks.as_sequence(recordings), checks.chosen_joints(recordings, joints)
    models = _each(models)
    calibrations = _calibrations(models)
    for name, calibration in calibrations.items():  # before the work, not after it
        missing = [j for j in names if j not in calibration.joints]
        if missing and not isinstance(calibration, CardCalibration):  # which has every joint
            common = [j for j in names if j not in missing]
            advice = f" Compare on {', '.join(common)} only (`joints`)." if common else ""
            raise InputError(
                f"{name} has no joint {', '.join(missing)}; it has "
                f"{', '.join(calibration.joints)}.{advice}"
            )
    trials = checks.usable_trials(recordings, names)
    learned = [m for m in models if isinstance(m, ServoFit) or _is_folder(m)]
    notes = [text for joint in names for text in checks.cautions(joint, trials[joint])]
    polls = {joint: predict.poll_of(recordings, joint, seed, lattices) for joint in names}
    runs = {joint: predict.compared_runs(recordings, joint, polls[joint]) for joint in names}
    source = ", ".join(r.name for r in recordings)
    predictions: dict[str, dict[str, predict.Prediction]] = {}
    for name, calibration in calibrations.items():
        predictions[name] = {
            joint: predict.predict(
                calibration, joint, runs[joint],
                predict.rule_of(joint, polls[joint], source, {name: calibration}), readings,
            )
            for joint in names
        }  # fmt: skip
    for name, calibration in calibrations.items():
        notes += _fitted_here(name, [file.sha256 for file in calibration.inputs], recordings)
    notes += predict.notes(calibrations, runs)
    scored = {name: _scored(predicted, seed) for name, predicted in predictions.items()}
    data, tracks, bands = None, {}, {}
    try:
        data = merged_groups(servo_data(recordings, names, readings, seed, polls))
        opened, fitted_to = _opened(learned, data, recordings)
        notes += fitted_to
        for name, servo in opened.items():
            rows = scores.as_rows(data, servo.of_rows)
            track, offset = scores.run_with_offset(scores.learned_run(servo.model, rows), rows)
            errors = scores.errors(servo.model, track, rows, everything)
            scored[name] = scores.ModelScores.of(errors, seed, offset_rad=offset)
            tracks[name] = track
        bands = {name: servo.band for name, servo in opened.items() if servo.band}
        tracks[scores.LINEAR], errors = _linear(data, seed)
        scored[scores.LINEAR] = scores.ModelScores.of(errors, seed)
        for name, predicted in predictions.items():
            tracks[name] = {j: _on_ticks(data, j, runs[j], p.tracks) for j, p in predicted.items()}
    except InputError as error:
        if learned:
            raise
        notes.append(f"No linear filter beside, it cannot be fitted to these runs: {error}")
    if learned and _loaded(runs):
        folders = ", ".join(n for n in scored if n not in predictions and n != scores.LINEAR)
        notes.append(f"{folders}: knows neither the load nor the P gain of a run.")
    notes += preset_notes(map(str, models))
    learned_names = iter(n for n in scored if n not in predictions and n != scores.LINEAR)
    named = iter(predictions)
    order = [
        next(learned_names if any(m is one for one in learned) else named) for m in models
    ]  # as given
    scored = {
        name: scored[name]
        for name in (*order, *([scores.LINEAR] if scores.LINEAR in scored else []))
    }
    period = float(np.median([r.loop_period_s for r in recordings]))
    if data is None:
        data = ServoData(tuple(names), period, {}, (), {}, polls)
        persistence = {joint: predict.persistence(compared) for joint, compared in runs.items()}
        repeatability = dict.fromkeys(names, float("nan"))
    else:
        persistence = scores.persistence(data, everything)
        repeatability = scores.repeatability(data, everything)
    rules = {joint: predict.rule_of(joint, polls[joint], source) for joint in names}
    return Comparison(
        models=scored,
        readings=rules,
        persistence_rmse_rad=persistence,
        repeatability_rad=repeatability,
        time_step_s=period,
        notes=tuple(notes),
        data=data,
        tracks=tracks,
        bands=bands,
        runs=runs,
        run_tracks={
            name: {joint: p.tracks for joint, p in predicted.items()}
            for name, predicted in predictions.items()
        },
    )  # fmt: skip


def _scored(predictions: Mapping[str, predict.Prediction], seed: int) -> scores.ModelScores:
    """Scores of a calibration's predictions by joint."""
    errors = {}
    for joint, p in predictions.items():
        e = p.errors()
        nothing = np.zeros(len(e["counted"]))
        errors[joint] = scores.Errors(
            e["counted"], p.one_step(), nothing, p.blocks(), e["held"], e["raw"]
        )
    return scores.ModelScores.of(
        errors, seed,
        offset_rad={joint: p.offset_rad for joint, p in predictions.items()},
        age_spread_rad={joint: p.age_spread_rad() for joint, p in predictions.items()},
        readings={joint: p.rule for joint, p in predictions.items()},
    )  # fmt: skip


def _fitted_here(name: str, hashes: Sequence[str], recordings: Sequence[Recording]) -> list[str]:
    """A sentence if a model was fitted to some of the recordings."""
    fitted = [r.name for r in recordings if r.sha256 in hashes]
    which = ", ".join(fitted) if len(fitted) < 4 else f"{len(fitted)} of these recordings"
    sentence = (
        f"{name} was fitted to {which}: its errors here are too small. Its file holds those on "
        "unseen data."
    )
    return [sentence] if fitted else []


def _loaded(runs: Mapping[str, Sequence[predict.ComparedRun]]) -> bool:
    """Whether runs differ in gain, or carry a load."""
    return any(
        r.trial.load is not None or r.run.p_gain != every[0].run.p_gain
        for every in runs.values()
        for r in every
    )


def _on_ticks(
    data: ServoData,
    joint: str,
    runs: Sequence[predict.ComparedRun],
    tracks: Sequence[NDArray[np.float64]],
) -> list[NDArray[np.float64]]:
    """Tracks of physics steps at the ticks of the data's runs, which may join trials."""
    place = {(r.recording, r.trial.number): n for n, r in enumerate(runs)}
    positions = []
    for run in data.runs[joint]:
        position = np.full(len(run.command_rad) + 1, np.nan)
        for number in np.unique(run.number):
            rows = np.flatnonzero(run.number == number)
            n = place.get((run.recording, int(number)))
            if n is None:
                continue
            step = run.elapsed_s[rows] / runs[n].run.step_s
            position[rows] = at_steps(tracks[n], step)
            last = step[-1] + data.period_s / runs[n].run.step_s
            position[rows[-1] + 1] = at_steps(tracks[n], np.array([last]))[0]
        positions.append(position)
    return positions


def _each(models: Model | Sequence[Model]) -> Sequence[str | Path | Calibration | ServoFit]:
    """The models one by one, those of `calibrate` as calibrations."""
    several = [models] if isinstance(models, str) or not isinstance(models, Sequence) else models
    each: list[Any] = [getattr(m, "calibration", m) for m in several]
    for model in each:
        if not isinstance(model, Calibration | ServoFit):
            as_path(model, "A model")
    return each


def _is_folder(model: str | Path | Calibration) -> TypeGuard[str | Path]:
    return not isinstance(model, Calibration) and Path(model).is_dir()


def _opened(
    models: Sequence[str | Path | ServoFit],
    data: ServoData,
    recordings: Sequence[Recording],
) -> tuple[dict[str, _Opened], list[str]]:
    """Models by label, and which of them were fitted to one of the recordings."""
    opened: dict[str, _Opened] = {}
    notes = []
    for model in models:
        servo = _open(model, data)
        called = model if isinstance(model, str | Path) else servo.name
        name = servo.name
        if name in opened:
            name = f"{name} ({called if called != name else len(opened) + 1})"
        opened[name] = servo
        notes += _fitted_here(str(called), servo.fitted_to, recordings)
    return opened, notes


def _calibrations(
    models: Sequence[str | Path | Calibration | ServoFit],
) -> dict[str, Calibration]:
    """Calibrations and cards among the models, by label."""
    calibrations: dict[str, Calibration] = {}
    for model in models:
        if isinstance(model, Calibration):
            calibration, called = model, ""
        elif isinstance(model, ServoFit) or _is_folder(model):
            continue
        elif not is_shipped(model) and Path(model).suffix.lower() not in _ENDINGS:
            refuse_other_kind(Path(model), "pupper-calibration")
            near = difflib.get_close_matches(str(model), (*PRESETS, *card_names()), n=1)
            usual = "Make one with `pupper-sysid fit-servo` or `calibrate`."
            raise InputError(
                f"{model} is neither a servo model's folder, nor a calibration (.yaml), nor a "
                "servo card (`pupper-sysid servo list`), nor one of the presets "
                f"{', '.join(PRESETS)}. {f'Did you mean {near[0]}?' if near else usual}"
            )
        else:
            calibration, called = load_calibration(model), Path(model).name
        loaded = any(j.servo for j in calibration.joints.values())
        kind = "servo under load" if loaded else "DelayedPD"
        label = f"{kind} ({called})" if called else kind
        if label in calibrations:
            label = f"{kind} ({model if called else len(calibrations) + 1})"
        calibrations[label] = calibration
    return calibrations


@dataclass(frozen=True)
class _Opened:
    """A learned model to compare."""

    name: str
    fitted_to: list[str]  # hashes
    model: ServoModel
    band: dict[str, scores.Band] = field(default_factory=dict)
    of_rows: tuple[str, ...] = ()  # joints fitted to raw rows


def _open(model: str | Path | ServoFit, data: ServoData) -> _Opened:
    if isinstance(model, ServoFit):
        if missing := [j for j in data.joints if j not in model.joints]:
            raise InputError(f"The {model.arch} model has no joint {', '.join(missing)}.")
        with TemporaryDirectory() as folder:
            model.save(folder, force=True)
            return _open(folder, data)
    saved = load_servo_model(Path(model), data.joints, data.period_s)
    contract = saved.contract
    name = contract.arch.upper() if contract.arch in ("mlp", "lstm", "fir") else contract.arch
    name += " (paper)" if contract.preset == "paper" else ""
    return _Opened(
        name, [r.sha256 for r in contract.recordings], saved.model,
        band={j: (c.band_noise_rad, c.band_timing_s) for j, c in contract.joints.items()},
        of_rows=tuple(j for j, mode in contract.readings_counted.items() if mode == "all"),
    )  # fmt: skip


def _linear(data: ServoData, seed: int) -> tuple[scores.Tracks, dict[str, scores.Errors]]:
    """The linear baseline, each group by a filter fitted to the others."""
    # where all rows count it is fitted to them as logged, their age included
    rows = scores.as_rows(data, [j for j in data.joints if data.modes[j] == "all"])
    cut, _ = grouped(rows, everything)
    ready = samples(cut, everything, past_ticks(data.period_s))
    fit = fit_network("fir", data.joints, data.period_s, ready, seed)
    parts = [
        scores.errors(model, scores.tracks(model, cut), cut, only(group))
        for group, model in fit.held_out.items()
    ]
    return scores.tracks(fit.model, rows), scores.pooled(parts)


PUBLISHED, FITTED = "DelayedPD, published", "DelayedPD, fitted here"
_TRAIN_SHARE = 2 / 3  # of a recording without loops
_PARTS = {"lstm": (0.0, 0.7), "mlp": (0.7, 1.0)}  # of the time that both fits take


def four_way(
    recording: Recording,
    joints: Sequence[str],
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Compare published DelayedPD, one fitted here, an MLP and an LSTM.

    Each runs free and one step ahead, on readings that none was fitted to: the last loop, or the
    last third of a recording without loops. (The published networks were scored on commands that
    they had been trained on.) The published model gets the offset of the readings that the others
    were fitted to, and predicts readings as `compare` does. `progress` is called with what is being
    done and the share of it that is done.
    """
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        split = Split.by_trials(numbers[:-1], numbers[-1:])
    else:
        end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
        split = Split.by_time(end, end)
    fits: dict[str, ServoFit] = {}
    for arch, part in _PARTS.items():
        say = _part_of(progress, part) if progress else None
        fits[arch] = fit_servo(
            recording, joints, arch, split=split, seed=seed, progress=say, keep_unfinished=False
        )
    mlp = fits["mlp"]
    assert split.train is not None and split.test is not None
    data = mlp.data
    rules = {j: predict.rule_of(j, data.lattices[j], recording.name) for j in data.joints}
    run = calibrated_run(load_calibration("paper"), data)
    track, offset = scores.run_with_offset(run, data, split.train)
    errors = scores.errors(None, track, data, split.test)
    published = scores.ModelScores.of(errors, seed, offset_rad=offset)
    fitted = {FITTED: mlp.scored["delayed-pd"], scores.LINEAR: mlp.scored["linear"]}
    fitted |= {arch.upper(): fit.scored[arch] for arch, fit in fits.items()}
    return Comparison(
        models={PUBLISHED: published} | fitted,
        readings=rules,
        persistence_rmse_rad={j: s.persistence_rmse_rad for j, s in mlp.joints.items()},
        repeatability_rad={j: s.repeatability_rad for j, s in mlp.joints.items()},
        time_step_s=mlp.time_step_s,
        notes=mlp.notes,
        data=mlp.data,
        tracks={PUBLISHED: track} | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        bands={},
    )


def calibrated_run(calibration: Calibration, data: ServoData) -> scores.FreeRun:
    """Free run of a calibration's servos on the runs of learned models, several times per tick."""

    def run(offset: NDArray[np.float64]) -> scores.Tracks:
        tracks: scores.Tracks = {}
        for n, joint in enumerate(data.joints):
            tracks[joint] = []
            for e, joint_run in enumerate(data.runs[joint]):
                physics = joint_run.on_physics(np.ones(len(joint_run.tick), bool))
                track = predict.track_of(calibration, joint, physics, offset[e, n]) - offset[e, n]
                tracks[joint].append(scores.on_ticks(track, joint_run, data.period_s))
        return tracks

    return run


def _part_of(
    progress: Callable[[str, float], None], part: tuple[float, float]
) -> Callable[[str, float], None]:
    """Progress of one fit as a part of the whole; never backwards."""
    start, end = part
    furthest = start

    def say(what: str, share: float) -> None:
        nonlocal furthest
        furthest = max(furthest, start + share * (end - start))
        progress(what, furthest)

    return say
