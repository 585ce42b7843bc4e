"""Twelve emulated servos, in free air or in a walking robot, as registers and datagrams show them.

A `ServoPlant` gives the truth; `EmulatedBus` and `ServoBench` make of it what a host reads. Servos
are counted in the order of `JOINT_NAMES`, their angles are in servo coordinates
(`hardware.joint_map`): a calf's servo angle is that with its thigh at neutral.

The emulators of all protocols use the same servos as `EmulatedBus`, with the same truth. A bench
adds the encoder's counts, the duty, the supply, and a hand that moves limp joints (`move_by_hand`),
so that a calibration of the joints can be rehearsed without a robot. `BusFaults` are faults of real
buses, injected at chosen rates, repeatably.

Polls are those of the robot's firmware (`servo_models.held_feedback`): its servo task polls one
servo after the other: servo `i` of `n` a share `i / n` of a round after the first. The length of a
round wanders slowly, each poll has its own small jitter, and each fails with the same probability,
silently.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import RLock
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.hardware.imu import GRAVITY_M_S2, ImuSample
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.robot import EmulatedRobot
from pupper_sysid.sim.robot.servo_mjcf import (
    for_commands_between_steps,
    free_air_xml,
    rest_at,
    switch_torque,
)

_CHUNK = 256
_DRIFT_MEMORY_S = 5.0  # recordings of 3 s see different mean periods, so it wanders over seconds
_WARM_UP_ROUNDS = 64


def held_over(
    since: float, stop: float, goal: float, queue: deque[tuple[float, float]]
) -> tuple[float, float]:
    """Integral of a held command over a time, and the command at its end.

    `queue` has the times of the commands to come; those before `stop` are taken off it.
    """
    integral = 0.0
    while queue and queue[0][0] < stop:
        at, following = queue.popleft()
        at = max(at, since)
        integral += goal * (at - since)
        since, goal = at, following
    return integral + goal * (stop - since), goal


class PollSchedule:
    """Poll instants of all servos, drawn as time goes on.

    A round has the mean length `period_s`, which wanders by the relative standard deviation
    `drift`; `phase_s`, shape (servos,), is a poll instant of each servo at time 0. A poll fails
    with the probability `loss`, and comes early or late with the standard deviation `jitter_s`.
    """

    def __init__(
        self,
        period_s: float,
        phase_s: NDArray[np.float64],
        loss: float,
        jitter_s: float,
        drift: float,
        rng: np.random.Generator,
    ):
        self._period, self._phase = period_s, np.asarray(phase_s, float)
        self._loss, self._jitter, self._drift, self._rng = loss, jitter_s, drift, rng
        servos = len(self._phase)
        self._servo = np.arange(servos)
        self._round = np.zeros(servos, int)
        self._next_start = -_WARM_UP_ROUNDS * period_s  # the first readings precede the first read
        self._wander = drift * rng.standard_normal()
        self._instants = np.empty((0, servos))
        self._succeeded = np.empty((0, servos), bool)
        self.latest_s = np.full(servos, -np.inf)
        """Last successful poll of each servo [s]; -inf before the first."""

    def advance(self, time_s: float) -> NDArray[np.float64]:
        """Last successful poll of each servo up to `time_s` [s]; time must not go backwards."""
        while True:
            if self._round.max() >= len(self._instants):
                self._draw()
            instants = self._instants[self._round, self._servo]
            due = instants <= time_s
            if not due.any():
                return self.latest_s
            success = due & self._succeeded[self._round, self._servo]
            self.latest_s = np.where(success, instants, self.latest_s)
            self._round += due

    def _draw(self) -> None:
        """Append a chunk of rounds, and drop those that lie behind every servo."""
        memory = np.exp(-self._period / _DRIFT_MEMORY_S)
        kicks = self._drift * np.sqrt(1 - memory**2) * self._rng.standard_normal(_CHUNK)
        starts = np.empty(_CHUNK)
        for i, kick in enumerate(kicks):
            starts[i] = self._next_start
            self._next_start += self._period * (1 + self._wander)
            self._wander = memory * self._wander + kick
        shape = (_CHUNK, len(self._servo))
        # half a round is far beyond any jitter meant here, and keeps the polls in order
        bound = 0.49 * self._period
        jitter = np.clip(self._jitter * self._rng.standard_normal(shape), -bound, bound)
        done = int(self._round.min())
        instants = starts[:, None] + self._phase + jitter
        self._instants = np.concatenate([self._instants[done:], instants])
        succeeded = self._rng.random(shape) >= self._loss
        self._succeeded = np.concatenate([self._succeeded[done:], succeeded])
        self._round -= done


class ServoPlant(Protocol):
    """Twelve servos and an IMU. Time starts at 0, in the default pose with the torque on.

    Time advances only to the instant of a call. That may be a little before the instant of the last
    call, since servos are not polled at the same time; commands come in order.
    """

    def command(self, index: int, time_s: float, angle_rad: float) -> None:
        """Command one servo from `time_s` on; a limp one ignores it."""
        ...

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        ...

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad]."""
        ...

    def load(self, index: int) -> float:
        """Signed share of a servo's effort limit in use at the time of the last `angle` call."""
        ...

    def imu(self, time_s: float) -> ImuSample | None:
        """Latest sample of the IMU; None if it gives none."""
        ...


class ServosOnStand:
    """A `ServoPlant` whose trunk is level and at rest: each servo moves alone."""

    def __init__(self, servos: Sequence[Any]):
        self._servos = servos

    def command(self, index: int, time_s: float, angle_rad: float) -> None:
        """Command one servo from `time_s` on; a limp one ignores it."""
        self._servos[index].command(time_s, angle_rad)

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        self._servos[index].torque(time_s, on)

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad]."""
        return self._servos[index].position_at(time_s)

    def load(self, index: int) -> float:
        """Signed share of a servo's effort limit in use at the time of the last `angle` call."""
        return self._servos[index].load

    def imu(self, time_s: float) -> ImuSample:
        """Gravity alone."""
        return ImuSample(time_s, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2]), False)


class FreeAirServos(ServosOnStand):
    """A `ServoPlant` on a stand, legs in free air."""

    def __init__(self, robot: EmulatedRobot):
        pose = robot.joint_map.rest_pose().tolist()
        super().__init__(
            [FreeAirServo(s.actuator, x) for s, x in zip(robot.servos, pose, strict=True)]
        )


AMBIENT_C, SUPPLY_V = 27.0, 7.4


class ServoBench:
    """The servos of a robot, by joint.

    Counts are those of `joint_map`, in servo coordinates, which must have all joints of the robot.
    With `keep_log` commands and readings are remembered: for tests, not for runs of days. What
    moves is the `plant`, by default the robot's servos in free air.

    `commands` are all commands: time [s], servo index, count. `hand_rad`, shape (joints,), is how
    far each limp servo was moved by hand (`move_by_hand`) [rad].
    """

    def __init__(
        self,
        robot: EmulatedRobot,
        joint_map: JointMap,
        rng: np.random.Generator,
        keep_log: bool = True,
        plant: ServoPlant | None = None,
    ):
        self.robot, self.map = robot, joint_map.select(robot.joint_names).per_servo()
        self._rng = rng
        self.plant = plant or FreeAirServos(robot)
        self._offset = np.array([s.feedback.offset_rad for s in robot.servos])
        self._noise = robot.spec.reading_noise_rad
        self._on = np.ones(len(robot.servos), bool)
        self.hand_rad = np.zeros(len(robot.servos))
        self._top = self.map.file.counts - 1
        self._scale = self.map.sign() * self.map.counts_per_rad()
        self._zero = self.map.to_counts(np.zeros(len(robot.servos)))
        self.index_of_id = {i: k for k, i in enumerate(self.map.ids)}
        self.supply_v, self.keep_log = SUPPLY_V, keep_log
        self.commands: list[tuple[float, int, int]] = []
        # two threads that step a simulation at once would corrupt it
        self._alone = RLock()

    def command(self, index: int, time_s: float, count: int) -> None:
        """Command one servo from `time_s` on, which must not go backwards."""
        with self._alone:
            self.plant.command(index, time_s, (count - self._zero[index]) / self._scale[index])
        if self.keep_log:
            self.commands.append((time_s, index, count))

    def torque(self, index: int, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp."""
        if on == self.is_on(index):
            return
        self._on[index] = on
        self.hand_rad[index] = 0.0
        with self._alone:
            self.plant.torque(index, time_s, on)

    def is_on(self, index: int) -> bool:
        """Whether the servo holds."""
        return bool(self._on[index])

    def angle(self, index: int, time_s: float) -> float:
        """True angle of a servo [rad], servo coordinates; from any thread."""
        with self._alone:
            return self.plant.angle(index, time_s) + float(self.hand_rad[index])

    def move_by_hand(self, index: int, by_rad: float | None) -> None:
        """Move a limp servo by an angle [rad], or (None) back to where it went limp."""
        self.hand_rad[index] = 0.0 if by_rad is None else self.hand_rad[index] + by_rad

    def count(self, index: int, time_s: float) -> int:
        """Count of the encoder: angle with offset and noise, rounded."""
        noise = self._noise * self._rng.standard_normal()
        angle = self.angle(index, time_s) + self._offset[index] + noise
        count = round(float(self._zero[index] + self._scale[index] * angle))
        return min(max(count, 0), self._top)

    def load(self, index: int) -> int:
        """Signed duty in thousandths, in the direction of the counts."""
        direction = 1 if self._scale[index] > 0 else -1
        return round(1000 * direction * self.plant.load(index))

    @property
    def acting_registers(self) -> Sequence[str]:
        """Registers of the servos that act on their motion; none in free air."""
        return getattr(self.plant, "acting_registers", ())

    def register(self, index: int, name: str) -> int:
        """Value of one of `acting_registers`."""
        plant: Any = self.plant
        return plant.register(index, name)

    def set_register(self, index: int, time_s: float, name: str, value: int) -> None:
        """Set one of `acting_registers` from `time_s` on."""
        plant: Any = self.plant
        plant.set_register(index, time_s, name, value)

    def imu(self, time_s: float) -> ImuSample | None:
        """Latest sample of the robot's IMU."""
        return self.plant.imu(time_s)

    def truth(self, **transport: Any) -> dict[str, Any]:
        """True parameters, and how the protocol delays commands (`transport`)."""
        return self.robot.truth() | {"transport": transport}


ANSWER_KINDS = (
    "lost", "late", "truncated", "corrupted", "duplicated", "foreign", "wrong-length",
)  # fmt: skip
STATE_KINDS = ("error-bits", "frozen", "reboot", "brown-out", "unplugged", "second-writer")
KINDS = (*ANSWER_KINDS, *STATE_KINDS)

_LATE_S = (0.004, 0.06)


@dataclass
class BusFaults:
    """Faults drawn at given rates."""

    rates: dict[str, float]
    """Probability per answer, for each of `KINDS`."""
    rng: np.random.Generator
    lasts_s: float = 0.2
    """How long faults of servos and lines last."""
    counts: dict[str, int] = field(default_factory=dict)
    """How many were injected."""
    ended: list[tuple[str, float]] = field(default_factory=list)
    """Kind and end of faults that last, on the emulator's clock."""

    def __post_init__(self):
        for kind, rate in self.rates.items():
            if kind not in KINDS:
                raise InputError(f"fault '{kind}' is not known; known are {', '.join(KINDS)}.")
            if not 0 <= rate <= 1:
                raise InputError(f"fault {kind}: {rate} is not a probability; choose 0 to 1.")
        if sum(self.rates.values()) > 1:
            raise InputError("faults: the probabilities add up to more than 1.")
        self._kinds = [k for k, r in self.rates.items() if r > 0]
        self._edges = np.cumsum([self.rates[k] for k in self._kinds])

    @classmethod
    def parse(cls, text: str, rng: np.random.Generator) -> BusFaults:
        """Faults from `kind=rate,kind=rate`; an empty text is none."""
        rates = {}
        for part in filter(None, (piece.strip() for piece in text.split(","))):
            kind, _, rate = part.partition("=")
            try:
                rates[kind] = decimal(rate)
            except ValueError:
                raise InputError(
                    f"`faults`: '{part}' is not kind=probability, such as lost=0.02."
                ) from None
        return cls(rates, rng)

    def draw(self) -> str | None:
        """The fault of the next answer, if any; counted."""
        if not self._kinds:
            return None
        k = int(np.searchsorted(self._edges, self.rng.random(), side="right"))
        if k >= len(self._kinds):
            return None
        self.counts[self._kinds[k]] = self.counts.get(self._kinds[k], 0) + 1
        return self._kinds[k]

    def apply(self, kind: str | None, answer: bytes, foreign: bytes) -> list[tuple[float, bytes]]:
        """What arrives instead of `answer`: pieces, each with its delay [s].

        `foreign` is the answer to another request.
        """
        match kind:
            case "lost" | "reboot":
                return []
            case "late":
                return [(float(self.rng.uniform(*_LATE_S)), answer)]
            case "truncated":
                return [(0.0, answer[: int(self.rng.integers(1, len(answer)))])]
            case "corrupted":
                return [(0.0, corrupted(answer, self.rng))]
            case "duplicated":
                return [(0.0, answer), (0.0, answer)]
        return [(0.0, foreign if kind == "foreign" else answer)]


def corrupted(answer: bytes, rng: np.random.Generator) -> bytes:
    """One burst of noise on a line: some bits of one byte, or of two neighbours, flipped."""
    damaged = bytearray(answer)
    at = int(rng.integers(len(damaged)))
    damaged[at] ^= int(rng.integers(1, 256))
    if rng.random() < 0.3 and at + 1 < len(damaged):
        damaged[at + 1] ^= int(rng.integers(1, 256))
    return bytes(damaged)


PHYSICS_STEP_S = 0.001
"""Half the step of fitting, so that the truth is not made by the model that is fitted."""

_STILL_RAD_S = 1e-4  # MuJoCo's dry friction creeps at up to 3e-5 rad/s: invisible
_STILL_RAD_S2 = 1e-4
_STEPS_BETWEEN_LOOKS = 50


class FreeAirServo:
    """A servo in free air; time starts at 0 and must not go backwards.

    MuJoCo steps it only as far, and as often, as its position is needed. Commands come at any
    instant, not only on physics steps: the actuator gets the mean of the held command over the step
    before (`sim.robot.servo_mjcf.for_commands_between_steps`). A servo at rest is not stepped until
    a command moves it.

    Parameters are scalars, the dead time at least two physics steps. It rests at `position_rad` at
    the start, commanded there for long.
    """

    def __init__(
        self,
        parameters: DelayedPDParameters,
        position_rad: float,
        time_step_s: float = PHYSICS_STEP_S,
    ):
        from pupper_sysid.sim.robot.engine import mujoco

        self._engine = mujoco
        native = for_commands_between_steps(parameters, time_step_s, "servo")
        self._model = mujoco.MjModel.from_xml_string(free_air_xml([native], time_step_s))
        self._data = mujoco.MjData(self._model)
        rest_at(self._model, self._data, [position_rad])
        self._gains = self._model.actuator_biasprm.copy()
        self._effort = float(np.asarray(parameters.effort_limit))
        self._dt = time_step_s
        self._settled_after = int(float(np.asarray(parameters.dead_time_s)) / time_step_s) + 3
        self._step = 0
        self._changed = -self._settled_after - 1
        self._goal = float(position_rad)
        self._queue: deque[tuple[float, float]] = deque()
        self._limp = self._asleep = False

    def command(self, time_s: float, position_rad: float) -> None:
        """Set the command from `time_s` on; times must not go backwards."""
        latest = self._queue[-1][1] if self._queue else self._goal
        if not self._limp and position_rad != latest:
            self._queue.append((time_s, float(position_rad)))
            self._asleep = False

    def position_at(self, time_s: float) -> float:
        """True position [rad] at `time_s`, at most one physics step before the latest call."""
        if time_s <= 0 or self._asleep:
            return float(self._data.qpos[0])
        self._advance(int(np.ceil(time_s / self._dt - 1e-9)))
        # exact inside a step: MuJoCo moves the joint with the velocity at the step's end
        ahead = self._step * self._dt - time_s
        self._asleep = not self._queue and self._resting()
        return float(self._data.qpos[0]) - float(self._data.qvel[0]) * ahead

    @property
    def load(self) -> float:
        """Signed share of the effort limit in use at the time of the last call."""
        if self._limp or self._asleep:
            return 0.0
        return float(self._data.actuator_force[0]) / self._effort

    def torque(self, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        position = self.position_at(time_s)
        self._limp = not on
        switch_torque(self._model, self._gains, on)
        velocity = float(self._data.qvel[0])
        rest_at(self._model, self._data, [position])
        self._data.qvel[0] = velocity
        self._goal = position
        self._queue.clear()
        self._changed = self._step
        self._asleep = False

    def _advance(self, last: int) -> None:
        """Take physics steps until the state is that of the start of step `last`."""
        while self._step < last:
            # step k sees the commands of step k - 1
            event = int(self._queue[0][0] / self._dt) + 1 if self._queue else last
            if event > self._step:
                steps = min(event, last) - self._step
                if not self._resting():
                    steps = min(steps, _STEPS_BETWEEN_LOOKS)
                    self._data.ctrl[0] = self._goal
                    self._engine.mj_step(self._model, self._data, nstep=steps)
                self._step += steps
            else:
                since, stop = (self._step - 1) * self._dt, self._step * self._dt
                integral, self._goal = held_over(since, stop, self._goal, self._queue)
                self._data.ctrl[0] = integral / self._dt
                self._engine.mj_step(self._model, self._data)
                self._changed = self._step
                self._step += 1

    def _resting(self) -> bool:
        """Whether another step would change nothing."""
        data = self._data
        return (
            self._step - self._changed > self._settled_after
            and abs(data.qvel[0]) < _STILL_RAD_S
            and abs(data.qacc[0]) < _STILL_RAD_S2
            and (self._limp or not len(data.act) or abs(data.act[0] - self._goal) < 1e-12)
        )
