"""Figure of a twin test: errors by actuator, and each joint's readings beside the predictions."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, INK, RED, WIDTH_IN, styled
from pupper_sysid.policies.twin.twin import Condition, Twin
from pupper_sysid.sysid.servo_fit.scores import mean_known, predicted

PLACES = (("air", BLUE, "in the air"), ("ground", RED, "on the ground"))
_COLUMNS, _SHOWN_S = 3, 2.5
_BAR = 0.36


@styled
def twin_figure(found: Twin) -> Figure:
    """Errors of every actuator; below, two seconds of each joint with the best one."""
    joints = found.data.joints
    columns = min(_COLUMNS, len(joints))
    rows = -(-len(joints) // columns)
    top = 1.1 + 0.42 * len(found.models)
    figure = Figure(figsize=(2 * WIDTH_IN, top + 1.7 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, columns, height_ratios=[top, *[1.7] * rows])
    draw_bars(figure.add_subplot(grid[0, :]), found)
    first = None
    for k, joint in enumerate(joints):
        axes = figure.add_subplot(grid[1 + k // columns, k % columns], sharex=first)
        first = first or axes
        draw_joint(axes, found, joint, found.best)
        if k % columns == 0:
            axes.set_ylabel("rad")
        if k + columns >= len(joints):
            axes.set_xlabel("time [s]")
    lines, labels = figure.axes[1].get_legend_handles_labels()
    figure.legend(
        lines, labels, loc="outside lower center", ncols=len(lines), title=f"with {found.best}"
    )
    return figure


def draw_bars(axes: Axes, found: Twin) -> None:
    """Mean error of every actuator in the air and on the ground, with 90 % intervals."""
    names = list(found.models)
    for place, colour, words in PLACES:
        shift = -_BAR / 2 if place == "air" else _BAR / 2
        for k, name in enumerate(names):
            own: Condition | None = getattr(found.models[name], place)
            if own is None:
                continue
            value, low, high = (1e3 * x for x in astuple(own.rmse_rad))
            axes.barh(
                k + shift, value, _BAR, color=colour, label=words if k == 0 else None,
                xerr=[[value - low], [high - value]], ecolor=INK, capsize=2,
            )  # fmt: skip
    floor = 1e3 * mean_known(list(found.repeatability_rad.values()))
    if np.isfinite(floor):
        axes.axvline(floor, color=GREEN, ls="--", label=f"repeatability {floor:.1f}")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set(xlabel="RMS error of predicted readings, mean of the joints [mrad]", xlim=(0, None))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)


def draw_joint(axes: Axes, found: Twin, joint: str, actuator: str) -> None:
    """Readings of a joint where its command moves most, and what an actuator predicts."""
    runs, model = found.data.runs[joint], found.models[actuator]
    place = max(range(len(runs)), key=lambda n: np.std(runs[n].command_rad))
    run = runs[place]
    time = run.trial.send_time_s - run.trial.send_time_s[0]
    shown = _busiest(run.command_rad, max(int(_SHOWN_S / found.time_step_s), 2))
    time = time[shown] - time[shown][0]
    axes.step(time, run.command_rad[shown], where="post", color=FAINT, lw=0.9, label="command")
    axes.plot(time, run.trial.position_rad[shown], "o", ms=2.2, color=INK, label="readings")
    for key, colour, words in PLACES:
        own: Condition | None = getattr(model, key)
        if own is not None:
            line = predicted(own.tracks[joint][place], run, run.reading_tick)[shown]
            axes.plot(time, line, color=colour, lw=1.1, label=words)
    axes.set_title(joint)


def _busiest(command: np.ndarray, count: int) -> slice:
    """The `count` rows in which a command moves most."""
    if len(command) <= count:
        return slice(None)
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(command)))])
    start = int(np.argmax(path[count:] - path[:-count]))
    return slice(start, start + count)
