"""`pupper-play`: watch a policy walk, in a window or as a video."""

from __future__ import annotations

import importlib
import os
import sys
import time
import warnings
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a display; --viewer opens a window

import numpy as np
import tyro
from numpy.typing import NDArray

from pupper_sysid.cli import policy_choice
from pupper_sysid.cli.live_views import refuse_files
from pupper_sysid.cli.program import run_program
from pupper_sysid.cli.terminal import err, need_positive, out, seconds_progress, warn
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, replacing
from pupper_sysid.sim.robot.terrain import Terrain

DESCRIPTION = """Watch a policy walk in the simulator it was trained in.

Example: pupper-play runs/<name> --command 0.15 0 0 --video walk.mp4
"""


@dataclass(frozen=True)
class Play:
    """A walk, as video or in a window."""

    policy: Annotated[Path, tyro.conf.Positional]
    """A run (`runs/<name>`) or a policy folder."""
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s], clipped to what the policy was trained
    for."""
    seconds: float = 10.0
    """Duration."""
    video: Path | None = None
    """Write an .mp4 file."""
    rerun: Path | None = None
    """Write commands, readings and the robot's motion for Rerun, .rrd."""
    mcap: Path | None = None
    """Write commands and readings in ROS 2's messages for Foxglove, .mcap."""
    viewer: bool = False
    """Open a window."""
    actuator: str | None = None
    """Calibration, `paper`, `release` or `ideal` instead of what it was trained with."""
    feedback: str | None = None
    """`held`, `ideal` or a calibration instead of what it was trained with."""
    terrain: Terrain = "flat"
    """Kind of ground."""
    seed: int = 0
    """Of servos, friction, start and ground."""
    force: bool = False
    """Replace an existing video."""


def _run(options: Play) -> None:
    need_positive("--seconds", options.seconds)
    from pupper_sysid.policies.deploy.deployment import checked_command

    command = checked_command(options.command)
    if options.video:
        if options.video.suffix.lower() != ".mp4":
            raise InputError(f"--video {options.video}: give a name that ends in .mp4.")
        refuse_overwrite(options.video, options.force)
    refuse_files(options.force, rerun=options.rerun, mcap=options.mcap)
    import torch

    from pupper_sysid.policies.walks.together import evaluation_task
    from pupper_sysid.sim.walking.env import PupperEnv
    from pupper_sysid.sim.walking.servo_ranges import servo_model_of

    torch.set_num_threads(1)
    policy, run = policy_choice.policy_at(options.policy)
    task, servos = policy_choice.simulator(
        options.policy, policy, run, options.actuator, options.feedback
    )
    policy_choice.warn_of_fallbacks([servos])
    command = policy_choice.trained_commands(policy, run).clipped(command[None], err.print)[0]
    task = replace(evaluation_task(task, options.seconds + 1.0), terrain=options.terrain)
    model = servo_model_of(servos.source, task.control_step_s)
    env = PupperEnv(task, servos, 1, options.seed, 1, model)
    env.set_command(command)
    track = _Track(env)
    observation, _ = env.observe()
    policy.reset(env.action)
    start = env.robots.qpos[0, :2].copy()
    velocities, ended, away = [], "", np.zeros(2)
    step_s = task.control_step_s
    with ExitStack() as files, seconds_progress("walking", options.seconds) as advance:
        screen = _Screen(env, options, files)
        for step in range(1, round(options.seconds / step_s) + 1):
            action = policy.act(observation)
            stepped = env.step(action)
            observation = stepped.observation
            if stepped.done[0]:
                what = "Left the ground's edge" if stepped.timed_out[0] else "Fell"
                ended = f"{what} after {step * step_s:.1f} s."
                break
            away = env.robots.qpos[0, :2] - start
            facts = stepped.facts
            track.add(step * step_s, action)
            velocities.append([*facts.linear_velocity[0, :2], facts.angular_velocity[0, 2]])
            if not screen.show(step_s, np.array(velocities[-1])):
                break
            advance(step * step_s, options.seconds, "")
        screen.close()
    track.write(options)
    moved = np.mean(velocities, axis=0) if velocities else np.zeros(3)
    if ended:
        out.print(ended)
    out.print(
        "command {:.2f} m/s forward, {:.2f} m/s left, {:.2f} rad/s; mean ".format(*command)
        + "{:.2f}, {:.2f}, {:.2f}".format(*moved)
        + f"; {np.linalg.norm(away):.2f} m from the start"
    )


class _Track:
    """Commands, readings and poses of a walk, for other viewers."""

    def __init__(self, env: Any):
        self._env = env
        self._time_s: list[float] = []
        self._rows: list[tuple[NDArray[np.float64], ...]] = []

    def add(self, time_s: float, action: NDArray[np.floating]) -> None:
        """Keep one step."""
        env = self._env
        sent = env.set_points(np.asarray(action, float))[0]
        self._time_s.append(time_s)
        self._rows.append((sent, env.readings[0].copy(), env.robots.qpos[0].copy()))

    def write(self, options: Play) -> None:
        """Write the files that the options name."""
        if not self._rows or (options.rerun is None and options.mcap is None):
            return
        from pupper_sysid.policies.twin.drawing import bodies_over_time
        from pupper_sysid.sysid.recordings.recording import Recording
        from pupper_sysid.sysid.view import write_mcap, write_rerun

        time_s, joints = np.array(self._time_s), self._env.body.joints
        sent, read, qpos = (np.array(part) for part in zip(*self._rows, strict=True))
        # a command holds for the step that ends with the reading
        recording = Recording.from_arrays(
            time_s - self._env.config.control_step_s, dict(zip(joints, sent.T, strict=True)),
            dict(zip(joints, read.T, strict=True)), read_time_s=time_s,
            metadata={"bus": {"kind": "simulated", "coordinates": "joint"}}, name="walk",
        )  # fmt: skip
        if options.mcap is not None:
            write_mcap(recording, options.mcap, options.force)
        if options.rerun is not None:
            bodies = bodies_over_time(self._env.robots.batch.get_model(0), qpos)
            write_rerun(recording, options.rerun, time_s, bodies, options.force)
        for path in filter(None, (options.rerun, options.mcap)):
            err.print(f"Wrote {path}.")


class _Screen:
    """A video, a window, or nothing."""

    def __init__(self, env: Any, options: Play, files: ExitStack):
        self._env, self._path = env, options.video or Path()
        self._film: Any = None
        self._viewer: Any = None
        self._model = env.robots.batch.get_model(0)
        self._data: Any = None
        if options.viewer:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")  # without a display, a viewer ends the process
                    importlib.import_module("glfw").init()
                viewer = importlib.import_module("mujoco.viewer")
                self._data = env.robots.batch.get_data(0)
                self._viewer = viewer.launch_passive(self._model, self._data)
            except Exception as error:  # whatever the window system raises
                raise InputError(
                    f"No window could be opened ({error}). Use --video walk.mp4 instead."
                ) from error
        if not options.video:
            return
        from pupper_sysid.policies.walks.film import Film

        step_s, scale = env.config.control_step_s, env.body.scale
        lines = (f"{options.policy.name} on {Path(env.servos.source).name}",)
        try:
            with ExitStack() as opened:
                file = opened.enter_context(replacing(self._path, options.force, hold=False))
                self._film = Film(file, self._model, step_s, lines, options.command, scale)
                files.push(opened.pop_all())  # the file is kept if the walk is
        except InputError as error:
            if "imageio" in str(error):
                raise
            warn(f"{error} The walk goes on.")

    def show(self, span_s: float, velocity: NDArray[np.float64]) -> bool:
        """Show one more picture; False when the window was closed."""
        if self._viewer is None and self._film is None:
            return True
        self._data = self._env.robots.batch.get_data(0, self._data)
        mujoco: Any = importlib.import_module("mujoco")
        mujoco.mj_forward(self._model, self._data)
        if self._film is not None:
            self._film.add(self._data, velocity)
        if self._viewer is not None:
            if not self._viewer.is_running():
                return False
            self._viewer.sync()
            time.sleep(span_s)
        return True

    def close(self) -> None:
        """Finish the video."""
        if self._film is not None:
            self._film.close()
            err.print(f"Wrote {self._path}.")
        if self._viewer is not None:
            self._viewer.close()


main = partial(run_program, Play, _run, "pupper-play", DESCRIPTION)

if __name__ == "__main__":
    main()
