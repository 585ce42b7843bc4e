"""`pupper-eval`: falls and tracking errors of a policy, as a table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.policy_choice import policy_at, run_folder, simulator, warn_of_fallbacks
from pupper_sysid.cli.terminal import err, number, out, print_json
from pupper_sysid.cli.user_errors import run_program
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.sim.robot.terrain import Terrain

if TYPE_CHECKING:
    from pupper_sysid.policies.analysis.evaluation import Evaluation, Figures, Standing

DESCRIPTION = """Falls and tracking errors of a policy, by direction, ground and added dead time.

Errors are mean absolute errors of the instantaneous velocity over whole episodes.

Example: pupper-eval runs/<name> --extra-delay-ms 0 40 80 --report report
"""


@dataclass(frozen=True)
class Eval:
    """Policy and conditions of an evaluation."""

    policy: Annotated[Path, tyro.conf.Positional]
    """A run (`runs/<name>`) or a policy folder."""
    episodes: int = 100
    """Number of episodes of 20 s with random commands; a fifth of that per direction."""
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
    if options.episodes < 1:
        raise InputError(f"--episodes is {options.episodes}; it must be at least 1.")
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

    from pupper_sysid.policies.analysis.evaluation import DIRECTIONS, evaluate

    torch.set_num_threads(1)
    policy, run = policy_at(options.policy)
    task, servos = simulator(options.policy, policy, run, options.actuator, options.feedback)
    warn_of_fallbacks([servos])
    stages = len(DIRECTIONS) + len(options.terrain) + len(options.extra_delay_ms)
    with terminal.progress("walking", 1 + stages) as advance:
        found = evaluate(
            policy, replace(task, terrain="flat"), servos, options.episodes, options.seed,
            options.threads, feedback=options.feedback or policy.contract.feedback,
            grounds=options.terrain, extra_delays_ms=options.extra_delay_ms, progress=advance,
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
        print_json(found.to_dict() | ({"report": page} if page else {}))
        return
    _show(found)
    if page:
        err.print(f"Wrote {page}.", soft_wrap=True)


def _show(found: Evaluation) -> None:
    table = terminal.table(
        f"{found.episodes} episodes of 20 s, actuator {found.actuator}, feedback "
        f"{found.feedback}; mean absolute errors",
        "", "fell %", "vx m/s", "vy m/s", "yaw rad/s", "duty", "swing s", "slip m/s",
    )  # fmt: skip
    table.add_row("random commands", *_cells(found))
    table.add_row("  a robot that stands", "–", *_errors(found.standing_still), *(["–"] * 3))
    for row in found.by_command:
        command = ", ".join(f"{c:g}" for c in row.command)
        table.add_row(f"{row.name} ({command})", *_cells(row))
    for row in found.by_terrain:
        table.add_row(f"ground: {row.terrain}", *_cells(row))
    for row in found.by_extra_delay:
        table.add_row(f"dead time +{row.extra_delay_ms:g} ms", *_cells(row))
    out.print(table)
    err.print("duty: share of time a foot is on the ground; slip: speed of feet on the ground.")


def _errors(row: Standing) -> list[str]:
    return [number(x, 3) for x in (row.mae_vx_m_s, row.mae_vy_m_s, row.mae_yaw_rad_s)]


def _cells(row: Figures) -> list[str]:
    return [
        number(100 * row.fall_rate, 0), *_errors(row), number(sum(row.duty) / len(row.duty), 2),
        number(row.swing_s, 2), number(row.foot_slip_m_s, 3),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
