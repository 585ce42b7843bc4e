"""A bench: servos that swing a pendulum each, with settable registers, behind any emulated bus.

    robot = draw_bench(rng, Pendulum(0.1, 0.1))
    bus = EmulatedBus(robot, rng, plant=PendulumBench(robot))

The defaults are an STS3215 at 7.4 V, to the accuracy to which published models agree. The truth
beside a recording has `loaded_servo`, the numbers of `PendulumServoParameters`, and `actuator`, the
DelayedPD servo that is equivalent at the factory's gains where nothing saturates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pupper_sysid.common.data_sheet import no_load_speed, stall_torque
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.bench import AMBIENT_C, SUPPLY_V, ServosOnStand
from pupper_sysid.sim.emulator.pendulum import (
    DYNAMIXEL_GAINS,
    FEETECH_REGISTERS,
    PHYSICS_STEP_S,
    Loop,
    PendulumServo,
    PendulumServoParameters,
    dynamixel_loop,
    dynamixel_registers,
    feetech_loop,
)
from pupper_sysid.sim.emulator.robot import EmulatedRobot, EmulatedServo, directly_read, draw_robot

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


def dynamixel_bench(model: str, registers: Mapping[str, int] | None = None) -> BenchSpec:
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
        registers=tuple((registers or {}).items()),
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
        found = super().truth()
        for servo, loaded in zip(self.servos, self.loaded, strict=True):
            found["joints"][servo.joint]["loaded_servo"] = loaded.truth()
            found["joints"][servo.joint]["registers"] = self.registers
        return found


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
        found = {}
        for joint, servo in zip(joints, self._servos, strict=True):
            own = {name: servo.register(name) for name in self.acting_registers}
            prefix = "position_" if "position_p_gain" in own else ""
            names = {f"{k}_gain": f"{prefix}{k}_gain" if prefix else k for k in ("p", "i", "d")}
            gains = {key: own.pop(name) for key, name in names.items()}
            found[joint] = {"model": self._model, **gains, "supply_voltage_v": self._supply_v}
            found[joint] |= {"temperature_c": AMBIENT_C, "registers": own}
        return found

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

    Parameters
    ----------
    rng : numpy.random.Generator
    joint_map : JointMap
    registers : mapping of str to int, optional
        Of servos that have them (`has_registers`), where they differ from the factory's.

    Returns
    -------
    (EmulatedRobot, PendulumBench or None)
        None for servos in free air as `EmulatedBus` has them.
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

    Parameters
    ----------
    rng : numpy.random.Generator
    load : Pendulum, optional
        Default: none, in free air.
    spec : BenchSpec, optional
    joint_map : JointMap, optional
        Default: one servo, `BENCH_MAP`.
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
        torque, duty, emf, friction, armature = np.exp(spec.spread * rng.standard_normal(5))
        late = spec.dead_time_s + spec.dead_time_sd_s * rng.standard_normal()
        own = PendulumServoParameters(
            torque_nm=float(spec.torque_nm * torque),
            duty_per_rad=float(spec.duty_per_rad * duty),
            back_emf_nm_s_rad=float(spec.back_emf_nm_s_rad * emf),
            friction_nm=float(spec.friction_nm * friction),
            armature_kg_m2=float(spec.armature_kg_m2 * armature),
            dead_time_s=float(max(late, 2 * PHYSICS_STEP_S)),
            mass_kg=load.mass_kg,
            length_m=load.length_m,
            arm_mass_kg=load.arm_mass_kg,
            hanging_rad=load.hanging_rad,
            count_rad=reading.quantum_rad,
            backlash_rad=spec.backlash_rad,
            output_friction_nm=spec.output_friction_nm,
        )
        loaded.append(own)
        servos.append(_equivalent(servo, own, spec.loop(registers, own)))
    return BenchRobot(reading, tuple(servos), layout, tuple(loaded), spec)


def _equivalent(servo: EmulatedServo, own: PendulumServoParameters, loop: Loop) -> EmulatedServo:
    """`servo` with the DelayedPD servo that moves alike for small errors."""
    actuator = DelayedPDParameters(
        stiffness=own.torque_nm * loop.p,
        damping=own.torque_nm * loop.d,
        friction_loss=own.friction_nm,
        armature=own.armature_kg_m2 + own.load_inertia_kg_m2,
        effort_limit=own.torque_nm * loop.most,
        velocity_limit=math.inf,
        dead_time_s=own.dead_time_s,
        back_emf=own.back_emf_nm_s_rad,
    )
    return replace(servo, actuator=actuator)
