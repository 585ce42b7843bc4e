"""The servo under load: against DelayedPD, against MuJoCo, and against its compiled form."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pupper_sysid.servo_models import kernel
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.servo_models.loaded_servo import Load, LoadedServo, LoadedServoParameters
from pupper_sysid.sim.robot.servo_mjcf import free_air_xml, rest_at
from pupper_sysid.sysid.fit.structure import loaded_columns
from support.refusals import assert_each_refused

STEP_S = 0.002
SERVO = LoadedServoParameters(
    duty_per_rad=0.06, duty_s_per_rad=0.03, stall_torque=2.4, back_emf=0.35, armature=0.02,
    friction_loss=0.06, dead_time_s=0.0133,
)  # fmt: skip
EXTENDED = replace(
    SERVO, stribeck_friction=0.05, stribeck_speed=0.2, load_friction_motor=0.15,
    load_friction_load=0.1, load_friction_quadratic=0.03, load_friction_static=0.4,
    torque_limit=1.6, off_brake=0.2, dead_zone_rad=0.002, start_duty=0.01,
)  # fmt: skip
LOAD = Load(0.0049, 0.48, 0.05)


def commands(steps: int = 2000) -> np.ndarray:
    time = STEP_S * np.arange(steps)
    return 0.6 * np.sin(2.0 * time**2) + 0.5 * (time > 2.0)


def test_without_load_and_its_friction_it_is_delayed_pd():
    loaded = LoadedServo(SERVO, p_gain=16.0, time_step_s=STEP_S)
    plain = DelayedPD(SERVO.delayed_pd(16.0), STEP_S)
    loaded.reset(0.1)
    plain.reset(0.1)
    difference = loaded.rollout(commands()) - plain.rollout(commands())
    assert np.abs(difference).max() < 1e-9


def test_what_delayed_pd_lacks_is_named_and_a_negative_number_is_refused():
    assert SERVO.beyond_delayed_pd() == ()
    assert set(EXTENDED.beyond_delayed_pd()) == {
        "friction that grows with the motor's torque", "friction that grows with the load",
        "friction that grows with the squared torque", "friction that is larger at standstill",
        "the minimum start force", "the dead zone",
        "a torque limit below the stall torque at speed",
    }  # fmt: skip
    cases = [({"stall_torque": -1.0}, "stall_torque is -1")]
    assert_each_refused(cases, lambda change: LoadedServo(replace(SERVO, **change)))


def test_mujoco_swings_the_same_pendulum():
    servo, gain = SERVO, 16.0
    mass, length = 0.49, 0.1
    load = Load(mass * length**2, mass * 9.81 * length, 0.0)
    # a point mass on an arm in place of free air; at 0 it hangs straight down
    xml = free_air_xml([servo.delayed_pd(gain)], STEP_S)
    xml = xml.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"')
    xml = xml.replace('pos="0 0 0" mass="1e-9"', f'pos="0 0 {-length}" mass="{mass}"')
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rest_at(model, data, [0.0])
    own = LoadedServo(servo, gain, load, STEP_S)
    own.reset(0.0)
    found = own.rollout(commands())
    for k, command in enumerate(commands()):
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
        assert abs(data.qpos[0] - found[k]) < 1e-6, k


@pytest.mark.parametrize(
    ("servo", "ramp", "speed"),
    [(SERVO, np.inf, np.inf), (EXTENDED, 30.0, np.inf), (EXTENDED, 30.0, 1.5), (SERVO, np.inf, 1)],
)
def test_in_ever_shorter_steps_the_servo_becomes_the_compiled_one(
    servo: LoadedServoParameters, ramp: float, speed: float
):
    servo, start = replace(servo, acceleration_limit=ramp, velocity_limit=speed), -0.2
    command, on = commands(1500), np.ones(1500)
    on[900:] = 0.0
    volts = 1.0 + 0.1 * np.sin(np.arange(1500) / 50)

    def apart_rad(times: int) -> float:
        signals, step_s = [np.repeat(x, times) for x in (command, on, volts)], STEP_S / times
        model = LoadedServo(servo, 16.0, LOAD, step_s)
        model.reset(start)
        rest = 60 * times
        held = np.concatenate([np.array([[start], [1.0], [1.0]]).repeat(rest, 1), signals], axis=1)
        load = np.array([LOAD.inertia_kg_m2, LOAD.gravity_nm, LOAD.hanging_rad])
        compiled = kernel.positions(
            kernel.SERVO, loaded_columns(servo)[None], np.array([0.0133 / step_s]), held,
            kernel.edges_of(held[0]), 16.0, load, start, rest, step_s,
        )[1:, 0]  # fmt: skip
        return float(np.sqrt(np.mean((model.rollout(*signals) - compiled) ** 2)))

    assert apart_rad(8) < 0.35 * apart_rad(1) and apart_rad(8) < 5e-4


def test_a_limp_servo_falls_to_where_its_load_hangs():
    own = LoadedServo(replace(SERVO, friction_loss=0.03), 16.0, LOAD, STEP_S)
    own.reset(1.2)
    end = own.rollout(np.full(4000, 1.2), torque_on=0.0)[-1]
    assert abs(end - 0.05) < np.arcsin(0.03 / 0.48)  # dry friction holds it there


@pytest.mark.parametrize(
    ("speed", "lasts_s"), [(np.inf, 2 * np.sqrt(0.8 / 20.0)), (2.0, 0.8 / 2.0 + 2.0 / 20.0)]
)
def test_a_set_point_with_limited_acceleration_arrives_when_theory_says(speed, lasts_s):
    # from rest to rest over x with acceleration a and then -a takes 2 sqrt(x / a)
    stiff = replace(SERVO, duty_per_rad=5.0, stall_torque=50.0, back_emf=0.0, friction_loss=0.0,
                    dead_time_s=0.0, acceleration_limit=20.0, velocity_limit=speed)  # fmt: skip
    own = LoadedServo(stiff, 16.0, time_step_s=STEP_S)
    own.reset(0.0)
    found = own.rollout(np.full(500, 0.8))
    arrived = STEP_S * np.argmax(found > 0.99 * 0.8)
    assert arrived == pytest.approx(lasts_s, rel=0.1)
