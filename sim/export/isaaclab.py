"""A calibration for Isaac Lab: a Python module of actuators and the feedback.

Field names are those of Isaac Lab 2.3.2, which `benchmarks/peers/check_exports.py` holds against
the released package, and of 3.0, which renamed the limits of actuator models; the module written
finds out which of them is there.
"""

from __future__ import annotations

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.sim.export.shared import (
    EXPLICIT_PD,
    NOT_CARRIED,
    block,
    call,
    delays_at_step,
    origin,
    step_note,
    torch_module,
)

_LIMITS = '''
def _limits(**given):
    """Limits of the actuator model by the names that this Isaac Lab has: 3.0 renamed them."""
    renamed = "actuator_effort_limit" in DelayedPDActuatorCfg.__dataclass_fields__
    return {f"actuator_{name}" if renamed else name: value for name, value in given.items()}


'''


def to_isaaclab(calibration: Calibration, physics_step_s: float) -> str:
    """A Python module with a `DelayedPDActuatorCfg` per joint, and the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s, EXPLICIT_PD)
    groups = []
    for name, joint in calibration.joints.items():
        a = joint.actuator
        low, high = whole_steps(delays[name].low, delays[name].high, physics_step_s)
        made = call(
            "DelayedPDActuatorCfg",
            ("joint_names_expr", [name]),
            ("stiffness", a.stiffness_nm_per_rad, "stiffness_nm_per_rad"),
            ("damping", a.damping_nm_s_per_rad, "damping_nm_s_per_rad"),
            ("armature", a.armature_kg_m2, "armature_kg_m2"),
            ("friction", a.friction_loss_nm, "friction_loss_nm"),
            ("dynamic_friction", a.friction_loss_nm.value),
            ("viscous_friction", a.back_emf_nm_s_per_rad, "back_emf_nm_s_per_rad"),
            call(
                "**_limits",
                ("effort_limit", a.effort_limit_nm, "effort_limit_nm"),
                ("velocity_limit", a.velocity_limit_rad_s, "velocity_limit_rad_s"),
            ),
            ("min_delay", low),
            ("max_delay", high),
        )
        groups.append(f'"{name}": {made}')
    notes = (
        *origin(calibration),
        f"Delays are whole physics steps of {1e3 * physics_step_s:g} ms, the measured interval "
        "rounded outward; one delay is drawn per robot and reset, for each joint alone. Set "
        "sim.dt to this, or export again for its physics step.",
        *step_note(calibration, delays, physics_step_s),
        "friction is a torque from Isaac Sim 5.0 on; 4.5 takes a coefficient there, so leave the "
        "friction lines out with it. viscous_friction is the back-EMF, which brakes outside of the "
        "effort limit.",
        "Not carried over: the limit on the set-point's speed (velocity_limit is only "
        "stored by Isaac Lab, none of its PDs uses it) but for the lag it makes, and parts of a "
        "step. The PD here is computed once per physics step, before it: keep steps at 5 ms or "
        "less.",
        NOT_CARRIED,
    )
    return torch_module(
        calibration, "Isaac Lab", notes, "from isaaclab.actuators import DelayedPDActuatorCfg",
        physics_step_s,
        _LIMITS
        + block("ACTUATORS", groups)
        + '"""For `ArticulationCfg(actuators=ACTUATORS)`."""\n',
    )  # fmt: skip
