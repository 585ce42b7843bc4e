"""DelayedPD is MuJoCo's native servo, step for step, and free-air data fix only ratios."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_mjcf import actuator_attributes, free_air_xml, rest_at
from support.refusals import assert_each_refused
from support.servo_parameters import MEASURED

H = 0.002
PAPER = DelayedPDParameters(
    stiffness=70.0,
    damping=1.2,
    friction_loss=0.03,
    armature=0.005,
    effort_limit=5.0,
    velocity_limit=10.5,
    dead_time_s=0.076,
)
TIME = np.arange(1000) * H
SINE = 0.3 * np.sin(2 * np.pi * 3 * TIME)
STEPS = np.select([TIME < 0.1, TIME < 0.8, TIME < 1.4], [0.0, 0.3, -0.5], 0.1)


def native(servo: DelayedPDParameters, commands: np.ndarray, start: float = 0.0) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(free_air_xml([servo], H))
    data = mujoco.MjData(model)
    rest_at(model, data, [start])
    positions = []
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
        positions.append(data.qpos[0])
    return np.array(positions)


def ours(servo: DelayedPDParameters, commands: np.ndarray, start: float = 0.0) -> np.ndarray:
    model = DelayedPD(servo, H)
    model.reset(np.array(start))
    return model.rollout(commands)


SERVOS = {
    "measured": MEASURED,
    "fractional delay": replace(MEASURED, dead_time_s=0.0273),
    "one step of delay": replace(MEASURED, dead_time_s=H),
    "no delay": replace(MEASURED, dead_time_s=0.0),
    "no friction": replace(MEASURED, friction_loss=0.0),
    "paper": PAPER,
    "torque always saturated": replace(MEASURED, effort_limit=0.19),
    "slow set-point": replace(MEASURED, velocity_limit=2.0),
    "back-EMF": replace(MEASURED, velocity_limit=np.inf, back_emf=0.35 / 8.0),
    "back-EMF and a slow set-point": replace(MEASURED, velocity_limit=2.0, back_emf=0.35 / 5.0),
    "no limits": replace(MEASURED, effort_limit=np.inf, velocity_limit=np.inf),
}


@pytest.mark.parametrize("servo", SERVOS.values(), ids=SERVOS.keys())
def test_numpy_servo_equals_mujocos_native_servo(servo):
    for commands, start in ((SINE, 0.785), (STEPS, 0.0)):
        expected = native(servo, start + commands, start)
        assert np.ptp(expected) > 0.05, "the servo must move for this to be a comparison"
        found = ours(servo, start + commands, start)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_step_by_step_equals_rollout_and_reset_forgets_everything():
    model = DelayedPD(MEASURED, H)
    model.reset(np.array(0.2))
    whole = model.rollout(0.2 + SINE)
    model.reset(np.array(0.2))
    np.testing.assert_array_equal([model.step(c) for c in 0.2 + SINE], whole)
    model.reset(np.array(0.2))
    halves = np.concatenate([model.rollout(0.2 + SINE[:333]), model.rollout(0.2 + SINE[333:])])
    np.testing.assert_array_equal(halves, whole)


def test_a_batch_of_servos_moves_as_each_of_them_alone():
    delays, friction = np.array([0.0, 0.011, 0.0273]), np.array([[0.0], [0.1]])
    batch = DelayedPD(replace(MEASURED, dead_time_s=delays, friction_loss=friction), H)
    together = batch.rollout(np.broadcast_to(STEPS[:, None, None], (len(STEPS), 2, 3)))
    for i, j in np.ndindex(2, 3):
        one = replace(MEASURED, dead_time_s=delays[j], friction_loss=friction[i, 0])
        np.testing.assert_array_equal(together[:, i, j], ours(one, STEPS))


def test_only_ratios_to_the_inertia_matter():
    for other in (MEASURED.per_inertia(), MEASURED.scaled(0.0055)):
        np.testing.assert_allclose(ours(other, STEPS), ours(MEASURED, STEPS), atol=1e-9)
    assert np.asarray(MEASURED.scaled(0.0055).armature) == 0.0055
    assert MEASURED.per_inertia().effort_limit == pytest.approx(0.35 / 8.08e-4)


def test_impossible_numbers_are_refused_by_name():
    cases = [
        ("stiffness", -1.0), ("armature", 0.0), ("dead_time_s", np.nan),
        ("friction_loss", np.array([0.1, -0.1])), ("effort_limit", np.nan),
        ("velocity_limit", -7.5),
    ]  # fmt: skip
    numbers = [({name: value}, name) for name, value in cases]
    assert_each_refused(numbers, lambda change: DelayedPD(replace(MEASURED, **change)))
    steps = [(step, "time_step_s") for step in (0.0, -0.002, np.nan, np.inf)]
    assert_each_refused(steps, lambda step: DelayedPD(MEASURED, step))
    delays = [(delay, "dead_time_s") for delay in (-0.001, np.nan, np.inf)]
    assert_each_refused(
        delays, lambda delay: actuator_attributes(replace(MEASURED, dead_time_s=delay), H)
    )
