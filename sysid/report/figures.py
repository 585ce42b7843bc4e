"""The report's figures: each function takes results and returns a matplotlib `Figure`.

They only draw: curves come from `sysid.report.figure_data`, the style from `common.figure_style`.
Curves differ from each other in more than colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter

from pupper_sysid.common.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    JOINT_COLOURS,
    MARKERS,
    ORANGE,
    RED,
    SKY,
    axes_column,
    axes_grid,
    styled,
)
from pupper_sysid.sysid.lag.joint_response import FrequencyResponse
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.report.figure_data import (
    LONGEST_RUN,
    HoldRuns,
    response_errors,
    within,
)


@styled
def lag_budget_figure(budgets: Mapping[str, LagBudget]) -> Figure:
    """One stacked bar per joint: the parts of the time from a command's row to its position's row.

    Parameters
    ----------
    budgets : dict of joint to LagBudget
        With their dead times.
    """
    figure, (axes,) = axes_column(1, 1.9 + 0.52 * len(budgets))
    ends = [_lag_bar(axes, row, budget) for row, budget in enumerate(budgets.values())]
    axes.set_yticks(range(len(budgets)), list(budgets))
    axes.set_ylim(len(budgets) - 0.4, -0.6)
    axes.set_xlim(0, max(ends) * 1.14)
    axes.set_xlabel("time after the command's row [ms]")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    kinds = [
        Patch(facecolor=c, hatch=h, edgecolor="white", lw=0, label=n) for n, c, h in _LAG_KINDS
    ]
    whisker = Line2D([], [], color=INK, marker="|", ms=8, markevery=[0, -1], lw=1.5)
    whisker.set_label("90 % interval of the dead time")
    raw = Line2D([], [], color=INK, lw=2.2, label="raw lag, the sum")
    figure.legend(
        handles=[*kinds, raw, whisker], loc="outside upper left", ncols=2, numpoints=2,
        columnspacing=1.2,
    )  # fmt: skip
    return figure


_LAG_KINDS = (
    ("command hold", SKY, ""),
    ("dead time", BLUE, ""),
    ("dynamics", GREEN, ""),
    ("stale readings (bus poll)", ORANGE, "///"),
)


_LIGHT, _DARK = "#fdfdfd", "#111111"
"""Letters on bars, which stay light or dark on a dark page."""


def _lag_bar(axes: Axes, row: int, part: LagBudget) -> float:
    """Draw one joint's bar; returns where it ends [ms]."""
    raw, dead_time = 1e3 * part.raw_lag_s.value, part.dead_time_s
    assert dead_time is not None
    lengths = (part.command_hold_s, dead_time.value, part.dynamics_s, part.stale_lag_s)
    left = 0.0
    for (name, colour, hatch), length in zip(_LAG_KINDS, lengths, strict=True):
        shown = max(1e3 * length, 0.0)
        axes.barh(
            row, shown, left=left, height=0.62, color=colour, hatch=hatch, edgecolor="white", lw=0
        )
        if shown > 5.0:
            # the feedback's hatching would run through its number
            box = {"boxstyle": "round,pad=0.15", "fc": colour, "ec": "none"}
            axes.text(
                left + 0.5 * shown, row - 0.13 * (name == "dead time"), f"{shown:.0f}",
                ha="center", va="center", color=_LIGHT if colour in (BLUE, GREEN) else _DARK,
                bbox=box if hatch else None,
            )  # fmt: skip
        left += shown
    middle = 1e3 * (part.command_hold_s + dead_time.value)
    below = 1e3 * max(dead_time.value - dead_time.low, 0.0)
    above = 1e3 * max(dead_time.high - dead_time.value, 0.0)
    for colour, width in (("white", 3.2), (INK, 1.5)):
        axes.errorbar(
            middle, row + 0.17, xerr=[[below], [above]], color=colour, capsize=4, lw=width,
            capthick=width,
        )  # fmt: skip
    axes.plot([raw, raw], [row - 0.4, row + 0.4], color=INK, lw=2.2)
    axes.text(raw + 0.015 * max(raw, 1.0), row, f"{raw:.0f}", va="center", weight="bold")
    return max(raw, left)


@styled
def hold_histogram_figure(found: Mapping[str, HoldRuns]) -> Figure:
    """For how many rows each reading stayed the same, counted and predicted by poll and loss.

    Parameters
    ----------
    found : dict of joint to HoldRuns
        From `sysid.report.figure_data.hold_runs`.
    """
    columns = 1 if len(found) <= _SINGLE else 3
    figure, grid = axes_grid(len(found), columns, 1.6)
    length = np.arange(1, LONGEST_RUN + 1)
    for n, (axes, (joint, runs)) in enumerate(zip(grid, found.items(), strict=True)):
        lattice = runs.lattice
        axes.bar(length, runs.count, color=ORANGE, label="counted")
        title = f"{joint}: {_LATTICE_WORDS.get(lattice.kind, lattice.kind)}"
        if runs.expected is not None:
            axes.plot(
                length, runs.expected, "D", color=INK, ms=5 if columns == 1 else 3,
                label="predicted by poll and loss",
            )  # fmt: skip
            lost = f"{100 * lattice.loss:.0f} %"
            period = f"{1e3 * lattice.poll_period_s:.2f} ms"
            title = f"{joint}: a poll every {period}, {lost} of them lost"
            if columns > 1:
                title = f"{joint}: {period}, {lost} lost"
        axes.set_title(title)
        if n % columns == 0:
            axes.set_ylabel("runs")
        axes.grid(axis="x", visible=False)
        axes.set_xticks(length, [str(n) for n in length[:-1]] + [f"≥{LONGEST_RUN}"])
        if n >= len(grid) - columns:
            axes.set_xlabel("rows with the same value")
    names = {}
    for axes in grid:
        handles, labels = axes.get_legend_handles_labels()
        names.update(zip(labels, handles, strict=True))
    figure.legend(list(names.values()), list(names), loc="outside upper left", ncols=2)
    return figure


_SINGLE = 3
"""Up to so many joints have a panel of full width each."""


_LATTICE_WORDS = {
    "every read": "live: each read shows the present position",
    "unresolved": "held, but no poll period found",
    "lattice": "polled, and how many polls were lost is not known",
}


@styled
def bode_figure(responses: Mapping[str, FrequencyResponse]) -> Figure:
    """Gain and phase over frequency: measured, from all rows, and of the fitted transfer function.

    Parameters
    ----------
    responses : dict of joint to FrequencyResponse
    """
    figure, (gain, phase) = axes_column(2, 6.4)
    for n, (joint, response) in enumerate(responses.items()):
        colour, mark = JOINT_COLOURS[n % len(JOINT_COLOURS)], MARKERS[n % len(MARKERS)]
        frequency, (gain_error, phase_error) = response.frequency_hz, response_errors(response)
        style = {"color": colour, "marker": mark, "ms": 5, "ls": "", "elinewidth": 1.2}
        decibels = 20 * np.log10(response.gain)
        gain.errorbar(frequency, decibels, yerr=gain_error, label=joint, **style)
        phase.errorbar(frequency, response.phase_deg, yerr=phase_error, **style)
        gain.plot(
            frequency, 20 * np.log10(np.abs(response.raw_response)), color=colour, marker=mark,
            ms=6, mfc="none", ls="",
        )  # fmt: skip
        for fit in list(response.transfer_functions.values())[-1:]:
            fine = np.geomspace(frequency[0], frequency[-1], 200)
            fitted = fit.evaluate(fine)
            gain.plot(fine, 20 * np.log10(np.abs(fitted)), color=colour, lw=1.2)
            phase.plot(fine, np.degrees(np.unwrap(np.angle(fitted))), color=colour, lw=1.2)
    gain.axhline(-3.01, color=INK, lw=1, ls=(0, (4, 2)))
    gain.text(1.0, -3.01, "−3 dB ", transform=gain.get_yaxis_transform(), ha="right", va="bottom")
    low, high = gain.get_ylim()
    gain.set_ylim(min(low, -4.0), max(high, 1.0))
    for axes in (gain, phase):
        axes.set_xscale("log")
        ticks = [f for f in _FREQUENCY_TICKS if axes.get_xlim()[0] <= f <= axes.get_xlim()[1]]
        axes.set_xticks(ticks, [f"{f:g}" for f in ticks])
        axes.xaxis.set_minor_formatter(NullFormatter())
    gain.set_ylabel("gain [dB]")
    phase.set_ylabel("phase [°]")
    phase.set_xlabel("frequency [Hz]")
    handles, _ = gain.get_legend_handles_labels()
    hollow = Line2D([], [], color=INK, marker="o", mfc="none", ls="", label="raw: all rows")
    line = Line2D([], [], color=INK, lw=1.2, label="fitted")
    figure.legend(handles=[*handles, hollow, line], loc="outside upper left", ncols=3)
    return figure


_FREQUENCY_TICKS = (0.1, 0.2, 0.5, 1, 2, 3, 4, 5, 7, 10, 15, 20)


@styled
def sweep_figure(trials: Sequence[Trial], periods: float = 3.0) -> Figure:
    """Commands and readings, a panel per frequency; stale readings are faint.

    Parameters
    ----------
    trials : sequence of Trial
        Tones of one joint.
    periods : float
        Number of periods to show, from the middle of each trial.
    """
    figure, panels = axes_column(len(trials), 0.6 + 1.35 * len(trials))
    for axes, trial in zip(panels, trials, strict=True):
        start = float(np.median(trial.send_time_s))
        shown = within(trial.send_time_s, start, start + periods / trial.frequency_hz)
        time = trial.send_time_s[shown] - start
        reading = trial.position_rad[shown]
        fresh = np.diff(reading, prepend=np.nan) != 0
        axes.plot(time, trial.command_rad[shown], "--", color=BLUE, lw=1.2, label="command")
        axes.plot(time[~fresh], reading[~fresh], "o", ms=2.5, color=FAINT, label="stale reading")
        axes.plot(time[fresh], reading[fresh], "o", ms=3.0, color=RED, label="fresh reading")
        axes.set_title(f"{trial.joint}, {trial.frequency_hz:g} Hz")
        axes.set_ylabel("rad")
    panels[0].legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    panels[-1].set_xlabel("time [s]")
    return figure
