"""`pupper-eval`: falls and tracking errors of a policy, as a table."""

from __future__ import annotations

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
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.sim.robot.terrain import Terrain

if TYPE_CHECKING:
    from pupper_sysid.common.interval import Interval
    from pupper_sysid.policies.analysis.evaluation import Evaluation, Figures

_FULL, _QUICK = (100, 20.0), (30, 10.0)  # episodes, seconds each

DESCRIPTION = """Falls and tracking errors of a policy, by direction, ground and added dead time.

Errors are mean absolute errors of the instantaneous velocity over whole episodes, with half the
width of their 90 % interval. --quick answers within 20 s on two cores, and less surely.

Example: pupper-eval runs/<name> --extra-delay-ms 0 40 80 --report report
"""


@dataclass(frozen=True)
class Eval:
    """Policy and conditions of an evaluation."""

    policy: Annotated[Path, tyro.conf.Positional]
    """A run (`runs/<name>`) or a policy folder."""
    quick: bool = False
    """Fewer and shorter episodes: 30 of 10 s. A first look, not for publication."""
    episodes: int | None = None
    """Number of episodes with random commands (100, --quick 30); a fifth of that per direction,
    half per ground and dead time."""
    seconds: float | None = None
    """Length of an episode (20, --quick 10)."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    terrain: tuple[Terrain, ...] = ("flat", "rough", "slopes", "troughs")
    """Kinds of ground of the table."""
    extra_delay_ms: tuple[float, ...] = (0.0, 40.0, 80.0)
    """Added to every servo's dead time, for the table."""
    seed: int = 0
    """Of commands, servos, friction and ground."""
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
    usual = _QUICK if options.quick else _FULL
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

    from pupper_sysid.policies.analysis.evaluation import evaluate

    torch.set_num_threads(1)
    policy, run = policy_at(options.policy)
    task, servos = simulator(options.policy, policy, run, options.actuator, options.feedback)
    warn_of_fallbacks([servos])
    task = replace(task, terrain="flat", episode_s=seconds)
    with terminal.share_progress("walking") as advance:
        found = evaluate(
            policy, task, servos, episodes, options.seed, options.threads,
            feedback=options.feedback or policy.contract.feedback, grounds=options.terrain,
            extra_delays_ms=options.extra_delay_ms,
            progress=partial(advance, f"{episodes} episodes of {seconds:g} s and all conditions"),
        )  # fmt: skip
    if page:
        from pupper_sysid.common.page import write_page
        from pupper_sysid.policies.analysis.walking_report import walking_sections

        folder = run_folder(options.policy)
        sections = walking_sections(policy, run, folder, found)
        title = f"Walking report: {folder.name}"
        name = options.policy.resolve().name
        write_page(page, title, f"{name}, seed {options.seed}", sections, options.force)
    if options.json:
        print_json({"quick": options.quick} | found.to_dict() | ({"report": page} if page else {}))
        return
    _show(found, options.quick)
    if page:
        err.print(f"Wrote {page}.", soft_wrap=True)


def _show(found: Evaluation, quick: bool) -> None:
    table = terminal.table(
        f"{'Quick look: ' if quick else ''}{found.episodes} episodes of {found.episode_s:g} s, "
        f"actuator {found.actuator}, feedback {found.feedback}; mean absolute errors ± half of "
        "their 90 % interval",
        "", "fell %", "vx m/s", "vy m/s", "yaw rad/s", "duty", "swing s", "slip m/s",
    )  # fmt: skip
    table.add_row("random commands", *_cells(found))
    still = found.standing_still
    errors = (still.mae_vx_m_s, still.mae_vy_m_s, still.mae_yaw_rad_s)
    table.add_row("  a robot that stands", "–", *(number(x, 3) for x in errors), *(["–"] * 3))
    for row in found.by_command:
        command = ", ".join(f"{c:g}" for c in row.command)
        table.add_row(f"{row.name} ({command})", *_cells(row))
    for row in found.by_terrain:
        table.add_row(f"ground: {row.terrain}", *_cells(row))
    for row in found.by_extra_delay:
        table.add_row(f"dead time +{row.extra_delay_ms:g} ms", *_cells(row))
    out.print(table)
    fell = found.intervals.fall_rate
    rows = (found, *found.by_command, *found.by_terrain, *found.by_extra_delay)
    err.print(
        f"Falls under random commands: 90 % interval {100 * fell.low:.0f}–{100 * fell.high:.0f} %. "
        "duty: share of time a foot is on the ground; slip: speed of feet on the ground. Rows are "
        f"of {', '.join(map(str, sorted({row.episodes for row in rows})))} episodes; episode k has "
        "the same robot in every row.",
        soft_wrap=True,
    )


def _cells(row: Figures) -> list[str]:
    own = row.intervals
    return [
        number(100 * row.fall_rate, 0),
        *(_error(e) for e in (own.mae_vx_m_s, own.mae_vy_m_s, own.mae_yaw_rad_s)),
        number(sum(row.duty) / len(row.duty), 2), number(row.swing_s, 2),
        number(row.foot_slip_m_s, 3),
    ]  # fmt: skip


def _error(error: Interval) -> str:
    return f"{number(error.value, 3)} ±{number(error.high - error.value, 3)}"


if __name__ == "__main__":
    main()
