"""A calibration for Newton: a Python module that puts the servos into a model and feeds them.

Armature and dry friction are attributes of Newton's joints. Dead times of any fraction of a step,
set-points of limited speed and the torques are computed on torch before each physics step, as
efforts: the joints' own drives clip their effort at the joint, where their damping goes on acting,
which makes a servo at its limit too slow (8 mrad on the sample's tones). Names are
those of Newton 1.3 to 1.8; `benchmarks/peers/check_exports.py` holds them against the releases.
"""

from __future__ import annotations

from pupper_sysid.sim.export.shared import NOT_CARRIED, ExportedServos, torch_module
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref

_IMPORTS = "import warp as wp"

_CODE = '''
def add_servos(builder):
    """Put the servos into a `newton.ModelBuilder` that has one robot; call it before replicating.

    Joints are found by name, the last part of their labels.
    """
    for name, servo in SERVOS.items():
        joint = _joint(builder.joint_label, name)
        dof = builder.joint_qd_start[joint]
        builder.joint_target_ke[dof] = builder.joint_target_kd[dof] = 0.0
        builder.joint_armature[dof] = servo["armature"]
        builder.joint_friction[dof] = servo["friction_loss"]
        builder.joint_damping[dof] = 0.0  # back-EMF is in the efforts
        builder.joint_target_mode[dof] = 0  # JointTargetMode.NONE: `Servos` gives the efforts
        for key, value in FRICTION.items():
            attribute = builder.custom_attributes.get(key)
            if attribute is not None:
                attribute.values = {} if attribute.values is None else attribute.values
                attribute.values[dof] = value


def _joint(labels, name):
    labels = [label.split("/")[-1] for label in labels]
    if labels.count(name) != 1:
        raise ValueError(f"{labels.count(name)} joints are called {name}; it must be one.")
    return labels.index(name)


class Servos:
    """Feeds the servos of all worlds of a finalised model, and reads them.

        servos = Servos(builder, model, num_worlds)
        servos.command(commands, state, control)    # before every physics step
        readings = servos.read(state)               # after it
        servos.restart(world_ids)                   # after these were reset

    Commands and readings have shape (worlds, joints), joints as in SERVOS [rad]. `builder` is the
    one that `add_servos` was given.
    """

    def __init__(self, builder, model, num_worlds=1):
        joints = [_joint(builder.joint_label, name) for name in SERVOS]
        self.at = [builder.joint_q_start[j] for j in joints]
        self.dof = [builder.joint_qd_start[j] for j in joints]
        self.worlds, device = num_worlds, str(wp.device_to_torch(model.device))
        self.bank = ServoBank(SERVOS, FEEDBACK, list(SERVOS), num_worlds, PHYSICS_DT, device)

    def command(self, commands, state, control):
        """Set the joints' efforts for the next physics step."""
        velocity = wp.to_torch(state.joint_qd).view(self.worlds, -1)[:, self.dof]
        efforts = wp.to_torch(control.joint_f).view(self.worlds, -1)
        efforts[:, self.dof] = self.bank.efforts(commands, self._position(state), velocity)

    def read(self, state):
        """What the servos report, in place of the joint positions."""
        return self.bank.read(self._position(state))

    def restart(self, world_ids=None):
        """Let worlds begin anew after their state was reset."""
        self.bank.restart(world_ids)

    def _position(self, state):
        return wp.to_torch(state.joint_q).view(self.worlds, -1)[:, self.at]
'''


def to_newton(servos: ExportedServos) -> str:
    """A Python module that puts servos into a `newton.ModelBuilder`, feeds and reads them."""
    notes = (
        "Take SolverMuJoCo with integrator='implicitfast' and steps of PHYSICS_DT. Delays are any "
        "fraction of a step, interpolated linearly, with a latency of its own for each command "
        "where its jitter is known; the set-point's speed is limited.",
        "Not represented by other solvers: friction as hard as gears.",
        NOT_CARRIED,
    )
    friction = (
        "FRICTION = {\n"
        f'    "mujoco:solreffriction": {friction_solref(servos.physics_step_s)!r},\n'
        f'    "mujoco:solimpfriction": {FRICTION_SOLIMP!r},\n'
        "}\n"
        '"""Friction that stops a joint within one physics step; of SolverMuJoCo."""\n\n'
    )
    return torch_module(servos, "Newton", notes, _IMPORTS, f"{friction}{_CODE}")
