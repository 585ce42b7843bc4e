"""Pictures of servo models: each joint's command, readings, and what every model makes of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

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
from pupper_sysid.sysid.servo_fit.compare import LINEAR, Comparison, band_half_width

_LONGEST_S = 3.0
_COLOURS = (BLUE, RED, GREEN, ORANGE, PINK)
_LINES = ("-", "--", "-.", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))


@styled
def compare_figure(found: Comparison, joints: Sequence[str] | None = None) -> Figure:
    """One panel per joint: the liveliest seconds of its recording.

    Parameters
    ----------
    found : Comparison
    joints : sequence of str, optional
        Which; by default all.
    """
    data = found.data
    shown = list(data.joints if joints is None else joints)
    figure, panels = axes_column(len(shown), 0.7 + 1.75 * len(shown))
    names = [n for n in found.tracks if n != LINEAR]
    for axes, joint in zip(panels, shown, strict=True):
        index, low, high = _liveliest(data, joint)
        run = data.runs[joint][index]
        ticks = np.arange(low, high)
        time = run.trial.send_time_s[low:high] - run.trial.send_time_s[low]
        axes.step(
            time, run.command_rad[low:high], where="post", color=FAINT, lw=1.0, label="command"
        )
        inside = (run.tick >= low) & (run.tick < high - 1)
        when = np.interp(run.tick[inside], ticks, time)
        axes.plot(when, run.position_rad[inside], "o", ms=3.2, color=INK, label="reading")
        for n, name in enumerate(names):
            track = found.tracks[name][joint][index]
            colour = _COLOURS[n % len(_COLOURS)]
            error = 1e3 * np.sqrt(np.mean(found.errors[name][joint].free_run ** 2))
            label = f"{name}, {error:.1f} mrad"
            axes.plot(
                time, track[low:high], ls=_LINES[n % len(_LINES)], color=colour, lw=1.5, label=label
            )
            band = found.bands.get(name, {}).get(joint)
            if band and n == 0:
                half = band_half_width(band, track, data.period_s)[low:high]
                axes.fill_between(
                    time,
                    track[low:high] - half,
                    track[low:high] + half,
                    color=colour,
                    alpha=0.15,
                    lw=0,
                )
        axes.set_title(joint)
        axes.set_ylabel("rad")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5, handlelength=2.2)
    panels[-1].set_xlabel("time [s]")
    figure.set_figwidth(8.0)
    return figure


def _liveliest(data, joint: str) -> tuple[int, int, int]:
    """Run and rows of the few seconds in which the command moves most."""
    rows = round(_LONGEST_S / data.period_s)
    best = (-1.0, 0, 0, 0)
    for index, run in enumerate(data.runs[joint]):
        moved = np.abs(np.diff(run.command_rad, prepend=run.initial_rad))
        total = np.cumsum(np.concatenate([[0.0], moved]))
        for low in range(0, max(1, len(moved) - rows + 1), max(1, rows // 4)):
            high = min(low + rows, len(moved))
            best = max(best, (float(total[high] - total[low]), index, low, high))
    return best[1:]
