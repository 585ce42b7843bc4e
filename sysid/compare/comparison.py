"""Result of a comparison of servo models: errors per model and joint, tables, figures.

`four_way` compares as the paper does: a published model, and three fitted here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.results import Result, internal
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.sysid.fit.predict import (
    ComparedRun,
    ReadingRule,
    in_words,
    rule_of,
    run_figure,
    track_of,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR, ModelScores

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
    """Scores of one model on readings that it predicts."""

    # as for the errors, with more numbers
    joints: dict[str, ComparedScores]  # pyright: ignore[reportIncompatibleVariableOverride]
    mean: ComparedScores
    """Over joints."""
    offset_rad: dict[str, float] = field(default_factory=dict)
    """By joint, reading minus prediction of these recordings; empty for a model fitted here."""
    age_spread_rad: dict[str, float] = field(default_factory=dict)
    """By joint, the part of the raw error that the unknown age of readings makes: a perfect model
    would have it. 0 where readings are dated."""
    readings: dict[str, ReadingRule] = field(default_factory=dict)
    """By joint, when a calibration says that readings were measured."""

    @classmethod
    def scored(
        cls,
        own: ModelScores,
        offset_rad: dict[str, float],
        age_spread_rad: dict[str, float],
        readings: dict[str, ReadingRule] | None = None,
    ) -> ComparedModel:
        """The scores with the offset, the spread and the rules that belong to them."""
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
            readings=readings or {},
        )


@dataclass(frozen=True, kw_only=True)
class Comparison(Result):
    """Servo models on the same readings."""

    models: dict[str, ComparedModel]
    readings: dict[str, ReadingRule]
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
    runs: dict[str, list[ComparedRun]] = internal(default_factory=dict)
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
        known = [j for j, own in self.runs.items() if all(r.offset_known for r in own)]
        said = [f"{', '.join(known)}: no offset is taken out, the load is known."] if known else []
        if len(known) < len(self.data.joints):
            said.append(OFFSET_RULE)
        rules = [self.readings, *(m.readings for m in self.models.values() if m.readings)]
        if len(rules) > 1:  # calibrations say when readings were measured
            rules = rules[1:]
        return list(dict.fromkeys([*said, *(text for own in rules for text in in_words(own))]))

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per joint."""
        from pupper_sysid.sysid.servo_fit.figures import free_run_figure

        every = [own for runs in self.runs.values() for own in runs]
        gains, loads = {own.run.p_gain for own in every}, [own.trial.load for own in every]
        if not self.data.runs or len(gains) > 1 or any(loads):
            return run_figure(self.runs, self.run_tracks, joints)
        errors = {name: model.errors for name, model in self.models.items()}
        drawn = {name: track for name, track in self.tracks.items() if name != LINEAR}
        return free_run_figure(self.data, drawn, errors, self.bands, joints)


def _mean_absolute(errors: NDArray[np.float64]) -> float:
    return float(np.mean(np.abs(errors))) if len(errors) else float("nan")


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
    split = _split(recording)
    fits: dict[str, ServoFit] = {}
    for arch, part in _PARTS.items():
        say = _part_of(progress, part) if progress else None
        fits[arch] = fit_servo(
            recording, joints, arch, split=split, seed=seed, progress=say, keep_unfinished=False
        )
    mlp = fits["mlp"]
    assert split.train is not None and split.test is not None
    data = mlp.data
    rules = {j: rule_of(j, data.lattices[j], recording.name) for j in data.joints}
    run = calibrated_run(load_calibration("paper"), data)
    track, offset = scores.run_with_offset(run, data, split.train)
    errors = scores.errors(None, track, data, split.test)
    published = scores.ModelScores.of(errors, seed)
    fitted = {FITTED: mlp.scored["delayed-pd"], LINEAR: mlp.scored["linear"]}
    fitted |= {arch.upper(): fit.scored[arch] for arch, fit in fits.items()}
    return Comparison(
        models={PUBLISHED: ComparedModel.scored(published, offset, {})}
        | {name: ComparedModel.scored(own, {}, {}) for name, own in fitted.items()},
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
            for e, own in enumerate(data.runs[joint]):
                physics = own.on_physics(np.ones(len(own.tick), bool))
                track = track_of(calibration, joint, physics, offset[e, n]) - offset[e, n]
                tracks[joint].append(scores.on_ticks(track, own, data.period_s))
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


def _split(recording: Recording) -> Split:
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        return Split.by_trials(numbers[:-1], numbers[-1:])
    end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
    return Split.by_time(end, end)
