"""Figures of a fitted model's free runs: overlays with the readings, and residuals.

They only draw: curves come from `sysid.report.figure_data`. What can be hidden on a page has a
`gid`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pupper_sysid.common.figure_style import (
    BLUE,
    FAINT,
    INK,
    RED,
    axes_column,
    axes_grid,
    styled,
)
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.report.figure_data import Track, some_tracks, tracks, window, within


@styled
def overlay_figure(
    result: JointCalibrationResult, found: list[Track] | None = None, panels: int = 4
) -> Figure:
    """Command, model and readings, the fresh ones at the time they were measured.

    Parameters
    ----------
    result : JointCalibrationResult
    found : list of Track, optional
        From `sysid.report.figure_data.tracks`, if they have been computed.
    panels : int
        At most so many frequencies.
    """
    shown = some_tracks(tracks(result) if found is None else found, panels)
    figure, grid = axes_column(len(shown), 1.2 + 1.75 * len(shown))
    for axes, track in zip(grid, shown, strict=True):
        _overlay(axes, track, result.joint, 1.0)
        axes.set_ylabel("from rest [rad]")
    grid[-1].set_xlabel("time in the trial [s]")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


@styled
def overlay_grid(found: Mapping[str, list[Track]]) -> Figure:
    """The same of every joint beside the others, one frequency each.

    Parameters
    ----------
    found : dict of joint to list of Track
        From `sysid.report.figure_data.tracks`; none of them empty.
    """
    figure, grid = axes_grid(len(found), 3, 1.75)
    for n, (axes, (joint, own)) in enumerate(zip(grid, found.items(), strict=True)):
        spread = some_tracks(own, 3)
        _overlay(axes, spread[len(spread) // 2], joint, 0.7)
        if n % 3 == 0:
            axes.set_ylabel("from rest [rad]")
        if n >= len(grid) - 3:
            axes.set_xlabel("time in the trial [s]")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
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
        track.time_s[fine], track.model_rad[fine], color=BLUE, lw=2 * size, label="DelayedPD",
        gid="part:model",
    )  # fmt: skip
    axes.plot(
        track.fresh_time_s[fresh], track.fresh_rad[fresh], "o", color=RED, ms=5 * size,
        mec="white", mew=0.6 * size, label="fresh readings, when measured", gid="part:fresh",
    )  # fmt: skip
    axes.set_title(_trial_name(track, joint))
    axes.set_xlim(start, stop)


OVERLAY_PARTS = {
    "command": "command", "raw": "raw readings", "model": "model", "fresh": "fresh readings"
}  # fmt: skip
"""Parts of an overlay by the end of their `gid`, and what they are called."""


@styled
def residual_figure(result: JointCalibrationResult, found: list[Track] | None = None) -> Figure:
    """Residuals of the model: over speed, fresh and raw; and over time.

    Parameters
    ----------
    result : JointCalibrationResult
    found : list of Track, optional
        From `sysid.report.figure_data.tracks`, if they have been computed.
    """
    found = tracks(result) if found is None else found
    figure, (over_speed, over_time) = axes_column(2, 6.0)
    lattice = result.lag.feedback
    age = 1e3 * (lattice.mean_age_s if np.isfinite(lattice.mean_age_s) else result.lag.stale_lag_s)
    rows = f"all rows at their own time (dashed: speed × {age:.0f} ms)"
    _residuals_over_speed(over_speed, found, 1.0, rows)
    fastest = np.max([np.max(np.abs(t.row_speed_rad_s), initial=0.0) for t in found], initial=0.0)
    reach = np.array([-1.0, 1.0]) * fastest
    over_speed.plot(reach, -age * reach, color=INK, lw=1.2, ls=(0, (4, 2)))
    over_speed.set_xlabel("speed of the model [rad/s]")
    over_speed.set_ylabel("reading − model [mrad]")
    start = 0.0
    for n, track in enumerate(found):
        over_time.plot(
            start + track.fresh_time_s, 1e3 * track.fresh_error_rad, ".", color=RED, ms=4
        )
        if track.frequency_hz > 0 and len(found) <= 12:
            over_time.text(
                start + 0.5 * track.time_s[-1], 0.97, f"{track.frequency_hz:.3g} Hz",
                transform=over_time.get_xaxis_transform(), ha="center", va="top",
                fontsize=9,
            )  # fmt: skip
        start += float(track.time_s[-1])
        if n < len(found) - 1:
            over_time.axvline(start, color=FAINT, lw=0.8)
    over_time.axhline(0, color=INK, lw=0.8)
    over_time.margins(x=0.01, y=0.2)
    over_time.set_xlabel("time, trials end to end [s]")
    over_time.set_ylabel("fresh − model [mrad]")
    figure.legend(*over_speed.get_legend_handles_labels(), loc="outside upper left", ncols=1)
    return figure


@styled
def residual_grid(found: Mapping[str, list[Track]]) -> Figure:
    """Fresh and raw residuals over speed, of every joint beside the others.

    Parameters
    ----------
    found : dict of joint to list of Track
        From `sysid.report.figure_data.tracks`.
    """
    figure, grid = axes_grid(len(found), 3, 1.75)
    for n, (axes, (joint, own)) in enumerate(zip(grid, found.items(), strict=True)):
        _residuals_over_speed(axes, own, 0.7, "all rows at their own time")
        axes.set_title(joint)
        if n % 3 == 0:
            axes.set_ylabel("reading − model [mrad]")
        if n >= len(grid) - 3:
            axes.set_xlabel("speed of the model [rad/s]")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _residuals_over_speed(axes: Axes, found: list[Track], size: float, rows: str) -> None:
    def gathered(name: str) -> NDArray:
        return np.concatenate([getattr(t, name) for t in found])

    axes.plot(
        gathered("row_speed_rad_s"), 1e3 * gathered("row_error_rad"), ".", color=FAINT,
        ms=3 * size, label=rows, rasterized=True, gid="part:raw",
    )  # fmt: skip
    axes.plot(
        gathered("fresh_speed_rad_s"), 1e3 * gathered("fresh_error_rad"), "o", color=RED,
        ms=3.5 * size, mec="white", mew=0.3, label="fresh rows when they were measured",
        rasterized=True, gid="part:fresh",
    )  # fmt: skip


def _trial_name(track: Track, joint: str) -> str:
    return f"{joint}, {track.frequency_hz:.3g} Hz" if track.frequency_hz > 0 else joint
