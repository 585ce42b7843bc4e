"""The policy, servos and task that the arguments of a program mean, and how they compare."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.cli.terminal import cell, err, table, warn
from pupper_sysid.common.border import read_json, refuse_other_kind
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import resolved, sha256
from pupper_sysid.policies.train.run_file import RUN_FILE, Run, load_run
from pupper_sysid.servo_models.calibration.calibration import PRESETS, is_shipped
from pupper_sysid.sim.walking.config import PRESETS as WALKING
from pupper_sysid.sim.walking.config import Walking, for_robot
from pupper_sysid.sim.walking.servo_ranges import IDEAL, ServoRanges, check_actuator, servo_ranges

if TYPE_CHECKING:
    from pupper_sysid.policies.deploy.matches import Match, ServoMatch
    from pupper_sysid.policies.network.policy_file import CommandRanges, Policy
    from pupper_sysid.sim.robot.body import Body

_CONTRACT = "contract.json"


def is_policy(folder: Path) -> bool:
    """Whether a folder is a run or a policy (a servo model has a contract, too)."""
    if (folder / RUN_FILE).is_file():
        return True
    with contextlib.suppress(InputError):
        content = read_json(folder / _CONTRACT)
        return isinstance(content, dict) and content.get("schema") == "pupper-policy"
    return False


def run_folder(path: Path) -> Path:
    """The run that a policy is in (`policy_best`, …), else the folder itself."""
    path = resolved(path)
    return path.parent if path.name.startswith("policy_") else path


def policy_at(path: Path) -> tuple[Policy, Run | None]:
    """The policy in a policy folder, or the best (else the last) of a run, and the run."""
    from pupper_sysid.policies.network.policy_file import (  # torch takes seconds to import
        CONTRACT,
        load_policy,
    )

    if (path / CONTRACT).is_file():
        # a shipped policy has its run's settings beside it, one in a run above it
        of_run = next((f for f in (path, path.parent) if (f / RUN_FILE).is_file()), None)
        return load_policy(path), load_run(of_run) if of_run else None
    if not (path / RUN_FILE).is_file():
        refuse_other_kind(path, "pupper-run")
        raise InputError(
            f"{path} is neither a run nor a policy. Give a folder that pupper-train wrote, "
            "like runs/<name>."
        )
    for name in ("policy_best", "policy_last"):
        if (path / name / CONTRACT).is_file():
            err.print(f"Taking {path / name}.")
            return load_policy(path / name), load_run(path)
    run = load_run(path)
    if run.architecture.privileged_actor:
        raise InputError(
            f"{path} is a teacher, which sees what no robot can. Train a policy that learns from "
            f"it: pupper-train --start scratch --imitation.teacher {path}"
        )
    raise InputError(
        f"{path} has no policy yet. Train on: pupper-train --resume {path} (the first is written "
        "after ten updates of PPO)."
    )


def trained_actuator(path: Path, policy: Policy, run: Run | None) -> tuple[str | None, bool]:
    """The actuator of the policy's training, and whether its hash is the contract's.

    A file is searched from here, then from the policy's folder and those above it, since a run
    keeps the name given at its beginning; of several, the one with the contract's hash is taken.
    None if there is none.
    """
    name = run.actuator if run else policy.contract.actuator
    if name == IDEAL or is_shipped(name):
        return name, True
    expected, candidates = policy.contract.actuator_sha256, _near(name, path)
    same = [f for f in candidates if expected is None or (f.is_file() and sha256(f) == expected)]
    return (str((same or candidates)[0]) if candidates else None), bool(same)


def chosen_actuator(path: Path, policy: Policy, run: Run | None, named: str | None) -> str:
    """The actuator for the policy at `path`: the `named` one, else that of its training."""
    if named is not None:
        check_actuator(named)
        return named
    trained, same = trained_actuator(path, policy, run)
    if trained is None:
        file, name = (RUN_FILE, run.actuator) if run else (_CONTRACT, policy.contract.actuator)
        raise InputError(
            f"{file} of {path} names the actuator {name}, which is not here. Give --actuator: a "
            f"calibration, or one of {', '.join((*PRESETS, IDEAL))}."
        )
    if not same:
        warn(
            f"{trained} is not the file with which {path} was trained: it was changed, or only "
            "has the same name. Give the right one, or this one, with --actuator."
        )
    return trained


def _near(name: str, path: Path) -> list[Path]:
    """Paths of this name from here, from `path` or from a folder above that."""
    folder = resolved(path)
    return [p for p in (Path(name), *(f / name for f in (folder, *folder.parents))) if p.exists()]


def refuse_other_robot(policy: Policy) -> None:
    """Refuse a policy that walks another robot than the Mini Pupper 2."""
    if (robot := policy.contract.robot) is not None:
        raise InputError(
            f"pupper-analyze knows the Mini Pupper 2 only, and this policy walks {robot.name}. "
            "Look at it with pupper-play, measure it with pupper-eval, compare its servos with "
            "pupper-analyze servo-demand, and walk it with pupper-deploy."
        )


def body_at(path: Path, policy: Policy, run: Run | None) -> Body:
    """The robot that the policy at `path` was trained on."""
    return _of_robot(run.task if run else Walking(), path, policy, run).body


def _of_robot(task: Walking, path: Path, policy: Policy, run: Run | None) -> Walking:
    """The task with the robot that the policy was trained on, whose files must be as they were."""
    robot = policy.contract.robot
    if robot is None:
        return task
    files = {}
    for key, name, expected in (
        ("robot", robot.mjcf, robot.mjcf_sha256),
        ("robot_config", robot.config, robot.config_sha256),
    ):  # fmt: skip
        if name is None or expected is None:
            files[key] = ""
            continue
        # where it was, or of that name beside the policy
        candidates = [f for f in (Path(name), *_near(Path(name).name, path)) if f.is_file()]
        same = next((f for f in candidates if sha256(f) == expected), None)
        if same is None:
            what = f"{candidates[0]} is not as it was" if candidates else "is not here"
            raise InputError(
                f"The policy at {path} walks {robot.name}, of {name}, which {what}. Put the file "
                "of its training there, or beside the policy."
            )
        files[key] = str(same)
    if run is None:
        return for_robot(task, files["robot"], files["robot_config"] or None)
    return replace(task, **files)


def simulator(
    path: Path, policy: Policy, run: Run | None, actuator: str | None, feedback: str | None
) -> tuple[Walking, ServoRanges]:
    """Task and servos for the policy at `path`: those of its training, unless others are given."""
    from pupper_sysid.policies.network.policy_file import refuse_other_observation

    contract = policy.contract
    refuse_other_observation(contract)
    task = run.task if run else Walking(
        physics_step_s=contract.physics_step_s, control_step_s=contract.control_step_s,
        action_scale=contract.action_scale_rad, knee=contract.knee,
    )  # fmt: skip
    task = _of_robot(task, path, policy, run)
    task = replace(
        task, observation=replace(task.observation, base_velocity=contract.base_velocity)
    )
    chosen = chosen_actuator(path, policy, run, actuator)
    if feedback is None:
        feedback = run.feedback if run else contract.feedback
        if feedback not in ("held", "ideal"):
            feedback = str(next(iter(_near(feedback, path)), feedback))
    return task, servo_ranges(chosen, feedback, task.body)


def trained_commands(policy: Policy, run: Run | None) -> CommandRanges:
    """Commands that a policy was trained for: of its file, else of its run.

    Where neither holds them, those of this version's presets are assumed, which is printed.
    """
    from pupper_sysid.policies.network.policy_file import CommandRanges

    contract = policy.contract
    if contract.commands is not None:
        return contract.commands
    if run is not None:
        reached = run.task.curriculum.at(contract.training.get("samples", float("inf")))
        return CommandRanges.of(run.task.commands, reached["commands"])
    # only the published presets let a policy see the trunk's speed
    of = "release" if contract.base_velocity == "true" else "fast"
    assumed = CommandRanges.of(WALKING[of].commands)
    err.print(
        "The policy's file does not say which commands it was trained for. Assumed are those of "
        f"the preset {of}: {assumed}."
    )
    return assumed


def warn_of_fallbacks(servos: Iterable[ServoRanges]) -> None:
    """Which joints go by another's numbers, once per calibration."""
    warn(
        *dict.fromkeys(
            f"{s.source} has no {', '.join(s.fallbacks)}: they take the numbers of "
            f"{', '.join(sorted(set(s.fallbacks.values())))}. Calibrate them to know."
            for s in servos
            if s.fallbacks
        )
    )


def show_match(match: Match) -> None:
    """Print how an observer answers beside the robot of the training."""
    if match.fits:
        err.print(match.sentence())
        return
    warn(match.sentence())
    rows = [row for row in match.table() if row["frequency_hz"] % 1 == 0]
    titles = (name.replace("_", " ") for name in rows[0])
    cells = ([cell(v, 2) for v in row.values()] for row in rows)
    err.print(table("Swing over command, and phase", *titles, rows=cells))


def show_servos(match: ServoMatch | None, is_learned: bool) -> None:
    """The robot's servos beside those of the training."""
    if match is None:
        err.print(
            "The robot's servos were not compared with those of the training: "
            + ("a learned model has no numbers." if is_learned else "the policy's file has none.")
        )
    elif match.outside:
        warn(f"{match.here} is not what the policy was trained for:", *match.sentences())
    else:
        err.print(*match.sentences())
