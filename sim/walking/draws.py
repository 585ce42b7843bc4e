"""What is drawn for each robot and episode: differences from the model, command, start, and twins.

`Differences` are the settings of what differs between a robot and its model: each is a named range,
0 (or a factor of 1) is off. `TYPICAL` holds the values that this robot's parts give reason for,
with their sources. What concerns the body and its servos is drawn here and written by
`sim.robot.robot_batch`; the IMU is `sim.walking.senses`.

Twins are one robot under several conditions. They have the same servos, friction, start, noise and
feedback faults, so that they differ in their conditions only (a command, a dead time, a push),
until one of them falls. Numbers are drawn for each different robot once and handed to all of its
twins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.trot import Trot

if TYPE_CHECKING:
    from pupper_sysid.sim.walking.config import Commands, Randomisation

Array = NDArray[np.float64]

_OF_VOLTAGE = ("stiffness", "effort_limit", "velocity_limit")
OF_MOTOR = ("stiffness", "damping", "effort_limit")
"""What a weak motor has less of."""
OF_UNIT = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit")
"""Numbers of a servo in which units of one type differ."""


def check_range(part: str, name: str, ends: tuple[float, float], least: float = -np.inf) -> None:
    """Refuse a range of a setting that cannot be drawn from."""
    low, high = ends
    if not (least <= low <= high and np.isfinite(high - low)):
        above = f" from {least:g} on" if np.isfinite(least) else ""
        raise InputError(
            f"{part}.{name} is {low:g} to {high:g}; give the lower end, then the upper one{above}."
        )


@dataclass(frozen=True)
class Differences:
    """Ranges of what differs from the model; the default is nothing.

    Servos' own numbers vary within the calibration's intervals in any case.
    """

    servo_spread: float = 0.0
    """Largest share by which each of a joint's numbers (`OF_UNIT`) differs from the calibration's:
    between units of one type, beyond what the calibration leaves open of its own."""
    joint_zero_rad: float = 0.0
    """Largest error of a servo's zero, the same in commands and readings."""
    command_jitter: tuple[float, float] = (1.0, 1.0)
    """Factor on the calibration's jitter of the commands' latency."""
    poll_period: tuple[float, float] = (1.0, 1.0)
    """Factor on the period in which a robot's servos are read."""
    imu_mounting_rad: float = 0.0
    """Largest angle, about each axis, by which the IMU is mounted askew."""
    gyro_bias_rad_s: float = 0.0
    """Largest constant error of each measured rate."""
    imu_latency_s: tuple[float, float] = (0.0, 0.0)
    """Age of the IMU's newest sample."""
    imu_period_s: tuple[float, float] = (0.0, 0.0)
    """Time between two samples of the IMU; 0 for a sample whenever one is wanted."""
    centre_of_mass_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Largest shift of the trunk's centre of mass along its axes."""
    battery: tuple[float, float] = (1.0, 1.0)
    """Factor on the servos' voltage: stiffness, effort limit and speed limit change together."""
    weak_leg_share: float = 0.0
    """Share of robots with one weak leg."""
    weak_leg: tuple[float, float] = (1.0, 1.0)
    """Factor on the torques of a weak leg's motors; their friction stays."""
    missed_ticks: float = 0.0
    """Chance that a control tick is missed: the set-points stay for one more."""
    without_effort: float = 0.0
    """Share of robots whose effort readings are 0, as on a bus that gives none."""
    as_calibrated: float = 0.0
    """Share of robots with none of these in body, servos and ticks."""

    def __post_init__(self):
        for name in ("servo_spread", "joint_zero_rad", "imu_mounting_rad", "gyro_bias_rad_s"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"differences.{name} must be from 0 to below 1.")
        for name in ("weak_leg_share", "missed_ticks", "without_effort", "as_calibrated"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"differences.{name} is a share: from 0 to 1.")
        for name, least in (
            ("command_jitter", 0.0), ("poll_period", 0.1), ("imu_latency_s", 0.0),
            ("imu_period_s", 0.0), ("battery", 0.1), ("weak_leg", 0.0),
        ):  # fmt: skip
            check_range("differences", name, getattr(self, name), least)

    @property
    def imu_late(self) -> bool:
        """Whether samples of the IMU are ever older than the observation."""
        return max(*self.imu_latency_s, *self.imu_period_s) > 0

    @property
    def imu_askew(self) -> bool:
        """Whether the IMU is ever mounted askew, or biased."""
        return max(self.imu_mounting_rad, self.gyro_bias_rad_s) > 0


TYPICAL = Differences(
    # servos of one type, bought together
    servo_spread=0.1,
    # a tenth of the angle between two teeth of a horn (25 teeth); recordings show 6 mrad
    joint_zero_rad=0.025,
    # other hosts are busier, or idle
    command_jitter=(0.5, 1.5),
    # one firmware tick more or less for each servo of a round of twelve at 2 ms
    poll_period=(0.9, 1.2),
    # two degrees: a board on stand-offs
    imu_mounting_rad=0.035,
    # what averaging over 200 samples at rest leaves, and its drift with temperature
    gyro_bias_rad_s=0.02,
    # firmware loop of 10 ms, read and answer over the serial line
    imu_latency_s=(0.002, 0.02),
    imu_period_s=(0.004, 0.01),  # output data rate of 235 Hz; 100 Hz through the firmware's loop
    # battery and computer can be placed otherwise; their places are not in the published model
    centre_of_mass_m=(0.008, 0.004, 0.006),
    # two lithium cells: 8.4 V full, 6.4 V empty, 7.4 V in the calibration
    battery=(0.86, 1.1),
    weak_leg_share=0.15,
    weak_leg=(0.6, 1.0),
    # a loop of 20 ms on a computer without a real-time kernel
    missed_ticks=0.01,
    # the loads of the bus are not torques, and some servos give none
    without_effort=0.3,
)
"""What this robot's parts give reason for."""


class Bodies:
    """What was drawn for the bodies of n robots.

    `zero_rad`, shape (n, 12), is the true servo angle where a servo reports 0; `centre_m`, shape
    (n, 3), the shift of the trunk's centre of mass; `jitter` and `poll`, shape (n,), factors on the
    commands' jitter and on the period of the readings; `effort` 1 with effort readings, 0 without.
    The mask `as_calibrated` has the robots without differences.
    """

    def __init__(self, settings: Differences, robots: int, body: Body):
        self._settings, self._body = settings, body
        self.zero_rad = np.zeros((robots, len(body.joints)))
        self.centre_m = np.zeros((robots, 3))
        self.jitter, self.poll, self.effort = np.ones(robots), np.ones(robots), np.ones(robots)
        self.as_calibrated = np.zeros(robots, bool)

    @property
    def state(self) -> dict[str, Any]:
        """Everything that changes, live."""
        return {
            "zero_rad": self.zero_rad, "centre_m": self.centre_m, "jitter": self.jitter,
            "poll": self.poll, "effort": self.effort, "as_calibrated": self.as_calibrated,
        }  # fmt: skip

    def draw(
        self, ids: NDArray[np.intp], servos: dict[str, Array], rng: np.random.Generator
    ) -> None:
        """Draw the bodies of some robots; nothing is drawn for what is off.

        `servos` are theirs, by field of `DelayedPDParameters`, shape (len(ids), 12); they are
        weakened in place.
        """
        settings, n = self._settings, len(ids)
        differ = np.ones(n, bool)
        if settings.as_calibrated:
            differ = rng.random(n) >= settings.as_calibrated
            self.as_calibrated[ids] = ~differ
        if settings.servo_spread:
            spread = settings.servo_spread
            for name in OF_UNIT:
                share = rng.uniform(-spread, spread, servos[name].shape)
                servos[name] *= 1.0 + share * differ[:, None]
        if settings.joint_zero_rad:
            most = settings.joint_zero_rad
            error = rng.uniform(-most, most, (n, len(self._body.joints)))
            self.zero_rad[ids] = error * differ[:, None]
        if any(settings.centre_of_mass_m):
            shift = rng.uniform(-1, 1, (n, 3)) * settings.centre_of_mass_m
            self.centre_m[ids] = shift * differ[:, None]
        for name, values in (("command_jitter", self.jitter), ("poll_period", self.poll)):
            ends = getattr(settings, name)
            if ends != (1.0, 1.0):
                values[ids] = np.where(differ, rng.uniform(ends[0], ends[1], n), 1.0)
        if settings.without_effort:
            self.effort[ids] = (rng.random(n) >= settings.without_effort) | ~differ
        if settings.battery != (1.0, 1.0):
            voltage = np.where(differ[:, None], rng.uniform(*settings.battery, (n, 1)), 1.0)
            for name in _OF_VOLTAGE:
                servos[name] *= voltage
        if settings.weak_leg_share and settings.weak_leg != (1.0, 1.0):
            weak = differ & (rng.random(n) < settings.weak_leg_share)
            leg = rng.integers(0, len(self._body.feet), n)
            factor = rng.uniform(*settings.weak_leg, n)
            strength = np.ones((n, len(self._body.feet) + 1))  # the last of joints of no leg
            strength[weak, leg[weak]] = factor[weak]
            for name in OF_MOTOR:
                servos[name] *= strength[:, self._body.leg_of]


def draw_commands(commands: Commands, count: int, share: float, rng: np.random.Generator) -> Array:
    """Commanded motions [m/s, m/s, rad/s], shape (count, 3), from a `share` of the ranges."""
    low, high = command_ends(commands)
    motions = rng.uniform(low, high, (count, 3)) * share
    alone = rng.random(count) < commands.single
    motions[alone] *= np.eye(3)[rng.integers(0, 3, count)][alone]
    motions[rng.random(count) < commands.standing] = 0.0
    return at_rest(commands, motions)


def command_ends(commands: Commands) -> Array:
    """Lowest and highest of forward and sideways speed and of the turn rate, shape (2, 3)."""
    return np.array([commands.forward_m_s, commands.sideways_m_s, commands.yaw_rad_s]).T


def at_rest(commands: Commands, command: Array) -> Array:
    """Commands (n, 3) with those within the dead band as 0: stand."""
    speed, turn = commands.dead_band
    small = np.linalg.norm(command[:, :2], axis=1) < speed
    small &= np.abs(command[:, 2]) < turn
    return np.where(small[:, None], 0.0, command)


def draw_pose(
    random: Randomisation, body: Body, trot: Trot, command: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Joint angles [rad] and velocities [rad/s] at the start, (n, joints), of commands (n, 3)."""
    n, joints = len(command), len(body.joints)
    start = body.pose + rng.uniform(-random.joint_rad, random.joint_rad, (n, joints))
    speed = rng.uniform(-random.joint_rad_s, random.joint_rad_s, (n, joints))
    trotting = rng.random(n) < random.on_the_move
    phase = rng.uniform(0.0, 2 * np.pi, n)
    if trotting.any():
        start[trotting] = trot.joints(phase, command, body)[trotting]
    return np.clip(start, body.low, body.high), speed * ~trotting[:, None]


@dataclass(frozen=True)
class Twins:
    """Which robots of an environment are the same one."""

    number: NDArray[np.intp]
    """Of each robot, shape (n,), from 0 on; twins have the same."""
    count: int
    """Different robots. Environments of one seed and count agree on the robot of a number."""


def generator(seed: int | list[int], twins: Twins | None = None) -> np.random.Generator:
    """Generator of a seed; with twins, one whose draws for all n robots are theirs.

    A draw is for all robots if the first axis of its size is n; others are plain ones of a
    separate generator.
    """
    plain = np.random.default_rng(seed)
    return plain if twins is None else cast(np.random.Generator, _SharedDraws(plain, twins))


class _SharedDraws:
    """The methods of a generator that the environment uses."""

    def __init__(self, rng: np.random.Generator, twins: Twins):
        self._rng, self._twins = rng, twins
        self._other = rng.spawn(1)[0]
        self.bit_generator = rng.bit_generator

    def uniform(self, low: Any, high: Any, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.uniform(low, high, size), size)

    def random(self, size: Any, dtype: Any = np.float64) -> Any:
        return self._drawn(lambda rng, size: rng.random(size, dtype), size)

    def integers(self, low: int, high: int, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.integers(low, high, size), size)

    def exponential(self, scale: float, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.exponential(scale, size), size)

    def standard_normal(self, size: Any) -> Any:
        return self._drawn(lambda rng, size: rng.standard_normal(size), size)

    def _drawn(self, draw: Callable[[np.random.Generator, tuple[int, ...]], Any], size: Any) -> Any:
        first, *rest = np.atleast_1d(size).tolist()
        if first != len(self._twins.number):
            return draw(self._other, (first, *rest))
        return draw(self._rng, (self._twins.count, *rest))[self._twins.number]
