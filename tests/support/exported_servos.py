"""Exported calibrations: field names of the released simulators, and a model around MJCF."""

from typing import Any

from pupper_sysid.sim.robot.engine import mujoco

# as released: isaaclab 2.3.2.post1, mjlab 1.6.0 (benchmarks/peers/check_exports.py reads them)
ISAACLAB = {
    "class_type", "joint_names_expr", "effort_limit", "velocity_limit", "effort_limit_sim",
    "velocity_limit_sim", "stiffness", "damping", "armature", "friction", "dynamic_friction",
    "viscous_friction", "min_delay", "max_delay",
}  # fmt: skip
ISAACLAB_3 = (ISAACLAB - {"effort_limit", "velocity_limit"}) | {
    "actuator_effort_limit", "actuator_velocity_limit", "joint_effort_limit",
    "joint_velocity_limit",
}  # fmt: skip
"""Of 3.0.0, without the names that are deprecated there."""
MJLAB = {
    "target_names_expr", "transmission_type", "armature", "frictionloss", "viscous_damping",
    "delay_min_lag", "delay_max_lag", "delay_hold_prob", "delay_update_period",
    "delay_per_env_phase", "stiffness", "damping", "effort_limit",
}  # fmt: skip


def in_free_air(snippet: str, names: tuple[str, ...]) -> Any:
    """A model of hinges without load that includes an exported file."""
    bodies = "".join(
        f'<body><joint name="{n}" class="servo_{n}" type="hinge" axis="0 1 0"/>'
        '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-15 1e-15 1e-15"/></body>'
        for n in names
    )
    text = (
        '<mujoco><include file="servos.xml"/><option gravity="0 0 0"/>'
        f"<worldbody>{bodies}</worldbody></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(text, {"servos.xml": snippet.encode()})
