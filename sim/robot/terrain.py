"""The ground: flat, rough, hills, troughs, steps and stairs, as MJCF and as heights.

Simulations of a batch do not see each other, so one field of tiles serves all of them; a robot
starts on a tile and its episode ends (as a time-out) before the field does. Sizes follow the
paper's terrain: tiles of 8 m, 5 cm between heights, rough ground of 1 to 2 cm, slopes up to 8.5°.
Steps (not in the paper) are 3 to 10 mm high and rise, as all of a field of heights, over 5 cm.
Stairs (neither) are of boxes, so that their edges are sharp: three square pyramids on a plane.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sim.robot.mini_pupper import FLAT_GROUND

Array = NDArray[np.float64]

Terrain = Literal["flat", "rough", "slopes", "troughs", "steps", "stairs", "mixed"]

TILE_M, SPACING_M = 8.0, 0.05
_NEAR_M = 0.15  # how far a robot reaches from the middle of its trunk, legs below the knee aside
_PLATFORM_M = 0.6
_ROUGH_M = (0.01, 0.02)
_STEEPEST = 0.15
_TREAD_M, _RISER_M = 0.3, (0.003, 0.01)  # up to what a foot is lifted in the reference trot
STAIRS_M = {0.005: (-6.0, 0.0), 0.01: (0.0, 0.0), 0.015: (6.0, 0.0)}
"""Middle of the pyramid (x, y) by the height of its steps [m]."""
_LEVELS = 7
_TILES = {
    "rough": ("rough",) * 4,
    "slopes": ("slope",) * 4,
    "troughs": ("trough",) * 4,
    "steps": ("steps",) * 4,
    "mixed": ("flat", "rough", "slope", "trough"),
}


@dataclass(frozen=True)
class Ground:
    """A piece of ground, its middle at the origin."""

    xml: str
    assets: str
    """`xml` and `assets`: MJCF inside `<worldbody>` and `<asset>`."""
    heights: Array | None
    """Heights [m] at `SPACING_M`, row along y; None for a plane; shape (rows, columns)."""
    half_size_m: float
    """Distance of its edge from the origin; infinite for a plane."""
    boxes: Array = field(default_factory=lambda: np.zeros((0, 4)))
    """Square boxes on a plane: x and y of the middle, half of the width, height of the top [m];
    shape (k, 4)."""

    def height(self, x: Array, y: Array) -> Array:
        """Height [m] at positions [m], as MuJoCo sees it; at the edge beyond the edge.

        Each square between four heights is two triangles, which meet where x and y grow together.
        """
        if self.heights is None:
            return self._highest_box(x, y, 0.0)
        most = len(self.heights) - 1
        column = np.clip((x + self.half_size_m) / SPACING_M, 0, most - 1e-6)
        row = np.clip((y + self.half_size_m) / SPACING_M, 0, most - 1e-6)
        i, j = row.astype(int), column.astype(int)
        u, v = row - i, column - j
        h = self.heights
        near, far = h[i, j], h[i + 1, j + 1]
        beside = np.where(v >= u, h[i, j + 1], h[i + 1, j])
        more, less = np.maximum(u, v), np.minimum(u, v)
        return near + more * (beside - near) + less * (far - beside)

    def highest_near(self, x: Array, y: Array) -> Array | float:
        """An upper bound of the heights [m] within 15 cm of positions [m]."""
        highest = self._highest
        if highest is None:
            return self._highest_box(x, y, _NEAR_M) if len(self.boxes) else 0.0
        column, row = (
            np.clip((at + self.half_size_m) / SPACING_M, 0, len(highest) - 1).astype(int)
            for at in (x, y)
        )
        return highest[row, column]

    def _highest_box(self, x: Array, y: Array, near_m: float) -> Array:
        """Height of the highest box [m] at positions, or within `near_m` of them."""
        height = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        for at_x, at_y, half, top in self.boxes:
            over = np.maximum(np.abs(x - at_x), np.abs(y - at_y)) <= half + near_m
            np.maximum(height, top, out=height, where=over)
        return height

    @cached_property
    def _highest(self) -> Array | None:
        """Highest of the heights around each, in all squares within `_NEAR_M`."""
        if self.heights is None:
            return None
        # from the corner of its square, a position is at most one height farther
        reach = int(np.ceil(_NEAR_M / SPACING_M)) + 1
        padded = np.pad(self.heights, reach, mode="edge")
        for axis in (0, 1):
            windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=axis)
            padded = windows.max(axis=-1)
        return padded

    def fill(self, model: Any) -> None:
        """Write the heights into a compiled `mujoco.MjModel`."""
        if self.heights is not None:
            model.hfield_data[:] = (
                (self.heights - self.heights.min()) / _depth(self.heights)
            ).ravel()


def make_ground(kind: Terrain, rng: np.random.Generator) -> Ground:
    """Ground of one kind, its random parts drawn from `rng`."""
    if kind == "flat":
        return Ground(FLAT_GROUND, "", None, np.inf)
    if kind == "stairs":
        return _stairs()
    count = round(TILE_M / SPACING_M)
    tiles = [_tile(name, count, rng) for name in _TILES[kind]]
    heights = np.block([[tiles[0], tiles[1]], [tiles[2], tiles[3]]])
    heights = np.pad(heights, ((0, 1), (0, 1)), mode="edge")
    half = SPACING_M * (len(heights) - 1) / 2
    rows = len(heights)
    assets = (
        f'<hfield name="ground" nrow="{rows}" ncol="{rows}" '
        f'size="{half} {half} {_depth(heights)} 0.1"/>'
    )
    xml = (
        f'<geom name="ground" type="hfield" hfield="ground" pos="0 0 {heights.min()}" '
        'material="grid" contype="0" conaffinity="1"/>'
    )
    return Ground(xml, assets, heights, half)


def _stairs() -> Ground:
    """Pyramids of stairs at `STAIRS_M`."""
    boxes = np.array(
        [
            (*middle, _PLATFORM_M / 2 + (_LEVELS - 1 - k) * _TREAD_M, (k + 1) * riser)
            for riser, middle in STAIRS_M.items()
            for k in range(_LEVELS)
        ]
    )
    geoms = "".join(
        f'<geom type="box" pos="{x} {y} {top / 2}" size="{half} {half} {top / 2}" '
        'material="grid" contype="0" conaffinity="1"/>'
        for x, y, half, top in boxes.tolist()
    )
    return Ground(FLAT_GROUND + geoms, "", None, np.inf, boxes)


def _depth(heights: Array) -> float:
    return max(float(np.ptp(heights)), 1e-3)


def _tile(name: str, count: int, rng: np.random.Generator) -> Array:
    """Heights of one tile, 0 at its edge."""
    if name == "flat":
        return np.zeros((count, count))
    if name == "rough":
        inside = np.minimum(np.arange(count), np.arange(count)[::-1]) * SPACING_M >= 0.25
        return rng.choice(_ROUGH_M, (count, count)) * np.outer(inside, inside)
    x = (np.arange(count) + 0.5) * SPACING_M - TILE_M / 2
    far = np.maximum(np.abs(x)[:, None], np.abs(x)[None, :])
    pyramid = TILE_M / 2 - np.maximum(far, _PLATFORM_M / 2)
    if name == "steps":
        return np.floor(pyramid / _TREAD_M) * rng.uniform(*_RISER_M)
    slope = rng.uniform(0.3, 1.0) * _STEEPEST
    return pyramid * slope * (1 if name == "slope" else -1)
