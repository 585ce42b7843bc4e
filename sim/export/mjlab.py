"""A calibration for mjlab: a Python module of actuators and the feedback.

Field names are those of mjlab 1.6.0; `benchmarks/peers/check_exports.py` holds them against the
released package.
"""

from __future__ import annotations

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.servo_models.step_size import Engine
from pupper_sysid.sim.export.shared import (
    NOT_CARRIED,
    block,
    call,
    delays_at_step,
    origin,
    step_note,
    torch_module,
)

MJLAB_PD = Engine(slews=False)


def to_mjlab(calibration: Calibration, physics_step_s: float) -> str:
    """A Python module with a `BuiltinPositionActuatorCfg` per joint, and the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s, MJLAB_PD)
    groups, bounds = [], []
    for name, joint in calibration.joints.items():
        a = joint.actuator
        steps = round(delays[name].value / physics_step_s)
        groups.append(
            call(
                "BuiltinPositionActuatorCfg",
                ("target_names_expr", (name,)),
                ("stiffness", a.stiffness_nm_per_rad, "stiffness_nm_per_rad"),
                ("damping", a.damping_nm_s_per_rad, "damping_nm_s_per_rad"),
                ("effort_limit", a.effort_limit_nm, "effort_limit_nm"),
                ("armature", a.armature_kg_m2, "armature_kg_m2"),
                ("frictionloss", a.friction_loss_nm, "friction_loss_nm"),
                ("viscous_damping", a.back_emf_nm_s_per_rad, "back_emf_nm_s_per_rad"),
                ("delay_min_lag", steps),
                ("delay_max_lag", steps),
                ("delay_hold_prob", 0.0),
                ("delay_update_period", 0),
                ("delay_per_env_phase", False),
            )
        )
        low, high = whole_steps(delays[name].low, delays[name].high, physics_step_s)
        bounds.append(f'"{name}": ({low}, {high}),')
    notes = (
        *origin(calibration),
        f"Delays are whole physics steps of {1e3 * physics_step_s:g} ms, the nearest one; the "
        "interval, rounded outward, is in DELAY_STEPS.",
        *step_note(calibration, delays, physics_step_s),
        "The least and the greatest lag are equal on purpose. With two different ones mjlab draws "
        "a lag in every physics step, so that commands overtake each other; with "
        "delay_hold_prob=1, or with a long delay_update_period, robots begin without any delay.",
        "Not carried over: the limit on the set-point's speed, parts of a step, and the stiffness "
        "of dry friction (MuJoCo's default lets a held joint creep: set solreffriction of the "
        "joints as the export to MJCF writes it).",
        NOT_CARRIED,
    )
    return torch_module(
        calibration, "mjlab", notes, "from mjlab.actuator import BuiltinPositionActuatorCfg",
        physics_step_s,
        block("ACTUATORS", groups, "()")
        + '"""For `EntityArticulationInfoCfg(actuators=ACTUATORS)`."""\n\n'
        + block("DELAY_STEPS", bounds)
        + '"""Least and greatest delay of each joint, in physics steps."""\n',
    )  # fmt: skip
