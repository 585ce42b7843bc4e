"""`pupper-eval`: falls and tracking errors of a policy, as a table."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.policy_choice import policy_at, run_folder, simulator, warn_of_fallbacks
from pupper_sysid.cli.program import run_program
from pupper_sysid.cli.terminal import err, need_positive, print_json, print_tables
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, resolved
from pupper_sysid.sim.robot.terrain import Terrain

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
    from pupper_sysid.policies.evaluation.report import tables_of, walking_sections

    torch.set_num_threads(1)
    policy, run = policy_at(options.policy)
    task, servos = simulator(options.policy, policy, run, options.actuator, options.feedback)
    warn_of_fallbacks([servos])
    cases = BATTERY if options.battery else table(options.terrain, options.extra_delay_ms)
    robots = battery_robots(episodes) if options.battery else usual_robots(episodes)
    with terminal.share_progress("walking") as advance:
        evaluation = evaluate(
            policy, replace(task, episode_s=seconds), servos, cases, robots, options.seed,
            options.threads, feedback=options.feedback or policy.contract.feedback,
            progress=partial(advance, f"{episodes} episodes of {seconds:g} s and all conditions"),
        )  # fmt: skip
    if page:
        from pupper_sysid.common.page import write_page

        folder = run_folder(options.policy)
        sections = walking_sections(policy, run, folder, evaluation)
        title = f"Walking report: {folder.name}"
        name = resolved(options.policy).name
        write_page(page, title, f"{name}, seed {options.seed}", sections, options.force)
    if options.json:
        about = {"quick": options.quick, "battery": options.battery}
        return print_json(about | evaluation.to_dict() | ({"report": page} if page else {}))
    first = evaluation.conditions[0].policy
    err.print(
        f"{'Quick look: ' if options.quick else ''}{first.episodes} episodes of "
        f"{evaluation.episode_s:g} s, actuator {evaluation.actuator}, feedback "
        f"{evaluation.feedback}. The trot is open-loop: it has a clock and sees nothing. Episode k "
        "has the same robot in every row; intervals are of 90 %."
    )
    for results in tables_of(evaluation):
        print_tables(results)
    if page:
        err.print(f"Wrote {page}.")


main = partial(run_program, Eval, _run, "pupper-eval", DESCRIPTION)

if __name__ == "__main__":
    main()
