"""An exported actuator module, run by Isaac Lab's own actuators: motion of free joints.

Called by `check_exports.py` in an environment with Isaac Lab's package, but without Isaac Sim:

    .venv-isaaclab/bin/python in_isaaclab.py EXPORTED.py commands.npz out.npz

Arguments as of `in_newton.py`; `commands.npz` also has `delay_steps` (joints,), which of the
exported delays to take, and `solref`, `solimp` of hard friction. Configuration, delay buffers and
torques are Isaac Lab's. PhysX needs Isaac Sim and a GPU, so MuJoCo moves the joints under these
torques, with the exported armature, and the exported friction as hard as a rigid body's.
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


def main() -> None:
    """Simulate and write."""
    path, given, out = sys.argv[1:]
    find_isaac_lab()
    from isaaclab.utils.types import ArticulationActions

    exported = runpy.run_path(path)
    data = np.load(given)
    command, step_s = data["command"], float(data["step_s"])
    names = list(exported["ACTUATORS"])
    actuators = []
    for name, steps in zip(names, data["delay_steps"], strict=True):
        cfg = exported["ACTUATORS"][name]
        if not cfg.min_delay <= steps <= cfg.max_delay:
            raise SystemExit(f"{name}: a delay of {steps} steps is not among the exported ones.")
        cfg.min_delay = cfg.max_delay = int(steps)
        actuator = cfg.class_type(cfg, [name], slice(None), 1, "cpu")
        actuator.reset(slice(None))
        actuators.append(actuator)
    model = mujoco.MjModel.from_xml_string(model_of(names))
    model.opt.timestep, model.opt.integrator = step_s, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.dof_armature[6:] = [float(a.armature) for a in actuators]
    model.dof_frictionloss[6:] = [float(a.friction) for a in actuators]
    model.dof_solref[6:], model.dof_solimp[6:] = data["solref"], data["solimp"]
    state = mujoco.MjData(model)
    mujoco.mj_setConst(model, state)  # friction's hardness goes by the inertia
    nothing = torch.zeros(1, 1)
    positions = np.zeros(command.shape)
    for k, goals in enumerate(command):
        for n, actuator in enumerate(actuators):
            where, speed = (
                torch.tensor([[float(v)]]) for v in (state.qpos[7 + n], state.qvel[6 + n])
            )
            told = ArticulationActions(torch.tensor([[goals[n]]]).float(), nothing, nothing)
            state.qfrc_applied[6 + n] = actuator.compute(told, where, speed).joint_efforts.item()
        mujoco.mj_step(model, state)
        positions[k] = state.qpos[7:]
    np.savez(out, position=positions)


if __name__ == "__main__":
    main()
