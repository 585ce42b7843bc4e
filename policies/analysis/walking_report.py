"""A page (`common.page`) about the training and the walk of a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, RED, WIDTH_IN, axes_column, styled
from pupper_sysid.common.files import versions
from pupper_sysid.common.page import Column, Picture, Section, Table
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import plain
from pupper_sysid.policies.analysis.evaluation import Evaluation, Figures, Standing
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.train.curves import LARGEST_BYTES, PROGRESS
from pupper_sysid.policies.train.run_file import RUN_FILE, Run

ERRORS = {
    "mae_vx_m_s": ("forward", "m/s"),
    "mae_vy_m_s": ("sideways", "m/s"),
    "mae_yaw_rad_s": ("in turning", "rad/s"),
}
_CURVES = {
    "reward": "reward per step",
    "falls_per_1000_steps": "falls / 1,000 steps",
    "std": "action noise",
}


def walking_sections(
    policy: Policy, run: Run | None, folder: Path, found: Evaluation
) -> list[Section]:
    """The page's sections.

    Parameters
    ----------
    policy : Policy
    run : Run or None
        How it was trained, if its folder says so.
    folder : Path
        Of the run or policy; its curves are shown if they are there.
    found : Evaluation

    Raises
    ------
    InputError
        If the folder's curves cannot be read.
    """
    rows = [_row("random commands", found)]
    rows += [_row(r.name, r) for r in found.by_command]
    rows += [_row(f"ground: {r.terrain}", r) for r in found.by_terrain]
    rows += [_row(f"dead time +{r.extra_delay_ms:g} ms", r) for r in found.by_extra_delay]
    columns = (
        Column("", lambda row: row["walk"], "key"),
        Column("fell, %", lambda row: f"{100 * row['fall_rate']:.0f}"),
        *(
            Column(f"{name}, {unit}", lambda row, key=key: f"{row[key]:.3f}")
            for key, (name, unit) in ERRORS.items()
        ),
        Column("duty", lambda row: f"{row['duty']:.2f}"),
        Column("swing, s", lambda row: f"{row['swing_s']:.2f}"),
        Column("slip, m/s", lambda row: f"{row['foot_slip_m_s']:.3f}"),
    )
    worst = max(rows[1:], key=lambda r: (r["fall_rate"], r["mae_vx_m_s"] + r["mae_vy_m_s"]))
    errors = (
        f"{getattr(found, key):.3f} {unit} {name} (a robot that stands: "
        f"{getattr(found.standing_still, key):.3f})"
        for key, (name, unit) in ERRORS.items()
    )
    sections = [
        Section(
            "found",
            "What was found",
            findings=[
                (
                    "Falls",
                    f"{100 * found.fall_rate:.0f} % of {found.episodes} episodes of "
                    f"{found.episode_s:g} s "
                    "with random commands.",
                ),
                (
                    "Tracking",
                    "; ".join(errors) + ". Mean absolute errors of every instant.",
                ),
                (
                    "Hardest of these walks",
                    f"{worst['walk']}: {100 * worst['fall_rate']:.0f} % fell, "
                    f"{worst['mae_vx_m_s']:.3f} m/s forward, "
                    f"{worst['mae_vy_m_s']:.3f} m/s sideways.",
                ),
            ],
            notes=[
                f"Walked with the servos of {Path(str(found.actuator)).name}, feedback "
                f"{found.feedback}, in simulation. Evaluate with the calibration of another robot "
                "before the policy walks on it.",
            ],
        ),
        Section(
            "walks",
            "How it walks",
            figures=[
                Picture(
                    "errors",
                    "Mean absolute errors by direction, ground and delay; dotted: a robot that "
                    "stands, under random commands. Red: some robots fell.",
                    _errors_figure(rows, found.standing_still),
                )
            ],
            tables=[Table("walks", "Errors, and what the feet do", columns, tuple(rows))],
            notes=[
                "duty: share of time a foot is on the ground; slip: speed of feet on the ground."
            ],
        ),
    ]
    curves = _curves(folder / PROGRESS)
    if curves is not None:
        sections.append(
            Section(
                "training",
                "How it was trained",
                figures=[
                    Picture(
                        "training",
                        "Training, by samples: reward, falls, and the noise of exploration.",
                        _training_figure(curves),
                    )
                ],
            )
        )
    sections.append(_settings(policy, run))
    return sections


def _row(name: str, found: Figures) -> dict[str, Any]:
    keys = ("fall_rate", *ERRORS, "swing_s", "foot_slip_m_s")
    duty = float(np.mean(found.duty))
    return {"walk": name, **{k: getattr(found, k) for k in keys}, "duty": duty}


def _curves(path: Path) -> dict[str, np.ndarray] | None:
    """Columns of `progress.csv`; None if there is none."""
    if not path.exists():
        return None
    remedy = "Move it away for a page without the training."
    found = read_table(path, read_text(path, LARGEST_BYTES, remedy), strict=False).numbers
    lacking = [name for name in ("samples", *_CURVES) if name not in found]
    if lacking:
        raise InputError(f"{path} has no numbers called {lacking[0]}. {remedy}")
    return {name: found[name] for name in ("samples", *_CURVES)}


@styled
def _training_figure(curves: Mapping[str, np.ndarray]) -> Figure:
    figure, axes = axes_column(len(_CURVES), 1.7 * len(_CURVES))
    for (key, title), one in zip(_CURVES.items(), axes, strict=True):
        one.plot(curves["samples"] / 1e6, curves[key], color=BLUE, lw=1.2)
        one.set_ylabel(title)
        if key == "falls_per_1000_steps":
            one.set_ylim(bottom=0)
    axes[-1].set_xlabel("samples [millions]")
    return figure


@styled
def _errors_figure(rows: Sequence[Mapping[str, Any]], still: Standing) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, 1.2 + 0.28 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(ERRORS), sharey=True)
    place = -np.arange(len(rows))
    for (key, (name, unit)), one in zip(ERRORS.items(), axes, strict=True):
        colours = [RED if r["fall_rate"] > 0 else GREEN for r in rows]
        one.barh(place, [r[key] for r in rows], color=colours, height=0.7)
        one.axvline(getattr(still, key), color=FAINT, ls=":")
        one.set_title(f"{name}, {unit}", fontsize=9)
        one.tick_params(axis="x", labelsize=7.5)
    axes[0].set_yticks(place, [r["walk"] for r in rows], fontsize=7.5)
    return figure


def _settings(policy: Policy, run: Run | None) -> Section:
    contract = policy.contract
    words = [
        f"Policy: {contract.kind}, trained with {Path(contract.actuator).name}. "
        f"Evaluated with {', '.join(f'{n} {v}' for n, v in versions().items())}."
    ]
    if run is None:
        return Section("made", "Where this comes from", words)
    rows = tuple({"setting": key, "value": value} for key, value in _flat(plain(run)))
    columns = (
        Column("setting", lambda row: row["setting"], "key"),
        Column("value", lambda row: row["value"], "prose"),
    )
    return Section(
        "made", "Where this comes from", words,
        tables=[Table("settings", f"Settings of the training ({RUN_FILE})", columns, rows)],
    )  # fmt: skip


def _flat(value: Mapping[str, Any], before: str = "") -> list[tuple[str, str]]:
    """Nested settings as dotted names."""
    found = []
    for key, one in value.items():
        if isinstance(one, Mapping):
            found += _flat(one, f"{before}{key}.")
        else:
            words = ", ".join(map(str, one)) if isinstance(one, list | tuple) else str(one)
            found.append((f"{before}{key}", words))
    return found
