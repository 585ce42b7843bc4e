"""Servos that several tests simulate."""

from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters

MEASURED = DelayedPDParameters(
    stiffness=10.3,
    damping=0.083,
    friction_loss=0.167,
    armature=8.08e-4,
    effort_limit=0.35,
    velocity_limit=7.6,
    dead_time_s=0.025,
)
"""Pooled fit of the published recordings of a Mini Pupper 2."""
