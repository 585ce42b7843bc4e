"""An exported actuator module, run by Isaac Lab's own actuators: motion of free joints.

Called by `check_exports.py` in an environment with Isaac Lab's package, but without Isaac Sim:

    .venv-isaaclab/bin/python in_isaaclab.py EXPORTED.py commands.npz out.npz [...]

Arguments as of `in_newton.py`; `commands.npz` also has `solref` and `solimp` of hard friction.
Configuration and torques are Isaac Lab's. PhysX needs Isaac Sim and a GPU, so MuJoCo moves the
joints under these torques, with the exported armature, and the exported friction as hard as a
rigid body's.
"""

from __future__ import annotations

import importlib.util
import runpy
import sys
import types
from pathlib import Path

import mujoco
import numpy as np
import torch
from free_joints import model_of


def find_isaac_lab() -> None:
    """Make the package inside the wheel importable; its reader of assets needs Isaac Sim."""
    spec = importlib.util.find_spec("isaaclab")
    if spec is None or spec.origin is None:
        raise SystemExit("isaaclab is not installed here: run install.sh.")
    sys.path.insert(0, str(Path(spec.origin).parent / "source" / "isaaclab"))
    assets = types.ModuleType("isaaclab.utils.assets")
    assets.read_file = None  # of actuator networks, which are not used
    sys.modules[assets.__name__] = assets


def run(path: str, given: str, out: str) -> None:
    """Simulate and write."""
    from isaaclab.utils.types import ArticulationActions

    exported = runpy.run_path(path)
    data = np.load(given)
    command, step_s = data["command"], float(data["step_s"])
    names = list(exported["SERVOS"])
    cfg = exported["ACTUATORS"]["servos"]
    actuator = cfg.class_type(cfg, names, slice(None), 1, "cpu")
    actuator.reset(None)
    model = mujoco.MjModel.from_xml_string(model_of(names))
    model.opt.timestep, model.opt.integrator = step_s, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.dof_armature[6:] = actuator.armature[0].numpy()
    model.dof_frictionloss[6:] = actuator.friction[0].numpy()
    model.dof_damping[6:] = actuator.viscous_friction[0].numpy()
    model.dof_solref[6:], model.dof_solimp[6:] = data["solref"], data["solimp"]
    state = mujoco.MjData(model)
    mujoco.mj_setConst(model, state)  # friction's hardness goes by the inertia
    nothing = torch.zeros(1, len(names))
    positions, readings = np.zeros(command.shape), np.zeros(command.shape)
    for k, goals in enumerate(command):
        where, speed = (torch.tensor(v)[None].float() for v in (state.qpos[7:], state.qvel[6:]))
        action = ArticulationActions(torch.tensor(goals)[None].float(), nothing, nothing)
        efforts = actuator.compute(action, where, speed).joint_efforts
        state.qfrc_applied[6:] = efforts[0].numpy()
        mujoco.mj_step(model, state)
        positions[k] = state.qpos[7:]
        readings[k] = actuator.servos.read(torch.tensor(state.qpos[7:])[None].float())[0].numpy()
    np.savez(out, position=positions, reading=readings)


if __name__ == "__main__":
    find_isaac_lab()
    for job in zip(*[iter(sys.argv[1:])] * 3, strict=True):
        run(*job)
