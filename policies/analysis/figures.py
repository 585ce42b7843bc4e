"""Figures of the analyses of policies: delay curves, ablations, orbits, gaits, demand on servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pupper_sysid.common.figure_style import (
    BLUE,
    GREEN,
    INK,
    JOINT_COLOURS,
    RED,
    axes_column,
    styled,
)
from pupper_sysid.common.joints import KINDS, LEGS
from pupper_sysid.policies.analysis.autonomy import Autonomy
from pupper_sysid.policies.analysis.gait import SETTLE_S, intervals
from pupper_sysid.policies.analysis.servo_demand import ServoDemand
from pupper_sysid.policies.analysis.trial import (
    AblationPoint,
    DelayPoint,
    DirectionWalk,
    GroundPoint,
)
from pupper_sysid.policies.walks.rollouts import Rollout

_MODES = {"fixed": "-", "jittered": "--", "replay": ":"}
_SHOWN_S = 2.0
_THIGH = 1  # LF thigh, as the paper draws


@styled
def delay_figure(curves: Mapping[str, Sequence[DelayPoint]]) -> Figure:
    """Survival, frequency and amplitude against more delay; a colour per policy."""
    titles = {
        "survival": "share still up", "frequency_hz": "gait [Hz]",
        "amplitude_rad": "amplitude [rad]",
    }  # fmt: skip
    points = [row for rows in curves.values() for row in rows]
    # walks too short for a rhythm have none to show
    names = {n: t for n, t in titles.items() if any(np.isfinite(getattr(r, n)) for r in points)}
    figure, axes = axes_column(len(names), 2.2 * len(names))
    for (name, title), panel in zip(names.items(), axes, strict=True):
        for k, (policy, rows) in enumerate(curves.items()):
            colour = _colour(k)
            for mode, line in _MODES.items():
                chosen = [r for r in rows if r.mode == mode and np.isfinite(getattr(r, name))]
                if chosen:
                    panel.plot(
                        [r.extra_delay_ms for r in chosen], [getattr(r, name) for r in chosen],
                        line, color=colour, marker="o", ms=3, label=f"{policy}, {mode}",
                    )  # fmt: skip
        panel.set_ylabel(title)
    if "survival" in names:
        axes[0].set_ylim(-0.05, 1.05)
    axes[-1].set_xlabel("more delay [ms]")
    axes[min(1, len(axes) - 1)].legend(fontsize=7)
    return figure


@styled
def ablation_figure(tables: Mapping[str, Sequence[AblationPoint]]) -> Figure:
    """Gait correlation in replay against noise, with the level of zeros as a line."""
    figure, axes = axes_column(len(tables), 2.6 * len(tables))
    for (policy, rows), panel in zip(tables.items(), axes, strict=True):
        channels = list(dict.fromkeys(r.channel for r in rows))
        for channel, colour in zip(channels, JOINT_COLOURS, strict=False):
            noise = [r for r in rows if r.channel == channel and r.kind == "noise"]
            zero = next(r for r in rows if r.channel == channel and r.kind == "zero")
            label = channel.replace("_", " ")
            panel.semilogx(
                [r.level for r in noise], [r.correlation for r in noise], color=colour,
                marker="o", ms=3, label=label,
            )  # fmt: skip
            panel.axhline(zero.correlation, color=colour, ls=":", lw=1)
        panel.set_title(policy)
        panel.set_ylabel("correlation of actions")
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
        for panel, condition, delay in zip(row, conditions, delays_ms, strict=True):
            panel.plot(condition[:, 0], condition[:, 1], color=BLUE, lw=0.6)
            panel.set(xlim=(-reach, reach), ylim=(-reach, reach), xticks=[], yticks=[])
            panel.set_title(f"{name}, +{delay:g} ms", fontsize=8)
    return figure


@styled
def gait_figure(rollout: Rollout) -> Figure:
    """Stance bars of the four feet, LF thigh's angle, and its action, over two seconds.

    Of the first robot that is up that long, with the thighs of others behind; empty if none is.
    """
    start = round(SETTLE_S / rollout.step_s)
    stop = start + round(_SHOWN_S / rollout.step_s)
    time = np.arange(stop - start) * rollout.step_s
    up = np.flatnonzero(rollout.alive[stop - 1]) if len(rollout.alive) >= stop else []
    figure, (feet, thigh, action) = axes_column(3, 6.0)
    for i, leg in enumerate(LEGS):
        for robot in up[:1]:
            for begin, length in intervals(rollout.contact[start:stop, robot, i], rollout.step_s):
                feet.barh(3 - i, length, left=begin, color=INK, height=0.6)
        feet.text(-0.02, 3 - i, leg, ha="right", va="center", transform=feet.get_yaxis_transform())
    feet.set(yticks=[], xlim=(0, time[-1]), title="feet on the ground")
    for k, robot in enumerate(up[:7]):
        bold = {"lw": 1.6, "color": RED} if k == 0 else {"lw": 0.5, "color": "#bbbbbb"}
        thigh.plot(time, rollout.joint_position[start:stop, robot, _THIGH], **bold)
    thigh.set(ylabel="LF thigh [rad]", xlim=(0, time[-1]))
    for robot in up[:1]:
        action.plot(time, rollout.action_rad[start:stop, robot, _THIGH], color=GREEN)
    action.set(ylabel="its action [rad]", xlabel="time [s]", xlim=(0, time[-1]))
    return figure


@styled
def autonomy_figure(tests: Mapping[str, Autonomy]) -> Figure:
    """Amplitude with inputs frozen, phase shift after pushes, and frequency against rate."""
    figure, (bars, shifts, rates) = axes_column(3, 8.0)
    count = len(tests)
    for k, (policy, test) in enumerate(tests.items()):
        colour = _colour(k)
        rows = test.frozen
        places = np.arange(len(rows)) + 0.8 * k / count
        bars.barh(places, [r.share for r in rows], 0.8 / count, color=colour, label=policy)
        for row, mark in zip(test.push, ("x", "o"), strict=False):  # none if no robot walked
            shifts.plot(
                row.phases, row.shifts, mark, ms=3, color=colour, ls="",
                label=f"{policy}, {row.push_m_s:g} m/s",
            )  # fmt: skip
        rates.plot(
            [r.rate_hz for r in test.rate], [r.frequency_hz for r in test.rate],
            marker="o", ms=3, color=colour, label=policy,
        )  # fmt: skip
    names = [r.test for r in next(iter(tests.values())).frozen]
    bars.set_yticks(np.arange(len(names)) + 0.4 * (count - 1) / count, names, fontsize=7)
    bars.set_xlabel("amplitude of the actions, share of that before")
    shifts.set(xlabel="phase at the push [cycles]", ylabel="shift [cycles]", ylim=(-0.52, 0.52))
    rates.set(xlabel="control rate [Hz]", ylabel="gait [Hz]", ylim=(0, None))
    for axes in (bars, shifts, rates):
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=6.5)
    return figure


@styled
def terrain_figure(tables: Mapping[str, Sequence[GroundPoint]]) -> Figure:
    """Survival and forward error on every kind of ground, a group of bars per ground."""
    names = {"survival": "share still up", "mae_vx_m_s": "forward error [m/s]"}
    figure, axes = axes_column(len(names), 2.4 * len(names))
    for panel, (key, title) in zip(axes, names.items(), strict=True):
        for k, (policy, rows) in enumerate(tables.items()):
            places = np.arange(len(rows)) + 0.8 * k / len(tables)
            heights, width = [getattr(r, key) for r in rows], 0.8 / len(tables)
            panel.bar(places, heights, width, color=_colour(k), label=policy)
        grounds = [r.ground for r in next(iter(tables.values()))]
        panel.set_xticks(np.arange(len(grounds)) + 0.4 * (len(tables) - 1) / len(tables), grounds)
        panel.set_ylabel(title)
    axes[-1].legend(fontsize=7, loc="lower right")
    return figure


@styled
def compliance_figure(tables: Mapping[str, Sequence[DirectionWalk]]) -> Figure:
    """Paths of one robot in six directions seen from above, a panel per policy."""
    figure, axes = axes_column(len(tables), 3.4 * len(tables))
    for panel, (policy, rows) in zip(axes, tables.items(), strict=True):
        for row, colour in zip(rows, JOINT_COLOURS, strict=False):
            path = np.asarray(row.path)
            if len(path):
                # forward is up, left is left
                panel.plot(-path[:, 1], path[:, 0], color=colour, lw=1.2, label=row.direction)
        panel.set_aspect("equal")
        panel.set(title=policy, xlabel="to the right [m]", ylabel="forward [m]")
    if axes[0].lines:
        axes[0].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _colour(k: int) -> str:
    return JOINT_COLOURS[k % len(JOINT_COLOURS)]


_SHOWN = 4000


@styled
def demand_figure(demand: ServoDemand) -> Figure:
    """Needed torque over speed, by kind of joint; the line is what the servo has."""
    figure, axes = axes_column(len(demand.kinds), 2.3 * len(demand.kinds))
    for (kind, names), panel in zip(demand.kinds.items(), axes, strict=True):
        speed = np.concatenate([demand.samples[name][0] for name in names])
        torque = np.concatenate([demand.samples[name][1] for name in names])
        stride = max(1, len(speed) // _SHOWN)
        panel.plot(speed[::stride], torque[::stride], ".", ms=1.5, color=BLUE, rasterized=True)
        servo = demand.joints[names[0]]
        stall, top = servo.stall_torque_nm, servo.top_speed_rad_s
        end = float(speed.max())
        last = end if top is None else top
        at_last = stall if top is None else servo.torque_at_top_nm
        # driving the torque left falls with speed, braking it rises by as much
        panel.plot([0, last, last, 0], [stall, at_last, at_last - 2 * stall, -stall], color=RED)
        panel.set_title(kind if kind in KINDS else ", ".join(names))
        panel.set_ylabel("N·m")
    axes[0].plot([], [], color=RED, label=demand.servo)
    axes[0].legend(loc="center right")
    axes[-1].set_xlabel("speed [rad/s]; torque is positive where it drives")
    return figure
