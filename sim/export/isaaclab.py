"""A calibration for Isaac Lab: a Python module of actuators and the feedback.

`to_isaaclab` writes a class based on Isaac Lab's `IdealPDActuator`: delays are any fraction of a
step, and the speed of set-points is limited; beside it the released `DelayedPDActuatorCfg`, in
whole steps. `to_isaaclab_bam` writes `BamActuatorCfg`, for servos that were fitted under load.

Field names are those of Isaac Lab 2.2 to 3.0, which `benchmarks/peers/check_exports.py` holds
against the released packages; 3.0 renamed the limits of actuator models, and the module written
finds out which names are there. `BamActuatorCfg` is that of Isaac Lab after 3.0.0.
"""

from __future__ import annotations

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.cards.files import motor_of
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.sim.export.shared import (
    EXPLICIT_PD,
    NOT_CARRIED,
    ExportedServos,
    block,
    call,
    docstring,
    feedback_block,
    torch_module,
)

_IMPORTS = """\
from isaaclab.actuators import DelayedPDActuatorCfg, IdealPDActuator, IdealPDActuatorCfg
from isaaclab.utils import configclass"""

_CODE = '''
class CalibratedServo(IdealPDActuator):
    """Torques of real servos, and the readings that they give."""

    def __init__(self, cfg, joint_names, *args, **kwargs):
        super().__init__(cfg, joint_names, *args, **kwargs)
        self.servos = ServoBank(
            SERVOS, FEEDBACK, list(joint_names), self._num_envs, PHYSICS_DT, self._device
        )

    def reset(self, env_ids):
        super().reset(env_ids)
        self.servos.restart(env_ids)

    def compute(self, control_action, joint_pos, joint_vel):
        self.computed_effort = self.servos.efforts(
            control_action.joint_positions, joint_pos, joint_vel
        )
        self.applied_effort = control_action.joint_efforts = self.computed_effort
        control_action.joint_positions = control_action.joint_velocities = None
        return control_action


@configclass
class CalibratedServoCfg(IdealPDActuatorCfg):
    class_type: type = CalibratedServo


def held_joint_pos(env, entity="robot", group="servos"):
    """Observation term: what the servos report, in place of the joint positions [rad]."""
    robot = env.scene[entity]
    actuator = robot.actuators[group]
    return actuator.servos.read(robot.data.joint_pos[:, actuator.joint_indices])


def _limits(**limits):
    """Limits of the actuator model by the names that this Isaac Lab has: 3.0 renamed them."""
    renamed = "actuator_effort_limit" in DelayedPDActuatorCfg.__dataclass_fields__
    return {f"actuator_{name}" if renamed else name: value for name, value in limits.items()}


def _by_joint(key):
    return {name: servo[key] for name, servo in SERVOS.items()}


ACTUATORS = {
    "servos": CalibratedServoCfg(
        joint_names_expr=list(SERVOS),
        stiffness=_by_joint("stiffness"),
        damping=_by_joint("damping"),
        armature=_by_joint("armature"),
        friction=_by_joint("friction_loss"),
        dynamic_friction=_by_joint("friction_loss"),
        viscous_friction=0.0,  # back-EMF is in the torques
        **_limits(
            effort_limit=_by_joint("effort_limit"),
            velocity_limit=_by_joint("velocity_limit_rad_s"),
        ),
    ),
}
"""For `ArticulationCfg(actuators=ACTUATORS)`."""

'''


def to_isaaclab(servos: ExportedServos) -> str:
    """A Python module with a class of servos, its configuration, and the feedback."""
    step_s = servos.physics_step_s
    groups = []
    for name, a in servos.actuators(EXPLICIT_PD).items():
        low, high = whole_steps(*a.dead_time_interval_s, step_s)
        group = call(
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
        groups.append(f'"{name}": {group}')
    cost_mrad = 1e3 * max(servos.whole_step_costs().values())
    notes = (
        "ACTUATORS holds one group of CalibratedServo: delays of any fraction of a step, "
        "interpolated linearly, a latency of its own for each command where its jitter is known, "
        "and the limit on the set-point's speed. Set sim.dt to PHYSICS_DT. Readings for the "
        "policy: `ObservationTermCfg(func=held_joint_pos)`; take velocities from differences of "
        "them.",
        "WHOLE_STEP_ACTUATORS, DelayedPDActuatorCfg as it is released, has delays of whole steps: "
        "the measured interval rounded outward, one delay drawn per robot and reset. The nearest "
        f"whole step is up to {cost_mrad:.1f} mrad off (RMS) at 4 Hz, "
        "0.3 rad, and the set-point's speed is not limited.",
        "friction is a torque from Isaac Sim 5.0 on; 4.5 takes a coefficient there, so leave the "
        "friction lines out with it. viscous_friction of WHOLE_STEP_ACTUATORS is the back-EMF, "
        "which brakes outside of the effort limit.",
        NOT_CARRIED,
    )
    whole_step = (
        block("WHOLE_STEP_ACTUATORS", groups)
        + '"""For `ArticulationCfg(actuators=WHOLE_STEP_ACTUATORS)`, where the class cannot be '
        'used."""\n'
    )
    return torch_module(servos, "Isaac Lab", notes, _IMPORTS, f"{_CODE}{whole_step}")


_BAM_IMPORTS = '''\
from isaaclab import actuators
from isaaclab.actuators import BamActuatorCfg


def _servo(motor, **settings):
    """A servo by the names that this Isaac Lab has for its motor's numbers."""
    fields = BamActuatorCfg.__dataclass_fields__
    if "motor" in fields:
        return BamActuatorCfg(motor=actuators.BamMotorCfg(**motor), **settings)
    if "parameter_overrides" in fields:
        numbers = {name: value for name, value in motor.items() if name != "model"}
        return BamActuatorCfg(parameter_overrides=numbers, **settings)
    raise ImportError("BamActuatorCfg of this Isaac Lab has neither motor nor parameter_overrides.")
'''


def to_isaaclab_bam(servos: ExportedServos) -> str:
    """A Python module with Isaac Lab's `BamActuatorCfg` per joint: motor, friction, delay."""
    step_s, stepped, groups = servos.physics_step_s, servos.actuators(), []
    lost: dict[str, list[str]] = {}
    for name, joint in servos.calibration.joints.items():
        if joint.servo is None:
            raise InputError(
                f"{name} was not fitted under load, so its motor's kt and R are unknown; export it "
                "to isaaclab, or record it with a known load."
            )
        loaded = joint.servo
        motor, beyond = motor_of(loaded)
        for words in beyond:
            lost.setdefault(words, []).append(name)
        steps = round(stepped[name].dead_time_s.value / step_s)
        group = call(
            "_servo",
            call("motor=dict", *motor.items()),
            ("joint_names_expr", [name]),
            ("kp_fw", loaded.p_gain),
            ("vin", loaded.reference_voltage_v or 1.0),
            ("armature", joint.actuator.armature_kg_m2, "armature_kg_m2"),
            ("min_delay", steps),
            ("max_delay", steps),
        )
        groups.append(f'"{name}": {group}')
    notes = (
        "For Isaac Lab after 3.0.0 with use_newton_actuators=True and Newton's MuJoCo solver. kt "
        "and R follow from stall torque and back-EMF at the supply voltage vin (1 V stands where "
        "the recording states none: only their ratio to it matters then).",
        "Delays are the nearest whole physics step: up to "
        f"{1e3 * max(servos.whole_step_costs().values()):.1f} mrad off (RMS) at 4 Hz, 0.3 rad.",
        *(f"Not represented: {words} ({', '.join(names)})." for words, names in lost.items()),
        "Not represented: backlash, which a calibration does not hold (`pupper-sysid backlash` "
        "measures it; give it as a play hinge), and the readings: see FEEDBACK, and HeldFeedback "
        "of the export to isaaclab.",
    )
    return (
        f"{docstring('Servos for Isaac Lab, as BAM models.', servos.head(EXPLICIT_PD, *notes))}\n"
        f"{_BAM_IMPORTS}\n\n{block('ACTUATORS', groups)}"
        '"""For `ArticulationCfg(actuators=ACTUATORS)`."""\n\n'
        f"{feedback_block(servos.calibration)}"
    )
