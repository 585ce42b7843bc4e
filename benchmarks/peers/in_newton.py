"""An exported servo module, run by Newton: motion of free joints behind a floating base.

Called by `check_exports.py` in Newton's own environment:

    .venv-newton/bin/python in_newton.py EXPORTED_FOLDER commands.npz out.npz

`commands.npz` has `command` (steps, joints) [rad] and `step_s`; `out.npz` gets `position` of the
same shape: where each joint is after each step.
"""

from __future__ import annotations

import sys

import newton
import numpy as np
import warp as wp
from free_joints import model_of


def main() -> None:
    """Simulate and write."""
    folder, given, out = sys.argv[1:]
    sys.path.insert(0, folder)
    import newton_actuators as exported

    data = np.load(given)
    command, step_s = data["command"], float(data["step_s"])
    wp.config.quiet = True
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_mjcf(model_of(list(exported.SERVOS)))
    exported.add_actuators(builder)
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverMuJoCo(model, integrator="implicitfast", use_mujoco_cpu=True)
    now, then, control = model.state(), model.state(), model.control()
    memory = [(a.state(), a.state()) for a in model.actuators]
    target = np.zeros(control.joint_target_q.shape, np.float32)
    positions = np.zeros(command.shape)
    for k, goals in enumerate(command):
        target[-len(goals) :] = goals
        control.joint_target_q.assign(target)
        control.joint_f.zero_()
        for n, actuator in enumerate(model.actuators):
            actuator.step(now, control, *memory[n], dt=step_s)
            memory[n] = memory[n][::-1]
        solver.step(now, then, control, None, step_s)
        now, then = then, now
        positions[k] = now.joint_q.numpy()[-len(goals) :]
    np.savez(out, position=positions)


if __name__ == "__main__":
    main()
