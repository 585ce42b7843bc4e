"""A calibration with every kind of entry at least once, for the tests to save and to spoil."""

import math

from pupper_sysid.servo_models.calibration.calibration import Calibration, InputFile, utc_now
from pupper_sysid.servo_models.calibration.parts import (
    Actuator,
    CandidateModel,
    Feedback,
    JointCalibration,
    Lag,
    RatiosToArmature,
    Scale,
    Scores,
    Selection,
)
from pupper_sysid.servo_models.calibration.quantity import Quantity


def measured(value: float, half_width: float = 0.1) -> Quantity:
    low, high = value * (1 - half_width), value * (1 + half_width)
    return Quantity(value=value, low=low, high=high, identified="yes")


def scaled(value: float) -> Quantity:
    return Quantity(value=value, identified="ratio only", why="free air")


def joint_calibration(stiffness: float = 11.0) -> JointCalibration:
    """Every kind of entry at least once; values that binary floats cannot hold exactly."""
    return JointCalibration(
        actuator=Actuator(
            model="delayed_pd",
            stiffness_nm_per_rad=scaled(stiffness),
            damping_nm_s_per_rad=scaled(0.1),
            friction_loss_nm=scaled(0.2),
            armature_kg_m2=scaled(1.1e-5),
            effort_limit_nm=scaled(0.35),
            velocity_limit_rad_s=Quantity(value=7.6, identified="no", why="peak speed: 5.7 # low"),
            dead_time_s=measured(0.025),
            delay_steps_min=10,
            delay_steps_max=15,
            physics_step_s=0.002,
            ratios_to_armature=RatiosToArmature(
                stiffness=measured(12700.0),
                damping=measured(103.0),
                friction_loss=measured(207.0),
                effort_limit=measured(433.0),
            ),
            scale=Scale(anchor="stall torque", value_nm=0.35, source="datasheet: 0.35 N·m"),
        ),
        feedback=Feedback(
            poll_period_s=measured(0.02685),
            loss=measured(0.42),
            quantum_rad=measured(math.pi / 550),
            offset_rad=Quantity(value=-0.1, low=-0.2, high=0.3, identified="yes"),
            mean_age_s=measured(0.0329),
        ),
        lag=Lag(lag_s=measured(0.041), raw_lag_s=measured(0.081)),
        selection=Selection(
            model="delayed_pd",
            candidate_models=(
                CandidateModel(model="pure delay", parameter_count=3, rmse_fresh_rad=0.0254),
                CandidateModel(
                    model="delayed_pd", parameter_count=8, parameters={"dead_time_s": 0.1 + 0.2}
                ),
            ),
        ),
        scores=Scores(rmse_free_run_held_rad=0.0136, fit_percent=92.7),
        warnings=("yes", "1e5", "-", "a: b", "speed limit not excited & 'so' on"),
    )


def calibration(**joints: JointCalibration) -> Calibration:
    return Calibration(
        robot="Mini Pupper 2",
        created=utc_now(),
        inputs=(InputFile(name="sweep.csv", sha256="0" * 64),),
        seed=7,
        versions={"numpy": "2.0"},
        notes=("Null", "0x10"),
        joints=joints or {"LF_hip": joint_calibration()},
    )
