"""Fit linear filters, MLPs and LSTMs of all joints; choose hyper-parameters by held-out groups.

A fit gives one model for the whole training part and one per held-out group. The errors of the
latter on their own group choose the ridge, the weight decay and the length of training, and give
the predictive band. With `nested`, the hyper-parameters of a group's model are chosen without that
group, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.sysid.servo_fit import windows
from pupper_sysid.sysid.servo_fit.training import LSTM, MLP, Checkpoint, train

Learned = CommandNetwork | RecurrentNetwork
_LSTM_MEMORY_S = 1.5
_AS_GOOD = 0.01  # of the logarithm of the error: one percent


@dataclass(frozen=True)
class NetworkFit:
    """Models of all joints."""

    model: Learned
    """Fitted to the whole training part."""
    held_out: dict[int, Learned]
    """Per group, the model fitted without it."""
    choices: dict[str, float]
    """Hyper-parameters chosen by held-out groups."""
    interrupted: bool
    """Whether Ctrl-C ended the training; the best so far was kept."""


def past_ticks(period_s: float) -> int:
    """Commands before a window that the models of this module need."""
    return max(windows.taps(period_s), round(_LSTM_MEMORY_S / period_s))


def fit_network(
    kind: str,
    joints: Sequence[str],
    period_s: float,
    data: windows.Samples,
    seed: int,
    nested: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> NetworkFit:
    """Fit one kind of model ("fir", "mlp" or "lstm") to all joints.

    `data` has `past_ticks(period_s)` commands before each window. With `nested` the
    hyper-parameters of each held-out model are chosen without its group, too. `progress` is called
    with steps done and steps in all.
    """
    groups = [int(g) for g in np.unique(data.group[data.used]) if g >= 0]
    nested = nested and len(groups) > 2  # a pair of two would leave nothing to learn from
    sets = windows.training_sets(groups, nested and kind != "fir")
    linear, ridge = _best_linear(data, groups, sets, period_s)
    build = partial(_build, joints, period_s, data, linear)
    choices: dict[str, float] = {"ridge": ridge}
    filters = {g: build(1 + n, {}) for n, g in enumerate(groups)}
    linear_fit = NetworkFit(build(0, {}), filters, choices, False)
    if kind == "fir":
        return linear_fit

    recipe = MLP if kind == "mlp" else LSTM
    # groups that choose a model: for the final one all, for a group's own model the others
    purposes: dict[int | None, list[tuple[int, int]]] = {
        None: [(n, g) for n, s in enumerate(sets) for g in s if len(s) == 1]
    }
    for outer in groups if nested else []:
        purposes[outer] = [
            (n, g)
            for n, s in enumerate(sets)
            for g in s
            if len(s) == 2 and outer in s and g != outer
        ]
    checkpoints: list[dict[str, NDArray]] = []
    steps_done: list[int] = []
    judged: dict[int | None, list[NDArray]] = {purpose: [] for purpose in purposes}
    held_back = 0

    def watch(now: Checkpoint) -> bool:
        nonlocal held_back
        checkpoints.append(now.weights)
        steps_done.append(now.step)
        for purpose, looks in purposes.items():
            ratios = [
                np.log(
                    _group_rms(now.error[..., n, :], data, g)
                    / _group_rms(linear.residual[..., n, None], data, g)
                )
                for n, g in looks
            ]
            judged[purpose].append(np.nanmean(np.stack(ratios), axis=(0, 1)))  # per decay
        lowest = [float(s.min()) for s in judged[None]]
        held_back = 0 if lowest[-1] <= min(lowest) + _AS_GOOD else held_back + 1
        return held_back >= recipe.patience

    interrupted = train(
        kind, recipe, period_s, data, linear, sets, seed, watch,
        (lambda done: progress(done, recipe.steps)) if progress else None,
    )  # fmt: skip
    if not checkpoints:  # interrupted before the first comparison: the linear part is the best
        return replace(linear_fit, interrupted=True)

    def kept(purpose: int | None, n: int) -> Learned:
        when, decay = _choose(judged[purpose])
        weights = {k: w[:, n, decay] for k, w in checkpoints[when].items()}
        return build(n, weights)

    when, decay = _choose(judged[None])
    choices |= {"weight_decay": recipe.decays[decay], "steps": steps_done[when]}
    held_out = {g: kept(g if nested else None, 1 + n) for n, g in enumerate(groups)}
    return NetworkFit(kept(None, 0), held_out, choices, interrupted)


def _choose(judged: list[NDArray]) -> tuple[int, int]:
    """Checkpoint and decay to keep: of those that are as good, the least regularised.

    Networks of a fold have less data than the final ones and often extrapolate, and so need more
    regularisation than the final fit.
    """
    table = np.stack(judged)
    best = np.argwhere(table <= np.nanmin(table) + _AS_GOOD)
    when, decay = min(best, key=lambda c: (c[1], -c[0]))
    return int(when), int(decay)


def _best_linear(
    data: windows.Samples, groups: list[int], sets: list[frozenset[int]], period_s: float
) -> tuple[windows.LinearFits, float]:
    """Linear models with the ridge that predicts held-out groups best."""
    singles = sets[: len(groups) + 1]
    scored = []
    for ridge in windows.RIDGES:
        fits = windows.fit_linear(data, singles, period_s, ridge)
        errors = [
            np.log(_group_rms(fits.residual[..., n + 1, None], data, g))
            for n, g in enumerate(groups)
        ]
        scored.append((float(np.nanmean(np.stack(errors))), ridge, fits))
    _, ridge, fits = min(scored, key=lambda s: s[0])
    return (
        fits if len(sets) == len(singles) else windows.fit_linear(data, sets, period_s, ridge)
    ), ridge


def _group_rms(error: NDArray, data: windows.Samples, group: int) -> NDArray[np.float64]:
    """RMS over a group's readings, shape (joints, candidates); NaN where a joint has none."""
    seen = data.used & (data.group == group)
    count = seen.sum((1, 2)).astype(float)
    total = np.sum(np.where(seen[..., None], error.astype(float) ** 2, 0.0), axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(total / count[:, None])


def _build(
    joints: Sequence[str],
    period_s: float,
    data: windows.Samples,
    linear: windows.LinearFits,
    n: int,
    weights: dict[str, NDArray],
) -> Learned:
    """Model of training set `n`; members of an MLP become one wide layer."""
    parameters: dict[str, NDArray] = {
        **data.normalisation, "fir": linear.fir[:, n], "fir_bias": linear.bias[:, n],
        "bound": linear.scale[:, n],
    }  # fmt: skip
    if "weight_hidden" in weights:
        parameters |= weights
        return RecurrentNetwork(joints, period_s, parameters, warm_up=data.past + 1)
    if weights:
        members, units = weights["bias_0"].shape[1:]
        count = linear.fir.shape[-1]
        first = np.moveaxis(weights["weight_0"], 1, 2).reshape(len(joints), count, members * units)
        parameters |= {
            "weight_0": first * windows.fading(count, period_s)[:, None],
            "bias_0": weights["bias_0"].reshape(len(joints), members * units),
            "weight_1": weights["weight_1"].reshape(len(joints), members * units, 1) / members,
            "bias_1": weights["bias_1"].mean(1)[:, None],
        }
    return CommandNetwork(joints, period_s, parameters)
