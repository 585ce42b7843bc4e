"""What `pupper-play` and `pupper-eval` share: which policy is meant, and in which simulator."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cli.terminal import err, warn
from common.errors import InputError
from policies.run_file import RUN_FILE, Run, load_run
from sim.servo_ranges import ServoRanges, check_actuator, servo_ranges
from sim.walking_config import Walking

if TYPE_CHECKING:
    from policies.policy_file import Policy

_CONTRACT = "contract.json"


def is_policy(folder: Path) -> bool:
    """Whether a folder is a run or a policy (a servo model has a contract, too)."""
    if (folder / RUN_FILE).is_file():
        return True
    with contextlib.suppress(OSError, ValueError):
        found = json.loads((folder / _CONTRACT).read_text())
        return isinstance(found, dict) and found.get("schema") == "pupper-policy"
    return False


def run_folder(path: Path) -> Path:
    """The run that a policy is in (`policy_best`, `policy_last`), else the folder itself."""
    path = path.resolve()
    return path.parent if path.name.startswith("policy_") else path


def policy_at(path: Path) -> tuple[Policy, Run | None]:
    """The policy in a policy folder, or the best (else the last) of a run, and the run.

    Raises
    ------
    InputError
        If there is none.
    """
    from policies.policy_file import CONTRACT, load_policy  # torch takes seconds to import

    if (path / CONTRACT).is_file():
        # a shipped policy has its run's settings beside it, one in a run above it
        of_run = next((f for f in (path, path.parent) if (f / RUN_FILE).is_file()), None)
        return load_policy(path), load_run(of_run) if of_run else None
    if not (path / RUN_FILE).is_file():
        raise InputError(
            f"{path} is neither a run nor a policy. Give a folder that pupper-train wrote, "
            "like runs/<name>."
        )
    for name in ("policy_best", "policy_last"):
        if (path / name / CONTRACT).is_file():
            err.print(f"Taking {path / name}.")
            return load_policy(path / name), load_run(path)
    raise InputError(
        f"{path} has no policy yet. Train on: pupper-train --resume {path} (the first is written "
        "after ten updates of PPO)."
    )


def simulator(
    policy: Policy, run: Run | None, actuator: str | None, feedback: str | None
) -> tuple[Walking, ServoRanges]:
    """Task and servos to run a policy in: its own, unless told otherwise."""
    from policies.policy_file import refuse_other_observation

    contract = policy.contract
    refuse_other_observation(contract)
    task = run.task if run else Walking(
        physics_step_s=contract.physics_step_s, control_step_s=contract.control_step_s,
        action_scale=contract.action_scale_rad, knee=contract.knee,
    )  # fmt: skip
    task = replace(
        task, observation=replace(task.observation, base_velocity=contract.base_velocity)
    )
    chosen = actuator or (run.actuator if run else None) or contract.actuator
    check_actuator(chosen)
    servos = servo_ranges(chosen, feedback or (run.feedback if run else contract.feedback))
    if servos.borrowed:
        kinds = sorted(set(servos.borrowed.values()))
        warn(
            [
                f"{chosen} has no {', '.join(servos.borrowed)}: they take the numbers of "
                f"{', '.join(kinds)}. Calibrate them to know."
            ]
        )
    return task, servos
