"""The emulated robot that walks, behind the same bus as a real one.

    bus = GuardedBus(WalkingBus(draw_robot(rng), rng))

Commands and readings are in joint coordinates (a calf relative to its thigh; `hardware.joint_map`)
and pass through `EmulatedBus`: quantisation, polls in turn, lost polls, offset, noise. The calf's
reading is that of two servos, polled at different times. In virtual time it runs as fast as the
machine can; `robot.trunk` gives the true motion.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.hardware.bus import BusSample, Sent, finite_angles
from pupper_sysid.hardware.imu import ImuSample
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import SHORTEST_DELAY_S, EmulatedRobot, RobotSpec, draw_robot
from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.walking.robot import PHYSICS_STEP_S, WalkingRobot, body_joint_map
from pupper_sysid.sim.walking.servo_ranges import ServoRanges


def calibrated_robot(
    servos: ServoRanges, rng: np.random.Generator, body: Body | None = None
) -> EmulatedRobot:
    """An emulated robot with the servos of a calibration or preset.

    Its servos have the calibration's values and lag; the shortest dead time that can be emulated is
    2 ms. The bus polls all of them with the median of their periods and losses. Counts, offsets of
    the readings and the host's timing are those of `draw_robot`; another robot than the Mini Pupper
    2 reads as fine as the calibration's servos.
    """
    feedback = servos.feedback
    spec = RobotSpec(
        poll_period_s=float(np.median([servo.poll_period_s for servo in feedback])),
        loss=float(np.median([servo.loss for servo in feedback])),
        command_jitter_s=servos.command_jitter_s,
    )
    layout = None
    if body is not None and not body.is_mini_pupper:
        layout = body_joint_map(body)
        quantum = float(np.median([servo.quantum_rad for servo in feedback]))
        spec = replace(spec, quantum_rad=quantum, reading_noise_rad=quantum / 2)
    drawn = draw_robot(rng, spec, layout)
    parameters = servos.in_steps_of(PHYSICS_STEP_S).nominal()
    emulated = []
    for servo in drawn.servos:
        values = {name: float(np.asarray(x)) for name, x in asdict(parameters[servo.joint]).items()}
        # an emulated servo's dead time is without the mean latency of commands
        late = values["dead_time_s"] - spec.command_jitter_s
        values["dead_time_s"] = max(late, SHORTEST_DELAY_S)
        emulated.append(replace(servo, actuator=DelayedPDParameters(**values)))
    return replace(drawn, servos=tuple(emulated))


class WalkingBus:
    """A `hardware.bus.ServoBus` with an IMU (`hardware.imu.Imu`) of an emulated robot that walks.

    `truth` are its servos and their feedback; `rng` decides lost polls, noise and timing. Time is
    virtual, or the host's. `robot` is the robot behind the bus.
    """

    name = "emulated"

    def __init__(
        self,
        truth: EmulatedRobot,
        rng: np.random.Generator,
        real_time: bool = False,
        body: Body | None = None,
    ):
        self.joint_names: tuple[str, ...] = truth.joint_names
        self.robot = WalkingRobot(truth, rng.spawn(1)[0], body=body)
        self._bus = EmulatedBus(truth, rng, real_time, self.robot, keep_log=False)
        self._map = body_joint_map(self.robot.body)
        self._servo_map = self._map.per_servo()
        self.limits = self._map.position_limits()
        about = {"kind": "emulated walking robot", "coordinates": "joint"}
        self.metadata: dict[str, Any] = self._bus.metadata | about

    def now(self) -> float:
        """Time of the bus's clock [s], from 0 at construction."""
        return self._bus.now()

    def sleep_until(self, time_s: float) -> None:
        """Return when `now()` has reached `time_s`; in virtual time only the physics costs."""
        self._bus.sleep_until(time_s)

    def write(self, position_rad: NDArray[np.float64]) -> Sent:
        """Send commands of the joints [rad], shape (12,)."""
        goal = finite_angles(position_rad, len(self.joint_names), self.name)
        sent = self._bus.write(self._servo_map.to_angles(self._map.to_counts(goal)))
        return Sent(sent.time_s, goal)

    def read(self) -> BusSample:
        """Read all joints once: the values of the last successful poll of each servo."""
        sample = self._bus.read()
        joints = self._map.to_angles(self._servo_map.to_counts(sample.position_rad))
        return replace(sample, position_rad=joints)

    def imu(self) -> ImuSample | None:
        """Latest sample of the IMU."""
        now = self.now()
        sample = self.robot.imu(now)
        return None if sample is None else replace(sample, time_s=now)

    def torque(self, on: bool) -> bool:
        """Hold the present pose, or switch the torque off."""
        return self._bus.torque(on)

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()
