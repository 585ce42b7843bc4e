"""Random emulated robots, recorded as by `sweep`, whose true motion and dead time are known."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.step_size import delay_at_step
from pupper_sysid.sim.emulator.bench import PHYSICS_STEP_S, FreeAirServo, FreeAirServos
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import EmulatedRobot, RobotSpec, draw_robot
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording, Trial
from pupper_sysid.sysid.sweep.excitation import parse_frequencies, plan
from pupper_sysid.sysid.sweep.recorder import record


def random_spec(rng: np.random.Generator, **chosen: float) -> RobotSpec:
    """Draw a spec; `chosen` fixes fields of `RobotSpec` instead (`loss=0.3`)."""
    base = RobotSpec()

    def around(value: float, spread: float) -> float:
        return float(value * np.exp(rng.uniform(-spread, spread)))

    drawn = {
        "dead_time_s": float(rng.uniform(0.010, 0.040)),
        "stiffness_per_inertia": around(base.stiffness_per_inertia, 0.4),
        "damping_per_inertia": around(base.damping_per_inertia, 0.3),
        "friction_per_inertia": around(base.friction_per_inertia, 0.5),
        "effort_per_inertia": around(base.effort_per_inertia, 0.2),
        "velocity_limit_rad_s": around(base.velocity_limit_rad_s, 0.15),
        "poll_period_s": float(rng.uniform(0.020, 0.034)),
        "loss": float(rng.uniform(0.0, 0.6)),
        "poll_jitter_s": float(rng.uniform(0.0, 0.0012)),
        "poll_drift": float(rng.uniform(0.0, 0.003)),
        # Mini Pupper counts, 300° over 10 bits, 360° over 12 bits
        "quantum_rad": float(rng.choice([np.pi / 550, np.radians(300) / 1024, 2 * np.pi / 4096])),
        "reading_noise_rad": float(rng.uniform(0.001, 0.006)),
        "sleep_overshoot_s": float(rng.uniform(0.0, 0.0005)),
    }
    return replace(base, **(drawn | chosen))


@dataclass(frozen=True)
class SweptRobot:
    """A recorded robot and its true parameters."""

    spec: RobotSpec
    joint: str
    servo: DelayedPDParameters
    recording: Recording
    bus: WitnessedBus

    def dead_time_s(self, step_s: float) -> float:
        """True dead time of the joint, for a simulation in steps of `step_s`."""
        return float(delay_at_step(self.servo, step_s, PHYSICS_STEP_S)[0])


def sweep_random_robot(rng: np.random.Generator, tones: str, **chosen: float) -> SweptRobot:
    """Draw a robot and sweep one of its joints, chosen at random, by tones such as "1-10" [Hz]."""
    spec = random_spec(rng, **chosen)
    joint = JOINT_NAMES[int(rng.integers(len(JOINT_NAMES)))]
    robot = draw_robot(rng, spec)
    bus = WitnessedBus(robot, rng, joint)
    trials = plan("sine", [joint], parse_frequencies(tones))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweep.csv"
        record(bus, trials, path)
        recording = load(path)
    return SweptRobot(spec, joint, robot.servos[JOINT_NAMES.index(joint)].actuator, recording, bus)


class RememberingServo(FreeAirServo):
    """A servo that remembers its past positions."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self._past: dict[int, tuple[float, float]] = {}

    def position_at(self, time_s: float) -> float:
        """True position at `time_s`, however long ago."""
        step = int(np.ceil(time_s / self._dt - 1e-9))
        if step < self._step and step in self._past:
            position, velocity = self._past[step]
            return position - velocity * (step * self._dt - time_s)
        now = super().position_at(time_s)
        self._past[self._step] = (float(self._data.qpos[0]), float(self._data.qvel[0]))
        return now


class WitnessedServos(FreeAirServos):
    """Servos in free air, one of which remembers."""

    def __init__(self, robot: EmulatedRobot, witnessed: int):
        super().__init__(robot)
        rest = robot.joint_map.rest_pose()[witnessed]
        self._servos[witnessed] = RememberingServo(robot.servos[witnessed].actuator, float(rest))


class WitnessedBus(EmulatedBus):
    """An emulated bus that logs the true position of one joint every millisecond."""

    def __init__(self, robot: EmulatedRobot, rng: np.random.Generator, joint: str):
        self._witnessed = JOINT_NAMES.index(joint)
        self._servos = WitnessedServos(robot, self._witnessed)
        super().__init__(robot, rng, plant=self._servos)
        self.time: list[float] = []
        self.position: list[float] = []

    def sleep_until(self, time_s: float) -> None:
        """Log the joint up to that time."""
        start = self.time[-1] + 1e-3 if self.time else 0.0
        super().sleep_until(time_s)
        for now in np.arange(start, self.now(), 1e-3):
            self.time.append(float(now))
            self.position.append(self._servos.angle(self._witnessed, float(now)))

    def motion(self, trial: Trial) -> Readings:
        """True motion of the joint during `trial`."""
        time, position = np.array(self.time), np.array(self.position)
        inside = (time >= trial.send_time_s[0]) & (time <= trial.send_time_s[-1])
        time, position = time[inside], position[inside]
        return Readings(np.arange(len(time)), time, position, time, 0.0)
