"""`servo`, `servo-demand` and `twin`: servo models on unseen readings, and on the whole robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.walks import Analysis, Commanded, Drawn, check_walk, tries_of
from pupper_sysid.cli.terminal import err, ms, need_positive, number
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from pupper_sysid.cli.commands.walks import Results, Tries
    from pupper_sysid.policies.analysis.servo_demand import ServoDemand as Demand
    from pupper_sysid.policies.analysis.trial import Trial
    from pupper_sysid.policies.twin.twin import Gyro
    from pupper_sysid.policies.twin.twin import Twin as Result
    from pupper_sysid.policies.walks.together import Actor
    from pupper_sysid.sim.robot.body import Body
    from pupper_sysid.sim.walking.servo_ranges import ServoRanges

_STROLL = 0.5  # of the commanded speed; slower, it is probably not the gait that was trained
_WIDTH = 78
_OF_ONNX = {
    "robot": "the robot's MJCF", "robot_config": "its YAML", "policy_config": "the policy's YAML",
}  # fmt: skip


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

    def analyse(self) -> Results:
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
        data = {**compared.to_dict(), "recording": path}
        return data, compared.plot(), terminal.result_table(table)

    def _walked(self, folder: Path) -> Path:
        """A recording of the servos of an emulated robot that a policy walks."""
        from pupper_sysid.cli.policy_choice import chosen_actuator, policy_at, run_folder
        from pupper_sysid.policies.deploy.assembly import walk_once
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

    def analyse(self) -> Results:
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

        demands: dict[str, Demand] = self.per_policy(demand_of, self.command)
        (name, demand), *_ = demands.items()
        speed = float(np.hypot(*self.command[:2]))
        if path_is_onnx(self.policies[0]) and demand.speed_m_s < _STROLL * speed:
            terminal.warn(
                f"{name} walks at {demand.speed_m_s:.2f} m/s where {speed:g} are commanded, "
                "so this may not be its gait: check the order, signs and scales of "
                "`observation`, the pose, and the command (--command)."
            )
        rows = (
            (
                joint, number(needs.speed_rad_s.p99, 1), number(needs.speed_rad_s.peak, 1),
                number(needs.top_speed_rad_s, 1), number(needs.torque_nm.p99, 2),
                number(needs.stall_torque_nm, 2),
                *(f"{100 * x:.0f} %" for x in (needs.torque_used, needs.short, needs.walked_short)),
            )
            for joint, needs in demand.joints.items()
        )  # fmt: skip
        table = terminal.table(
            self.title(f"{name} on {Path(self.servo).name}"), "servo", "rad/s 99 %", "peak", "has",
            "N·m 99 %", "has", "used", "short", "(walked)", rows=rows,
        )  # fmt: skip
        if not self.json:
            for line in wrap(demand.verdict, _WIDTH):
                terminal.out.print(line)
        return {"demand": demands, "verdict": demand.verdict}, demand_figure(demand), table

    def tries(self, command: tuple[float, float, float]) -> Tries:
        """The policy of a run or of an ONNX file, and how it is tried."""
        path = self.policies[0]
        if not path_is_onnx(path):
            if key := next((n for n in _OF_ONNX if getattr(self, n) is not None), None):
                raise InputError(
                    f"--{key.replace('_', '-')} is for a policy in an ONNX file; {path} is a run "
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

        files = {path: "a policy's ONNX file"}
        files |= {
            getattr(self, key): f"{what} as --{key.replace('_', '-')}"
            for key, what in _OF_ONNX.items()
        }
        for file, what in files.items():
            if file is not None and not file.is_file():
                raise InputError(f"There is no {file}. Give {what}.")
        network = OnnxNetwork(path)
        exported = exported_policy(network)
        if exported is not None and self.policy_config is None:
            return exported, *simulator(path, exported, None, self.actuator, self.feedback)
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
    return path.suffix.lower() == ".onnx"


_PLACES = (("air", "in the air"), ("ground", "on the ground"))


@dataclass(frozen=True)
class Twin(Drawn):
    """Give a recording's commands to the whole simulated robot and compare it with the readings.

    Once in the air and once on the ground, with every actuator, joint by joint; the readings are
    predicted with their age and an offset per joint. Says where the robot was, if that shows.

    Example: pupper-analyze twin recordings/walk.csv --actuator calibrated.yaml --actuator paper
    """

    recording: tyro.conf.Positional[tuple[Path, ...]] = ()
    """The recording; by default the newest in recordings/."""
    actuator: tyro.conf.UseAppendAction[
        Annotated[tuple[str, ...], tyro.conf.arg(metavar="ACTUATOR")]
    ] = ()
    """Calibration, servo card, `paper`, `release` or `ideal`; once per actuator."""
    feedback: Path | None = None
    """Calibration of the same bus, whose poll is used where the recording does not show its own and
    no actuator has one."""
    model: Path | None = None
    """MJCF or URDF of the robot; by default it is the Mini Pupper."""
    imu: tuple[Path, ...] = ()
    """IMU logs of the robot on the ground (columns timestamp, gx, gy, gz), whose spectra are shown
    beside the simulated gyro's."""
    test_loops: str = ""
    """Trials (loops) to score on, such as 2, with the offsets of the others; by default all."""
    robots: int = 16
    """Simulated robots on the ground, which differ in friction and payload."""
    threads: int = 0
    """Of the physics; 0 for all cores."""

    def analyse(self) -> Results:
        """Simulate and compare."""
        from pupper_sysid.policies.twin.drawing import actuator_of, robot_for
        from pupper_sysid.policies.twin.twin import read_imu, spectrum, twin, twin_figure
        from pupper_sysid.servo_models.calibration.calibration import load_calibration

        if not self.actuator:
            raise InputError(
                "No actuator was named: give a calibration, such as `--actuator calibrated.yaml`."
            )
        recordings = terminal.load_all(self.recording)
        if len(recordings) != 1:
            raise InputError("One recording at a time: name one.")
        logs = {path.name: read_imu(path) for path in self.imu}
        robot = robot_for(recordings[0], self.model)
        actuators = {
            Path(name).name or name: actuator_of(name, robot, recordings[0])
            for name in self.actuator
        }
        loops = terminal.whole_numbers("--test-loops", self.test_loops) if self.test_loops else []
        feedback = {self.feedback.name: load_calibration(self.feedback)} if self.feedback else {}
        with terminal.share_progress("simulating") as advance:
            result = twin(
                recordings[0], actuators, robot, feedback,
                test_loops=loops,
                copies=self.robots, seed=self.seed, threads=self.threads,
                progress=lambda share: advance("simulating", share),
            )  # fmt: skip
        seen = {name: spectrum(log.time_s, [log.rate_rad_s]) for name, log in logs.items()}
        if not self.json:
            _explain(result, seen)
        return (
            {**result.to_dict(), "imu": seen, "recording": recordings[0].name},
            twin_figure(result),
            _table(result),
        )


def _explain(result: Result, seen: dict[str, Gyro | None]) -> None:
    """Errors by joint, gyro, notes and the verdict, above the table."""
    best = result.models[result.best]
    conditions = {words: getattr(best, place) for place, words in _PLACES if getattr(best, place)}
    columns = [f"{what} {words}" for words in conditions for what in ("RMS", "mean")]
    rows = []
    for joint in result.readings:
        errors = (c.joints[joint] for c in conditions.values())
        both = (x for e in errors for x in (e.rmse_rad, e.mae_rad))
        rows.append((joint, *map(ms, (*both, result.repeatability_rad[joint]))))
    terminal.print_table(
        f"Errors of {result.best} by joint, mrad", "joint", *columns, "repeatability", rows=rows
    )
    if seen:
        simulated = {f"simulated, {n}": m.ground.gyro for n, m in result.models.items() if m.ground}
        terminal.print_table(
            "Gyro: deviation rad/s, peak Hz and its share of the variance", "", "x", "y", "z",
            rows=(
                (name, *(", ".join(map(number, axis)) for axis in zip(
                    gyro.deviation_rad_s, gyro.peak_hz, gyro.peak_share, strict=True)))
                for name, gyro in (seen | simulated).items() if gyro is not None
            ),
        )  # fmt: skip
    terminal.warn(*result.notes)
    for line in wrap(result.verdict_in_words, _WIDTH):
        terminal.out.print(line)


def _table(result: Result) -> Table:
    table = terminal.table(
        f"Simulated {result.robot} against readings, mean of the joints, mrad ({result.scored})",
        "actuator", "", "RMS (90 %)", "mean abs.", "upright", "robot was",
    )  # fmt: skip
    for name, model in result.models.items():
        for place, words in _PLACES:
            condition = getattr(model, place)
            if condition is None:
                continue
            error = condition.rmse_rad
            evidence = model.evidence.verdict if model.evidence and place == "ground" else ""
            table.add_row(
                name if place == "air" else "", words,
                f"{ms(error.value)} ({ms(error.low)}–{ms(error.high)})", ms(condition.mean.mae_rad),
                f"{condition.upright} of {condition.copies}" if place == "ground" else "", evidence,
            )  # fmt: skip
    means = {"persistence": result.persistence_rmse_rad, "repeatability": result.repeatability_rad}
    for name, by_joint in means.items():
        values = [x for x in by_joint.values() if x == x]
        table.add_row(name, "", ms(sum(values) / len(values)) if values else "–", "", "", "")
    return table
