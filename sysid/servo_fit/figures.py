"""Figure of servo models in free run beside commands and readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
        for n, (name, model_tracks) in enumerate(tracks.items()):
            track = model_tracks[joint][index]
            track = track[:: scores.steps_per_tick(track, run)]
            colour = _COLOURS[n % len(_COLOURS)]
            error = 1e3 * scores.rms(errors[name][joint].free_run)
            label = f"{name}, {error:.1f} mrad"
            axes.plot(
                time, track[low:high], ls=_LINES[n % len(_LINES)], color=colour, lw=1.5, label=label
            )
            band = bands.get(name, {}).get(joint)
            if band and n == 0:
                half = scores.band_half_width(band, np.gradient(track) / data.period_s)[low:high]
                middle = track[low:high]
                axes.fill_between(
                    time, middle - half, middle + half, color=colour, alpha=0.15, lw=0
                )
        axes.set_title(joint)
        axes.set_ylabel("rad")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5, handlelength=2.2)
    panels[-1].set_xlabel("time [s]")
    figure.set_figwidth(8.0)
    return figure


def _liveliest(data: ServoData, joint: str) -> tuple[int, int, int]:
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
