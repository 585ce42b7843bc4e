"""Compare servo models on recordings: the same free run, the same readings, side by side.

Models are folders of `fit-servo` and calibrations. Each predicts the readings of the recording's
bus, their age and their offset (`sysid.compare.readings`), by one rule for all. Beside them stand a
linear filter fitted to the recording's other groups, persistence, and the robot's repeatability. A
note names models that were fitted to a recording they are compared on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    is_shipped,
    load_calibration,
)
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.servo_file import SavedModel, load_servo_model
from pupper_sysid.sysid.compare import under_load
from pupper_sysid.sysid.compare.readings import (
    ReadingRule,
    age_spread_rad,
    as_rows,
    calibrated_run,
    in_words,
    reading_rules,
    run_with_offset,
    shown,
    with_ages,
)
from pupper_sysid.sysid.compare.under_load import needs_runs
from pupper_sysid.sysid.doctor.checks import cautions
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.recordings.joints import (
    Joints,
    Recordings,
    as_sequence,
    chosen_joints,
    joint_rng,
    usable_trials,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR, ModelScores
from pupper_sysid.sysid.servo_fit.windows import everything, grouped, merged_groups, only, samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OFFSET_RULE = (
    "Offsets are of this recording: for every model the median of reading minus prediction."
)


@dataclass(frozen=True, kw_only=True)
class ComparedScores(scores.Scores):
    """Root mean square and mean absolute errors of one model on one joint, or their means [rad]."""

    mae_held_rad: float
    mae_raw_rad: float


@dataclass(frozen=True, kw_only=True)
class ComparedModel(ModelScores):
    """Scores of one model on readings that it predicts.

    Attributes
    ----------
    joints : dict of str to ComparedScores
    mean : ComparedScores
        Over joints.
    offset_rad : dict of str to float
        By joint, reading minus prediction of these recordings; empty for a model fitted here.
    age_spread_rad : dict of str to float
        By joint, the part of the raw error that the unknown age of readings makes: a perfect model
        would have it. 0 where readings are dated.
    """

    # as for the errors, with more numbers
    joints: dict[str, ComparedScores]  # pyright: ignore[reportIncompatibleVariableOverride]
    mean: ComparedScores
    offset_rad: dict[str, float] = field(default_factory=dict)
    age_spread_rad: dict[str, float] = field(default_factory=dict)

    @classmethod
    def scored(
        cls, own: ModelScores, offset_rad: dict[str, float], age_spread_rad: dict[str, float]
    ) -> ComparedModel:
        """The scores with the offset and the spread that belong to them."""
        joints = {
            joint: ComparedScores(
                **vars(found),
                mae_held_rad=_mean_absolute(own.errors[joint].held),
                mae_raw_rad=_mean_absolute(own.errors[joint].raw),
            )
            for joint, found in own.joints.items()
        }
        more = {"joints": joints, "mean": scores.mean(joints)}
        return cls(
            **vars(own) | more,  # pyright: ignore[reportArgumentType]
            offset_rad=offset_rad,
            age_spread_rad=age_spread_rad,
        )


@dataclass(frozen=True, kw_only=True)
class Comparison(Result):
    """Servo models on the same readings.

    Attributes
    ----------
    models : dict of str to ComparedModel
    readings : dict of str to ReadingRule
        By joint, when its readings were measured.
    persistence_rmse_rad, repeatability_rad : dict of str to float
        Per joint.
    time_step_s : float
        Time between commands.
    notes : tuple of str
    data : ServoData
    tracks : dict of str to Tracks
        Readings of each model in free run.
    bands : dict of str to (dict of str to Band)
        By model, of those that have a predictive band, then joint.
    """

    models: dict[str, ComparedModel]
    readings: dict[str, ReadingRule]
    persistence_rmse_rad: dict[str, float]
    repeatability_rad: dict[str, float]
    time_step_s: float
    notes: tuple[str, ...]
    data: ServoData = internal()
    tracks: dict[str, scores.Tracks] = internal()
    bands: dict[str, dict[str, scores.Band]] = internal()

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
                        "readings": self.readings[joint].rule,
                        "persistence_rmse_rad": self.persistence_rmse_rad[joint],
                        "repeatability_rad": self.repeatability_rad[joint],
                        "band_noise_rad": noise, "band_timing_s": timing,
                    }
                )  # fmt: skip
        return pd.DataFrame(rows).set_index(["joint", "model"])

    def reading_notes(self) -> list[str]:
        """How readings were predicted, one sentence per rule, and the rule of the offset."""
        return [OFFSET_RULE, *in_words(self.readings)]

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per joint.

        Parameters
        ----------
        joints : sequence of str, optional
            By default all.
        """
        from pupper_sysid.sysid.servo_fit.figures import free_run_figure

        errors = {name: model.errors for name, model in self.models.items()}
        drawn = {name: track for name, track in self.tracks.items() if name != LINEAR}
        return free_run_figure(self.data, drawn, errors, self.bands, joints)


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
    trials = usable_trials(recordings, names)
    calibrations = _calibrations(models)
    if needs_runs(recordings, names, list(calibrations.values())):
        return _compare_runs(recordings, models, calibrations, names, seed, lattices)
    data = merged_groups(servo_data(recordings, names, readings, seed, lattices))
    opened: dict[str, _Opened] = {}
    notes = [text for joint in names for text in cautions(joint, trials[joint])]
    inputs = {r.sha256: r.name for r in recordings}
    for given in models:
        found = _open(given, data)
        called = given if isinstance(given, str | Path) else found.name
        name = found.name
        if name in opened:
            name = f"{name} ({called if called != name else len(opened) + 1})"
        opened[name] = found
        notes += [
            f"{called} was fitted to {inputs[h]}: its errors here are too small. Its contract "
            "holds those on unseen data."
            for h in found.fitted_to
            if h in inputs
        ]
    if presets := [str(given) for given in models if str(given) in PRESETS]:
        notes.append(
            f"{', '.join(presets)}: published with ideal feedback. Where its delay stands for the "
            "age of readings, too, that age counts twice here."
        )
    known = {name: found.calibration for name, found in opened.items() if found.calibration}
    rules = reading_rules(data, ", ".join(r.name for r in recordings), known)
    data = with_ages(data, rules)
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


@dataclass(frozen=True, kw_only=True)
class RunComparison(Comparison):
    """Servo models on runs under load, each with its own gain and load.

    Attributes
    ----------
    runs : dict of str to list of BenchRun
        By joint.
    run_tracks : dict of str to (dict of str to list of ndarray)
        By model, then joint: predicted readings at the steps of each run.
    """

    runs: dict[str, list[under_load.BenchRun]] = internal()
    run_tracks: dict[str, dict[str, list[NDArray[np.float64]]]] = internal()

    def reading_notes(self) -> list[str]:
        """How readings were predicted, and which offsets were taken out."""
        known = [j for j, own in self.runs.items() if all(b.offset_known for b in own)]
        said = [f"{', '.join(known)}: no offset is taken out, the load is known."] if known else []
        return [*said, *([OFFSET_RULE] if len(known) < len(self.runs) else [])]

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per run."""
        return under_load.figure(self.runs, self.run_tracks, joints)


def _compare_runs(
    recordings: Sequence[Recording],
    models: Sequence[str | Path | Calibration | ServoFit],
    calibrations: Mapping[str, Calibration],
    joints: Sequence[str],
    seed: int,
    lattices: Mapping[str, PollLattice] | None,
) -> RunComparison:
    """`compare` where trials differ in gain, load or torque."""
    if len(calibrations) < len(models):
        raise InputError(
            "These recordings tell of a load or of several P gains, which only calibrations and "
            "servo cards know. Leave out folders of fit-servo."
        )
    notes = []
    inputs = {r.sha256: r.name for r in recordings}
    for name, calibration in calibrations.items():
        notes += [
            f"{name} was fitted to {inputs[f.sha256]}: its errors here are too small."
            for f in calibration.inputs
            if f.sha256 in inputs
        ]
    runs: dict[str, list[under_load.BenchRun]] = {}
    rules: dict[str, ReadingRule] = {}
    for joint in joints:
        trials = [t for r in recordings for t in r.trials(joint)]
        lattice = (lattices or {}).get(joint) or find_poll_lattice(
            tuple(trials), joint_rng(seed, joint)
        )
        runs[joint] = under_load.bench_runs(recordings, joint, seed, lattice)
        kind = {"every read": "live", "lattice": "own dates"}.get(lattice.kind, "as logged")
        source = ", ".join(r.name for r in recordings)
        rules[joint] = ReadingRule(rule=kind, source=source)
    made: dict[str, ComparedModel] = {}
    tracks: dict[str, dict[str, list[NDArray[np.float64]]]] = {}
    for name, calibration in calibrations.items():
        tracks[name], found, offset = {}, {}, {}
        for joint, own in runs.items():
            volts = under_load.reference_voltage(calibration, joint)
            own = under_load.at_voltage(own, volts)
            track, offset[joint] = under_load.predict(calibration, joint, own)
            tracks[name][joint] = track
            error = under_load.errors(own, track)
            nothing = np.zeros(len(error["fresh"]))
            found[joint] = scores.Errors(
                error["fresh"], under_load.one_step(own, track), nothing, under_load.blocks(own),
                error["held"], error["raw"],
            )  # fmt: skip
        spread = dict.fromkeys(joints, 0.0)
        made[name] = ComparedModel.scored(ModelScores.of(found, seed), offset, spread)
    notes += under_load.notes(calibrations, runs)
    nan = float("nan")
    period = float(np.median([r.loop_period_s for r in recordings]))
    return RunComparison(
        models=made,
        readings=rules,
        persistence_rmse_rad={j: under_load.persistence(own) for j, own in runs.items()},
        repeatability_rad=dict.fromkeys(joints, nan),
        time_step_s=period,
        notes=tuple(notes),
        data=ServoData(tuple(joints), period, {}, (), {}, {}),
        tracks={},
        bands={},
        runs=runs,
        run_tracks=tracks,
    )


def _calibrations(
    models: Sequence[str | Path | Calibration | ServoFit],
) -> dict[str, Calibration]:
    """Calibrations and cards among the models, by label."""
    found: dict[str, Calibration] = {}
    for given in models:
        if isinstance(given, Calibration):
            calibration, called = given, ""
        elif isinstance(given, ServoFit) or Path(given).is_dir() or not _is_calibration(given):
            continue
        else:
            calibration, called = load_calibration(given), Path(given).name
        loaded = any(j.under_load for j in calibration.joints.values())
        kind = "servo under load" if loaded else "DelayedPD"
        label = f"{kind} ({called})" if called else kind
        if label in found:
            label = f"{kind} ({given if called else len(found) + 1})"
        found[label] = calibration
    return found


def _mean_absolute(errors: NDArray[np.float64]) -> float:
    return float(np.mean(np.abs(errors))) if len(errors) else float("nan")


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
    if _is_calibration(given):
        return _calibrated(load_calibration(given), f"DelayedPD ({path.name})", data)
    raise InputError(
        f"{given} is neither a servo model's folder, nor a calibration (.yaml), nor one of the "
        f"presets {', '.join(PRESETS)}. Make one with `pupper-sysid fit-servo` or `calibrate`."
    )


def _calibrated(calibration: Calibration, name: str, data: ServoData) -> _Opened:
    for joint in data.joints:
        calibration.joint(joint)
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
