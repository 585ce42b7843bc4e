"""Emulated robots as plain numbers: true parameters of their servos, feedback and timing.

`RobotSpec` is a kind of robot: the mean servo, its spread from joint to joint, the feedback's
errors, the host's timing. `draw_robot` draws one robot of it, whose numbers are the truth that an
identification should find. `sim.emulator.bus` makes them move.

The defaults are published measurements of one Mini Pupper 2: pooled fit of three joints, poll
statistics of twelve recordings.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.held_feedback import HeldFeedback

RADIANS_PER_COUNT = np.pi / 550
CENTRE_COUNT = 512
SHORTEST_DELAY_S = 0.002
"""Shortest dead time that can be emulated [s]: two physics steps."""


@dataclass(frozen=True)
class RobotSpec:
    """A kind of emulated robots. Times in s, angles in rad, torques in N·m."""

    dead_time_s: float = 0.025
    """Mean dead time of a servo, from the host's sending to the first torque. The transport of a
    reading to the host (about 3 ms on the robot) is counted here: a poll is seen at once."""
    stiffness_per_inertia: float = 12_700.0
    """Mean stiffness / armature [1/s²]."""
    damping_per_inertia: float = 103.0
    """Mean damping / armature [1/s]."""
    friction_per_inertia: float = 207.0
    """Mean dry friction / armature [rad/s²]."""
    effort_per_inertia: float = 433.0
    """Effort limit / armature [rad/s²]; with `stall_torque_nm` it sets the armature."""
    stall_torque_nm: float = 0.35
    """Effort limit of every servo [N·m] (shop specification of 3.5 kg·cm)."""
    velocity_limit_rad_s: float = 7.6
    """Mean rate limit of the set-point [rad/s]."""
    gain_spread: float = 0.10
    """Standard deviation of the logarithm of each of the four ratios to inertia, per joint."""
    velocity_spread: float = 0.05
    """The same for the velocity limit."""
    command_jitter_s: float = 0.0
    """Standard deviation and mean of the (exponential) latency of each command, a part of the dead
    time: a goal frame that is lost and sent again."""
    dead_time_sd_s: float = 0.0015
    """Standard deviation of the dead time from joint to joint."""
    offset_sd_rad: float = 0.005
    """Standard deviation of each joint's constant reading error."""
    poll_period_s: float = 0.02685
    """Time between two polls of the same servo; 0 for a bus where every reading is fresh."""
    loss: float = 0.42
    """Probability that a poll fails and leaves the stale reading in place."""
    poll_jitter_s: float = 0.0008
    """Standard deviation of a poll instant about its lattice."""
    poll_drift: float = 0.002
    """Relative standard deviation of the poll period as it wanders over seconds: half of the
    0.4 % between recordings of 3 s, of which estimation errors are a part."""
    quantum_rad: float = RADIANS_PER_COUNT
    """Quantisation step, of commands (truncated) and of readings (rounded); 0 for none."""
    reading_noise_rad: float = 0.003
    """Standard deviation of a reading before rounding: half a step. The recordings leave 11 to
    14 mrad unexplained, unmodelled friction included; readings at rest flicker by a step."""
    sleep_overshoot_s: float = 0.0001
    """Mean of the (exponential) time by which a sleep of the host ends late."""
    write_duration_s: float = 0.0003
    """Time the host spends in one write."""
    read_duration_s: float = 0.0005
    """Time the host spends in one read."""


@dataclass(frozen=True)
class EmulatedServo:
    """True parameters of one servo."""

    joint: str
    actuator: DelayedPDParameters
    """Scalars. Its dead time is without the latency of commands (`command_jitter_s`)."""
    feedback: HeldFeedback
    poll_phase_s: float
    """One poll instant of its lattice, before jitter and drift [s]."""
    zero_rad: float
    """Angle of the centre count [rad]."""
    count_sign: int
    """Direction of the counts as the angle grows."""

    @property
    def command_rounding(self) -> str:
        """Direction in which truncation to counts moves the commanded angle: "up" or "down"."""
        return "down" if self.count_sign > 0 else "up"


@dataclass(frozen=True)
class EmulatedRobot:
    """One robot: its spec, and its servos in the order of its joint map."""

    spec: RobotSpec
    servos: tuple[EmulatedServo, ...]
    joint_map: JointMap

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the servos."""
        return tuple(servo.joint for servo in self.servos)

    def truth(self) -> dict:
        """All true parameters as plain numbers and strings, ready for YAML."""
        joints = {}
        for servo in self.servos:
            joints[servo.joint] = {
                "actuator": {k: float(v) for k, v in asdict(servo.actuator).items()}
                | {
                    "dead_time_s": float(np.asarray(servo.actuator.dead_time_s))
                    + self.spec.command_jitter_s,
                    "command_jitter_s": self.spec.command_jitter_s,
                },
                "feedback": {k: float(v) for k, v in asdict(servo.feedback).items()}
                | {
                    "mean_age_s": float(servo.feedback.mean_age_s),
                    "phase_s": servo.poll_phase_s,
                    "jitter_s": self.spec.poll_jitter_s,
                },
                "zero_rad": servo.zero_rad,
                "command_rounding": servo.command_rounding,
            }
        return {"spec": asdict(self.spec), "joints": joints}


def draw_robot(
    rng: np.random.Generator, spec: RobotSpec | None = None, joint_map: JointMap | None = None
) -> EmulatedRobot:
    """Draw one robot of `spec` (default: the published Mini Pupper 2)."""
    spec = spec or RobotSpec()
    start = rng.uniform(0.0, spec.poll_period_s)
    layout = (joint_map or load_joint_map("mini_pupper_2")).per_servo()
    servos = []
    for turn, (joint, sign, zero) in enumerate(
        zip(layout.joint_names, layout.sign(), layout.zero_rad(), strict=True)
    ):
        kp, kd, friction, effort = np.exp(spec.gain_spread * rng.standard_normal(4))
        speed = np.exp(spec.velocity_spread * rng.standard_normal())
        delay = spec.dead_time_s + spec.dead_time_sd_s * rng.standard_normal()
        armature = spec.stall_torque_nm / (spec.effort_per_inertia * effort)
        actuator = DelayedPDParameters(
            stiffness=float(spec.stiffness_per_inertia * kp * armature),
            damping=float(spec.damping_per_inertia * kd * armature),
            friction_loss=float(spec.friction_per_inertia * friction * armature),
            armature=float(armature),
            effort_limit=spec.stall_torque_nm,
            velocity_limit=float(spec.velocity_limit_rad_s * speed),
            dead_time_s=float(max(delay - spec.command_jitter_s, SHORTEST_DELAY_S)),
        )
        feedback = HeldFeedback(
            poll_period_s=spec.poll_period_s,
            loss=spec.loss,
            quantum_rad=spec.quantum_rad,
            offset_rad=float(spec.offset_sd_rad * rng.standard_normal()),
        )
        # the firmware polls in the order of ids; another bus in that of the map
        place = layout.ids[turn] - 1 if joint_map is None else turn
        phase = float(start + place / len(layout.ids) * spec.poll_period_s)
        servos.append(EmulatedServo(joint, actuator, feedback, phase, float(zero), int(sign)))
    return EmulatedRobot(spec, tuple(servos), layout)


def directly_read(joint_map: JointMap) -> RobotSpec:
    """Spec of servos on a serial line: every reading is fresh, none is lost.

    Torque and speed are those of the servo's data sheet, where the map names it; the ratios to the
    inertia stay those of the Mini Pupper's servos.
    """
    spec = RobotSpec(
        poll_period_s=0.0, loss=0.0, quantum_rad=float(1 / joint_map.counts_per_rad().max())
    )
    sheet = data_sheet(joint_map.file.servo or "")
    if sheet is None:
        return spec
    rating = sheet.at()
    speed = rating.no_load_speed_rad_s or spec.velocity_limit_rad_s
    return replace(spec, stall_torque_nm=rating.stall_torque_nm, velocity_limit_rad_s=speed)
