"""The robot on which `in_newton.py` and `in_mjlab.py` run exported servos."""

from __future__ import annotations


def model_of(names: list[str]) -> str:
    """MJCF of hinges without load on a base of a quadruped's mass that floats without gravity."""
    bodies = "".join(
        f'<body name="{n}_link" pos="0 0 {k + 1}"><joint name="{n}" axis="0 0 1"/>'
        '<inertial pos="0 0 0" mass="1e-5" diaginertia="1e-9 1e-9 1e-9"/></body>'
        for k, n in enumerate(names)
    )
    return (
        '<mujoco><option gravity="0 0 0"/><worldbody><body name="base"><freejoint/>'
        f'<geom type="box" size=".5 .5 .5" mass="12"/>{bodies}</body></worldbody></mujoco>'
    )
