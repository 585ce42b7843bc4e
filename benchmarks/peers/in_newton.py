"""An exported servo module, run by Newton: motion of free joints behind a floating base.

Called by `check_exports.py` in Newton's own environment:

    .venv-newton/bin/python in_newton.py EXPORTED.py commands.npz out.npz [...]

`commands.npz` has `command` (steps, joints) [rad] and `step_s`; `out.npz` gets `position` of the
same shape, where each joint is after each step, and `reading`, what its servo reports.
"""

from __future__ import annotations

import runpy
import sys

import newton
import numpy as np
import torch
import warp as wp
from free_joints import model_of


def run(path: str, given: str, out: str) -> None:
    """Simulate and write."""
    exported = runpy.run_path(path)
    data = np.load(given)
    command, step_s = data["command"], float(data["step_s"])
    wp.config.quiet = True
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(model_of(list(exported["SERVOS"])))
    exported["add_servos"](builder)
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverMuJoCo(model, integrator="implicitfast", use_mujoco_cpu=True)
    now, then, control = model.state(), model.state(), model.control()
    servos = exported["Servos"](builder, model)
    positions, readings = np.zeros(command.shape), np.zeros(command.shape)
    for k, goals in enumerate(command):
        servos.command(torch.tensor(goals, dtype=torch.float32)[None], now, control)
        solver.step(now, then, control, None, step_s)
        now, then = then, now
        readings[k] = servos.read(now)[0].numpy()
        positions[k] = now.joint_q.numpy()[-command.shape[1] :]
    np.savez(out, position=positions, reading=readings)


if __name__ == "__main__":
    for job in zip(*[iter(sys.argv[1:])] * 3, strict=True):
        run(*job)
