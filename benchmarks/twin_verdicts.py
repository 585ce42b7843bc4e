"""Was the robot on the ground? Verdicts of the twin test on robots of which the truth is known.

Random emulated robots (`random_robots.py`) execute an open-loop trot or a sum of tones on all
joints, on the ground or held in the air (`sim.walking.robot`, steps of 1 ms), behind the emulated
bus: polled, lossy, quantised readings. In the air the trunk is tilted by 6° (standard deviation
about either axis), on the ground it weighs up to 20 % more or less, with a friction of 0.3 to 1.2.
Zeros of the joints are off by 0, 5 or 20 mrad, half of their variance common to a kind. The twin
test gets servos that are wrong: each ratio to the inertia by a factor (standard deviation of its
logarithm 0.2), dead times by 3 ms, all torques together by another factor (0.5).

    .venv/bin/python benchmarks/twin_verdicts.py --robots 60
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

from shared import print_rows  # isort: skip

import numpy as np
import tyro
from numpy.typing import NDArray
from random_robots import random_spec

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.policies.twin.drawing import Actuator, robot_for
from pupper_sysid.policies.twin.twin import twin
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import EmulatedRobot, draw_robot
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.robot import WalkingRobot
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, Plan, TrialPlan
from pupper_sysid.sysid.sweep.recorder import record

LOOP_S = 0.04
SECONDS = 12.0
SCALED = ("stiffness", "damping", "friction_loss", "effort_limit", "back_emf")
POSE = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])


def commands(rng: np.random.Generator, kind: str) -> Plan:
    """A trot in some direction, or tones on every joint."""
    if kind == "trot":
        trot = Trot(
            frequency_hz=float(rng.uniform(1.5, 3.3)), lift_m=float(rng.uniform(0.006, 0.02))
        )
        way = rng.uniform([-0.15, -0.08, -0.4], [0.15, 0.08, 0.4])[None]

        def offset(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
            t = np.maximum(np.asarray(time_s, float) - LEAD_IN_S, 0.0)
            phase = 2 * np.pi * trot.frequency_hz * t
            joints = trot.joints(phase, np.broadcast_to(way, (len(t), 3)))
            joints[:, 2::3] += joints[:, 1::3] - POSE[1]  # a calf's servo holds thigh + calf
            return np.minimum(t, 0.5)[:, None] / 0.5 * (joints - POSE)

    else:
        tone, turn = rng.uniform(0.3, 3.0, (3, 12)), rng.uniform(0, 2 * np.pi, (3, 12))
        size = rng.uniform(0.03, 0.12) * rng.uniform(0.3, 1.0, (3, 12))

        def offset(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
            t = np.maximum(np.asarray(time_s, float) - LEAD_IN_S, 0.0)[:, None, None]
            wave = (size * np.sin(2 * np.pi * tone * t + turn)).sum(axis=1)
            return np.minimum(t[:, 0], 0.5) / 0.5 * wave

    trial = TrialPlan(JOINT_NAMES, float("nan"), LEAD_IN_S + SECONDS, offset)
    return Plan((trial,), dict(DEFAULT_POSE), {"kind": kind})


class Placed(WalkingRobot):
    """A robot on the ground, or held in the air by its trunk."""

    def __init__(self, robot: EmulatedRobot, rng: np.random.Generator, ground: bool):
        self._ground, self._chance = ground, rng.spawn(1)[0]
        super().__init__(robot, rng)

    def _stand(self) -> None:
        model, rng = self._model, self._chance
        trunk = int(model.jnt_bodyid[0])
        if self._ground:
            model.body_mass[trunk] += rng.uniform(-0.2, 0.2) * model.body_subtreemass[trunk]
            model.geom_friction[:, 0] = rng.uniform(0.3, 1.2)
        else:  # so heavy that legs do not move it, and without weight
            model.body_mass[trunk], model.body_inertia[trunk] = 1e4, 1e2
            model.body_gravcomp[trunk] = 1.0
            tilt = rng.normal(0, np.radians(6.0), 2)
            self._data.qpos[2] += 1.0
            self._data.qpos[3:7] = [1.0, *(tilt / 2), 0.0] / np.sqrt(1 + (tilt**2).sum() / 4)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        super()._stand()


def recorded(
    robot: EmulatedRobot, rng: np.random.Generator, kind: str, ground: bool, zero_sd_rad: float
) -> tuple[Recording, bool]:
    """What the bus showed of the robot, and whether it stayed up."""
    plant = Placed(robot, rng.spawn(1)[0], ground)
    bus = EmulatedBus(robot, rng, plant=plant)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        record(bus, commands(rng, kind), path, loop_period_s=LOOP_S)
        walk = load(path)
    up = plant.trunk(LEAD_IN_S + SECONDS).upright > 0.5
    zero = dict(zip(JOINT_NAMES, zeros(rng, zero_sd_rad), strict=True))
    position = walk.table["position_rad"] + walk.table["joint"].map(zero)
    moved = walk.table.assign(position_rad=position)
    return Recording.from_frame(moved, metadata=walk.metadata), up


def zeros(rng: np.random.Generator, sd_rad: float) -> NDArray[np.float64]:
    """Zeros of all joints: half of their variance is common to a kind, mirrored on the right."""
    own, common = rng.normal(0, sd_rad / np.sqrt(2), (2, 4, 3))
    mirror = np.ones((4, 3))
    mirror[1::2, 0] = -1.0  # hips of the right legs
    return (own + mirror * common[0]).ravel()


def mistaken(robot: EmulatedRobot, rng: np.random.Generator) -> Actuator:
    """The robot's servos, as a calibration that is wrong."""
    values: dict[str, NDArray[np.float64]] = {
        f: np.array([float(np.asarray(getattr(s.actuator, f))) for s in robot.servos])
        for f in PARAMETER_KEYS
    }
    scale = np.exp(rng.normal(0, 0.5))
    for name in SCALED:
        values[name] = scale * values[name] * np.exp(rng.normal(0, 0.2))
    values["armature"] = scale * values["armature"]
    values["dead_time_s"] = np.maximum(values["dead_time_s"] + rng.normal(0, 0.003), 0.002)
    return Actuator(values, polled(robot), {})


def polled(robot: EmulatedRobot) -> Calibration:
    """A calibration whose feedback is the robot's."""
    base = load_calibration("paper")
    joints = {}
    for servo in robot.servos:
        own = base.joint(servo.joint)
        exact = {
            name: getattr(own.feedback, name).model_copy(
                update={"value": getattr(servo.feedback, name)}
            )
            for name in ("poll_period_s", "loss", "quantum_rad")
        }
        joints[servo.joint] = own.model_copy(
            update={"feedback": own.feedback.model_copy(update=exact)}
        )
    return base.model_copy(update={"joints": joints})


def tested(seed: int) -> tuple[tuple[str, str, float], str] | None:
    """Truth and verdict of one robot; None if it fell or was stopped."""
    rng = np.random.default_rng([20261124, seed])
    kind, ground = ("trot", "tones")[seed % 2], bool(seed // 2 % 2)
    zero = (0.0, 0.005, 0.02)[seed // 4 % 3]
    robot = draw_robot(rng, replace(random_spec(rng), offset_sd_rad=0.0))
    try:
        walk, up = recorded(robot, rng, kind, ground, zero)
    except SafetyStop:
        return None
    if not up:
        return None
    found = twin(walk, {"calibration": mistaken(robot, rng)}, robot_for(walk), copies=8, threads=1)
    evidence = found.models["calibration"].evidence
    assert evidence is not None
    return ("ground" if ground else "air", kind, 1e3 * zero), evidence.verdict


def main(robots: int = 60) -> None:
    """Print the verdicts by truth."""
    results = [tested(seed) for seed in range(robots)]
    counts: dict[tuple, Counter] = defaultdict(Counter)
    for truth, verdict in filter(None, results):
        counts[truth][verdict] += 1
    print(f"{results.count(None)} fell, or were stopped by the guard, and are left out.")
    verdicts = ("ground", "air", "cannot tell")
    print_rows(
        ("truth", "commands", "zeros mrad", *verdicts),
        ((*truth, *(own[v] for v in verdicts)) for truth, own in sorted(counts.items())),
    )


if __name__ == "__main__":
    tyro.cli(main)
