"""WarpRobots: the robots of `sim.robot.robot_batch`, with their physics on a Warp device.

Drawing, placing and writing robots is inherited from `RobotBatch`, by MuJoCo on the host, so that
both engines have one task. A control step sends commands, state and servos to the device, takes all
its physics steps there (on CUDA as one graph) and brings back what `RobotBatch` gives: positions,
torques and forces on the feet at each physics step. Delay lines and the solver's warm start stay
on the device. It computes in single precision; on CUDA the order of sums, and so the last bits, may
differ between runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.networks import JointArrays
from pupper_sysid.sim.gpu.worlds import Worlds
from pupper_sysid.sim.robot.robot_batch import Moved, RobotBatch
from pupper_sysid.sim.robot.terrain import Ground
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]

_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0")
"""What MuJoCo computes from masses, centres and rotor inertias, for the solver."""


class WarpRobots(RobotBatch):
    """Robots on one piece of ground, stepped by mujoco-warp; see `RobotBatch`.

    `device` has Warp's name: `cuda`, `cuda:1`, or `cpu` to try it.
    """

    def __init__(
        self,
        config: Walking,
        servos: ServoRanges,
        ground: Ground,
        environments: int,
        device: str,
        servo_model: JointArrays | None = None,
        extra_dead_time_s: float | Array = 0.0,
        extra_jitter_s: Array | None = None,
    ):
        super().__init__(
            config, servos, ground, environments, 1, servo_model, extra_dead_time_s, extra_jitter_s
        )
        self._hash += " on Warp"  # what follows a state is not exactly the same there
        for name in _DERIVED:
            if getattr(self.model, name).size:
                super().field(name)
        self._worlds = Worlds(self.model, self._fields, environments, config.substeps, device)
        self._host = {
            name: self.batch.bind(name) for name in ("history", "time", "qacc_warmstart", "act")
        }
        self._host_sites, self._site_position = self._site_position, self._site_position.copy()
        self._ahead = np.ones(environments, bool)  # rows that the host has written
        self._broken = np.zeros(environments, bool)

    def field(self, name: str) -> Array:
        """Live values of a model field that differs between robots, shape (n, …)."""
        if name not in self._fields:
            raise InputError(
                f"`{name}` is one value for all robots on a Warp device; those of each robot are "
                f"{', '.join(self._fields)}."
            )
        return self._fields[name]

    def move(self, ids: NDArray[np.intp], place: Array) -> None:
        """As `RobotBatch.move`."""
        super().move(ids, place)
        self._site_position[ids] = self._host_sites[ids]

    def place(
        self,
        ids: NDArray[np.intp],
        joints: Array,
        joint_velocity: Array,
        margin_m: float,
        rng: np.random.Generator,
    ) -> None:
        """As `RobotBatch.place`."""
        super().place(ids, joints, joint_velocity, margin_m, rng)
        self._ahead[ids] = True
        self._site_position[ids] = self._host_sites[ids]

    def broken(self) -> NDArray[np.bool_]:
        """Robots that have been reset in the last step, because they became NaN."""
        return self._broken.copy()

    @property
    def state(self) -> dict[str, Any]:
        """As `RobotBatch.state`."""
        behind = ~self._ahead
        for name, value in self._worlds.read().items():
            self._host[name][behind] = value[behind]
        return super().state

    def restore(self, state: dict[str, Any]) -> bool:
        """As `RobotBatch.restore`."""
        exact = super().restore(state)
        self._ahead[:] = True
        self._site_position[:] = self._host_sites
        return exact

    def _rollout(self, part: int, start: Array, control: Array | None) -> Moved:
        ahead = np.flatnonzero(self._ahead)
        if len(ahead):
            self._worlds.write(ahead, {name: values[ahead] for name, values in self._host.items()})
            self._ahead[:] = False
        self._worlds.write_fields(self._fields)
        commands = self._control if control is None else control
        moved = {
            name: values.astype(float)
            for name, values in self._worlds.advance(self.qpos, self.qvel, commands).items()
        }
        if control is not None:
            self._control[:] = control[:, -1]
        self.qpos[:], self.qvel[:] = moved["qpos"][:, -1], moved["qvel"]
        self._activation[:], self._site_position[:] = moved["act"], moved["site_xpos"]
        self._reset_broken(moved)
        touch = moved["sensordata"][:, -self._touch_steps :, self._touch].max(axis=1)
        feet = self._site_position[:, None, self._feet_sites]
        return Moved(self._parts[part], start, moved["qpos"], moved["actuator_force"], touch, feet)

    def _reset_broken(self, moved: dict[str, Array]) -> None:
        """Reset robots that became NaN, as MuJoCo does."""
        self._broken = ~np.isfinite(self.qpos.sum(axis=1) + self.qvel.sum(axis=1))
        ids = np.flatnonzero(self._broken)
        if len(ids):
            self.batch.reset(ids)
            self._ahead[ids] = True
            self._site_position[ids] = self._host_sites[ids]
            moved["qpos"][ids] = self.model.qpos0
            moved["actuator_force"][ids] = moved["sensordata"][ids] = 0.0
