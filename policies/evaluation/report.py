"""Tables of an evaluation, as `pupper-eval` prints them; a page about a policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import BLUE, FAINT, RED, WIDTH_IN, axes_column, styled
from pupper_sysid.common.files import versions
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.page import Picture, Section
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import plain
from pupper_sysid.common.tables import Column, Table, ends, rounded
from pupper_sysid.policies.evaluation.evaluate import WALKERS, Evaluation, Figures, in_short
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.train.run_file import LARGEST_CURVES_BYTES, PROGRESS, RUN_FILE, Run
from pupper_sysid.policies.walks.rollouts import ERRORS, STRIDE_ERRORS

_WALK = Column("", "walk", kind="key")
_SIDES = {"forward": "front", "backward": "rear", "left": "left", "right": "right"}
_AXES = (("vx", "mm/s"), ("vy", "mm/s"), ("yaw", "mrad/s"))


def tables_of(evaluation: Evaluation) -> list[Table]:
    """Falls, what came before them, errors, directions and effort, a row per condition."""
    rows: list[dict[str, Any]] = [
        {"walk": row.name}
        | {k: v for walker in WALKERS for k, v in _figures(walker, getattr(row, walker)).items()}
        | {"duty": float(np.mean(row.policy.duty)), "stride_hz": row.policy.stride_hz}
        | {"slip": row.policy.foot_slip_m_s}
        for row in evaluation.conditions
    ]
    falls = Table(
        "walks", "Falls, %, and what the policy's feet do",
        (
            _WALK,
            *(Column(w, f"{w}.fall_rate", "%", 0, "interval", short=w) for w in WALKERS),
            Column("duty", "duty", digits=2),
            Column("steps Hz", "stride_hz"),
            Column("slip", "slip", "m/s", 3),
        ),
        rows,
    )  # fmt: skip
    return [
        falls, _before_falls(evaluation), _errors(rows, "every instant", ERRORS),
        _errors(rows, "the mean over a stride", STRIDE_ERRORS), _directions(evaluation, rows),
        _effort(evaluation),
    ]  # fmt: skip


def _figures(walker: str, figures: Figures) -> dict[str, float]:
    """Figures of one walker with their intervals, under names that begin with its name."""
    names = ("fall_rate", *ERRORS, *STRIDE_ERRORS, "speed_share", "heading_drift_deg")
    return {
        key: number
        for name in names
        for key, number in ends(f"{walker}.{name}", figures.intervals[name]).items()
    }


def _errors(rows: list[dict[str, Any]], of_what: str, names: tuple[str, ...]) -> Table:
    columns = [_WALK]
    for walker in ("policy", "trot"):
        for k, (name, (axis, unit)) in enumerate(zip(names, _AXES, strict=True)):
            words = f"{walker}, {axis}"
            short = axis if k or walker == "policy" else f"{walker} {axis}"
            columns.append(Column(words, f"{walker}.{name}", unit, 0, "margin", short=short))
    # of random commands, in the policy's columns
    still = {k.replace("standing.", "policy."): v for k, v in rows[0].items() if "standing." in k}
    title = f"Mean absolute errors of {of_what}, mm/s and mrad/s: policy and trot"
    return Table("", title, columns, [*rows, {"walk": "standing, random"} | still])


def _directions(evaluation: Evaluation, rows: list[dict[str, Any]]) -> Table:
    visible = [
        row | {"command": ", ".join(f"{c:g}" for c in condition.command or ())}
        for condition, row in zip(evaluation.conditions, rows, strict=True)
        if condition.group == "direction" and any(condition.command or ())
    ]
    columns = (
        _WALK,
        Column("m/s, rad/s", "command", kind="words"),
        *(
            Column(w, f"{w}.speed_share", "%", 0, "margin", short=w) for w in ("policy", "trot")
        ),
        *(Column(w, f"{w}.heading_drift_deg", "°", 1, "margin") for w in ("policy", "trot")),
    )  # fmt: skip
    title = f"Speed over the commanded, %, and change of heading over {evaluation.episode_s:g} s, °"
    return Table("", title, columns, visible)


def _effort(evaluation: Evaluation) -> Table:
    """Clearance of the swings and effort of the servos, of policy and trot."""
    rows = [
        {"walk": row.name, "walker": walker} | figures.rows()[0]
        for row in evaluation.conditions
        for walker, figures in (("policy", row.policy), ("trot", row.trot))
    ]
    kinds = list(evaluation.conditions[0].policy.torque_saturated_share)

    def of_kinds(heading: str, name: str) -> Column:
        return Column(
            heading, name, "%",
            show=lambda row: "/".join(rounded(row[f"{name}_{kind}"], 0, 100) for kind in kinds),
        )  # fmt: skip

    columns = (
        Column(
            "", "walk", kind="key",
            show=lambda row: row["walk"] if row["walker"] == "policy" else "",
        ),
        Column("walker", "walker", kind="words"),
        Column("p10", "clearance_p10_m", "mm"),
        Column("p50", "clearance_p50_m", "mm"),
        Column("low", "low_swing_share", "%", 0),
        of_kinds("at limit", "torque_saturated_share"),
        of_kinds("rms", "rms_torque_share"),
        Column("power", "mechanical_power_w", "W", short="W"),
        Column("cost of transport", "cost_of_transport", short="CoT"),
    )  # fmt: skip
    title = (
        "Clearance of the swings (tenth percentile, median; share below 2 mm) and effort of the "
        "servos: share of the time at the torque limit and rms torque over the limit, "
        f"{'/'.join(kinds)}; mechanical power; cost of transport"
    )
    return Table("effort", title, columns, rows)


def _before_falls(evaluation: Evaluation) -> Table:
    columns = (
        Column("", "row", kind="key"),
        Column("walker", "walker", kind="words"),
        Column("falls", "falls", digits=0),
        Column("at", "time_s", "s"),
        Column("tilt", "tilt_before_deg", "°", 0),
        Column("to the", "toward", kind="words", show=lambda row: _SIDES[row["toward"]]),
        Column("tipped", "tipped", digits=0),
        Column("pushed", "after_push", digits=0),
    )
    title = (
        "Before falls: median time, median tilt 0.2 s before, usual side; pushed: a push in the "
        "last second"
    )
    return Table("falls", title, columns, in_short(evaluation.falls))


ERROR_UNITS = {
    "mae_vx_m_s": ("forward", "m/s"),
    "mae_vy_m_s": ("sideways", "m/s"),
    "mae_yaw_rad_s": ("in turning", "rad/s"),
}
_CURVES = {
    "reward": "reward per step",
    "falls_per_1000_steps": "falls / 1,000 steps",
    "std": "action noise",
}
_SCORE = {"score": "score without noise"}  # by which the best policy is chosen; not in old curves


def walking_sections(
    policy: Policy, run: Run | None, folder: Path, evaluation: Evaluation
) -> list[Section]:
    """The page's sections.

    `run` is None where the folder does not say how the policy was trained; the folder's curves are
    shown if they are there.
    """
    walked = (
        f"Walked with the servos of {Path(str(evaluation.actuator)).name}, feedback "
        f"{evaluation.feedback}, seed {evaluation.seed}, in simulation, on robots and terrain of "
        "which no training knows. Evaluate with the calibration of another robot before the policy "
        "walks on it."
    )
    sections = [
        Section("found", "What was found", findings=_findings(evaluation), notes=[walked]),
        Section(
            "walks",
            "How it walks",
            figures=[
                Picture(
                    "errors",
                    "Mean absolute errors of the mean velocity over a stride, with 90 % intervals. "
                    "Blue: policy, red where some robots fell; grey: open-loop trot; dotted: a "
                    "robot that stands, under random commands.",
                    _errors_figure(evaluation),
                ),
                Picture(
                    "falls",
                    "Share of robots that fell, with 90 % intervals. Blue: policy; grey: open-loop "
                    "trot; hollow: standing.",
                    _falls_figure(evaluation),
                ),
            ],
            tables=tables_of(evaluation),
            notes=[
                "A robot that fell counts as one that stands still until the "
                "end. duty: share of time a foot is on the ground; slip: speed of feet on it; "
                "speed: mean speed along the command over the commanded one. clearance: largest "
                "height of the sole over the ground in a swing; low: below 2 mm; at limit: share "
                "of the time in which a servo gives all of its torque; power: positive work of "
                "all servos over time; cost of transport: that over weight times distance."
            ],
        ),
    ]
    if (folder / PROGRESS).exists():
        caption = "Training, by samples: reward, falls, and the noise of exploration."
        picture = Picture("training", caption, _training_figure(_curves(folder / PROGRESS)))
        sections.append(Section("training", "How it was trained", figures=[picture]))
    return [*sections, _settings(policy, run)]


def _findings(evaluation: Evaluation) -> list[tuple[str, str]]:
    first = evaluation.conditions[0]
    walked, trot, still = first.policy, first.trot, first.standing
    errors = (
        f"{getattr(walked, key):.3f} {unit} {name} (trot {getattr(trot, key):.3f}, standing "
        f"{getattr(still, key):.3f})"
        for key, (name, unit) in ERROR_UNITS.items()
    )
    worst = max(evaluation.conditions, key=lambda r: (r.policy.fall_rate, r.policy.mae_vx_m_s))
    half = [r for r in evaluation.conditions if r.trot.fall_rate >= 0.1]
    won = sum(r.policy.fall_rate <= 0.5 * r.trot.fall_rate for r in half)
    beside = (
        f"The open-loop trot falls in 10 % of episodes or more under {len(half)} of "
        f"{len(evaluation.conditions)} conditions; the policy falls at most half as often in "
        f"{won} of them."
        if half
        else "The open-loop trot falls in less than 10 % of episodes under all of them."
    )
    return [
        (
            "Falls",
            f"{100 * walked.fall_rate:.0f} % of {walked.episodes} episodes of "
            f"{evaluation.episode_s:g} s with random commands. {beside}",
        ),
        ("Tracking", "; ".join(errors) + ". Mean absolute errors of every instant."),
        (
            "Hardest of these walks",
            f"{worst.name}: {100 * worst.policy.fall_rate:.0f} % fell (trot "
            f"{100 * worst.trot.fall_rate:.0f} %), {worst.policy.mae_vx_m_s:.3f} m/s forward, "
            f"{worst.policy.mae_vy_m_s:.3f} m/s sideways.",
        ),
    ]


def _curves(path: Path) -> dict[str, np.ndarray]:
    """Columns of `progress.csv`."""
    remedy = "Move it away for a page without the training."
    columns = read_table(path, read_text(path, LARGEST_CURVES_BYTES, remedy), strict=False).numbers
    lacking = [name for name in ("samples", *_CURVES) if name not in columns]
    if lacking:
        raise InputError(f"{path} has no numbers called {lacking[0]}. {remedy}")
    return {name: columns[name] for name in ("samples", *_SCORE, *_CURVES) if name in columns}


@styled
def _training_figure(curves: Mapping[str, np.ndarray]) -> Figure:
    titles = {key: title for key, title in (_SCORE | _CURVES).items() if key in curves}
    figure, axes = axes_column(len(titles), 1.7 * len(titles))
    for (key, title), panel in zip(titles.items(), axes, strict=True):
        panel.plot(curves["samples"] / 1e6, curves[key], color=BLUE, lw=1.2)
        panel.set_ylabel(title)
        if key == "falls_per_1000_steps":
            panel.set_ylim(bottom=0)
    axes[-1].set_xlabel("samples [millions]")
    return figure


@styled
def _errors_figure(evaluation: Evaluation) -> Figure:
    rows, still = evaluation.conditions, evaluation.conditions[0].standing
    figure = Figure(figsize=(WIDTH_IN, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(STRIDE_ERRORS), sharey=True)
    place = -np.arange(len(rows))
    for key, (name, unit), panel in zip(STRIDE_ERRORS, ERROR_UNITS.values(), axes, strict=True):
        for offset, walker in ((0.15, "policy"), (-0.15, "trot")):
            for at, row in zip(place, rows, strict=True):
                figures: Figures = getattr(row, walker)
                colour = FAINT if walker == "trot" else RED if figures.fall_rate > 0 else BLUE
                _point(panel, figures.intervals[key], at + offset, 1.0, colour)
        panel.axvline(getattr(still, key), color=FAINT, ls=":")
        panel.set_title(f"{name}, {unit}", fontsize=9)
        panel.set_xlim(left=0)
        panel.tick_params(axis="x", labelsize=7.5)
    axes[0].set_yticks(place, [row.name for row in rows], fontsize=7.5)
    return figure


@styled
def _falls_figure(evaluation: Evaluation) -> Figure:
    rows = evaluation.conditions
    figure = Figure(figsize=(WIDTH_IN, 1.2 + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots()
    place = -np.arange(len(rows))
    for offset, walker, colour in ((0.2, "policy", BLUE), (0.0, "trot", FAINT)):
        for at, row in zip(place, rows, strict=True):
            _point(axes, getattr(row, walker).intervals["fall_rate"], at + offset, 100.0, colour)
    still = [100 * row.standing.fall_rate for row in rows]
    axes.plot(still, place - 0.2, "o", mfc="none", mec=FAINT, ms=4, ls="none")
    axes.set_xlim(-2, 102)
    axes.set_xlabel("fell, %")
    axes.set_yticks(place, [row.name for row in rows], fontsize=7.5)
    return figure


def _point(axes: Any, value: Interval, at: float, scale: float, colour: str) -> None:
    """A value with its interval, on one line."""
    axes.plot(scale * value.value, at, "o", color=colour, ms=4)
    if np.isfinite(value.low):
        axes.plot([scale * max(value.low, 0.0), scale * value.high], [at, at], color=colour, lw=1.2)


def _settings(policy: Policy, run: Run | None) -> Section:
    contract = policy.contract
    words = [
        f"Policy: {contract.kind}, trained with {Path(contract.actuator).name}. "
        f"Evaluated with {', '.join(f'{n} {v}' for n, v in versions().items())}."
    ]
    if run is None:
        return Section("made", "Where this comes from", words)
    rows = [{"setting": key, "value": value} for key, value in _flat(plain(run))]
    columns = Column("setting", "setting", kind="key"), Column("value", "value", kind="prose")
    return Section(
        "made", "Where this comes from", words,
        tables=[Table("settings", f"Settings of the training ({RUN_FILE})", columns, rows)],
    )  # fmt: skip


def _flat(value: Mapping[str, Any], before: str = "") -> list[tuple[str, str]]:
    """Nested settings as dotted names."""
    values = []
    for key, entry in value.items():
        if isinstance(entry, Mapping):
            values += _flat(entry, f"{before}{key}.")
        else:
            words = ", ".join(map(str, entry)) if isinstance(entry, list | tuple) else str(entry)
            values.append((f"{before}{key}", words))
    return values
