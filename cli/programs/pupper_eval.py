"""`pupper-eval`: falls and tracking errors of a policy, as a table."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.policy_choice import policy_at, run_folder, simulator, warn_of_fallbacks
from pupper_sysid.cli.terminal import err, need_positive, number, out, print_json
from pupper_sysid.cli.user_errors import run_program
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, resolved
from pupper_sysid.sim.robot.terrain import Terrain

if TYPE_CHECKING:
    from pupper_sysid.common.interval import Interval
    from pupper_sysid.policies.evaluation.evaluate import Evaluation

_FULL, _QUICK = (100, 20.0), (30, 10.0)  # episodes, seconds each
_FULL_BATTERY, _QUICK_BATTERY = (40, 20.0), (10, 8.0)

DESCRIPTION = """Falls, errors and effort of a policy, beside an open-loop trot and standing.

By direction, ground and added dead time; with --battery under pushes, on slopes and stairs, with
loads, weak legs, missed ticks, late and jittered servos. Errors are of the velocity at every
instant and of its mean over a stride; a robot that fell counts as one that stands until the end.
Beside them stand the clearance of the swings, and how near servos are to their torque limits.
--quick answers within 20 s on two cores (the battery within 60 s), and less surely.

Example: pupper-eval runs/<name> --extra-delay-ms 40 80 --report report
"""


@dataclass(frozen=True)
class Eval:
    """Policy and conditions of an evaluation."""

    policy: Annotated[Path, tyro.conf.Positional]
    """A run (`runs/<name>`) or a policy folder."""
    quick: bool = False
    """Fewer and shorter episodes: 30 of 10 s, of the battery 10 of 8 s. A first look, not for
    publication."""
    battery: bool = False
    """The battery instead of directions, grounds and dead times: conditions under which robots
    fall. About 8 minutes on two cores."""
    episodes: int | None = None
    """Number of episodes with random commands (100, --quick 30); an eighth of that under each other
    condition. Of the battery: under each (40, --quick 10)."""
    seconds: float | None = None
    """Length of an episode (20, --quick 10, of the battery 8)."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    terrain: tuple[Terrain, ...] = ("rough", "slopes", "troughs")
    """Kinds of ground of the table, besides flat ground; not of the battery."""
    extra_delay_ms: tuple[float, ...] = (40.0, 80.0)
    """Added to every servo's dead time, for the table; not of the battery."""
    seed: int = 0
    """Of commands, servos, friction and ground; no training has the same ones."""
    threads: int = 0
    """Of the physics; 0 for all cores."""
    report: Path | None = None
    """Folder for an HTML page with the run's curves and settings, its figures as PNG and SVG and
    its tables as CSV."""
    force: bool = False
    """Replace a report that exists."""
    json: bool = False
    """Print one JSON object."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    run_program(Eval, _run, "pupper-eval", DESCRIPTION, arguments)


def _run(options: Eval) -> None:
    quick, full = (_QUICK_BATTERY, _FULL_BATTERY) if options.battery else (_QUICK, _FULL)
    usual = quick if options.quick else full
    episodes = usual[0] if options.episodes is None else options.episodes
    seconds = usual[1] if options.seconds is None else options.seconds
    if episodes < 1:
        raise InputError(f"--episodes is {episodes}; it must be at least 1.")
    need_positive("--seconds", seconds)
    for extra in options.extra_delay_ms:
        if not 0 <= extra < float("inf"):
            raise InputError(
                f"--extra-delay-ms is {extra:g}; a servo cannot answer before its own dead time: "
                "give 0 or more."
            )
    page = options.report / "walking.html" if options.report else None
    if page:
        refuse_overwrite(page, options.force)  # before the work
    import torch

    from pupper_sysid.policies.evaluation.evaluate import (
        BATTERY,
        battery_robots,
        evaluate,
        table,
        usual_robots,
    )

    torch.set_num_threads(1)
    policy, run = policy_at(options.policy)
    task, servos = simulator(options.policy, policy, run, options.actuator, options.feedback)
    warn_of_fallbacks([servos])
    cases = BATTERY if options.battery else table(options.terrain, options.extra_delay_ms)
    robots = battery_robots(episodes) if options.battery else usual_robots(episodes)
    with terminal.share_progress("walking") as advance:
        found = evaluate(
            policy, replace(task, episode_s=seconds), servos, cases, robots, options.seed,
            options.threads, feedback=options.feedback or policy.contract.feedback,
            progress=partial(advance, f"{episodes} episodes of {seconds:g} s and all conditions"),
        )  # fmt: skip
    if page:
        from pupper_sysid.common.page import write_page
        from pupper_sysid.policies.evaluation.report import walking_sections

        folder = run_folder(options.policy)
        sections = walking_sections(policy, run, folder, found)
        title = f"Walking report: {folder.name}"
        name = resolved(options.policy).name
        write_page(page, title, f"{name}, seed {options.seed}", sections, options.force)
    if options.json:
        about = {"quick": options.quick, "battery": options.battery}
        print_json(about | found.to_dict() | ({"report": page} if page else {}))
        return
    _show(found, options.quick)
    if page:
        err.print(f"Wrote {page}.")


def _show(found: Evaluation, quick: bool) -> None:
    first = found.conditions[0].policy
    err.print(
        f"{'Quick look: ' if quick else ''}{first.episodes} episodes of {found.episode_s:g} s, "
        f"actuator {found.actuator}, feedback {found.feedback}. The trot is open-loop: it has a "
        "clock and sees nothing. Episode k has the same robot in every row; intervals are of 90 %."
    )
    _show_falls(found)
    _show_errors(found, "every instant", "")
    _show_errors(found, "the mean over a stride", "stride_")
    _show_directions(found)
    _show_effort(found)


def _show_falls(found: Evaluation) -> None:
    """Falls of all three, what the policy's feet do, and what came before the falls."""
    shown = terminal.table(
        "Falls, %, and what the policy's feet do", "", "policy", "trot", "standing", "duty",
        "steps Hz", "slip m/s",
    )  # fmt: skip
    for row in found.conditions:
        own = row.policy
        rates = [each.intervals.fall_rate for each in (row.policy, row.trot, row.standing)]
        shown.add_row(
            row.name,
            *(f"{100 * r.value:.0f} ({100 * r.low:.0f}–{100 * r.high:.0f})" for r in rates),
            number(sum(own.duty) / len(own.duty), 2), number(own.stride_hz, 1),
            number(own.foot_slip_m_s, 3),
        )  # fmt: skip
    out.print(shown)
    if not found.falls:
        return
    from pupper_sysid.policies.evaluation.figures import in_short

    shown = terminal.table(
        "Before falls: median time, median tilt 0.2 s before, usual side; pushed: a push in the "
        "last second", "", "walker",
        "falls", "at s", "tilt °", "to the", "tipped", "pushed",
    )  # fmt: skip
    for own in in_short(found.falls):
        shown.add_row(
            own.row, own.walker, str(own.falls), number(own.time_s, 1),
            number(own.tilt_before_deg, 0), _SIDES[own.toward], str(own.tipped),
            str(own.after_push),
        )  # fmt: skip
    out.print(shown)


def _show_errors(found: Evaluation, of_what: str, prefix: str) -> None:
    shown = terminal.table(
        f"Mean absolute errors of {of_what}, mm/s and mrad/s: policy and trot", "",
        "vx", "vy", "yaw", "trot vx", "vy", "yaw",
    )  # fmt: skip
    names = [f"{prefix}{name}" for name in ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")]
    for row in found.conditions:
        walkers = (row.policy.intervals, row.trot.intervals)
        cells = [_within(getattr(own, n), 1000) for own in walkers for n in names]
        shown.add_row(row.name, *cells)
    still = found.conditions[0].standing
    standing = [_within(getattr(still.intervals, name), 1000) for name in names]
    shown.add_row("standing, random", *standing, *[""] * 3)
    out.print(shown)


def _show_directions(found: Evaluation) -> None:
    rows = [row for row in found.conditions if row.group == "direction" and any(row.command or ())]
    if not rows:
        return
    shown = terminal.table(
        f"Speed over the commanded, %, and change of heading over {found.episode_s:g} s, °",
        "", "m/s, rad/s", "policy", "trot", "policy °", "trot °",
    )  # fmt: skip
    for row in rows:
        each = (row.policy.intervals, row.trot.intervals)
        shown.add_row(
            row.name, ", ".join(f"{c:g}" for c in row.command or ()),
            *(_within(own.speed_share, 100) for own in each),
            *(_within(own.heading_drift_deg, 1) for own in each),
        )  # fmt: skip
    out.print(shown)


def _show_effort(found: Evaluation) -> None:
    """Clearance of the swings and effort of the servos, of policy and trot."""
    kinds = [k for k in found.conditions[0].policy.torque_saturated_share if k != "hip"]
    shown = terminal.table(
        "Clearance of the swings (tenth percentile, median; share below 2 mm) and effort of the "
        "servos: share of the time at the torque limit and rms torque over the limit, "
        f"{' and '.join(kinds)}; mechanical power; cost of transport",
        "", "walker", "p10 mm", "p50 mm", "low %", "at limit %", "rms %", "W", "CoT",
    )  # fmt: skip
    for row in found.conditions:
        for walker, own in (("policy", row.policy), ("trot", row.trot)):
            pairs = (own.torque_saturated_share, own.rms_torque_share)
            shown.add_row(
                row.name if walker == "policy" else "", walker,
                number(1e3 * own.clearance_p10_m, 1), number(1e3 * own.clearance_p50_m, 1),
                number(100 * own.low_swing_share, 0),
                *("/".join(number(100 * each[k], 0) for k in kinds) for each in pairs),
                number(own.mechanical_power_w, 1), number(own.cost_of_transport, 1),
            )  # fmt: skip
    out.print(shown)


_SIDES = {"forward": "front", "backward": "rear", "left": "left", "right": "right"}


def _within(interval: Interval, scale: float) -> str:
    half = scale * (interval.high - interval.value)
    if not math.isfinite(interval.value):
        return number(interval.value)
    return f"{number(scale * interval.value, 0 if scale > 1 else 1)} ±{number(half, 0)}"


if __name__ == "__main__":
    main()
