"""Rounds of `sweep --until`: record and fit, each round a recording of its own, until the goal."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite

if TYPE_CHECKING:
    from pupper_sysid.sysid.fit.results import JointCalibrationResult
    from pupper_sysid.sysid.plan.proposal import SweepPlan
    from pupper_sysid.sysid.plan.until import JointOutcome, Outcome
    from pupper_sysid.sysid.recordings.recording import Recording

Record = Callable[[Path, dict[str, Any], bool], list[Path]]
"""Records a request, or with True the rest of it, to a file; returns the files written."""


def run_rounds(
    record: Record,
    path: Path,
    request: dict[str, Any],
    *,
    resume: bool,
    whole: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Record the first sweep, or what is left of the last round, and go on to the goal.

    `path` is the first recording, or the one that is continued (`resume`), which may be `whole`
    already; `request` is its. `force` replaces the rounds of an earlier sweep.
    """
    started = time.perf_counter()
    from pupper_sysid.sysid.doctor.checks import each_joint
    from pupper_sysid.sysid.fit.joint_fit import fit_joint
    from pupper_sysid.sysid.plan.plan_file import save_plan
    from pupper_sysid.sysid.plan.until import parse_goal, record_until
    from pupper_sysid.sysid.sweep.resume import footer, header_of

    series = request["until"]
    first = path.with_name(series["first"])
    if resume:
        paths = _recorded(first)
        if paths[-1] != path:
            path = paths[-1]
            whole, request = bool(footer(path)), dict(header_of(path)["sweep"])
    else:
        paths = [path]
        if force:  # rounds of an earlier sweep of this name are not this one's
            for old in _recorded(first)[1:]:
                old.unlink()
    written = list(paths)
    if not whole:
        written += record(path, request, resume)[1:]

    def record_next(plan: SweepPlan, number: int) -> Path:
        file = _of_round(first, number)
        refuse_overwrite(file)
        plan_file = file.with_suffix(".plan.yaml")
        save_plan(plan, plan_file, force=True)  # of a round that never began, if it is there
        again = request | {
            "plan": str(plan_file), "joints": plan.joints, "loop_period_s": plan.loop_period_s,
            "until": series | {"number": number},
        }  # fmt: skip
        written.extend([*record(file, again, False), plan_file])
        return file

    def fit(
        recordings: Sequence[Recording], joints: list[str]
    ) -> dict[str, JointCalibrationResult]:
        with terminal.progress("fitting", len(joints)) as advance:
            return each_joint(
                partial(fit_joint, seed=request["seed"]), recordings, joints, 2, advance
            )

    try:
        outcome = record_until(
            parse_goal(series["goal"]), paths, series["joints"], fit, record_next,
            most_seconds=series["most_seconds"], seed=request["seed"],
            report=lambda found: _say_progress(found, series["goal"]),
        )  # fmt: skip
    except KeyboardInterrupt:
        say_how_to_resume(first)
        raise
    if as_json:
        elapsed = time.perf_counter() - started
        terminal.print_json(outcome.to_dict() | {"written": written, "elapsed_s": elapsed})
    else:
        _print_outcome(outcome, written, series["goal"])


def _of_round(first: Path, number: int) -> Path:
    return first if number == 1 else first.with_name(f"{first.stem}_{number}.csv")


def _recorded(first: Path) -> list[Path]:
    """Files of the rounds that were begun."""
    if not first.exists():
        raise InputError(f"{first}, the first recording of this sweep, is missing. Put it back.")
    found, number = [first], 2
    while (path := _of_round(first, number)).exists():
        found.append(path)
        number += 1
    return found


def _say_progress(found: dict[str, JointOutcome], goal: str) -> None:
    """One line per joint on stderr."""
    from pupper_sysid.sysid.plan.until import half_width

    for joint, state in found.items():
        dead = state.dead_time_s
        terminal.err.print(
            f"{joint}: after {state.recorded_s:.0f} s the dead time is "
            f"{terminal.ms(dead.value)} ms ± {terminal.ms(half_width(dead))} ({goal}): "
            f"{state.why or 'reached'}."
        )


def _print_outcome(outcome: Outcome, written: list[Path], goal: str) -> None:
    shown = terminal.table(
        f"Until {goal}", "joint", "rounds", "seconds", "dead time ms", "90 % interval", "goal"
    )
    for joint, state in outcome.joints.items():
        dead = state.dead_time_s
        shown.add_row(
            joint, str(state.rounds), terminal.number(state.recorded_s, 0),
            terminal.ms(dead.value), f"{terminal.ms(dead.low)} … {terminal.ms(dead.high)}",
            "reached" if state.reached else "not reached",
        )  # fmt: skip
    terminal.out.print(shown)
    for joint, state in outcome.joints.items():
        if state.why:
            terminal.warn(f"{joint}: the goal was not reached: {state.why}.")
    for name in written:
        terminal.out.print(f"  {name}")
    following = ("calibrate", *outcome.recordings, "--out", "calibrated.yaml")
    terminal.out.print(f"Next:\n  {terminal.command('pupper-sysid', *following)}")


def say_how_to_resume(path: Path) -> None:
    """Print the command that continues a recording."""
    resuming = terminal.command("pupper-sysid", "sweep", "--resume", path)
    terminal.err.print(f"The recording up to here is in {path}; continue it with\n  {resuming}")
