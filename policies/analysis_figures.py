"""Pictures of the analyses of policies: delay curves, ablations, orbits and gaits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from common.figure_style import BLUE, GREEN, INK, JOINT_COLOURS, RED, axes_column, styled
from common.joints import LEGS
from policies.gait import intervals
from policies.rollouts import Rollout

_MODES = {"fixed": "-", "jittered": "--", "replay": ":"}
_SHOWN_S = 2.0
_SETTLE_S = 2.0
_THIGH = 1  # LF thigh, as the paper draws

Rows = Sequence[Mapping[str, Any]]


@styled
def delay_figure(curves: Mapping[str, Rows]) -> Figure:
    """Survival, frequency and amplitude against more delay; a colour per policy."""
    names = {"survival": "share still up", "frequency_hz": "gait [Hz]", "amplitude_rad": "rad"}
    figure, axes = axes_column(len(names), 2.2 * len(names))
    for (name, title), one in zip(names.items(), axes, strict=True):
        for (policy, rows), colour in zip(curves.items(), JOINT_COLOURS, strict=False):
            for mode, line in _MODES.items():
                chosen = [r for r in rows if r["mode"] == mode and np.isfinite(r[name])]
                if chosen:
                    one.plot(
                        [r["extra_delay_ms"] for r in chosen], [r[name] for r in chosen], line,
                        color=colour, marker="o", ms=3, label=f"{policy}, {mode}",
                    )  # fmt: skip
        one.set_ylabel(title)
    axes[-1].set_xlabel("more delay [ms]")
    axes[1].legend(fontsize=7)
    return figure


@styled
def ablation_figure(tables: Mapping[str, Rows]) -> Figure:
    """Gait correlation in replay against noise, with the level of zeros as a line."""
    figure, axes = axes_column(len(tables), 2.6 * len(tables))
    for (policy, rows), one in zip(tables.items(), axes, strict=True):
        channels = list(dict.fromkeys(r["channel"] for r in rows))
        for channel, colour in zip(channels, JOINT_COLOURS, strict=False):
            noise = [r for r in rows if r["channel"] == channel and r["kind"] == "noise"]
            zero = next(r for r in rows if r["channel"] == channel and r["kind"] == "zero")
            label = channel.replace("_", " ")
            one.semilogx(
                [r["level"] for r in noise], [r["correlation"] for r in noise], color=colour,
                marker="o", ms=3, label=label,
            )  # fmt: skip
            one.axhline(zero["correlation"], color=colour, ls=":", lw=1)
        one.set_title(policy)
        one.set_ylabel("correlation of actions")
    axes[-1].set_xlabel("noise, share of the channel's own deviation (dotted: zeros)")
    axes[0].legend(fontsize=7)
    return figure


@styled
def orbit_figure(orbits: Mapping[str, Sequence[NDArray[np.floating]]], delays_ms: Sequence[float]):
    """First two principal components, a row per kind of state, a column per delay."""
    figure = Figure(figsize=(2.2 * len(delays_ms), 2.2 * len(orbits)), layout="constrained")
    axes = figure.subplots(len(orbits), len(delays_ms), squeeze=False)
    for row, (name, conditions) in zip(axes, orbits.items(), strict=True):
        reach = max(np.abs(c[:, :2]).max() for c in conditions)
        for one, condition, delay in zip(row, conditions, delays_ms, strict=True):
            one.plot(condition[:, 0], condition[:, 1], color=BLUE, lw=0.6)
            one.set(xlim=(-reach, reach), ylim=(-reach, reach), xticks=[], yticks=[])
            one.set_title(f"{name}, +{delay:g} ms", fontsize=8)
    return figure


@styled
def autonomy_figure(tables: Mapping[str, Rows]) -> Figure:
    """Amplitude that is left with inputs frozen, a group of bars per policy."""
    figure, (axes,) = axes_column(1, 3.0)
    for k, (policy, rows) in enumerate(tables.items()):
        places = np.arange(len(rows)) + 0.8 * k / len(tables)
        shares = [r["share"] for r in rows]
        axes.barh(places, shares, 0.8 / len(tables), color=JOINT_COLOURS[k], label=policy)
    tests = [r["test"] for r in next(iter(tables.values()))]
    axes.set_yticks(np.arange(len(tests)) + 0.2, tests, fontsize=7)
    axes.set_xlabel("amplitude of the actions, share of that before")
    axes.legend(fontsize=7)
    return figure


@styled
def gait_figure(rollout: Rollout, robot: int = 0) -> Figure:
    """Stance bars of the four feet, LF thigh's angle, and its action, over two seconds."""
    start = round(_SETTLE_S / rollout.step_s)
    stop = start + round(_SHOWN_S / rollout.step_s)
    time = np.arange(stop - start) * rollout.step_s
    figure, (feet, thigh, action) = axes_column(3, 6.0)
    for i, leg in enumerate(LEGS):
        for begin, length in intervals(rollout.contact[start:stop, robot, i], rollout.step_s):
            feet.barh(3 - i, length, left=begin, color=INK, height=0.6)
        feet.text(-0.02, 3 - i, leg, ha="right", va="center", transform=feet.get_yaxis_transform())
    feet.set(yticks=[], xlim=(0, time[-1]), title="feet on the ground")
    for i in range(min(rollout.joint_position.shape[1], 7)):
        bold = {"lw": 1.6, "color": RED} if i == robot else {"lw": 0.5, "color": "#bbbbbb"}
        thigh.plot(time, rollout.joint_position[start:stop, i, _THIGH], **bold)
    thigh.set(ylabel="LF thigh [rad]", xlim=(0, time[-1]))
    action.plot(time, rollout.action_rad[start:stop, robot, _THIGH], color=GREEN)
    action.set(ylabel="its action [rad]", xlabel="time [s]", xlim=(0, time[-1]))
    return figure
