"""A calibration for mjlab: a Python module of actuators and the feedback.

A class on mjlab's `Actuator` gives MuJoCo-Warp the torques of the servos, with delays of any
fraction of a step; beside it the released `BuiltinPositionActuatorCfg`, in whole steps. Names are
those of mjlab 1.3 to 1.6; `benchmarks/peers/check_exports.py` holds them against the released
packages.
"""

from __future__ import annotations

from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.servo_models.step_size import Engine
from pupper_sysid.sim.export.shared import NOT_CARRIED, ExportedServos, block, call, torch_module
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref

BUILTIN_PD = Engine(slews=False)
"""Position actuators of mjlab: MuJoCo's PD, set-points of unlimited speed."""

_IMPORTS = """\
from dataclasses import dataclass

import mujoco
from mjlab.actuator import Actuator, ActuatorCfg, BuiltinPositionActuatorCfg"""

_CODE = '''
@dataclass(kw_only=True)
class CalibratedServoCfg(ActuatorCfg):
    """Servos of all joints in SERVOS; a name may stand behind prefixes, as in `left/LF_hip`."""

    target_names_expr: tuple[str, ...] = tuple(f"(.*/)?{name}" for name in SERVOS)

    def build(self, entity, target_ids, target_names):
        return CalibratedServo(self, entity, target_ids, target_names)


class CalibratedServo(Actuator):
    """Motors with the torques of real servos, and their readings."""

    def edit_spec(self, spec, target_names):
        for target in target_names:
            servo, joint = SERVOS[target.split("/")[-1]], spec.joint(target)
            joint.armature, joint.frictionloss = servo["armature"], servo["friction_loss"]
            joint.solref_friction, joint.solimp_friction = FRICTION_SOLREF, FRICTION_SOLIMP
            for name in ("damping", "stiffness"):
                polynomial = hasattr(getattr(joint, name), "__len__")
                setattr(joint, name, [0.0, 0.0, 0.0] if polynomial else 0.0)
            joint.actfrclimited = False
            actuator = spec.add_actuator(name=target, target=target)
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
            actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
            actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
            actuator.gainprm[:], actuator.biasprm[:], actuator.gear[:] = 0.0, 0.0, 0.0
            actuator.gainprm[0] = actuator.gear[0] = 1.0
            actuator.inheritrange = 0.0
            actuator.ctrllimited = actuator.forcelimited = False
            self._mjs_actuators.append(actuator)

    def initialize(self, mj_model, model, data, device):
        super().initialize(mj_model, model, data, device)
        names = [name.split("/")[-1] for name in self.target_names]
        self.servos = ServoBank(SERVOS, FEEDBACK, names, data.nworld, PHYSICS_DT, device)

    def reset(self, env_ids=None):
        super().reset(env_ids)
        self.servos.restart(env_ids)

    def compute(self, cmd):
        return self.servos.efforts(cmd.position_target, cmd.pos, cmd.vel)


def held_joint_pos(env, entity="robot"):
    """Observation term: what the servos report, in place of the joint positions [rad]."""
    robot = env.scene[entity]
    (actuator,) = (a for a in robot.actuators if isinstance(a, CalibratedServo))
    return actuator.servos.read(robot.data.joint_pos[:, actuator.target_ids])


ACTUATORS = (CalibratedServoCfg(),)
"""For `EntityArticulationInfoCfg(actuators=ACTUATORS)`."""

'''


def to_mjlab(servos: ExportedServos) -> str:
    """A Python module with a class of servos, its configuration, and the feedback."""
    step_s = servos.physics_step_s
    groups, bounds = [], []
    for name, a in servos.actuators(BUILTIN_PD).items():
        steps = round(a.dead_time_s.value / step_s)
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
        low, high = whole_steps(*a.dead_time_interval_s, step_s)
        bounds.append(f'"{name}": ({low}, {high}),')
    cost_mrad = 1e3 * max(servos.whole_step_costs(BUILTIN_PD).values())
    notes = (
        "ACTUATORS holds one CalibratedServoCfg for all joints: delays of any fraction of a step, "
        "interpolated linearly, a latency of its own for each command where its jitter is known, "
        "the limit on the set-point's speed, and friction as hard as gears. Set the simulation's "
        "timestep to PHYSICS_DT and its integrator to implicitfast. Readings for the policy: "
        "`ObservationTermCfg(func=held_joint_pos)`; take velocities from their differences.",
        "WHOLE_STEP_ACTUATORS, BuiltinPositionActuatorCfg as it is released, has delays of the "
        f"nearest whole step: up to {cost_mrad:.1f} mrad off "
        "(RMS) at 4 Hz, 0.3 rad, and set-points of unlimited speed. The interval, rounded outward, "
        "is in DELAY_STEPS. The least and the greatest lag are equal on purpose: with two "
        "different ones mjlab draws a lag in every physics step, so that commands overtake each "
        "other; with delay_hold_prob=1, or a long delay_update_period, robots begin without delay. "
        "Its dry friction is MuJoCo's default, which lets a held joint creep: set solreffriction "
        "of the joints as the export to MJCF writes it.",
        NOT_CARRIED,
    )
    friction = (
        f"FRICTION_SOLREF = {list(friction_solref(step_s))!r}\n"
        f"FRICTION_SOLIMP = {list(FRICTION_SOLIMP)!r}\n"
        '"""Friction that stops a joint within one physics step, as gears do."""\n\n'
    )
    whole_step = (
        block("WHOLE_STEP_ACTUATORS", groups, "()")
        + '"""For `EntityArticulationInfoCfg(actuators=WHOLE_STEP_ACTUATORS)`, where the class '
        'cannot be used."""\n\n'
        + block("DELAY_STEPS", bounds)
        + '"""Least and greatest delay of each joint, in physics steps."""\n'
    )
    return torch_module(servos, "mjlab", notes, _IMPORTS, f"{friction}{_CODE}{whole_step}")
