"""Tables of an evaluation (`common.tables`), which `pupper-eval` prints and its page shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from pupper_sysid.common.results import plain
from pupper_sysid.common.tables import Column, Table, ends, rounded
from pupper_sysid.policies.evaluation.evaluate import WALKERS, Evaluation
from pupper_sysid.policies.evaluation.figures import Figures, in_short
from pupper_sysid.policies.walks.tracking import ERRORS, STRIDE_ERRORS

_WALK = Column("", "walk", kind="key")
_SIDES = {"forward": "front", "backward": "rear", "left": "left", "right": "right"}
_AXES = (("vx", "mm/s"), ("vy", "mm/s"), ("yaw", "mrad/s"))


def tables_of(found: Evaluation) -> list[Table]:
    """Falls, what came before them, errors, directions and effort, a row per condition."""
    rows: list[dict[str, Any]] = [
        {"walk": row.name}
        | {k: v for walker in WALKERS for k, v in _figures(walker, getattr(row, walker)).items()}
        | {"duty": float(np.mean(row.policy.duty)), "stride_hz": row.policy.stride_hz}
        | {"slip": row.policy.foot_slip_m_s}
        for row in found.conditions
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
        falls, _before_falls(found), _errors(rows, "every instant", ERRORS),
        _errors(rows, "the mean over a stride", STRIDE_ERRORS), _directions(found, rows),
        _effort(found),
    ]  # fmt: skip


def _figures(walker: str, own: Figures) -> dict[str, float]:
    """Figures of one walker with their intervals, under names that begin with its own."""
    names = ("fall_rate", *ERRORS, *STRIDE_ERRORS, "speed_share", "heading_drift_deg")
    return {
        key: number
        for name in names
        for key, number in ends(f"{walker}.{name}", getattr(own.intervals, name)).items()
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


def _directions(found: Evaluation, rows: list[dict[str, Any]]) -> Table:
    shown = [
        row | {"command": ", ".join(f"{c:g}" for c in condition.command or ())}
        for condition, row in zip(found.conditions, rows, strict=True)
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
    title = f"Speed over the commanded, %, and change of heading over {found.episode_s:g} s, °"
    return Table("", title, columns, shown)


def _effort(found: Evaluation) -> Table:
    """Clearance of the swings and effort of the servos, of policy and trot."""
    rows = [
        {"walk": row.name, "walker": walker} | own.rows()[0]
        for row in found.conditions
        for walker, own in (("policy", row.policy), ("trot", row.trot))
    ]
    kinds = list(found.conditions[0].policy.torque_saturated_share)

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


def _before_falls(found: Evaluation) -> Table:
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
    return Table("falls", title, columns, [plain(row) for row in in_short(found.falls)])
