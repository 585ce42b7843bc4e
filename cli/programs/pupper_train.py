"""`pupper-train`: train a walking policy on the measured robot."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

# Physics threads and torch threads take turns, so waiting must not spin.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import tyro
import yaml
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pupper_sysid.cli.policy_choice import warn_of_fallbacks
from pupper_sysid.cli.program import begin_work, parse, user_errors
from pupper_sysid.cli.terminal import err, out, print_json, remember, share_progress, spell, warn
from pupper_sysid.common.border import refuse_other_kind
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import hold_output, refuse_path
from pupper_sysid.common.results import plain
from pupper_sysid.policies.train.run_file import (
    OWN,
    TROT,
    Kind,
    Run,
    Start,
    check_teacher,
    load_run,
    preset,
    refuse_taken,
    with_robot,
)
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Rewards
from pupper_sysid.sim.walking.servo_ranges import check_actuator, servo_ranges

if TYPE_CHECKING:
    from pupper_sysid.policies.train.learner import Ranks

DESCRIPTION = """Train a walking policy in a simulator that moves like the measured robot.

Start with `pupper-train --actuator calibrated.yaml`; Ctrl-C saves and ends, `--resume` goes on.
Then `pupper-play runs/<name>` and `pupper-eval runs/<name>`.
"""
Preset = Literal["fast", "paper", "release"]

_SEARCHING = 0.3  # of a run's minutes: the most in which a first gait is searched


@dataclass(frozen=True)
class Options:
    """Settings of a training, and its folder."""

    run: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)
    policy: Kind = "mlp"
    """Kind of network; sets --architecture.* to sizes that suit it."""
    preset: Preset = "fast"
    """`fast`: sizes, task and rewards for a few cores; `paper`, `release`: as published."""
    start: Start = "imitation"
    """`imitation`: learn to continue a trot, then improve it; `scratch`: find a walk from nothing,
    with a teacher that acts by a clock, then learn to walk like it from what the robot sees;
    `teacher`: that teacher alone, for `--imitation.teacher runs/NAME`. The published presets always
    start from nothing."""
    robot: Path | None = None
    """MJCF or URDF of another robot than the Mini Pupper 2: any with legs and position servos. Its
    task is scaled by its size."""
    robot_config: Path | None = None
    """YAML beside it: joints, feet, pose, servos, gait, commands (docs/own_robot.md)."""
    name: str | None = None
    """Name of the run's folder in runs/; by default policy, date and time."""
    resume: Path | None = None
    """Folder of a run to go on with; only --iterations and --minutes can be new."""
    print_config: bool = False
    """Show all settings as YAML and stop."""
    benchmark: bool = False
    """Measure how fast environment, update and both together are, and stop."""
    json: bool = False
    """Print one JSON object instead of a table (with --benchmark)."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    with user_errors(words, "pupper-train") as rest:
        options = _parse(rest)
        begin_work()
        _run(options, rest)


def _parse(words: list[str]) -> Options:
    """Options; --preset, --policy and --start set the defaults of the others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    kinds = {"start": Start, "preset": Preset, "policy": Kind}
    for name in (*kinds, "robot", "robot-config"):
        parser.add_argument(f"--{name}", nargs="?")
    typed = vars(parser.parse_known_args(words)[0])
    # a wrong choice is refused by tyro, which then parses them all
    choices = {n: typed[n] if typed[n] in get_args(k) else get_args(k)[0] for n, k in kinds.items()}
    start: Any = choices["start"]
    begun = preset(choices["preset"], choices["policy"], start)
    remember(Options(begun))  # errors before the parsing name options, too
    robot, config = (typed[n] and Path(typed[n]) for n in ("robot", "robot_config"))
    if config is not None and robot is None:
        raise InputError("--robot-config describes the robot of --robot; give that, too.")
    if robot is not None:
        begun = with_robot(begun, robot, config)
    return parse(
        Options, words, "pupper-train", DESCRIPTION,
        default=Options(begun, start=start), config=(tyro.conf.FlagCreatePairsOff,),
    )  # fmt: skip


def _run(options: Options, words: list[str]) -> None:
    run, begun = options.run, time.monotonic()
    if options.print_config:
        print(yaml.safe_dump(plain(run), sort_keys=False), end="")
        return
    if options.name is not None:
        refuse_path(options.name, "--name")
    if options.resume is None and not options.benchmark:
        check_actuator(run.actuator)
        if run.imitation.iterations and run.imitation.teacher not in (TROT, OWN):
            check_teacher(Path(run.imitation.teacher), run)
    # torch and rsl_rl take seconds to import: only after the settings were checked
    warnings.filterwarnings("ignore", category=UserWarning, module="torch")
    from pupper_sysid.policies.train.learner import Ranks
    from pupper_sysid.policies.train.training import train

    if options.benchmark:
        from pupper_sysid.policies.train.speed import measure, with_sample

        sample_run = with_sample(run)
        check_actuator(sample_run.actuator)
        if sample_run is not run:
            warn(f"There is no {run.actuator} here; measuring with {sample_run.actuator}.")
        rates = measure(sample_run)
        if options.json:
            print_json(rates)
        else:
            for name, value in rates.items():
                text = f"{value:,.3g}" if isinstance(value, float) else str(value)
                out.print(f"{name:28} {text}")
        return
    ranks = Ranks.join()
    name = options.name or f"{options.policy}-{datetime.now():%Y%m%d-%H%M%S}"
    folder = options.resume or Path("runs") / ranks.same(name)
    if options.resume is not None and not options.resume.is_dir():
        refuse_other_kind(options.resume, "pupper-run")
        raise InputError(f"{options.resume} does not exist. Give the folder of a run.")
    servos = []
    if options.resume is None:
        refuse_taken(folder)
        servos = [servo_ranges(run.actuator, run.feedback, run.task.body)]
    else:
        load_run(options.resume)
    if ranks.rank == 0:
        hold_output(folder)
        err.print(f"{'Going on with' if options.resume else 'Training into'} {folder}.")
    if options.resume is None:
        if ranks.rank == 0:
            warn_of_fallbacks(servos)
            for note in run.task.body.notes:
                err.print(note)
        run = _with_first_gait(run, ranks, begun + 60 * _SEARCHING * run.minutes)
    with _bar() as watch:
        notice, stopping = (warn, err.print) if ranks.rank == 0 else (lambda text: None,) * 2
        if options.resume:
            learner = train(folder, None, watch, *_extension(options, words), notice, stopping)
        else:
            spent_s = time.monotonic() - begun
            learner = train(folder, run, watch, notice=notice, stopping=stopping, spent_s=spent_s)
    if ranks.rank > 0:
        return
    on = (
        f"go on: pupper-train --resume {folder} (longer than it was begun for: with --iterations "
        "or --minutes)"
    )
    if learner.architecture.privileged_actor:
        use = f"Learn from it: pupper-train --start scratch --imitation.teacher {folder}"
    else:
        use = f"Look at it: pupper-play {folder} --video walk.mp4; measure it: pupper-eval {folder}"
    if not learner.iteration:
        use = f"Its first gait is not complete, so it walks badly if at all. {use}"
    err.print(f"Saved. {use}; {on}")


def _with_first_gait(run: Run, ranks: Ranks, until: float) -> Run:
    """The run with a gait for its servos, which the first process searches for all.

    It does so until a time of the monotonic clock.
    """
    from pupper_sysid.policies.train.first_gait import fits_trots, with_first_gait

    if not fits_trots(run):
        return run
    task = run.task
    if ranks.rank == 0:
        with share_progress("first gait") as advance:
            task = with_first_gait(
                run, lambda text: err.print(spell(text)), partial(advance, "searching"),
                lambda: time.monotonic() > until,
            ).task  # fmt: skip
    fitted = json.loads(ranks.same(json.dumps(plain({"trot": task.trot, "rewards": task.rewards}))))
    trot, rewards = Trot(**fitted["trot"]), Rewards(**fitted["rewards"])
    return replace(run, task=replace(run.task, trot=trot, rewards=rewards))


def _extension(options: Options, words: list[str]) -> tuple[int | None, float | None]:
    """New --iterations and --minutes of a resumed run; anything else would have no effect."""
    flags = {a.split("=")[0] for a in words if a.startswith("--")}
    ignored = flags - {"--resume", "--iterations", "--minutes"}
    if ignored:
        raise InputError(
            f"A resumed run keeps its own settings, so {sorted(ignored)[0]} would change nothing. "
            "Leave it out, or start a new run."
        )
    return (
        options.run.iterations if "--iterations" in flags else None,
        options.run.minutes if "--minutes" in flags else None,
    )


@contextlib.contextmanager
def _bar() -> Iterator:
    """Progress bar with the time left; without a terminal one line per ten updates."""
    terminal = err.is_terminal
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(), TextColumn("{task.fields[left]}"), TextColumn("{task.fields[what]}"),
        console=err, disable=not terminal,
    ) as bar:  # fmt: skip
        task = bar.add_task("starting", total=None, what="", left="")

        def watch(now) -> None:
            if now.phase == "imitation":
                what = f"difference to the teacher {now.row['difference']:.3f}"
            else:
                what = (
                    f"score {now.row['score']:.2f}, reward {now.row['reward'] * 50:.2f}/s, "
                    f"std {now.row['std']:.3f}, rate {now.row['learning_rate']:.1e}, "
                    f"KL {now.row['kl']:.3f}, clipped {100 * now.row['clip_fraction']:.0f} %"
                )
            label = {"teacher": "teacher", "imitation": "first gait", "ppo": "PPO"}[now.phase]
            until = f"{now.left_s / 60:.0f} min left"
            bar.update(
                task, description=label, completed=now.done, total=now.total, what=what, left=until
            )
            if not terminal and (now.done % 10 == 0 or now.done == 1):
                err.print(f"{label} {now.done}/{now.total}, {until}: {what}")

        yield watch


if __name__ == "__main__":
    main()
