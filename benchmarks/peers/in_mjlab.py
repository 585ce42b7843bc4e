"""An exported actuator module, run by mjlab: motion of free joints behind a floating base.

Called by `check_exports.py` in mjlab's own environment; arguments as `in_newton.py`:

    .venv-mjlab/bin/python in_mjlab.py EXPORTED.py commands.npz out.npz [...]
"""

from __future__ import annotations

import runpy
import sys

import mujoco
import numpy as np
import torch
import warp as wp
from free_joints import model_of
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim.sim import MujocoCfg, Simulation, SimulationCfg


def run(path: str, given: str, out: str) -> None:
    """Simulate and write."""
    exported = runpy.run_path(path)
    data = np.load(given)
    command, step_s = data["command"], float(data["step_s"])
    wp.config.quiet = True
    names = list(exported["SERVOS"])
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(model_of(names)),
        articulation=EntityArticulationInfoCfg(actuators=exported["ACTUATORS"]),
    )
    scene = Scene(SceneCfg(num_envs=1, entities={"robot": robot}), "cpu")
    options = MujocoCfg(timestep=step_s, integrator="implicitfast", gravity=(0.0, 0.0, 0.0))
    sim = Simulation(1, SimulationCfg(mujoco=options), scene.compile(), "cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    scene.reset()
    entity = scene["robot"]
    ids, _ = entity.find_joints(names, preserve_order=True)
    (actuator,) = entity.actuators
    positions, readings = np.zeros(command.shape), np.zeros(command.shape)
    for k, goals in enumerate(command):
        entity.set_joint_position_target(torch.tensor(goals, dtype=torch.float32)[None], ids)
        scene.write_data_to_sim()
        sim.step()
        scene.update(step_s)
        here = entity.data.joint_pos
        positions[k] = here[0, ids].cpu().numpy()
        readings[k] = actuator.servos.read(here[:, actuator.target_ids])[0].cpu().numpy()
    np.savez(out, position=positions, reading=readings)


if __name__ == "__main__":
    for job in zip(*[iter(sys.argv[1:])] * 3, strict=True):
        run(*job)
