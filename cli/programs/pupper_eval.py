"""`pupper-eval`: how well a policy walks, as a table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.policy_choice import policy_at, run_folder, simulator, tell_borrowed
from pupper_sysid.cli.terminal import err, number, out, print_json
from pupper_sysid.cli.user_errors import run_program
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.sim.robot.terrain import Terrain

DESCRIPTION = """How well a policy walks: falls, tracking errors, by direction, ground and delay.

Errors are mean absolute errors of the instantaneous velocity over whole episodes.

Example: pupper-eval runs/<name> --extra-delay-ms 0 40 80 --report report
"""


@dataclass(frozen=True)
class Eval:
    """What to evaluate, and where."""

    policy: Annotated[Path, tyro.conf.Positional]
    """A run (`runs/<name>`) or a policy folder."""
    episodes: int = 100
    """How many episodes of 20 s with random commands; a fifth of that per direction."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    terrain: tuple[Terrain, ...] = ("flat", "rough", "slopes", "troughs")
    """Kinds of ground of the table."""
    extra_delay_ms: tuple[float, ...] = (0.0, 40.0, 80.0)
    """Added to every servo's delay, for the table."""
    seed: int = 0
    """Of commands, servos, friction and ground."""
    threads: int = 0
    """Of the physics; 0 for all cores."""
    report: Path | None = None
    """Folder for all of it as an HTML page, with the run's curves and settings; beside the page its
    figures as PNG and SVG, its tables as CSV."""
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
                f"--extra-delay-ms is {extra:g}; a servo cannot answer before its own delay: give "
                "0 or more."
            )
    page = options.report / "walking.html" if options.report else None
    if page:
        refuse_overwrite(page, options.force)  # before the work, not after it
    import torch

    from pupper_sysid.policies.analysis.evaluation import evaluate, evaluation_task, summary, walk

    torch.set_num_threads(1)
    policy, run = policy_at(options.policy)
    task, servos = simulator(options.policy, policy, run, options.actuator, options.feedback)
    tell_borrowed([servos])
    flat = replace(task, terrain="flat")
    stages = 8 + len(options.terrain) + len(options.extra_delay_ms)
    with terminal.progress("walking", stages) as advance:
        found = evaluate(
            policy, flat, servos, options.episodes, options.seed, options.threads, advance
        )
        found["feedback"] = options.feedback or policy.contract.feedback
        found["by_terrain"] = []
        for ground in options.terrain:
            advance(ground)
            there = evaluation_task(replace(task, terrain=ground))
            walked = walk(policy, there, servos, max(options.episodes // 2, 1), options.seed,
                          None, options.threads)  # fmt: skip
            found["by_terrain"].append({"terrain": ground, **summary(walked)})
        found["by_extra_delay"] = []
        for extra in options.extra_delay_ms:
            advance(f"+{extra:g} ms")
            late = servos.later(extra / 1000)
            walked = walk(policy, evaluation_task(flat), late, max(options.episodes // 2, 1),
                          options.seed, None, options.threads)  # fmt: skip
            found["by_extra_delay"].append({"extra_delay_ms": extra, **summary(walked)})
    if page:
        from pupper_sysid.common.page import write_page
        from pupper_sysid.policies.analysis.walking_report import walking_sections

        folder = run_folder(options.policy)
        sections = walking_sections(policy, run, folder, found)
        title = f"Walking report: {folder.name}"
        name = options.policy.resolve().name
        write_page(page, title, f"{name}, seed {options.seed}", sections, options.force)
    if options.json:
        print_json(found | ({"report": str(page)} if page else {}))
        return
    _show(found)
    if page:
        err.print(f"Wrote {page}.", soft_wrap=True)


def _show(found: dict[str, Any]) -> None:
    columns = ("fell %", "vx m/s", "vy m/s", "yaw rad/s", "duty", "swing s", "slip m/s")
    table = terminal.table(
        f"{found['episodes']} episodes of 20 s, actuator {found['actuator']}, feedback "
        f"{found['feedback']}; mean absolute errors",
        "", *columns,
    )  # fmt: skip
    still = found["standing_still"]
    table.add_row("random commands", *_cells(found))
    table.add_row(
        "  a robot that stands", "–", *(number(still[k], 3) for k in _ERRORS), *(["–"] * 3)
    )
    for row in found["by_command"]:
        command = ", ".join(f"{c:g}" for c in row["command"])
        table.add_row(f"{row['name']} ({command})", *_cells(row))
    for row in found["by_terrain"]:
        table.add_row(f"ground: {row['terrain']}", *_cells(row))
    for row in found["by_extra_delay"]:
        table.add_row(f"delay +{row['extra_delay_ms']:g} ms", *_cells(row))
    out.print(table)
    err.print("duty: share of time a foot is on the ground; slip: speed of feet on the ground.")


_ERRORS = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")


def _cells(row: dict[str, Any]) -> list[str]:
    duty = sum(row["duty"]) / len(row["duty"])
    return [
        number(100 * row["fall_rate"], 0), *(number(row[k], 3) for k in _ERRORS), number(duty, 2),
        number(row["swing_s"], 2), number(row["foot_slip_m_s"], 3),
    ]  # fmt: skip


if __name__ == "__main__":
    main()
