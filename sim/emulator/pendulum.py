"""One servo with a position loop in duty that swings a pendulum, stepped by MuJoCo.

    duty   = clip(duty_per_rad * (P * error - D * d_time_s * speed), ±torque limit)
    torque = torque_nm * duty - back_emf * speed          (limp: 0)

against Coulomb friction, armature, and the gravity and inertia of a point mass on an arm. The error
is set-point minus encoder in whole counts; inside the dead zone the duty is 0, outside at least the
minimum start force. Commands and switches of the torque take effect after `dead_time_s`; set-points
follow a ramp if the registers acceleration or goal speed ask for one. With `backlash_rad` the motor
turns the encoder's shaft through gears with that much play: the encoder sits on the output, as in
these servos.

What the registers mean for the loop is listed by model, with the defaults of a bench (`BenchSpec`):
torque, speed and factory gains of the model's data sheet; dead time, armature and friction to
the accuracy to which published models of such servos agree. A bench is of servos that swing a
pendulum each, with settable registers, behind any emulated bus:

    robot = draw_bench(rng, Pendulum(0.1, 0.1))
    bus = EmulatedBus(robot, rng, plant=PendulumBench(robot))

Its defaults are an STS3215 at 7.4 V. The truth beside a recording has `loaded_servo`, the numbers
of `PendulumServoParameters`, and `actuator`, the DelayedPD servo that is equivalent at the
factory's gains where nothing saturates.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pupper_sysid.common.data_sheet import no_load_speed, stall_torque
from pupper_sysid.hardware.dynamixel import SERIES, profile
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.bench import (
    AMBIENT_C,
    PHYSICS_STEP_S,
    SUPPLY_V,
    ServosOnStand,
    held_over,
)
from pupper_sysid.sim.emulator.robot import EmulatedRobot, directly_read, draw_robot
from pupper_sysid.sim.robot.servo_mjcf import (
    FRICTION_SOLIMP,
    INTEGRATOR,
    MASSLESS,
    attributes,
    friction_solref,
    numbers,
)

FEETECH_REGISTERS = {
    "p": 32, "d": 32, "i": 0, "min_start_force": 16, "dead_zone_cw": 1, "dead_zone_ccw": 1,
    "acceleration": 0, "goal_speed": 0, "torque_limit": 1000, "max_torque": 1000,
}  # fmt: skip
"""Registers that act on the motion, as an STS3215 leaves the factory (`i` does not act here)."""

ACCELERATION_UNIT = 100
"""Counts/s² per unit of Feetech's register acceleration."""

DYNAMIXEL_GAINS = {
    "XL330-M288": (400, 0, 0), "XL330-M077": (400, 0, 0), "XC330-M288": (400, 0, 0),
    "XL430-W250": (640, 0, 4000), "XM430-W210": (800, 0, 0), "XM430-W350": (800, 0, 0),
    "MX-28": (850, 0, 0), "MX-64": (850, 0, 0), "MX-106": (850, 0, 0), "XH430-W350": (900, 0, 0),
}  # fmt: skip
"""Position P, I and D gain as a servo leaves the factory (Robotis e-Manual)."""

_TICK_S = 0.001
_FULL_PWM = 885
_CURRENT_BASED = 5


@dataclass(frozen=True)
class Loop:
    """Constants of a position loop."""

    p: float
    """Duty per radian of error."""
    d: float
    """Duty per speed [s/rad]."""
    least: float
    """Smallest duty outside the dead zone."""
    most: float
    """Largest duty."""
    zone_cw: int = 0
    """Dead zone [counts]."""
    zone_ccw: int = 0
    top_speed_rad_s: float = math.inf
    """Of the set-point's ramp."""
    top_acceleration_rad_s2: float = math.inf


def feetech_loop(registers: Mapping[str, int], servo: Any) -> Loop:
    """Loop of an STS servo: gains per radian, ramps in counts."""
    count = servo.count_rad or math.tau / 4096
    return Loop(
        servo.duty_per_rad * registers["p"],
        servo.duty_per_rad * registers["d"] * servo.d_time_s,
        registers["min_start_force"] / 1000 if servo.count_rad else 0.0,
        min(registers["torque_limit"], registers["max_torque"], 1000) / 1000,
        registers["dead_zone_cw"],
        registers["dead_zone_ccw"],
        registers["goal_speed"] * count or math.inf,
        registers["acceleration"] * ACCELERATION_UNIT * count or math.inf,
    )


def dynamixel_loop(registers: Mapping[str, int], servo: Any) -> Loop:
    """Loop of an X or MX servo: P over 128 and D over 16 per count, full duty at a PWM of 885.

    Profiles by speed only; the current limit acts in the current-based position mode.
    """
    ramp = profile(SERIES[1200], registers)
    most = min(registers["pwm_limit"], registers["goal_pwm"], _FULL_PWM) / _FULL_PWM
    if registers["operating_mode"] == _CURRENT_BASED:
        most *= min(registers["goal_current"] / max(registers["current_limit"], 1), 1.0)
    return Loop(
        servo.duty_per_rad * registers["position_p_gain"],
        servo.duty_per_rad * 128 / 16 * registers["position_d_gain"] * _TICK_S,
        0.0,
        most,
        top_speed_rad_s=ramp.speed_rad_s,
        top_acceleration_rad_s2=ramp.acceleration_rad_s2,
    )


def dynamixel_registers(model: str) -> dict[str, int]:
    """Registers of a Dynamixel that act on the motion, as it leaves the factory."""
    p, i, d = DYNAMIXEL_GAINS[model]
    return {
        "position_p_gain": p, "position_i_gain": i, "position_d_gain": d, "pwm_limit": _FULL_PWM,
        "goal_pwm": _FULL_PWM, "current_limit": 1193, "goal_current": 1193, "operating_mode": 3,
        "drive_mode": 0, "profile_velocity": 0, "profile_acceleration": 0,
    }  # fmt: skip


GRAVITY_M_S2 = 9.81

_STILL_RAD_S, _STILL_RAD_S2, _STILL_STEPS = 1e-4, 1e-2, 50
_HORN_KG_M2 = 1e-5  # output side without a load


@dataclass(frozen=True)
class PendulumServoParameters:
    """True numbers of a servo and its load."""

    torque_nm: float
    """Torque at full duty and standstill [N·m]."""
    duty_per_rad: float
    """Duty per radian of error and unit of the P gain."""
    back_emf_nm_s_rad: float
    """Torque lost per speed [N·m·s/rad]."""
    friction_nm: float
    """Coulomb friction of motor and gears [N·m]."""
    armature_kg_m2: float
    """Reflected inertia of motor and gears."""
    dead_time_s: float
    """From a command's arrival to its first torque."""
    mass_kg: float = 0.0
    """Point mass at the end of the arm; 0 for free air."""
    length_m: float = 0.0
    arm_mass_kg: float = 0.0
    """Mass of the arm, a uniform rod."""
    hanging_rad: float = 0.0
    """Position at which the mass hangs straight down."""
    count_rad: float = 0.0
    """Resolution of the position loop; 0 for a continuous one."""
    d_time_s: float = 0.001
    """Derivative time per unit ratio of D to P: one turn of the loop."""
    backlash_rad: float = 0.0
    """Play between motor and output."""
    output_friction_nm: float = 0.0
    """Coulomb friction of the output shaft, beyond the play."""

    @property
    def load_inertia_kg_m2(self) -> float:
        """Inertia of the load about the axis [kg·m²]."""
        return (self.mass_kg + self.arm_mass_kg / 3) * self.length_m**2

    @property
    def gravity_nm(self) -> float:
        """Largest torque of gravity [N·m]."""
        return (self.mass_kg + self.arm_mass_kg / 2) * GRAVITY_M_S2 * self.length_m

    def truth(self) -> dict[str, float]:
        """All numbers, ready for YAML."""
        return {name: float(value) for name, value in asdict(self).items()} | {
            "load_inertia_kg_m2": self.load_inertia_kg_m2,
            "gravity_nm": self.gravity_nm,
        }


class PendulumServo:
    """A servo with its load; time starts at 0 and must not go backwards.

    At the start it rests at `position_rad`, commanded there for long. `registers` are those that
    differ from the `factory`'s, which act on the motion; `loop` gives the constants of the position
    loop.
    """

    def __init__(
        self,
        parameters: PendulumServoParameters,
        position_rad: float,
        registers: Mapping[str, int] | None = None,
        factory: Mapping[str, int] = FEETECH_REGISTERS,
        loop: Callable[[Mapping[str, int], Any], Loop] = feetech_loop,
    ):
        from pupper_sysid.sim.robot.engine import mujoco

        self.parameters, self._engine = parameters, mujoco
        self._registers = dict(factory) | dict(registers or {})
        self._loop_of = loop
        self._model = mujoco.MjModel.from_xml_string(_xml(parameters, PHYSICS_STEP_S))
        self._data = mujoco.MjData(self._model)
        self._data.qpos[0] = position_rad
        if parameters.backlash_rad:  # the load lies on one side of the play
            side = math.copysign(parameters.backlash_rad / 2, position_rad - parameters.hanging_rad)
            self._data.qpos[:] = position_rad + side, -side
        mujoco.mj_forward(self._model, self._data)
        self._dt = PHYSICS_STEP_S
        self._step = self._still = 0
        self._goal = self._setpoint = float(position_rad)
        self._rate = self._duty = 0.0
        self._queue: deque[tuple[float, float]] = deque()
        self._limp = self._off = False
        self._switch: tuple[float, bool] | None = None
        self._loop = loop(self._registers, parameters)

    def command(self, time_s: float, position_rad: float) -> None:
        """Set the command from `time_s` on; times must not go backwards."""
        if not self._limp:
            self._queue.append((time_s + self.parameters.dead_time_s, float(position_rad)))
            self._still = 0

    def torque(self, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp; takes effect after the dead time, too."""
        self.position_at(time_s)
        self._limp, self._still = not on, 0
        self._queue.clear()
        self._switch = time_s + self.parameters.dead_time_s, on

    def register(self, name: str) -> int:
        """Value of a register."""
        return self._registers[name]

    def set_register(self, time_s: float, name: str, value: int) -> None:
        """Set a register from `time_s` on; one that does not act is kept."""
        self.position_at(time_s)
        self._registers[name] = int(value)
        self._still = 0
        self._loop = self._loop_of(self._registers, self.parameters)

    def position_at(self, time_s: float) -> float:
        """True position of the output [rad], at most one step before the latest call."""
        if time_s > 0:
            last = math.ceil(time_s / self._dt - 1e-9)
            while self._step < last:
                if self._still > _STILL_STEPS:
                    self._step = last
                else:
                    self._advance()
        ahead = max(self._step * self._dt - max(time_s, 0.0), 0.0)
        position, speed = self._output()
        return position - speed * min(ahead, self._dt)

    @property
    def load(self) -> float:
        """Signed duty at the time of the last call."""
        return self._duty

    def _output(self) -> tuple[float, float]:
        qpos, qvel = self._data.qpos, self._data.qvel
        if self.parameters.backlash_rad:
            return float(qpos[0] + qpos[1]), float(qvel[0] + qvel[1])
        return float(qpos[0]), float(qvel[0])

    def _advance(self) -> None:
        """One physics step, with one turn of the position loop."""
        data = self._data
        position, speed = self._output()
        if self._switch and self._switch[0] < (self._step + 0.5) * self._dt:
            self._off, self._switch = not self._switch[1], None
            self._goal = self._setpoint = position
            self._rate = self._duty = 0.0
            self._model.dof_damping[0] = 0.0 if self._off else self.parameters.back_emf_nm_s_rad
        if not self._off:
            self._follow(self._mean_goal())
            self._duty = self._drive(position, speed)
        data.ctrl[0] = self._duty
        self._engine.mj_step(self._model, data)
        self._step += 1
        moving = (
            self._queue
            or self._switch
            or abs(speed) > _STILL_RAD_S
            or abs(data.qacc[0]) > _STILL_RAD_S2
            or self._setpoint != self._goal
        )
        self._still = 0 if moving else self._still + 1

    def _mean_goal(self) -> float:
        """Mean of the delayed command over the present step; ended ones leave the queue."""
        since = self._step * self._dt
        stop = since + self._dt
        if not self._queue or self._queue[0][0] >= stop:
            return self._goal
        integral, self._goal = held_over(since, stop, self._goal, self._queue)
        return integral / self._dt

    def _follow(self, goal: float) -> None:
        """Move the set-point to `goal`, on a ramp if the registers ask for one."""
        top_speed, acceleration = self._loop.top_speed_rad_s, self._loop.top_acceleration_rad_s2
        if math.isinf(top_speed) and math.isinf(acceleration):
            self._setpoint = goal
            return
        way, before = goal - self._setpoint, self._rate
        rate = min(top_speed, abs(way) / self._dt)
        if not math.isinf(acceleration):
            # the rate at which a step may end for the rest of the way to be enough to stop
            gain = acceleration * self._dt
            toward = math.copysign(before, before * way)
            room = gain**2 / 4 + 2 * acceleration * abs(way) - gain * toward
            rate = min(rate, math.sqrt(max(room, gain**2 / 4)) - gain / 2)
            rate = math.copysign(rate, way)
            self._rate = min(max(rate, before - gain), before + gain)
            step = (before + self._rate) / 2 * self._dt
        else:
            self._rate = math.copysign(rate, way)
            step = self._rate * self._dt
        if abs(way - step) < 1e-9 or (abs(way) < 1e-4 and abs(self._rate) < 2e-1):
            self._setpoint, self._rate = goal, 0.0
        else:
            self._setpoint += step

    def _drive(self, position: float, speed: float) -> float:
        """Duty of the position loop."""
        count = self.parameters.count_rad
        error = self._setpoint - position
        if count:
            counts = round(self._setpoint / count) - round(position / count)
            zone = self._loop.zone_ccw if counts > 0 else self._loop.zone_cw
            if abs(counts) <= zone:
                return 0.0
            error = counts * count
        loop = self._loop
        duty = loop.p * error - loop.d * speed
        if abs(duty) < loop.least:
            duty = math.copysign(loop.least, error)
        return min(max(duty, -loop.most), loop.most)


def _xml(p: PendulumServoParameters, time_step_s: float) -> str:
    """MJCF: a motor on a hinge about y, and its load, directly or through gears with play."""
    solver = {
        "solreffriction": numbers(*friction_solref(time_step_s)),
        "solimpfriction": numbers(*FRICTION_SOLIMP),
    }
    motor: dict[str, Any] = solver | {
        "name": "motor", "type": "hinge", "axis": "0 1 0", "ref": numbers(p.hanging_rad),
        "armature": numbers(p.armature_kg_m2), "damping": numbers(p.back_emf_nm_s_rad),
        "frictionloss": numbers(p.friction_nm),
    }  # fmt: skip
    total = p.mass_kg + p.arm_mass_kg
    load = MASSLESS
    if total > 0 and p.length_m > 0:
        below = (p.mass_kg + p.arm_mass_kg / 2) * p.length_m / total
        inertia = numbers(max(p.load_inertia_kg_m2 - total * below**2, 1e-12))
        load = (
            f'<inertial pos="0 0 {numbers(-below)}" mass="{numbers(total)}" '
            f'diaginertia="{inertia} {inertia} {inertia}"/>'
        )
    if p.backlash_rad:
        half = p.backlash_rad / 2
        play = attributes(
            solver
            | {
                "name": "play", "type": "hinge", "axis": "0 1 0", "armature": repr(_HORN_KG_M2),
                "limited": "true", "range": numbers(-half, half),
                "solreflimit": "0.002 1", "solimplimit": "0.99 0.9999 0.0001",
                "frictionloss": numbers(p.output_friction_nm),
            }
        )  # fmt: skip
        load = f"{MASSLESS}<body><joint {play}/>{load}</body>"
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{time_step_s}" '
        f'integrator="{INTEGRATOR}" gravity="0 0 {-GRAVITY_M_S2}"/>'
        f"<worldbody><body><joint {attributes(motor)}/>{load}</body></worldbody>"
        f'<actuator><motor joint="motor" gear="{numbers(p.torque_nm)}"/></actuator></mujoco>'
    )


_SPREAD = ("torque_nm", "duty_per_rad", "back_emf_nm_s_rad", "friction_nm", "armature_kg_m2")
"""What differs from servo to servo of a bench."""
BENCH_MAP = "bench_sts3215"
"""Joint map of one STS3215 on a bench: joint `bench`, id 1, 0 rad at its centre count."""


@dataclass(frozen=True)
class Pendulum:
    """A load, as `sysid.recordings.table.PendulumLoad` describes it in a recording."""

    mass_kg: float = 0.0
    length_m: float = 0.0
    arm_mass_kg: float = 0.0
    hanging_rad: float = 0.0


@dataclass(frozen=True)
class BenchSpec:
    """A kind of servos on a bench: means, and spreads of their logarithms from servo to servo."""

    torque_nm: float = 1.8
    duty_per_rad: float = 0.19
    back_emf_nm_s_rad: float = 0.34
    friction_nm: float = 0.05
    armature_kg_m2: float = 0.015
    dead_time_s: float = 0.012
    dead_time_sd_s: float = 0.0015
    spread: float = 0.12
    backlash_rad: float = 0.0
    output_friction_nm: float = 0.002
    """Acts only with backlash."""
    offset_sd_rad: float = 0.002
    reading_noise_rad: float = 0.0004
    """A quarter of a count."""
    registers: tuple[tuple[str, int], ...] = ()
    """Registers that differ from the factory's."""
    model: str = "STS3215"
    supply_v: float = SUPPLY_V

    @property
    def factory(self) -> dict[str, int]:
        """Registers that act on the motion, as the servo leaves the factory."""
        if self.model in DYNAMIXEL_GAINS:
            return dynamixel_registers(self.model)
        return dict(FEETECH_REGISTERS)

    @property
    def loop(self) -> Callable[[Mapping[str, int], Any], Loop]:
        """Position loop of the model."""
        return dynamixel_loop if self.model in DYNAMIXEL_GAINS else feetech_loop


def dynamixel_bench(model: str) -> BenchSpec:
    """Bench of a Dynamixel: torque and speed of its data sheet at its usual supply.

    Armature, friction and dead time are of the size that published fits of these servos give.
    """
    supply_v = 5.0 if model.startswith(("XL330", "XC330")) else 12.0
    torque, _ = stall_torque(model, supply_v)
    speed = no_load_speed(model, supply_v) or 5.0
    return BenchSpec(
        torque_nm=torque,
        # PWM per count of error, over 128 per unit of P; full duty is 885
        duty_per_rad=4096 / math.tau / 885 / 128,
        back_emf_nm_s_rad=torque / speed,
        friction_nm=0.04 * torque,
        armature_kg_m2=0.0035 * torque,
        dead_time_s=0.006,
        dead_time_sd_s=0.001,
        spread=0.1,
        model=model,
        supply_v=supply_v,
    )


@dataclass(frozen=True)
class BenchRobot(EmulatedRobot):
    """Servos on a bench; the `actuator` of each is equivalent at its present gains."""

    loaded: tuple[PendulumServoParameters, ...] = ()
    bench: BenchSpec = BenchSpec()

    @property
    def registers(self) -> dict[str, int]:
        """Registers that act on the motion, as they are set."""
        return self.bench.factory | dict(self.bench.registers)

    def truth(self) -> dict[str, Any]:
        """All true parameters as plain numbers and strings, ready for YAML."""
        truth = super().truth()
        for servo, loaded in zip(self.servos, self.loaded, strict=True):
            truth["joints"][servo.joint]["loaded_servo"] = loaded.truth()
            truth["joints"][servo.joint]["registers"] = self.registers
        return truth


class PendulumBench(ServosOnStand):
    """A `ServoPlant` of loaded servos, whose registers act."""

    def __init__(self, robot: BenchRobot):
        pose = robot.joint_map.rest_pose().tolist()
        spec = robot.bench
        self.acting_registers = tuple(spec.factory)
        self._model, self._supply_v = spec.model, spec.supply_v
        super().__init__(
            [
                PendulumServo(p, x, robot.registers, spec.factory, spec.loop)
                for p, x in zip(robot.loaded, pose, strict=True)
            ]
        )

    def servo_setups(self, joints: Sequence[str]) -> dict[str, dict[str, Any]]:
        """By joint, what a recording's header says of its servo."""
        setups = {}
        for joint, servo in zip(joints, self._servos, strict=True):
            registers = {name: servo.register(name) for name in self.acting_registers}
            prefix = "position_" if "position_p_gain" in registers else ""
            names = {f"{k}_gain": f"{prefix}{k}_gain" if prefix else k for k in ("p", "i", "d")}
            gains = {key: registers.pop(name) for key, name in names.items()}
            setups[joint] = {"model": self._model, **gains, "supply_voltage_v": self._supply_v}
            setups[joint] |= {"temperature_c": AMBIENT_C, "registers": registers}
        return setups

    def register(self, index: int, name: str) -> int:
        """Value of a register that acts on the motion."""
        return self._servos[index].register(name)

    def set_register(self, index: int, time_s: float, name: str, value: int) -> None:
        """Set a register of a servo from `time_s` on."""
        self._servos[index].set_register(time_s, name, value)


def has_registers(joint_map: JointMap) -> bool:
    """Whether the robot of a joint map is emulated with servos whose registers act."""
    return joint_map.file.servo == "STS3215"


def draw_of_map(
    rng: np.random.Generator, joint_map: JointMap, registers: Mapping[str, int] | None = None
) -> tuple[EmulatedRobot, PendulumBench | None]:
    """Draw the robot of a joint map, in free air, and what moves its servos.

    STS3215 are bare servos of a bench. Others move like the Mini Pupper's, with torque and speed of
    their data sheet.

    `registers` are of servos that have them (`has_registers`), where they differ from the
    factory's. What moves them is None for servos in free air as `EmulatedBus` has them.
    """
    if not has_registers(joint_map):
        return draw_robot(rng, directly_read(joint_map), joint_map), None
    spec = BenchSpec(registers=tuple((registers or {}).items()))
    robot = draw_bench(rng, spec=spec, joint_map=joint_map)
    return robot, PendulumBench(robot)


def draw_bench(
    rng: np.random.Generator,
    load: Pendulum | None = None,
    spec: BenchSpec | None = None,
    joint_map: JointMap | None = None,
) -> BenchRobot:
    """Draw servos on a bench, one per joint of the map, each with the same load.

    By default without a load, in free air, and one servo (`BENCH_MAP`).
    """
    spec, load = spec or BenchSpec(), load or Pendulum()
    layout = (joint_map or load_joint_map(BENCH_MAP)).per_servo()
    reading = replace(
        directly_read(layout),
        offset_sd_rad=spec.offset_sd_rad,
        reading_noise_rad=spec.reading_noise_rad,
    )
    drawn = draw_robot(rng, reading, layout)
    registers = spec.factory | dict(spec.registers)
    servos, loaded = [], []
    for servo in drawn.servos:
        factors = np.exp(spec.spread * rng.standard_normal(len(_SPREAD)))
        late = spec.dead_time_s + spec.dead_time_sd_s * rng.standard_normal()
        parameters = PendulumServoParameters(
            **{n: float(getattr(spec, n) * f) for n, f in zip(_SPREAD, factors, strict=True)},
            **asdict(load),
            dead_time_s=float(max(late, 2 * PHYSICS_STEP_S)),
            count_rad=reading.quantum_rad,
            backlash_rad=spec.backlash_rad,
            output_friction_nm=spec.output_friction_nm,
        )
        loaded.append(parameters)
        loop = spec.loop(registers, parameters)
        equivalent = DelayedPDParameters(  # moves alike for small errors
            stiffness=parameters.torque_nm * loop.p,
            damping=parameters.torque_nm * loop.d,
            friction_loss=parameters.friction_nm,
            armature=parameters.armature_kg_m2 + parameters.load_inertia_kg_m2,
            effort_limit=parameters.torque_nm * loop.most,
            velocity_limit=math.inf,
            dead_time_s=parameters.dead_time_s,
            back_emf=parameters.back_emf_nm_s_rad,
        )
        servos.append(replace(servo, actuator=equivalent))
    return BenchRobot(reading, tuple(servos), layout, tuple(loaded), spec)
