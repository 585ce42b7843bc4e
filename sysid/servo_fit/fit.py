"""Fit servo models of all joints and score them on unseen data, beside baselines.

`Split` defines the parts for training and for testing; by default each group (loop, tone) is left
out in turn. Hyper-parameters (ridge, weight decay, length of training) are chosen by groups held
out of the training part. A linear filter, DelayedPD and persistence are fitted to the same part and
scored on the same readings.

DelayedPD and sparse equations are fitted to the same part as the networks, in free run from the
first reading to the part's readings at their own times (`sysid.fit.search`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import versions
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.common.results import Result, internal, plain
from pupper_sysid.servo_models.calibration.calibration import utc_now
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPDParameters, ServoModel
from pupper_sysid.servo_models.networks import RecurrentNetwork
from pupper_sysid.servo_models.servo_file import (
    ARCHITECTURES,
    input_names,
    physical_model,
    save_servo_model,
)
from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS
from pupper_sysid.servo_models.step_size import at_step
from pupper_sysid.sysid.doctor import checks
from pupper_sysid.sysid.doctor.checks import Joints, Recordings
from pupper_sysid.sysid.feedback.poll_lattice import quantum
from pupper_sysid.sysid.fit.run import Run, whole_counts
from pupper_sysid.sysid.fit.search import Problem, search
from pupper_sysid.sysid.fit.structure import PREFERRED, candidate
from pupper_sysid.sysid.recordings.table import LARGEST_COUNT
from pupper_sysid.sysid.servo_fit import scores, windows
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.networks import Learned, fit_network, fit_published, past_ticks
from pupper_sysid.sysid.servo_fit.scores import ModelScores, Scores, Tracks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Split:
    """What is for training and what for testing; None: every group is left out in turn."""

    name: str
    """In words."""
    train: windows.Part | None = None
    test: windows.Part | None = None

    @classmethod
    def by_trials(cls, train_loops: Sequence[int], test_loops: Sequence[int]) -> Split:
        """Whole trials (loops of a playback), by their numbers."""
        for name, numbers in (("train_loops", train_loops), ("test_loops", test_loops)):
            for number in numbers:
                refuse_outside(f"`{name}`", number, -LARGEST_COUNT, LARGEST_COUNT)
        if both := set(train_loops) & set(test_loops):
            raise InputError(
                f"Loop {min(both)} is in `train_loops` and in `test_loops`; a model would be "
                "tested on what it has seen."
            )
        names = (",".join(map(str, numbers)) for numbers in (train_loops, test_loops))
        return cls(
            "trained on loops {}, tested on {}".format(*names),
            lambda number, elapsed, group: np.isin(number, list(train_loops)),
            lambda number, elapsed, group: np.isin(number, list(test_loops)),
        )

    @classmethod
    def by_time(cls, train_before_s: float, test_after_s: float) -> Split:
        """The beginning of each trial for training, its end for testing [s since its start]."""
        if not 0 < train_before_s <= test_after_s < np.inf:
            raise InputError(
                f"`train_before_s` is {train_before_s:g} and `test_after_s` {test_after_s:g}; "
                "training must end after 0 s and before testing begins."
            )
        return cls(
            f"trained on the first {train_before_s:g} s of each trial, "
            f"tested after {test_after_s:g} s",
            lambda number, elapsed, group: elapsed < train_before_s,
            lambda number, elapsed, group: elapsed >= test_after_s,
        )


EACH_GROUP_IN_TURN = Split("each group left out in turn")


@dataclass(frozen=True, kw_only=True)
class FitScores(Scores):
    """Scores of a fitted model on one joint, or their means, beside the baselines."""

    linear_rmse_rad: float
    delayed_pd_rmse_rad: float
    """`linear_rmse_rad` and `delayed_pd_rmse_rad`: free run of a linear filter and of DelayedPD
    fitted to the same readings [rad]."""
    persistence_rmse_rad: float
    """The last reading as the prediction of the next [rad]."""
    repeatability_rad: float
    """RMS difference of repetitions over √2 [rad]; NaN if no command was repeated."""
    band_noise_rad: float
    band_timing_s: float
    """`band_noise_rad` and `band_timing_s`: standard deviation of the error at speed v: sqrt(noise²
    + (timing · v)²)."""


@dataclass(frozen=True, kw_only=True)
class ServoFit(Result):
    """A fitted servo model and its scores on readings it was not fitted to."""

    arch: str
    preset: str
    seed: int
    split: str
    """What was for training and what for testing."""
    readings_counted: dict[str, str]
    """Per joint, "fresh" or "all"."""
    groups: tuple[str, ...]
    """What could be held out."""
    time_step_s: float
    """Time between commands."""
    choices: dict[str, float]
    """Hyper-parameters chosen by held-out groups."""
    joints: dict[str, FitScores]
    mean: FitScores
    """Over joints."""
    rmse_free_run_rad: Interval
    linear_rmse_rad: Interval
    difference_to_linear_rad: Interval
    """`rmse_free_run_rad`, `linear_rmse_rad` and `difference_to_linear_rad`: means over joints of
    the model, of the linear filter, and their difference."""
    coverage_of_90_percent_band: float
    """Share of the test readings inside the predictive band."""
    readings: dict[str, int]
    """Per joint, that the model was fitted to."""
    recordings: tuple[dict[str, str], ...]
    """Name and SHA-256 of each."""
    verdict: str
    """Whether the model is better than the linear filter."""
    notes: tuple[str, ...]
    interrupted: bool
    """Whether Ctrl-C ended the training; the best model so far was kept."""
    model: ServoModel = internal()
    """Fitted to the whole training part (to everything, where groups were left out in turn)."""
    parameters: Mapping[str, NDArray[np.floating]] = internal()
    """Its arrays, for a model file."""
    scored: dict[str, ModelScores] = internal()
    """Under the name of the architecture, "linear" and "delayed-pd"."""
    data: ServoData = internal()
    tracks: Tracks = internal()
    """Free run of the model."""

    def to_frame(self) -> pd.DataFrame:
        """Scores, one row per joint."""
        rows = [{"joint": joint} | asdict(s) for joint, s in self.joints.items()]
        return pd.DataFrame(rows).set_index("joint")

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the model in free run beside commands and readings, a panel per joint."""
        from pupper_sysid.sysid.report.figures import free_run_figure

        bands = {j: (s.band_noise_rad, s.band_timing_s) for j, s in self.joints.items()}
        return free_run_figure(
            self.data, {self.arch: self.tracks}, {self.arch: self.scored[self.arch].errors},
            {self.arch: bands}, joints,
        )  # fmt: skip

    def save(self, folder: Path | str, force: bool = False) -> None:
        """Save the model with its contract: what it was fitted to, how, and how good it is.

        Parameters
        ----------
        folder : Path or str
            Made if missing.
        force : bool
            Replace a model that is there.
        """
        feedback = isinstance(self.model, Learned) and self.model.feedback
        warm_up = self.model.warm_up if isinstance(self.model, RecurrentNetwork) else 0
        contract = {
            "arch": self.arch, "preset": self.preset, "created": utc_now(),
            "time_step_s": self.time_step_s, "inputs": input_names(self.parameters, feedback),
            "feedback": feedback, "warm_up": warm_up,
            "joints": {joint: self._joint(joint) for joint in self.joints},
            "readings_counted": self.readings_counted, "split": self.split,
            "choices": self.choices, "recordings": self.recordings, "seed": self.seed,
            "versions": versions("torch", "safetensors"), "notes": [self.verdict, *self.notes],
        }  # fmt: skip
        save_servo_model(Path(folder), self.parameters, contract, force)

    def _joint(self, joint: str) -> dict[str, Any]:
        known = plain(self.joints[joint])
        return {
            "scores": {k: v for k, v in known.items() if k.endswith("_rad")},
            "band_noise_rad": known["band_noise_rad"] or 0.0,
            "band_timing_s": known["band_timing_s"] or 0.0,
            "readings": self.readings[joint],
        }


def fit_servo(
    recordings: Recordings,
    joints: Joints = None,
    arch: str = "mlp",
    preset: str = "default",
    split: Split = EACH_GROUP_IN_TURN,
    readings: str = "auto",
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    keep_unfinished: bool = True,
) -> ServoFit:
    """Fit a servo model per joint and score it on readings it has not seen.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        At one rate.
    joints : str or sequence of str, optional
        By default all that were recorded.
    arch : {"fir", "mlp", "lstm", "delayed-pd", "sindy"}
        Kind of model.
    preset : {"default", "paper"}
        `paper` trains an MLP or LSTM as published: from its last position, one step ahead.
    split : Split
        Parts for training and for testing; by default each group is left out in turn.
    readings : {"auto", "fresh", "all"}
        Which readings count, see `sysid.servo_fit.data`.
    seed : int
        Of the networks, of the physical models' starts and of the bootstrap.
    progress : callable, optional
        Called with the name of the present work and the share of it that is done.
    keep_unfinished : bool
        Whether Ctrl-C ends the training only, and keeps the best network so far.

    Returns
    -------
    ServoFit
        The model, fitted to the whole training part, and its scores.

    Raises
    ------
    InputError
        If the data cannot support a fit.
    """
    recordings, joints = checks.as_sequence(recordings), checks.chosen_joints(recordings, joints)
    if arch not in ARCHITECTURES:
        raise InputError(f"`arch` is {arch}; it must be one of {', '.join(ARCHITECTURES)}.")
    if preset == "paper" and arch not in ("mlp", "lstm"):
        raise InputError(f"`preset='paper'` has an mlp and an lstm; there is no published {arch}.")
    if preset == "paper" and (other := [j for j in joints if j not in DEFAULT_POSE]):
        raise InputError(
            f"`preset='paper'` is for the joints of a Mini Pupper; {other[0]} is none. "
            "Leave it out."
        )
    trials = checks.usable_trials(recordings, joints)
    data = servo_data(recordings, joints, readings, seed)
    recorded = ", ".join(data.groups)
    notes = [text for j in joints for text in checks.cautions(j, trials[j])]
    training = split.train or windows.everything
    data, note = windows.grouped(data, training)
    notes += [note] if note else []
    data = windows.merged_groups(data)
    if split.test is None:
        data = windows.with_two_groups(data, training)
        folds = [(windows.without(g), windows.only(g)) for g in range(len(data.groups))]
    else:
        folds = [(training, split.test)]
        if not any(windows.chosen(r, split.test).any() for j in joints for r in data.runs[j]):
            raise InputError(
                f"There is nothing to test on: {split.name}. What was recorded: {recorded}. "
                "Without a split every part is predicted by a model fitted to the others."
            )
    say = progress or (lambda what, share: None)
    ready = windows.samples(data, training, past_ticks(data.period_s))
    count = dict(zip(joints, (int(n) for n in ready.used.sum((1, 2))), strict=True))

    ours = _fit(arch, preset, data, ready, training, folds, split, seed, say, keep_unfinished)
    linear = physics = ours.folds
    if arch != "fir":
        fir = fit_network("fir", joints, data.period_s, ready, seed)
        linear = _fold_models(fir, folds, split)
    if arch != "delayed-pd":
        say("DelayedPD", 0.0)
        values = delayed_pd_fits(data, [train for train, _ in folds], seed)
        physics = [physical_model("delayed-pd", v, data.period_s) for v in values]
    if ours.interrupted:
        notes.append("Training was stopped early; the best so far was kept.")
    few = ours.weights_per_joint
    if few and few > min(count.values()):
        notes.append(
            f"Each joint's model has {few:,} weights and {min(count.values()):,} readings: it "
            "rests on weight decay, chosen by held-out groups."
        )
    models = {"linear": linear, "delayed-pd": physics, arch: ours.folds}
    scored = {}
    for name, fold_models in models.items():
        parts = [
            scores.errors(model, scores.tracks(model, data), data, test)
            for model, (_, test) in zip(fold_models, folds, strict=True)
        ]
        scored[name] = ModelScores.of(scores.pooled(parts), seed)
    errors = scored[arch].errors
    bands = {j: scores.band(e) for j, e in (ours.held_out or errors).items()}
    test: windows.Part = split.test or (lambda number, elapsed, group: group >= 0)
    covered = np.concatenate([
        np.abs(e.free_run) <= scores.band_half_width(bands[j], e.speed) for j, e in errors.items()
    ])  # fmt: skip
    persistence = scores.persistence(data, test)
    repeatability = scores.repeatability(data, test)
    by_joint = {
        j: FitScores(
            **vars(scored[arch].joints[j]),
            linear_rmse_rad=scored["linear"].joints[j].rmse_free_run_rad,
            delayed_pd_rmse_rad=scored["delayed-pd"].joints[j].rmse_free_run_rad,
            persistence_rmse_rad=persistence[j], repeatability_rad=repeatability[j],
            band_noise_rad=bands[j][0], band_timing_s=bands[j][1],
        )
        for j in joints
    }  # fmt: skip
    mean = scores.mean(by_joint)
    difference = scores.interval(errors, seed, scored["linear"].errors)
    return ServoFit(
        arch=arch, preset=preset, seed=seed, split=split.name, readings_counted=data.modes,
        groups=data.groups, time_step_s=data.period_s,
        choices={k: float(v) for k, v in ours.choices.items()}, joints=by_joint, mean=mean,
        rmse_free_run_rad=scored[arch].rmse_free_run_rad,
        linear_rmse_rad=scored["linear"].rmse_free_run_rad, difference_to_linear_rad=difference,
        coverage_of_90_percent_band=float(covered.sum() / max(covered.size, 1)), readings=count,
        recordings=tuple({"name": r.name, "sha256": r.sha256} for r in recordings),
        verdict=verdict(arch, scored, difference, mean.repeatability_rad), notes=tuple(notes),
        interrupted=ours.interrupted, model=ours.model, parameters=ours.parameters,
        scored=scored, data=data, tracks=scores.tracks(ours.model, data),
    )  # fmt: skip


def verdict(
    arch: str, scores: Mapping[str, ModelScores], difference: Interval, repeatability_rad: float
) -> str:
    """Comparison with the linear filter and with the robot's repeatability, in words."""
    if arch == "fir":
        return "This is the linear model itself."
    name = {"delayed-pd": "DelayedPD", "sindy": "sparse equation"}.get(arch, arch.upper())
    linear = scores["linear"].mean.rmse_free_run_rad
    gain, low, high = (100 * x / linear for x in astuple(difference))
    how = "better" if high < 0 else "worse" if low > 0 else "not better"
    text = (
        f"The {name} is {how} than the linear model on this data "
        f"({gain:+.0f} %, 90 % interval {low:+.0f} to {high:+.0f} %)."
    )
    if np.isfinite(repeatability_rad):
        above = scores[arch].mean.rmse_free_run_rad - repeatability_rad
        text += (
            f" The robot's repeatability is {1e3 * repeatability_rad:.1f} mrad; the model is "
            f"{1e3 * above:.1f} mrad above it."
        )
    return text


@dataclass(frozen=True)
class _Fitted:
    """The model, one per fold, and errors on held-out groups."""

    model: ServoModel
    parameters: Mapping[str, NDArray[np.floating]]
    folds: list[ServoModel]
    choices: dict[str, float]
    held_out: dict[str, scores.Errors] | None
    weights_per_joint: int
    interrupted: bool = False


def _fit(
    arch: str,
    preset: str,
    data: ServoData,
    ready: windows.Samples,
    training: windows.Part,
    folds: list[tuple[windows.Part, windows.Part]],
    split: Split,
    seed: int,
    say: Callable[[str, float], None],
    keep_unfinished: bool,
) -> _Fitted:
    if arch in ("delayed-pd", "sindy"):
        same = split.test is not None  # the one fold is the whole training part
        parts = [train for train, _ in folds]
        fits = delayed_pd_fits if arch == "delayed-pd" else sindy_fits
        values = fits(data, parts if same else [training, *parts], seed)
        models: list[ServoModel] = [physical_model(arch, v, data.period_s) for v in values]
        return _Fitted(models[0], values[0], models if same else models[1:], {}, None, 0)
    if preset == "paper":
        published = [
            fit_published(arch, data, part, seed, lambda share: say(f"{arch} as published", share))
            for part in ([f[0] for f in folds] + ([] if split.test is not None else [training]))
        ]
        size = sum(
            v[0].size for k, v in published[-1].parameters.items() if "weight" in k or "bias" in k
        )
        return _Fitted(
            published[-1], published[-1].parameters, list(published[: len(folds)]), {}, None, size
        )
    fit = fit_network(
        arch, data.joints, data.period_s, ready, seed, nested=split.test is None,
        progress=lambda done, steps: say(arch, done / steps),
    )  # fmt: skip
    if fit.interrupted and not keep_unfinished:
        raise KeyboardInterrupt
    held = [
        scores.errors(m, scores.tracks(m, data), data, _both(training, windows.only(g)))
        for g, m in fit.held_out.items()
    ]
    size = sum(
        v[0].size
        for k, v in fit.model.parameters.items()
        if k.startswith(("weight", "bias", "fir"))
    )
    return _Fitted(
        fit.model, fit.model.parameters, _fold_models(fit, folds, split), fit.choices,
        scores.pooled(held) if held else None, size if arch != "fir" else 0, fit.interrupted,
    )  # fmt: skip


def _fold_models(
    fit: Any, folds: list[tuple[windows.Part, windows.Part]], split: Split
) -> list[ServoModel]:
    if split.test is not None:
        return [fit.model]
    return [fit.held_out[g] for g in range(len(folds))]


def _both(a: windows.Part, b: windows.Part) -> windows.Part:
    return lambda number, elapsed, group: a(number, elapsed, group) & b(number, elapsed, group)


_NAMES = (
    "dead_time_s", "stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit",
)  # fmt: skip
_MANY = 10  # problems; fewer get more starts, since few tones have many local optima


def delayed_pd_fits(
    data: ServoData, parts: Sequence[windows.Part], seed: int
) -> list[dict[str, NDArray[np.float64]]]:
    """One DelayedPD per joint for each part of the data.

    Each has the fields of `DelayedPDParameters` for an armature of 1, and `offset_rad`, shape
    (joints,).
    """
    model = candidate(PREFERRED)
    keep, final = (12, 3) if len(parts) * len(data.joints) <= _MANY else (6, 2)
    fits = []
    for part in parts:
        points = []
        for joint in data.joints:
            runs = part_runs(data, joint, part)
            problem = Problem(model, runs, (noise_scale(data, joint),) * len(runs))
            rng = np.random.default_rng(seed)
            points.append(model.decode(search(problem, rng, keep=keep, final=final)[0].point))
        v = np.array(points).T
        shifts = np.array([_truncation_shift(data, joint) for joint in data.joints])
        servos = DelayedPDParameters(
            **dict(zip(_NAMES, v, strict=False)), armature=np.ones_like(v[0])
        )
        stepped = at_step(servos, TIME_STEP_S).arrays()
        del stepped["back_emf"]  # the structure has none
        fits.append(stepped | {"offset_rad": v[6] + shifts})
    return fits


def sindy_fits(
    data: ServoData, parts: Sequence[windows.Part], seed: int
) -> list[dict[str, NDArray[np.float64]]]:
    """One sparse equation per joint for each part of the data.

    Each has every name of `COEFFICIENTS` that some joint has, `dead_time_s` and `offset_rad`, shape
    (joints,).
    """
    from pupper_sysid.sysid.sparse import fit_equations

    equations = []
    for part in parts:
        runs = {j: part_runs(data, j, part) for j in data.joints}
        results = fit_equations(runs, {j: noise_scale(data, j) for j in data.joints}, seed)
        names = [n for n in COEFFICIENTS if any(n in r.coefficients for r in results.values())]
        absent = {"saturation_error_rad": np.inf}
        values = {
            n: np.array([r.coefficients.get(n, absent.get(n, 0.0)) for r in results.values()])
            for n in names
        }
        values["dead_time_s"] = np.array([r.dead_time_s for r in results.values()])
        values["offset_rad"] = np.array(
            [r.offset_rad + _truncation_shift(data, j) for j, r in results.items()]
        )
        equations.append(values)
    return equations


def part_runs(data: ServoData, joint: str, part: windows.Part) -> tuple[Run, ...]:
    """Runs of a joint on the clock of physics, with only the part's readings."""
    chosen = [(run, windows.chosen(run, part)) for run in data.runs[joint]]
    return tuple(run.on_physics(use) for run, use in chosen if use.any())


def noise_scale(data: ServoData, joint: str) -> float:
    """Scale of ordinary residuals [rad]: two quantisation steps, or the scatter of readings."""
    step = quantum([run.trial for run in data.runs[joint]])
    # two counts, as measured on the real servos (facts of the recordings); 12 mrad if unknown
    return 2.0 * step if step > 0 else 0.012


def _truncation_shift(data: ServoData, joint: str) -> float:
    """Mean of quantised minus unquantised commands [rad].

    The fit uses commands as whole counts; the model that runs gets them unquantised.
    """
    runs = data.runs[joint]
    return float(np.mean(np.concatenate([whole_counts(r.trial) - r.command_rad for r in runs])))
