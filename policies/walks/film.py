"""A walk as a video: the robot followed by camera, shadow and floor, its speeds written beside it.

Needs the extra `video` (imageio with ffmpeg; Pillow comes with matplotlib) and a library that draws
without a window (EGL or OSMesa, see `MUJOCO_GL`).
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.robot.engine import mujoco

SIZE = (720, 1280)
"""Height and width [pixels]."""
_AZIMUTH_DEG, _ELEVATION_DEG, _DISTANCE_M = 125.0, -18.0, 0.62
_HEIGHT_M = 0.06  # at which the camera looks
_HIDDEN_GROUP = 3  # of geoms, from which on MuJoCo draws none
_FOLLOW = 0.1  # share of the way to the robot that the camera goes with each picture
_MEAN_S = 1.0
_TEXT, _EDGE = (30, 34, 40), (255, 255, 255)


class Film:
    """An .mp4 file of one simulated robot, which runs as fast as the robot.

    The model is one of `physics="evaluation"`, which has shapes, a light and a floor; `step_s` is
    the time between pictures. Lines (policy, servos) and the command (forward and sideways speed
    [m/s], turn rate [rad/s]) are written into every picture; `scale` is the size of the robot over
    the Mini Pupper's (`sim.robot.body.Body.scale`).
    """

    def __init__(
        self, path: Path, model: Any, step_s: float, lines: Sequence[str], command: Sequence[float],
        scale: float = 1.0,
    ):  # fmt: skip
        frame = model.vis.global_  # of a user's model it may be smaller
        frame.offheight, frame.offwidth = np.maximum((frame.offheight, frame.offwidth), SIZE)
        try:
            self._renderer = mujoco.Renderer(model, *SIZE)
        except Exception as error:  # EGL, OSMesa and GLFW raise different errors
            raise InputError(
                f"No frames can be drawn here ({type(error).__name__}: {error}), so there is no "
                "video. Install EGL or OSMesa, or set MUJOCO_GL."
            ) from error
        try:
            imageio: Any = importlib.import_module("imageio.v2")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = imageio.get_writer(
                path, fps=1 / step_s, codec="libx264", macro_block_size=None
            )
        except (ImportError, ValueError, RuntimeError) as error:  # no imageio, or no ffmpeg
            raise InputError(
                "Writing video needs the package imageio: pip install 'pupper-sysid[video]'."
            ) from error
        self._model, self._step_s = model, step_s
        self._lines, self._command = tuple(lines), tuple(command)
        self._velocity: deque[NDArray[np.float64]] = deque(maxlen=max(1, round(_MEAN_S / step_s)))
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = _AZIMUTH_DEG, _ELEVATION_DEG
        self._camera.distance = _DISTANCE_M * scale
        self._height_m = _HEIGHT_M * scale
        self._shown = mujoco.MjvOption()
        if not (model.geom_group[model.geom_bodyid > 0] < _HIDDEN_GROUP).any():
            self._shown.geomgroup[:] = 1  # a robot without meshes is drawn as what collides
        self._pictures = 0

    def add(self, data: Any, velocity: NDArray[np.float64]) -> None:
        """One more picture.

        `data` has the positions of bodies as of now (`mj_forward`); the velocity, shape (3,), is
        forward and sideways speed [m/s], and turn rate [rad/s].
        """
        self._velocity.append(np.asarray(velocity, float))
        at, trunk = self._camera.lookat, data.qpos[:3]
        share = _FOLLOW if self._pictures else 1.0
        at[:2] += share * (trunk[:2] - at[:2])
        at[2] = self._height_m
        self._renderer.update_scene(data, camera=self._camera, scene_option=self._shown)
        self._writer.append_data(self._written(self._renderer.render()))
        self._pictures += 1

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def _written(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture with the caption beside the robot."""
        from matplotlib import font_manager
        from PIL import Image, ImageDraw, ImageFont

        if not hasattr(self, "_font"):
            self._font = ImageFont.truetype(font_manager.findfont("DejaVu Sans Mono"), 20)
        image = Image.fromarray(picture)
        drawn, mean = ImageDraw.Draw(image), np.mean(self._velocity, axis=0)
        speeds = "{:+9.2f} m/s {:+9.2f} m/s {:+9.2f} rad/s"
        rows = [
            *self._lines,
            f"{self._pictures * self._step_s:5.1f} s       forward          left            turn",
            f"command  {speeds.format(*self._command)}",
            f"last {_MEAN_S:g} s {speeds.format(*mean)}",
        ]
        for n, row in enumerate(rows):
            drawn.text(
                (28, 24 + 32 * n), row, fill=_TEXT, font=self._font, stroke_width=2,
                stroke_fill=_EDGE,
            )  # fmt: skip
        return np.asarray(image)
