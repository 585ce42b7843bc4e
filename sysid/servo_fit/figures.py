"""Figure of servo models in free run beside commands and readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pupper_sysid.common.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PINK,
    RED,
    axes_column,
    styled,
)
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData

_LONGEST_S = 3.0
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
            error = 1e3 * scores.rms(errors[name][joint].free_run)
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
    rows = round(_LONGEST_S / data.period_s)
    parts = [busiest(run.command_rad, rows) for run in data.runs[joint]]
    moved = [
        np.abs(np.diff(run.command_rad[part])).sum()
        for run, part in zip(data.runs[joint], parts, strict=True)
    ]
    index = int(np.argmax(moved))
    return index, parts[index]
