"""What a gait needs of its servos, against what a servo has: speed, torque, dead time.

The policy walks on the servos it is given (by default those of its training), and the motion and
the torques of every servo are kept. The servo in question would make the same motion with its
inertia and friction, so at each instant it would need the torque

    need = force - back_emf * speed + (armature' - armature) * acceleration
           + (friction_loss' - friction_loss) * sign(speed)

with a prime on the numbers of that servo, whose motor has `effort_limit' - back_emf' * speed` left
in the direction of motion. A joint is *short* while it needs more than that (by 5 %), or turns
faster than the top speed. A policy that drives its servos into their limits is short on any servo,
so the share is compared with that of the servos that walked. Forces and speeds are those at the
ends of control steps, accelerations means over them: peaks of impacts between are not seen.

The dead time that a gait needs is the longest at which it still walks: the servos' own and more,
until fewer than 90 % of the robots that stay up otherwise do. Last, the policy walks on the servo
in question itself, P gain and all: a servo can be strong enough and still move otherwise than the
ones the policy knows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import Result, internal
from pupper_sysid.policies.analysis.gait import SETTLE_S
from pupper_sysid.policies.analysis.trial import Trial
from pupper_sysid.policies.walks.together import (
    Actor,
    Condition,
    Moment,
    StepRecorder,
    walk_together,
)
from pupper_sysid.servo_models.calibration.parts import NO_SPEED_LIMIT_RAD_S
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]

EXTRA_DEAD_TIMES_S = (0.0, 0.02, 0.04, 0.06, 0.08, 0.12, 0.16)
STILL_UP = 0.9
"""Share of the robots that stay up without more dead time, that must stay up with it."""
STILL_FAST = 0.8
"""Share of the speed on the servos of the walk that must be reached on the servo in question."""
MOST_SHORT = 0.05
"""Share of the time for which a servo may be short, beyond that of the servos that walked."""
_TOLERANCE, _MOST_USED = 1.05, 10.0


@dataclass(frozen=True)
class Spread(Result):
    """Sizes over time and robots."""

    median: float
    p95: float
    p99: float
    peak: float

    @classmethod
    def of(cls, values: Array) -> Spread:
        """Spread of the absolute values."""
        return cls(*np.quantile(np.abs(values), (0.5, 0.95, 0.99, 1.0)).tolist())


@dataclass(frozen=True)
class JointDemand(Result):
    """What one joint's servo must do."""

    speed_rad_s: Spread
    """Speed of the servo."""
    torque_nm: Spread
    """Torque that the servo in question would need."""
    top_speed_rad_s: float | None
    """Its speed without load; None where it is not limited."""
    stall_torque_nm: float
    """Its largest torque at standstill."""
    torque_at_top_nm: float
    """Its torque left at that speed, which a limit of the set-point can leave above 0."""
    torque_used: float
    """99 % quantile of needed torque over the torque left at that speed, at most 10; above 1 is too
    much."""
    rotor_nm: float
    """99 % quantile of the torque that accelerates its armature."""
    short: float
    """Share of the time in which it has less torque or speed than needed."""
    walked_short: float
    """The same share of the simulated servo that walked."""
    walked_nm: Spread
    """Torque of the simulated servo that walked."""

    @property
    def lacks(self) -> bool:
        """Whether it is short for longer than the servo that walked."""
        return self.short - self.walked_short > MOST_SHORT


@dataclass(frozen=True)
class ServoDemand(Result):
    """What a gait needs of its servos, against what a servo has."""

    servo: str
    """The servo in question."""
    walked_on: str
    """Servos of the walk."""
    robots: int
    """Robots that walked."""
    joints: Mapping[str, JointDemand]
    dead_time_s: float | None
    """Dead time of the servo in question; None where its source has none."""
    tolerated_dead_time_s: float
    """Longest dead time at which the gait still walks."""
    tolerated_at_least: bool
    """Whether that is the longest that was tried."""
    survival: float
    """Share of robots that stay up on the servos of the walk."""
    survival_on_it: float | None
    """Share that stays up on the servo in question; None if it cannot be simulated in these
    physics steps."""
    speed_m_s: float
    """Mean speed in the direction of the command on the servos of the walk."""
    speed_on_it_m_s: float | None
    """The same on the servo in question."""
    verdict: str
    """The result in a sentence or two."""
    samples: Mapping[str, tuple[Array, Array]] = internal()
    """Speed and needed torque in the direction of motion, by joint."""
    kinds: Mapping[str, tuple[str, ...]] = internal()
    """Joints by kind."""

    @property
    def walks_on_it(self) -> bool:
        """Whether the policy walks on the servo in question nearly as well as on its own."""
        if self.survival_on_it is None or self.speed_on_it_m_s is None:
            return False
        slow = self.speed_m_s > 0 and self.speed_on_it_m_s < STILL_FAST * self.speed_m_s
        return self.survival_on_it >= STILL_UP * self.survival and not slow

    @property
    def sufficient(self) -> bool:
        """Whether speed, torque and a known dead time are enough, and the policy walks on it."""
        late = self.dead_time_s is not None and self.dead_time_s > self.tolerated_dead_time_s
        return self.walks_on_it and not late and not any(j.lacks for j in self.joints.values())


def servo_demand(
    policy: Actor,
    trial: Trial,
    candidate: ServoRanges,
    dead_time_known: bool = True,
    extra_dead_times_s: Sequence[float] = EXTRA_DEAD_TIMES_S,
) -> ServoDemand:
    """Let a policy walk and compare what it needs with what a servo has.

    The candidate is the servo in question, for all joints of the trial's robot, and
    `dead_time_known` whether its dead time is a number rather than missing. The dead times added to
    those of the walk [s] begin with 0.
    """
    # a gait that drives strong servos into their limits would seem to need more than the servo has
    drawn = replace(trial.task.randomisation, torque_scale=(1.0, 1.0))
    trial = replace(trial, task=replace(trial.task, randomisation=drawn))
    conditions = [trial.condition(extra_dead_time_s=extra) for extra in extra_dead_times_s]
    walks = walk_together(
        policy, trial.servos, conditions, trial.seconds, trial.seed, trial.threads, _Recorder,
        trial.progress,
    )  # fmt: skip
    plain = walks[0]
    now = plain.steady(SETTLE_S)
    if not now.any():
        raise InputError(
            f"No robot walked for {SETTLE_S:g} s, so there is no gait to measure. Give a policy "
            "that walks on these servos."
        )
    numbers, body = candidate.value, trial.task.body
    speed, acceleration, force = plain.speed[now], plain.acceleration[now], plain.force[now]
    walked = {name: np.broadcast_to(x, plain.speed.shape)[now] for name, x in plain.servos.items()}
    direction = np.sign(speed)
    need = force - walked["back_emf"] * speed
    need += (numbers["armature"] - walked["armature"]) * acceleration
    need += (numbers["friction_loss"] - walked["friction_loss"]) * direction
    used, short = _load(need, speed, numbers)
    _, walked_short = _load(force - walked["back_emf"] * speed, speed, walked)
    top = _top_speed(numbers)
    at_top = numbers["effort_limit"] - numbers["back_emf"] * np.minimum(top, NO_SPEED_LIMIT_RAD_S)
    joints = {
        name: JointDemand(
            speed_rad_s=Spread.of(speed[:, i]), torque_nm=Spread.of(need[:, i]),
            top_speed_rad_s=None if top[i] >= NO_SPEED_LIMIT_RAD_S else float(top[i]),
            stall_torque_nm=float(numbers["effort_limit"][i]), torque_at_top_nm=float(at_top[i]),
            torque_used=float(np.quantile(used[:, i], 0.99)),
            rotor_nm=float(np.quantile(np.abs(numbers["armature"][i] * acceleration[:, i]), 0.99)),
            short=float(short[:, i].mean()), walked_short=float(walked_short[:, i].mean()),
            walked_nm=Spread.of(force[:, i]),
        )
        for i, name in enumerate(body.joints)
    }  # fmt: skip
    survived = [walk.survival for walk in walks]
    enough = [s >= STILL_UP * survived[0] for s in survived]
    last = enough.index(False) - 1 if False in enough else len(enough) - 1
    try:
        (on_it,) = walk_together(
            policy, candidate, [trial.condition()], trial.seconds, trial.seed, trial.threads,
            _Recorder,
        )  # fmt: skip
    except InputError:  # too stiff for the task's physics steps
        on_it = None
    demand = ServoDemand(
        servo=candidate.source,
        walked_on=trial.servos.source,
        robots=int(now.any(axis=0).sum()),
        joints=joints,
        dead_time_s=float(numbers["dead_time_s"].mean()) if dead_time_known else None,
        tolerated_dead_time_s=float(trial.servos.value["dead_time_s"].mean())
        + extra_dead_times_s[last],
        tolerated_at_least=last == len(enough) - 1,
        survival=survived[0],
        survival_on_it=on_it.survival if on_it else None,
        speed_m_s=plain.mean_speed(now),
        speed_on_it_m_s=on_it.mean_speed(on_it.steady(SETTLE_S)) if on_it else None,
        verdict="",
        samples={
            name: (np.abs(speed[:, i]), need[:, i] * direction[:, i])
            for i, name in enumerate(body.joints)
        },
        kinds={kind: tuple(body.joints[i] for i in at) for kind, at in body.kinds.items()},
    )
    return replace(demand, verdict=_verdict(demand))


def _load(need: Array, speed: Array, servo: Mapping[str, Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Needed torque over what a servo has left, and where that is too little or too slow."""
    spare = servo["effort_limit"] - servo["back_emf"] * speed * np.sign(need)
    used = np.minimum(np.abs(need) / np.maximum(spare, 1e-9), _MOST_USED)
    return used, (used > _TOLERANCE) | (np.abs(speed) > _TOLERANCE * _top_speed(servo))


def _top_speed(servo: Mapping[str, Array]) -> Array:
    """Speeds without load of all servos [rad/s]."""
    spare = np.maximum(servo["effort_limit"] - servo["friction_loss"], 0.0)
    free = np.where(servo["back_emf"] > 0, spare / np.maximum(servo["back_emf"], 1e-12), np.inf)
    return np.minimum(free, servo["velocity_limit"])


def _verdict(demand: ServoDemand) -> str:
    servo, joints = demand.servo.rpartition("/")[2], demand.joints
    at_least = "at least " if demand.tolerated_at_least else ""
    bound = f"{at_least}{1e3 * demand.tolerated_dead_time_s:.0f} ms with which the gait walks"
    if demand.dead_time_s is None:
        about = f"its source has no dead time, to hold against the {bound}"
    else:
        how = "more than" if demand.dead_time_s > demand.tolerated_dead_time_s else "within"
        about = f"its dead time of {1e3 * demand.dead_time_s:.0f} ms is {how} the {bound}"
    if demand.survival_on_it is None or demand.speed_on_it_m_s is None:
        walk = "it is too stiff to be simulated in the task's physics steps"
    else:
        walk = (
            f"in the simulator {100 * demand.survival_on_it:.0f} % of the robots stay up on it and "
            f"walk at {demand.speed_on_it_m_s:.2f} m/s, against "
            f"{100 * demand.survival:.0f} % and {demand.speed_m_s:.2f} on "
            f"{demand.walked_on.rpartition('/')[2]}"
        )
    lacking = [name for name, joint in joints.items() if joint.lacks]
    if lacking:
        worst = max(lacking, key=lambda name: joints[name].short)
        worst_joint = joints[worst]
        why = f"{servo} is short of torque or speed in {len(lacking)} of {len(joints)} joints, "
        why += f"most in {worst}, {100 * worst_joint.short:.0f} % of the time"
        if worst_joint.rotor_nm > 0.5 * worst_joint.torque_nm.p99:
            of_all = f"{worst_joint.rotor_nm:.2g} of {worst_joint.torque_nm.p99:.2g} N·m"
            why += f" (its own armature takes {of_all})"
    else:
        most = max(joints, key=lambda name: joints[name].torque_used)
        why = f"{servo} is as strong and fast as the gait needs: at most "
        why += f"{100 * joints[most].torque_used:.0f} % of its torque ({most})"
    return f"{'Yes' if demand.sufficient else 'No'}: {why}; {about}; {walk}."


@dataclass(frozen=True)
class _Kept:
    """Servo motion and forces of the robots of a condition; shape (steps, n, joints)."""

    step_s: float
    force: Array
    speed: Array
    acceleration: Array
    along: Array
    """Speed of the trunk in the direction of the command [m/s], shape (steps, n)."""
    alive: NDArray[np.bool_]
    survival: float
    servos: dict[str, Array]
    """Of each robot, by field of `DelayedPDParameters`; shape (n, joints)."""

    def mean_speed(self, now: NDArray[np.bool_]) -> float:
        """Mean of `along` over some steps; 0 if there are none."""
        return float(self.along[now].mean()) if now.any() else 0.0

    def steady(self, after_s: float) -> NDArray[np.bool_]:
        """Steps of robots that are up, some seconds after the start; shape (steps, n)."""
        counts = self.alive.copy()
        counts[: round(after_s / self.step_s)] = False
        return counts


class _Recorder(StepRecorder):
    """Keeps `_Kept` of one environment."""

    def __init__(self, env: PupperEnv, policy: Actor | None, conditions: Sequence[Condition]):
        super().__init__(env, policy, conditions)
        self._servos = {name: x.copy() for name, x in env.robots.drawn.items()}

    def arrays(self, now: Moment) -> dict[str, NDArray]:
        to_servo, facts = self.env.robots.to_servo, now.facts
        command = now.command[:, :2]
        size = np.linalg.norm(command, axis=1)
        along = (facts.planar_velocity[:, :2] * command).sum(axis=1) / np.maximum(size, 1e-9)
        return {
            "force": facts.torque.copy(), "speed": to_servo(facts.velocity).copy(),
            "acceleration": to_servo(facts.acceleration).copy(), "along": along,
            "alive": now.alive.copy(),
        }  # fmt: skip

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> _Kept:
        return _Kept(
            condition.task.control_step_s, **self.stacked(robots, steps),
            survival=1.0 - float(self.fell[robots].mean()),
            servos={n: x[robots] for n, x in self._servos.items()},
        )  # fmt: skip
