"""The report's figures: each function takes results and returns a matplotlib `Figure`.

Curves differ from each other in more than colour (`common.figure_style`); what can be hidden on a
page has a `gid`. `tracks` is the free run of a fitted model beside commands and readings;
`hold_runs` counts for how many rows readings stay the same, beside the prediction of the poll
lattice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from pupper_sysid.common.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    JOINT_COLOURS,
    MARKERS,
    ORANGE,
    PINK,
    RED,
    SKY,
    axes_column,
    axes_grid,
    styled,
)
from pupper_sysid.common.interval import HALF_WIDTH_SD
from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.kernel import COLUMNS
from pupper_sysid.sysid.backlash import JointBacklash
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, simulate
from pupper_sysid.sysid.fit.structure import candidate, loaded_columns
from pupper_sysid.sysid.lag.frequency_response import FrequencyResponse
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData


@styled
def lag_budget_figure(budgets: Mapping[str, LagBudget]) -> Figure:
    """One stacked bar per joint: parts of the time from a command's row to its position's row."""
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
    ("command hold", SKY, ""), ("dead time", BLUE, ""), ("dynamics", GREEN, ""),
    ("stale readings (bus poll)", ORANGE, "///"),
)  # fmt: skip
_LIGHT, _DARK = "#fdfdfd", "#111111"  # letters on bars, which stay so on a dark page


def _lag_bar(axes: Axes, row: int, part: LagBudget) -> float:
    """Draw one joint's bar; returns where it ends [ms]."""
    raw, dead_time = 1e3 * part.raw_lag_s.value, part.dead_time_s
    assert dead_time is not None
    lengths = (part.command_hold_s, dead_time.value, part.dynamics_s, part.stale_lag_s)
    at = 0.0
    for (name, colour, hatch), length in zip(_LAG_KINDS, lengths, strict=True):
        long = max(1e3 * length, 0.0)
        axes.barh(
            row, long, left=at, height=0.62, color=colour, hatch=hatch, edgecolor="white", lw=0
        )
        if long > 5.0:
            # the feedback's hatching would run through its number
            box = {"boxstyle": "round,pad=0.15", "fc": colour, "ec": "none"}
            axes.text(
                at + 0.5 * long, row - 0.13 * (name == "dead time"), f"{long:.0f}",
                ha="center", va="center", color=_LIGHT if colour in (BLUE, GREEN) else _DARK,
                bbox=box if hatch else None,
            )  # fmt: skip
        at += long
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
    return max(raw, at)


@styled
def hold_histogram_figure(holds: Mapping[str, HoldRuns]) -> Figure:
    """For how many rows each reading stayed the same, counted and predicted by poll and loss."""
    columns = 1 if len(holds) <= _SINGLE else 3
    figure, grid = axes_grid(len(holds), columns, 1.6)
    length = np.arange(1, LONGEST_RUN + 1)
    for n, (axes, (joint, runs)) in enumerate(zip(grid, holds.items(), strict=True)):
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


_SINGLE = 3  # up to so many joints have a panel of full width each
_LATTICE_WORDS = {
    "every read": "live: each read shows the present position",
    "unresolved": "held, but no poll period found",
    "lattice": "polled, and how many polls were lost is not known",
}


@styled
def bode_figure(responses: Mapping[str, FrequencyResponse]) -> Figure:
    """Gain and phase over frequency: measured, of all rows, and of the fitted transfer function."""
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
    gain.text(0.0, -3.01, " −3 dB", transform=gain.get_yaxis_transform(), va="top")
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


_SHOWN_PERIODS, _SHOWN_S = 2.5, 3.0  # of a tone, and of other motion
LONGEST_RUN = 12  # hold runs of this many rows and more share the last bar


class Track:
    """One trial: command, model and readings; angles from rest [rad], times [s], speeds [rad/s].

    `time_s`, `command_rad` and `model_rad` are on the physics clock, from the trial's start, shape
    (steps,). What begins with `fresh` is of fresh readings at the time that they were measured,
    shape (fresh,); with `row`, of every reading at the time of its row, shape (rows,), NaN where it
    is missing. Errors are reading minus model, speeds those of the model. The frequency is NaN if
    the trial is no tone.
    """

    def __init__(self, run: Run, simulated: NDArray):
        rest = run.rest_rad
        # over a few steps: dry friction makes the speed of a single one jump
        smooth = np.convolve(np.pad(simulated, 2, mode="edge"), np.ones(5) / 5, mode="valid")
        speed = np.gradient(smooth, TIME_STEP_S)
        self.frequency_hz = run.frequency_hz
        self.time_s = np.arange(run.steps) * np.float64(TIME_STEP_S)
        self.command_rad, self.model_rad = run.command - rest, simulated[: run.steps] - rest
        self.fresh_time_s, self.fresh_rad = TIME_STEP_S * run.sample_step, run.sample_rad - rest
        self.row_time_s, self.row_rad = TIME_STEP_S * run.row_step, run.row_rad - rest
        self.fresh_error_rad = run.sample_rad - at_steps(simulated, run.sample_step)
        self.row_error_rad = run.row_rad - at_steps(simulated, run.row_step)
        self.fresh_speed_rad_s = at_steps(speed, run.sample_step)
        self.row_speed_rad_s = at_steps(speed, run.row_step)


def tracks(result: JointCalibrationResult, model: str | None = None) -> list[Track]:
    """Free run of a fitted model on every trial of its joint, by default the one simulators run.

    A joint under load has one model.
    """
    if not result.runs:
        return []
    if (loaded := result.loaded) is not None:
        columns = loaded_columns(loaded.servo)
        for name in {"gravity_nm", "hanging_rad", "offset_rad"} & loaded.numbers.keys():
            columns[COLUMNS.index(name)] = loaded.numbers[name].value
        dead_time_s = np.array([float(np.asarray(loaded.servo.dead_time_s))])
        simulated = [simulate(columns[None], dead_time_s, run)[:, 0] for run in result.runs]
    else:
        model = model or result.simulated_model
        fitted = candidate(model)
        values = np.array([result.candidate_models[model].values[name] for name in fitted.names])
        simulated = free_run(fitted, values, result.runs)
    return [Track(*pair) for pair in zip(result.runs, simulated, strict=True)]


def window(track: Track) -> tuple[float, float]:
    """Start and end of the stretch of `track` to show [s]: steady tone, or largest motion."""
    end = float(track.time_s[-1])
    if track.frequency_hz > 0:
        length = min(_SHOWN_PERIODS / track.frequency_hz, end)
        start = min(0.5 * end, end - length)
        return start, start + length
    part = busiest(track.command_rad, int(_SHOWN_S / TIME_STEP_S))
    return float(track.time_s[part.start]), float(track.time_s[part.stop - 1])


def within(time: NDArray, start: float, stop: float) -> NDArray[np.bool_]:
    """Which times lie within a stretch, its ends included."""
    return (time >= start) & (time <= stop)


def some_tracks(every: list[Track], count: int = 4) -> list[Track]:
    """At most `count` tracks, spread over their frequencies, slowest first."""
    order = sorted(every, key=lambda t: t.frequency_hz if t.frequency_hz > 0 else 0.0)
    seen: dict[float, Track] = {}
    for n, track in enumerate(order):
        seen.setdefault(
            round(track.frequency_hz, 2) if track.frequency_hz > 0 else -float(n), track
        )
    order = list(seen.values())
    index = np.unique(np.round(np.linspace(0, len(order) - 1, min(count, len(order)))).astype(int))
    return [order[i] for i in index]


def response_errors(response: FrequencyResponse) -> tuple[NDArray, NDArray]:
    """Half of the 90 % intervals of gain [dB] and phase [degrees], shape (tones,) each."""
    along = response.response / np.abs(response.response)
    sd = []
    for direction in (along, 1j * along):
        u = np.stack([direction.real, direction.imag], axis=-1)
        sd.append(np.sqrt(np.einsum("ni,nij,nj->n", u, response.covariance, u)))
    relative = HALF_WIDTH_SD * np.array(sd) / np.abs(response.response)
    return 20 / np.log(10) * relative[0], np.degrees(relative[1])


@dataclass(frozen=True)
class HoldRuns:
    """For how many rows a reading stays the same."""

    lattice: PollLattice
    count: NDArray[np.int64]
    """Shape (LONGEST_RUN,). Runs of 1, 2, … rows; the last holds all longer ones."""
    expected: NDArray[np.float64] | None
    """Shape (LONGEST_RUN,). Predicted by the poll period and the share of lost polls; None without
    a lattice."""


def hold_runs(
    histograms: Sequence[tuple[int, ...]], loop_periods_s: Sequence[float], lattice: PollLattice
) -> HoldRuns:
    """Hold runs of one joint, counted by the doctor and predicted by its poll lattice.

    `histograms` has runs of 1, 2, … rows in each recording; they are added.
    """
    count = np.zeros(LONGEST_RUN, dtype=np.int64)
    for histogram in histograms:
        length = np.clip(np.arange(len(histogram)), 0, LONGEST_RUN - 1)
        np.add.at(count, length, np.array(histogram, dtype=np.int64))
    if lattice.kind != "lattice" or not count.any() or not np.isfinite(lattice.loss):
        return HoldRuns(lattice, count, None)
    # between two good polls lie k periods with probability (1 - loss) loss^(k-1); a gap of x rows,
    # at a random phase of the loop, is seen as floor(x) or ceil(x) rows, on average as x
    share, k = np.zeros(LONGEST_RUN + 1), np.arange(1, 200)
    weight = (1 - lattice.loss) * lattice.loss ** (k - 1)
    gap = k * lattice.poll_period_s / float(np.median(loop_periods_s))
    for rows, chance in ((np.floor(gap), 1 - gap % 1), (np.floor(gap) + 1, gap % 1)):
        np.add.at(share, np.clip(rows, 0, LONGEST_RUN).astype(int), weight * chance)
    share = share[1:] / max(share[1:].sum(), 1e-12)  # several polls within a row leave one run
    return HoldRuns(lattice, count, count.sum() * share)


@styled
def overlay_figure(result: JointCalibrationResult, runs: list[Track] | None = None) -> Figure:
    """Command, model and readings, the fresh ones at the time they were measured."""
    chosen = some_tracks(tracks(result) if runs is None else runs)
    figure, grid = axes_column(len(chosen), 1.2 + 1.75 * len(chosen))
    for axes, track in zip(grid, chosen, strict=True):
        _overlay(axes, track, result.joint, 1.0)
        axes.set_ylabel("from rest [rad]")
    grid[-1].set_xlabel("time in the trial [s]")
    figure.legend(
        *grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, columnspacing=1.0
    )
    return figure


@styled
def overlay_grid(by_joint: Mapping[str, list[Track]]) -> Figure:
    """The same of every joint beside the others, one frequency each; no joint without tracks."""

    def draw(axes: Axes, joint: str, joint_tracks: list[Track]) -> None:
        spread = some_tracks(joint_tracks, 3)
        _overlay(axes, spread[len(spread) // 2], joint, 0.7)

    columns = 2 if len(by_joint) < 3 else 4  # of a narrow and of a wide figure
    return _small_multiples(by_joint, draw, "time in the trial [s]", "from rest [rad]", columns)


def _small_multiples(
    by_joint: Mapping[str, list[Track]], draw: Callable[[Axes, str, list[Track]], None],
    below: str, beside: str, columns: int,
) -> Figure:  # fmt: skip
    """A panel per joint, three in a row, with one legend of `columns`."""
    figure, grid = axes_grid(len(by_joint), 3, 1.75)
    for n, (axes, (joint, joint_tracks)) in enumerate(zip(grid, by_joint.items(), strict=True)):
        draw(axes, joint, joint_tracks)
        if n % 3 == 0:
            axes.set_ylabel(beside)
        if n >= len(grid) - 3:
            axes.set_xlabel(below)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=columns)
    return figure


def _overlay(axes: Axes, track: Track, joint: str, size: float) -> None:
    """One trial; marks and lines are `size` times as large as usual."""
    start, stop = window(track)
    fine, row = within(track.time_s, start, stop), within(track.row_time_s, start, stop)
    fresh = within(track.fresh_time_s, start, stop)
    axes.plot(
        track.time_s[fine], track.command_rad[fine], color=INK, lw=1, ls=(0, (4, 2)),
        label="command (zero-order hold)", gid="part:command",
    )  # fmt: skip
    axes.plot(
        track.row_time_s[row], track.row_rad[row], color=FAINT, lw=0.9, marker=".", ms=3.5 * size,
        drawstyle="steps-post", label="raw readings", gid="part:raw",
    )  # fmt: skip
    axes.plot(
        track.time_s[fine], track.model_rad[fine], color=BLUE, lw=1.5 * size, label="DelayedPD",
        gid="part:model", zorder=3,  # over readings that follow each other closely
    )  # fmt: skip
    axes.plot(
        track.fresh_time_s[fresh], track.fresh_rad[fresh], "o", color=RED, ms=5 * size,
        mec="white", mew=0.6 * size, label="fresh readings, when measured", gid="part:fresh",
    )  # fmt: skip
    hertz = f", {track.frequency_hz:.3g} Hz" if track.frequency_hz > 0 else ""
    axes.set_title(f"{joint}{hertz}")
    axes.set_xlim(start, stop)


OVERLAY_PARTS = {
    "command": "command", "raw": "raw readings", "model": "model", "fresh": "fresh readings"
}  # fmt: skip
"""Parts of an overlay by the end of their `gid`, and what they are called."""


@styled
def residual_figure(result: JointCalibrationResult, runs: list[Track] | None = None) -> Figure:
    """Residuals of the model: over speed, fresh and raw; and over time."""
    runs = tracks(result) if runs is None else runs
    figure, (over_speed, over_time) = axes_column(2, 6.0)
    lattice = result.lag.feedback
    age = 1e3 * (lattice.mean_age_s if np.isfinite(lattice.mean_age_s) else result.lag.stale_lag_s)
    rows = f"all rows at their own time (dashed: speed × {age:.0f} ms)"
    _residuals_over_speed(over_speed, runs, 1.0, rows)
    fastest = np.max([np.max(np.abs(t.row_speed_rad_s), initial=0.0) for t in runs], initial=0.0)
    reach = np.array([-1.0, 1.0]) * fastest
    over_speed.plot(reach, -age * reach, color=INK, lw=1.2, ls=(0, (4, 2)))
    over_speed.set_xlabel("speed of the model [rad/s]")
    over_speed.set_ylabel("reading − model [mrad]")
    start = 0.0
    for n, track in enumerate(runs):
        over_time.plot(
            start + track.fresh_time_s, 1e3 * track.fresh_error_rad, ".", color=RED, ms=4
        )
        if track.frequency_hz > 0 and len(runs) <= 12:
            over_time.text(
                start + 0.5 * track.time_s[-1], 0.97, f"{track.frequency_hz:.3g} Hz",
                transform=over_time.get_xaxis_transform(), ha="center", va="top",
                fontsize=9,
            )  # fmt: skip
        start += float(track.time_s[-1])
        if n < len(runs) - 1:
            over_time.axvline(start, color=FAINT, lw=0.8)
    over_time.axhline(0, color=INK, lw=0.8)
    over_time.margins(x=0.01, y=0.2)
    over_time.set_xlabel("time, trials end to end [s]")
    over_time.set_ylabel("fresh − model [mrad]")
    figure.legend(*over_speed.get_legend_handles_labels(), loc="outside upper left", ncols=1)
    return figure


@styled
def residual_grid(by_joint: Mapping[str, list[Track]]) -> Figure:
    """Fresh and raw residuals over speed, of every joint beside the others."""

    def draw(axes: Axes, joint: str, joint_tracks: list[Track]) -> None:
        _residuals_over_speed(axes, joint_tracks, 0.7, "all rows at their own time")
        axes.set_title(joint)

    speed, error = "speed of the model [rad/s]", "reading − model [mrad]"
    return _small_multiples(by_joint, draw, speed, error, 1 if len(by_joint) < 3 else 2)


def _residuals_over_speed(axes: Axes, runs: list[Track], size: float, rows: str) -> None:
    def gathered(name: str) -> NDArray:
        return np.concatenate([getattr(t, name) for t in runs])

    axes.plot(
        gathered("row_speed_rad_s"), 1e3 * gathered("row_error_rad"), ".", color=FAINT,
        ms=3 * size, label=rows, rasterized=True, gid="part:raw",
    )  # fmt: skip
    axes.plot(
        gathered("fresh_speed_rad_s"), 1e3 * gathered("fresh_error_rad"), "o", color=RED,
        ms=3.5 * size, mec="white", mew=0.3, label="fresh rows when they were measured",
        rasterized=True, gid="part:fresh",
    )  # fmt: skip


_PANEL_IN = 2.8


@styled
def hysteresis_figure(joints: Mapping[str, JointBacklash]) -> Figure:
    """Hysteresis with its 90 % interval over the P gain, a panel per joint."""
    figure, panels = axes_column(len(joints), _PANEL_IN * len(joints))
    for axes, (joint, backlash) in zip(panels, joints.items(), strict=True):
        gains = np.array([g.p_gain for g in backlash.gains])
        known = np.isfinite(gains).all()
        place = gains if known else np.arange(len(gains), dtype=float)
        best, low, high = np.degrees([astuple(g.hysteresis_rad) for g in backlash.gains]).T
        axes.errorbar(
            place, best, [best - low, high - best], fmt="o", color=BLUE, capsize=3,
            label="hysteresis, 90 %",
        )  # fmt: skip
        if known and len(gains) > 1:
            lowest = int(np.argmin(gains))
            line = np.linspace(gains.min(), gains.max(), 200)
            axes.plot(
                line, best[lowest] * gains[lowest] / line, "--", color=FAINT,
                label="friction alone: as 1/P",
            )  # fmt: skip
        if (zone := backlash.dead_zone_rad) is not None:
            ends = 2 * np.degrees([zone.low, zone.high])
            axes.axhspan(*ends, color=ORANGE, alpha=0.3, lw=0, label="twice the dead zone, 90 %")
        axes.set_ylim(bottom=0)
        axes.set_xticks(place, [f"{g:g}" if known else "?" for g in gains])
        axes.set_xlabel("P gain")
        axes.set_ylabel("hysteresis [°]")
        play = backlash.backlash_rad
        verdict = (
            "not determined"
            if play is None
            else "{:.2f}° [{:.2f}, {:.2f}]".format(*np.degrees(astuple(play)))
        )
        axes.set_title(f"{joint}: backlash {verdict}")
        axes.legend()
    return figure


_COLOURS = (BLUE, RED, GREEN, ORANGE, PINK)
_LINES = ("-", "--", "-.", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))


@styled
def free_run_figure(
    data: ServoData,
    tracks: Mapping[str, scores.Tracks],
    errors: Mapping[str, Mapping[str, scores.Errors]],
    bands: Mapping[str, Mapping[str, scores.Band]],
    joints: Sequence[str] | None = None,
) -> Figure:
    """One panel per joint: the seconds in which its command moves most.

    All mappings are by model; errors and bands then by joint. Bands are drawn for the first model.
    """
    names = list(data.joints if joints is None else joints)
    figure, panels = axes_column(len(names), 0.7 + 1.75 * len(names))
    for axes, joint in zip(panels, names, strict=True):
        index, part = _liveliest(data, joint)
        run, low, high = data.runs[joint][index], part.start, part.stop
        ticks = np.arange(low, high)
        time = run.trial.send_time_s[part] - run.trial.send_time_s[low]
        axes.step(time, run.command_rad[part], where="post", color=FAINT, lw=1.0, label="command")
        inside = (run.tick >= low) & (run.tick < high - 1)
        when = np.interp(run.tick[inside], ticks, time)
        axes.plot(when, run.position_rad[inside], "o", ms=3.2, color=INK, label="reading")
        for n, (name, model_tracks) in enumerate(tracks.items()):
            track = model_tracks[joint][index]
            track = track[:: scores.steps_per_tick(track, run)]
            colour = _COLOURS[n % len(_COLOURS)]
            error = 1e3 * rms(errors[name][joint].free_run)
            label = f"{name}, {error:.1f} mrad"
            axes.plot(
                time, track[part], ls=_LINES[n % len(_LINES)], color=colour, lw=1.5, label=label
            )
            band = bands.get(name, {}).get(joint)
            if band and n == 0:
                half = scores.band_half_width(band, np.gradient(track) / data.period_s)[part]
                middle = track[part]
                axes.fill_between(
                    time, middle - half, middle + half, color=colour, alpha=0.15, lw=0
                )
        axes.set_title(joint)
        axes.set_ylabel("rad")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5, handlelength=2.2)
    panels[-1].set_xlabel("time [s]")
    figure.set_figwidth(8.0)
    return figure


def busiest(command_rad: NDArray[np.float64], rows: int) -> slice:
    """The `rows` consecutive rows in which a command moves most."""
    if len(command_rad) <= rows:
        return slice(0, len(command_rad))
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(command_rad)))])
    start = int(np.argmax(path[rows:] - path[:-rows]))
    return slice(start, start + rows)


def _liveliest(data: ServoData, joint: str) -> tuple[int, slice]:
    """Run and rows of the few seconds in which the command moves most."""
    rows = round(_SHOWN_S / data.period_s)
    parts = [busiest(run.command_rad, rows) for run in data.runs[joint]]
    moved = [
        np.abs(np.diff(run.command_rad[part])).sum()
        for run, part in zip(data.runs[joint], parts, strict=True)
    ]
    index = int(np.argmax(moved))
    return index, parts[index]
