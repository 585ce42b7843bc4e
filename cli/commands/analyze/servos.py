"""`servo` and `servo-demand`: servo models on unseen readings; what a gait needs of its servos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Analysis, Commanded, check_walk, tries_of
from pupper_sysid.cli.terminal import err, need_positive, number
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.analyze.common import Found, Tries
    from pupper_sysid.policies.analysis.servo_demand import ServoDemand as Demand
    from pupper_sysid.policies.analysis.trial import Trial
    from pupper_sysid.policies.walks.conditions import Actor
    from pupper_sysid.sim.robot.body import Body
    from pupper_sysid.sim.walking.servo_ranges import ServoRanges

_ONNX = ".onnx"
_STROLL = 0.5  # of the commanded speed; slower, it is probably not the gait that was trained

_WIDTH = 78


@dataclass(frozen=True)
class Servo(Analysis):
    """Compare servo models on a recording, or on a walk of an emulated robot.

    These are the published DelayedPD, a fitted DelayedPD, an LSTM and an MLP.
    Give one recording or one policy. --command, --seconds and --actuator are for a policy's walk.

    Example: pupper-analyze servo recordings/playback.csv
    """

    policies: tyro.conf.Positional[tuple[Path, ...]] = ()
    """One recording, or one run or policy folder."""
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""
    seconds: float = 10.0
    """Duration of a policy's walk."""

    def analyse(self) -> Found:
        """Fit and compare the models."""
        from pupper_sysid.sysid.compare.compare import four_way
        from pupper_sysid.sysid.report.tables import mean_error_table

        need_positive("--seconds", self.seconds)
        if len(self.policies) != 1:
            raise InputError("Servo models are compared on one recording or policy at a time.")
        (path,) = self.policies
        if path.is_dir():
            path = self._walked(path)
        (recording,) = terminal.load_all([path])
        with terminal.share_progress("fitting") as advance:
            compared = four_way(recording, recording.joints, self.seed, advance)
        title = "RMS error on unseen readings, mrad, mean of the joints"
        table = mean_error_table(compared.models, compared.persistence_rmse_rad, title)
        found = {**compared.to_dict(), "recording": path}
        return found, compared.plot(), terminal.result_table(table)

    def _walked(self, folder: Path) -> Path:
        """A recording of the servos of an emulated robot that a policy walks."""
        from pupper_sysid.cli.policy_choice import chosen_actuator, policy_at, run_folder
        from pupper_sysid.policies.deploy.emulated_walk import walk_once
        from pupper_sysid.policies.deploy.stacks import STACKS
        from pupper_sysid.sysid.recordings.files import RecordingWriter

        policy, run = policy_at(folder)
        actuator = chosen_actuator(folder, policy, run, self.actuator)
        path = self.out / f"{run_folder(folder).name}-walk.csv"
        about = {"bus": {"kind": "emulated walking robot", "coordinates": "servo"}}
        with RecordingWriter(path, about | {"policy": str(folder)}, self.force) as rows:
            outcome, _ = walk_once(
                policy, STACKS["closed-loop"], self.command, self.seconds, self.seed, actuator,
                rows=rows,
            )  # fmt: skip
            rows.close({"stop_reason": outcome.stop_reason})
        return path


@dataclass(frozen=True)
class ServoDemand(Commanded):
    """Compare what a gait needs of its servos with what a servo has: speed, torque, dead time.

    The policy is a run, or the ONNX file of any trainer with its robot's MJCF. What its metadata
    lack stands in a YAML beside it (docs: Understanding a walk).

    Example: pupper-analyze servo-demand walk.onnx --robot duck.xml --servo sts3215-bam-m1
    """

    servo: str | None = None
    """The servo in question: a servo card, its file, a calibration or a preset."""
    robot: Path | None = None
    """MJCF of an ONNX file's robot; without it, it walks the Mini Pupper 2."""
    robot_config: Path | None = None
    """YAML of that robot, as for pupper-train."""
    policy_config: Path | None = None
    """YAML of an ONNX file: joints, default pose, action scale, time step, observation. By default
    the one beside it."""

    def analyse(self) -> Found:
        """Walk, and compare."""
        from pupper_sysid.policies.analysis.figures import demand_figure
        from pupper_sysid.policies.analysis.servo_demand import servo_demand
        from pupper_sysid.servo_models.cards.files import is_card, load_card
        from pupper_sysid.sim.walking.servo_ranges import check_actuator, servo_ranges

        if self.servo is None:
            raise InputError(
                "Which servo? Name one with --servo: a card (`pupper-sysid servo list`) or a "
                "calibration."
            )
        if len(self.policies) != 1:
            raise InputError("One gait at a time: name one policy.")
        (policy,) = self.policies
        if Path(policy).is_file() and Path(policy).suffix != ".onnx":
            raise InputError(
                f"{policy} holds no policy. Give a run, a policy folder, or an ONNX file (.onnx)."
            )
        check_actuator(self.servo)
        card = is_card(self.servo)
        known = not card or load_card(self.servo).pd().dead_time_s is not None

        def candidate(body: Body) -> ServoRanges:
            # a card is of one servo, whichever joints of a calibration the robot's YAML names
            return servo_ranges(self.servo or "", body=replace(body, servo_of={}) if card else body)

        def demand_of(policy: Actor, trial: Trial) -> Demand:
            return servo_demand(policy, trial, candidate(trial.task.body), known)

        found: dict[str, Demand] = self.each(demand_of, self.command)
        (name, demand), *_ = found.items()
        wanted = float(np.hypot(*self.command[:2]))
        if path_is_onnx(self.policies[0]) and demand.speed_m_s < _STROLL * wanted:
            terminal.warn(
                f"{name} walks at {demand.speed_m_s:.2f} m/s where {wanted:g} are commanded, "
                "so this may not be its gait: check the order, signs and scales of "
                "`observation`, the pose, and the command (--command)."
            )
        table = terminal.table(
            self.title(f"{name} on {Path(self.servo).name}"), "servo", "rad/s 99 %", "peak", "has",
            "N·m 99 %", "has", "used", "short", "(walked)",
        )  # fmt: skip
        for joint, own in demand.joints.items():
            table.add_row(
                joint, number(own.speed_rad_s.p99, 1), number(own.speed_rad_s.peak, 1),
                number(own.top_speed_rad_s, 1), number(own.torque_nm.p99, 2),
                number(own.stall_torque_nm, 2), f"{100 * own.torque_used:.0f} %",
                f"{100 * own.short:.0f} %", f"{100 * own.walked_short:.0f} %",
            )  # fmt: skip
        if not self.json:
            for line in wrap(demand.verdict, _WIDTH):
                terminal.out.print(line)
        return {"demand": found, "verdict": demand.verdict}, demand_figure(demand), table

    def tries(self, command: tuple[float, float, float]) -> Tries:
        """The policy of a run or of an ONNX file, and how it is tried."""
        path = self.policies[0]
        if not path_is_onnx(path):
            if other := next((n for n in _OF_ONNX if getattr(self, n) is not None), None):
                raise InputError(
                    f"--{other.replace('_', '-')} is for a policy in an ONNX file; {path} is a run "
                    "or a policy of pupper-train, which knows its robot."
                )
            return tries_of(self, command, *self.size, other_robots=True)
        from pupper_sysid.cli.policy_choice import warn_of_fallbacks
        from pupper_sysid.policies.analysis.trial import Trial

        check_walk(command, *self.size)
        policy, task, servos = self._of_onnx(path)
        warn_of_fallbacks([servos])
        return {path.stem: (policy, Trial(task, servos, command, *self.size, self.seed))}

    def _of_onnx(self, path: Path) -> tuple[Any, Any, ServoRanges]:
        """Policy, task and servos of the walk."""
        from pupper_sysid.cli.policy_choice import simulator
        from pupper_sysid.policies.analysis.foreign_policy import (
            ForeignPolicy,
            exported_policy,
            servos_of_training,
        )
        from pupper_sysid.policies.network.onnx_network import OnnxNetwork
        from pupper_sysid.sim.walking.servo_ranges import check_actuator, servo_ranges

        for file, what in (
            (path, "a policy's ONNX file"), (self.robot, "the robot's MJCF as --robot"),
            (self.robot_config, "its YAML as --robot-config"),
            (self.policy_config, "the policy's YAML as --policy-config"),
        ):  # fmt: skip
            if file is not None and not file.is_file():
                raise InputError(f"There is no {file}. Give {what}.")
        network = OnnxNetwork(path)
        own = exported_policy(network)
        if own is not None and self.policy_config is None:
            return own, *simulator(path, own, None, self.actuator, self.feedback)
        policy = ForeignPolicy.of(network, self.policy_config)
        task = policy.task(self.robot, self.robot_config)
        policy.fit(task)
        if self.actuator is not None:
            check_actuator(self.actuator)
            servos = servo_ranges(self.actuator, self.feedback or "held", task.body)
        else:
            servos = servos_of_training(policy, task, self.robot)
        for note in policy.notes:
            err.print(note)
        return policy, task, servos


def path_is_onnx(path: Path) -> bool:
    """Whether a policy is named by its ONNX file."""
    return path.suffix.lower() == _ONNX


_OF_ONNX = ("robot", "robot_config", "policy_config")
