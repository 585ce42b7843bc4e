"""Fit servo models of all joints, score them on data they have not seen, beside honest baselines.

The caller says which part is for training and which for testing, or that each group (loop, tone) is
to be left out in turn. Whatever is chosen on the way (ridge, weight decay, length of training) is
chosen by groups held out of the training part. The linear filter and DelayedPD are always fitted to
the same part and scored on the same readings, and so is "it stays where it was".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import DEFAULT_POSE
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.recurrent_network import RecurrentNetwork
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.networks import Learned, fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.physics import (
    delayed_pd_fits,
    delayed_pd_model,
    sindy_fits,
    sindy_model,
)
from pupper_sysid.sysid.servo_fit.published import fit_published
from pupper_sysid.sysid.servo_fit.windows import (
    Part,
    Samples,
    chosen,
    everything,
    grouped,
    merged_groups,
    only,
    samples,
    without,
)


@dataclass(frozen=True)
class Split:
    """What is for training and what for testing; None: every group is left out in turn.

    Attributes
    ----------
    name : str
        In words.
    train, test : Part or None
    """

    name: str
    train: Part | None = None
    test: Part | None = None


EACH_GROUP_IN_TURN = Split("each group left out in turn")


@dataclass(frozen=True)
class Scored:
    """One model on the test part.

    Attributes
    ----------
    errors : dict of str to Errors
    interval : (float, float)
        90 % interval of the mean over joints of the free-run RMS [rad].
    """

    errors: dict[str, scores.Errors]
    interval: tuple[float, float]

    def free_run(self, joint: str) -> float:
        """RMS of a joint in free run [rad]."""
        return scores.rms(self.errors[joint].free_run)

    @property
    def mean(self) -> float:
        """Mean over joints of the RMS in free run [rad]."""
        return float(np.mean([self.free_run(j) for j in self.errors]))


@dataclass(frozen=True)
class ServoFit:
    """A fitted model with all that is known of it.

    Attributes
    ----------
    model : ServoModel
        Fitted to the whole training part (to everything, where groups were left out in turn).
    parameters : dict of str to ndarray
        Its arrays, for a model file.
    scored : dict of str to Scored
        Under the name of the architecture, "linear" and "delayed-pd".
    persistence, repeatability : dict of str to float
        Per joint [rad].
    band : dict of str to (float, float)
        Noise [rad] and timing [s] of the predictive band, from readings held out of the fit.
    coverage : float
        Share of the test readings inside the 90 % band.
    difference : (float, float, float)
        Model less linear model, mean RMS [rad], and its 90 % interval.
    interrupted : bool
        Whether Ctrl-C ended the training; the best so far was kept.
    """

    arch: str
    preset: str
    data: ServoData
    split: Split
    model: ServoModel
    parameters: Mapping[str, NDArray[np.floating]]
    choices: dict[str, float]
    scored: dict[str, Scored]
    persistence: dict[str, float]
    repeatability: dict[str, float]
    band: dict[str, tuple[float, float]]
    coverage: float
    difference: tuple[float, float, float]
    readings: dict[str, int]
    notes: tuple[str, ...]
    tracks: scores.Tracks
    interrupted: bool

    @property
    def feedback(self) -> bool:
        """Whether the model is shown the position it predicted last."""
        return isinstance(self.model, Learned) and self.model.feedback

    @property
    def warm_up(self) -> int:
        """Steps at rest that an LSTM needs after a reset; 0 for others."""
        return self.model.warm_up if isinstance(self.model, RecurrentNetwork) else 0

    @property
    def verdict(self) -> str:
        """Whether it was worth it, in words."""
        name = {"delayed-pd": "DelayedPD", "sindy": "sparse equation"}.get(
            self.arch, self.arch.upper()
        )
        gain, low, high = self.difference
        linear = self.scored["linear"].mean
        span = f"({100 * gain / linear:+.0f} %, 90 % interval {100 * low / linear:+.0f} to "
        span += f"{100 * high / linear:+.0f} %)"
        if self.arch == "fir":
            return "This is the linear model itself."
        if high < 0:
            said = f"The {name} is better than the linear model on this data {span}."
        elif low > 0:
            said = f"The {name} is worse than the linear model on this data {span}."
        else:
            said = f"The {name} is not better than the linear model on this data {span}."
        floor = scores.mean_known(list(self.repeatability.values()))
        if np.isfinite(floor):
            said += (
                f" The robot repeats itself to {1e3 * floor:.1f} mrad; the model is "
                f"{1e3 * (self.scored[self.arch].mean - floor):.1f} mrad above that."
            )
        return said


def fit_servo(
    recordings: Sequence[Recording],
    joints: Sequence[str],
    arch: str = "mlp",
    preset: str = "default",
    split: Split = EACH_GROUP_IN_TURN,
    mode: str = "auto",
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> ServoFit:
    """Fit and score one kind of model.

    Parameters
    ----------
    recordings : sequence of Recording
    joints : sequence of str
    arch : {"fir", "mlp", "lstm", "delayed-pd", "sindy"}
    preset : {"default", "paper"}
        `paper` trains an MLP or LSTM as published: shown its last position, one step ahead.
    split : Split
    mode : {"auto", "fresh", "all"}
        Which readings count, see `sysid.servo_fit.data`.
    seed : int
    progress : callable, optional
        Called with what is being done and the share of it that is done.

    Raises
    ------
    InputError
        If the data cannot support a fit; the sentence says why.
    """
    if preset == "paper" and arch not in ("mlp", "lstm"):
        raise InputError(f"--preset paper has an mlp and an lstm; there is no published {arch}.")
    if preset == "paper" and (other := [j for j in joints if j not in DEFAULT_POSE]):
        raise InputError(
            f"--preset paper is for the joints of a Mini Pupper; {other[0]} is none. Leave it out."
        )
    data = servo_data(recordings, joints, mode, seed)
    notes: list[str] = []
    whole = split.train or everything
    data, note = grouped(data, whole)
    notes += [note] if note else []
    data = merged_groups(data)
    if split.test is None:
        data = _with_two_groups(data, whole)
        folds = [(without(g), only(g)) for g in range(len(data.groups))]
    else:
        folds = [(whole, split.test)]
        if not any(chosen(r, split.test).any() for j in joints for r in data.runs[j]):
            raise InputError(f"There is nothing to test on: {split.name}. Check loops and times.")
    say = progress or (lambda what, share: None)
    ready = samples(data, whole, past_ticks(data.period_s))
    readings = dict(zip(joints, (int(n) for n in ready.used.sum((1, 2))), strict=True))

    ours = _fit(arch, preset, data, ready, whole, folds, split, seed, say)
    linear = physics = ours.folds
    if arch != "fir":
        fir = fit_network("fir", joints, data.period_s, ready, seed)
        linear = _fold_models(fir, folds, split)
    if arch != "delayed-pd":
        say("DelayedPD", 0.0)
        found = _physics("delayed-pd", data, folds, seed)
        physics = [delayed_pd_model(v, data.period_s) for v in found]
    if ours.interrupted:
        notes.append("Training was stopped early; the best so far was kept.")
    few = ours.weights_per_joint
    if few and few > min(readings.values()):
        notes.append(
            f"Each joint's model has {few:,} weights and {min(readings.values()):,} readings: what "
            "holds it together is weight decay, chosen by held-out groups."
        )
    scored = {
        "linear": _score(linear, folds, data, seed),
        "delayed-pd": _score(physics, folds, data, seed),
    }
    scored[arch] = _score(ours.folds, folds, data, seed)
    held_out = ours.held_out or scored[arch].errors
    bands = {j: scores.band(e) for j, e in held_out.items()}
    low, high = scores.interval(scored[arch].errors, seed, scored["linear"].errors)
    test: Part = split.test or (lambda number, elapsed, group: group >= 0)
    return ServoFit(
        arch, preset, data, split, ours.model, ours.parameters, ours.choices, scored,
        scores.persistence(data, test), scores.repeatability(data, test), bands,
        _coverage(scored[arch].errors, bands),
        (scored[arch].mean - scored["linear"].mean, low, high), readings, tuple(notes),
        scores.tracks(ours.model, data), ours.interrupted,
    )  # fmt: skip


def _with_two_groups(data: ServoData, part: Part) -> ServoData:
    """The data without groups that nobody has readings of, such as a tone cut short.

    Raises
    ------
    InputError
        If a joint has readings in one group only, so that nothing of it can be held out.
    """
    present = {
        j: {int(g) for r in data.runs[j] for g in r.group[r.readings.rows][chosen(r, part)]} - {-1}
        for j in data.joints
    }
    for joint, own in present.items():
        if len(own) < 2:
            seen = ", ".join(data.groups[g] for g in own) or "nothing"
            raise InputError(
                f"{joint} has readings of {seen} only, others of more, so it cannot be tested on "
                "what it has not seen. Leave it out with --joints, record it again, or split by "
                "time with --train-before and --test-after."
            )
    used = sorted(set().union(*present.values()))
    place = np.full(len(data.groups) + 1, -1)
    place[used] = np.arange(len(used))
    runs = {j: tuple(replace(r, group=place[r.group]) for r in own) for j, own in data.runs.items()}
    return replace(data, runs=runs, groups=tuple(data.groups[g] for g in used))


# ------------------------------------------------------------------------------- fitting


@dataclass(frozen=True)
class _Fitted:
    """What `_fit` makes: the model, one per fold, and what is left of held-out groups."""

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
    ready: Samples,
    whole: Part,
    folds: list[tuple[Part, Part]],
    split: Split,
    seed: int,
    say: Callable[[str, float], None],
) -> _Fitted:
    if arch in ("delayed-pd", "sindy"):
        build = delayed_pd_model if arch == "delayed-pd" else sindy_model
        same = split.test is not None  # the one fold is the whole training part
        parts = folds if same else [(whole, whole), *folds]
        values = _physics(arch, data, parts, seed)
        models: list[ServoModel] = [build(v, data.period_s) for v in values]
        return _Fitted(models[0], values[0], models if same else models[1:], {}, None, 0)
    if preset == "paper":
        found = [
            fit_published(arch, data, part, seed, lambda share: say(f"{arch} as published", share))
            for part in ([f[0] for f in folds] + ([] if split.test is not None else [whole]))
        ]
        size = sum(
            v[0].size for k, v in found[-1].parameters.items() if "weight" in k or "bias" in k
        )
        return _Fitted(found[-1], found[-1].parameters, list(found[: len(folds)]), {}, None, size)
    fit = fit_network(
        arch, data.joints, data.period_s, ready, seed, nested=split.test is None,
        progress=lambda done, steps: say(arch, done / steps),
    )  # fmt: skip
    held = [
        scores.errors(m, scores.tracks(m, data), data, _both(whole, only(g)))
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


def _fold_models(fit: Any, folds: list[tuple[Part, Part]], split: Split) -> list[ServoModel]:
    if split.test is not None:
        return [fit.model]
    return [fit.held_out[g] for g in range(len(folds))]


def _physics(
    arch: str, data: ServoData, folds: list[tuple[Part, Part]], seed: int
) -> list[dict[str, NDArray[np.float64]]]:
    fits = delayed_pd_fits if arch == "delayed-pd" else sindy_fits
    return fits(data, [train for train, _ in folds], seed)


def _score(
    models: Sequence[ServoModel | Learned],
    folds: list[tuple[Part, Part]],
    data: ServoData,
    seed: int,
) -> Scored:
    parts = [
        scores.errors(model, scores.tracks(model, data), data, test)
        for model, (_, test) in zip(models, folds, strict=True)
    ]
    found = scores.pooled(parts)
    return Scored(found, scores.interval(found, seed))


def _coverage(found: dict[str, scores.Errors], bands: dict[str, tuple[float, float]]) -> float:
    inside, total = 0, 0
    for joint, e in found.items():
        noise, timing = bands[joint]
        half = 1.645 * np.sqrt(noise**2 + (timing * e.speed) ** 2)
        inside, total = inside + int(np.sum(np.abs(e.free_run) <= half)), total + len(half)
    return inside / max(total, 1)


def _both(a: Part, b: Part) -> Part:
    return lambda number, elapsed, group: a(number, elapsed, group) & b(number, elapsed, group)
