"""Assembly of a controller from policy, stack and observer, with checks; emulated walks.

The observer is compared with the training's actuator, and the servos with the training's. While the
robot walks, `FrozenReadings` compares readings with a model of the servo.

`walk_once` walks an emulated robot in virtual time, through guard, bus and log as on a robot. Its
servos are drawn as `sim.emulator.robot` draws them, and its true motion is known: `WalkScore`
compares it with the commands.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError, SafetyStop
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.policies.deploy.controller import Controller
from pupper_sysid.policies.deploy.deployment import Outcome, Rows, Tick, constant, deploy
from pupper_sysid.policies.deploy.matches import Match, ServoMatch, compare, servo_match
from pupper_sysid.policies.deploy.stacks import Observer, Stack, SyntheticPD, make_observer
from pupper_sysid.policies.network.policy_file import Policy, trained_servo
from pupper_sysid.policies.walks.rollouts import ERRORS, named, tracking_errors
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.servo_file import WEIGHTS
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.robot import WalkingBus, WalkingRobot, body_joint_map
from pupper_sysid.sim.walking.servo_ranges import (
    ServoRanges,
    is_servo_model,
    servo_model_of,
    servo_ranges,
)


@dataclass(frozen=True)
class Assembly:
    """A controller, with the comparison of its observer and the header of its log."""

    controller: Controller
    frozen_readings: FrozenReadings
    """To be a watcher of the walk."""
    match: Match
    """The observer on this robot compared with the actuator the policy was trained with."""
    servo_match: ServoMatch | None
    """The robot's servos compared with those of the training; None if either is not known."""
    header: dict[str, Any]
    """Everything that `reassemble` needs."""


def assemble(
    policy: Policy,
    stack: Stack,
    joint_map: JointMap,
    actuator: str,
    servo: Path | None,
    trained: str | None = None,
    body: Body | None = None,
) -> Assembly:
    """Make a controller.

    `joint_map` is that of the bus, in joint coordinates; `actuator` the calibration or preset of
    the robot, for a simulated PD; `servo` the folder of a learned servo model; `trained` the
    calibration or preset of the training, if it is another. The robot is the Mini Pupper 2 by
    default.
    """
    contract = policy.contract
    period = stack.period_s(contract)
    servos = servo_ranges(actuator, body=body)
    pose = contract.default_pose_rad
    parameters = DelayedPDParameters(**servos.value)
    limits = joint_map.per_servo().position_limits()
    ends = limits.low_rad, limits.high_rad
    model = None
    if stack.observer == "servo-model" and servo is not None:
        if not servo.is_dir():
            raise InputError(f"`servo` is {servo}: there is no such folder.")
        model = servo_model_of(servo, period)
    observer = make_observer(
        stack.observer, period, contract.velocity_steps, parameters, ends, model, len(pose)
    )
    of_training = parameters
    if trained is not None and trained != actuator:
        of_training = DelayedPDParameters(**servo_ranges(trained, body=body).value)
    match = compare(observer, of_training, period, parameters, pose)
    stall = float(np.median(servos.value["effort_limit"]))  # torque at full duty
    stall = stall if np.isfinite(stall) else 0.0
    controller = Controller(policy, stack, observer, joint_map, stall)
    moving = SyntheticPD(parameters, period, limits_rad=ends, joints=len(pose))
    frozen = FrozenReadings(moving, controller.to_servo, controller.joints)
    header = {
        "policy_sha256": contract.weights_sha256, "stack": asdict(stack),
        "joint_map": joint_map.file.name, "actuator": actuator,
        "actuator_sha256": sha256(Path(actuator)) if Path(actuator).is_file() else None,
        "servo": str(servo) if model else None,
        "servo_sha256": sha256(servo / WEIGHTS) if servo and model else None,
    }  # fmt: skip
    return Assembly(controller, frozen, match, _servo_match(policy, servos, trained), header)


def reassemble(
    policy: Policy, header: dict[str, Any], log: Path, body: Body | None = None
) -> Controller:
    """The controller of a log, from its header; `body` is another robot than the Mini Pupper 2."""
    try:
        if header["policy_sha256"] != policy.contract.weights_sha256:
            raise InputError(f"{log} was made with another policy. Give that one.")
        stack = Stack(**header["stack"])
        joint_map = None if body is None else body_joint_map(body)
        if joint_map is None or header["joint_map"] != joint_map.file.name:
            joint_map = load_joint_map(header["joint_map"])
        servo = Path(header["servo"]) if header["servo"] else None
        assembled = assemble(policy, stack, joint_map, header["actuator"], servo, body=body)
        hashes = ("actuator_sha256", "servo_sha256")
        changed = [key for key in hashes if header[key] != assembled.header[key]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{log}: its header is damaged: {error}.") from error
    if changed:
        file = header[changed[0].removesuffix("_sha256")]
        raise InputError(f"{log} was made with another file at {file}. Restore that file.")
    return assembled.controller


def _servo_match(policy: Policy, servos: ServoRanges, trained: str | None) -> ServoMatch | None:
    """Compare with the servos in the policy's file, or with the calibration of an older one."""
    if is_servo_model(servos.source):
        return None
    trained_servos, feedback = policy.contract.servo, policy.contract.feedback
    if trained_servos is None and trained is not None:
        known = feedback if feedback in ("held", "ideal") else "held"
        trained_servos = trained_servo(trained, known, Walking(), servo_ranges(trained, known))
    return None if trained_servos is None else servo_match(trained_servos, servos)


Array = NDArray[np.float64]

WINDOW_S = 2.0
"""Longer than any run of lost polls, and than most rests of a live reading."""
_LATE_S = 0.3  # motion that a reading may not show yet: dead time, servo lag, age
_MOVED_RAD = 0.03  # five quantisation steps of the robot's proxy; the models' error in free run
_SAME_RAD = 1e-6
_FOLLOWS_SHARE = GuardLimits().follows_share  # of the model's motion; less is noise about one place
_CHECK_EVERY_TICKS = 5


class FrozenReadings:
    """Watcher of a walk: stops it if a reading stays the same while its servo must have moved.

    The guard stops a robot if a command moved by 0.1 rad and the reading did not change
    (`hardware.safety.monitor`). A hip is commanded less than that in most walks. Less is no
    evidence by itself: dry friction holds a servo, and servos under load stood still for seconds
    against commands that moved by 0.05 rad. So the commands are passed through a model of the
    servo, friction included: where the model moves and the reading does not, the reading is frozen,
    or the servo is. Where the model does not move either, nothing can be found, and the motion is
    too small to matter.

    `servos` is a model of them in free run at the loop's period, in servo coordinates, to which
    `to_servo` converts joint angles [rad].
    """

    def __init__(
        self,
        servos: Observer,
        to_servo: Callable[[Array], Array],
        joints: Sequence[str] = JOINT_NAMES,
    ):
        self._joints = joints
        self._servos, self._to_servo = servos, to_servo
        ticks = round(WINDOW_S / servos.period_s)
        self._moved: deque[Array] = deque(maxlen=ticks)
        self._read: deque[Array] = deque(maxlen=ticks)
        self._late = max(round(_LATE_S / servos.period_s), 1)
        self._ticks = 0

    def __call__(self, tick: Tick) -> None:
        """Take a tick.

        A `SafetyStop` is raised where a reading has not changed, but for noise, in the last two
        seconds, in which the model moved.
        """
        sent = self._to_servo(tick.sent)
        if not self._ticks:  # after standing still: at rest where it was commanded to be
            self._servos.reset(sent)
        self._ticks += 1
        self._read.append(self._to_servo(tick.reading.position_rad))
        self._moved.append(self._servos.step(sent, self._read[-1]).position)
        if len(self._read) != self._read.maxlen or self._ticks % _CHECK_EVERY_TICKS:
            return
        moved = np.ptp(np.array(self._moved)[: -self._late], axis=0)
        read = np.array(self._read)
        # the guard stops the robot for a joint without readings
        spread = np.nanmax(read, axis=0, initial=-np.inf) - np.nanmin(read, axis=0, initial=np.inf)
        noise = np.maximum(_FOLLOWS_SHARE * moved, _SAME_RAD)
        frozen = (moved > _MOVED_RAD) & (spread >= 0) & (spread < noise)
        if frozen.any():
            k = int(np.argmax(frozen))
            same = "the same position"
            if spread[k] >= _SAME_RAD:
                same = f"positions within {spread[k]:.3f} rad"
            raise SafetyStop(
                f"{self._joints[k]} has reported {same} for {WINDOW_S:g} s, in which a "
                f"servo under its commands moves by {moved[k]:.2f} rad. It is blocked, without "
                "power, or has stopped answering; switch the servos' power off and on."
            )


class WalkScore:
    """Tracking errors of an emulated robot; a watcher of `policies.deploy.deployment.deploy`.

    Times are those of `bus`.
    """

    def __init__(self, bus: ServoBus, robot: WalkingRobot):
        self._bus, self._robot = bus, robot
        self._moved: list[np.ndarray] = []
        self._commands: list[np.ndarray] = []

    def __call__(self, tick: Tick) -> None:
        """Record the robot's true motion at a tick."""
        trunk = self._robot.trunk(self._bus.now())
        self._moved.append(np.array([*trunk.velocity_m_s[:2], trunk.yaw_rate_rad_s]))
        self._commands.append(tick.senses.command)

    def summary(self) -> dict[str, Any]:
        """Mean absolute errors and `mean_motion` up to the last tick; None before the first."""
        if not self._moved:
            return dict.fromkeys((*ERRORS, "mean_motion"))
        moved, commands = (np.array(x)[:, None] for x in (self._moved, self._commands))
        up, fell = np.ones((len(moved), 1), bool), np.zeros(1, bool)
        errors = tracking_errors(moved, commands, up, fell)[0]
        return {**named(errors), "mean_motion": (moved[:, 0].sum(axis=0) / len(moved)).tolist()}


def walk_once(
    policy: Policy,
    stack: Stack,
    command: tuple[float, float, float],
    seconds: float,
    seed: int,
    actuator: str,
    servo: Path | None = None,
    rows: Rows | None = None,
    noise: int = 0,
) -> tuple[Outcome, WalkScore]:
    """One walk of one emulated robot; its log is discarded.

    The command is forward and sideways speed [m/s] and turn rate [rad/s]; `seed` is that of the
    robot, `noise` of all else: lost polls, noise, timing. `actuator` and `servo` are as for
    `policies.deploy.assembly.assemble`; `rows` takes the servos' rows, as of a recording.
    """
    truth = draw_robot(np.random.default_rng(seed))
    joint_map = load_joint_map("mini_pupper_2")
    inner = WalkingBus(truth, np.random.default_rng([seed, noise]))
    with closing(GuardedBus(inner)) as bus, tempfile.TemporaryDirectory() as folder:
        assembled = assemble(policy, stack, joint_map, actuator, servo)
        score = WalkScore(bus, inner.robot)
        outcome = deploy(
            bus, inner, assembled.controller, constant(command), seconds,
            Path(folder) / "walk.csv", assembled.header, rows, [score, assembled.frozen_readings],
        )  # fmt: skip
    return outcome, score
