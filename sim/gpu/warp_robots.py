# pyright: reportInvalidTypeForm=false
"""WarpRobots: the robots of `sim.robot.robot_batch`, with their physics on a Warp device.

Drawing, placing and writing robots is inherited from `RobotBatch`, by MuJoCo on the host, so that
both engines have one task. A control step sends commands, state and servos to the device, takes all
its physics steps there (on CUDA as one graph) and brings back what `RobotBatch` gives: positions,
torques and forces on the feet at each physics step. Delay lines and the solver's warm start stay
on the device. It computes in single precision; on CUDA the order of sums, and so the last bits, may
differ between runs.

mujoco-warp has no `<pid>` actuator and no PGS. The servo is an integrator with mujoco-warp's delay
line, and a kernel that limits the set-point's speed and computes the torque, as MuJoCo's `<pid>`
does; Newton's method solves the constraints. Warp and mujoco-warp, the extra `gpu`, are imported
where a device is requested.
"""

# no `from __future__ import annotations`: Warp reads the annotations of its kernels
from copy import copy
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.networks import JointArrays
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.robot_batch import Moved, RobotBatch
from pupper_sysid.sim.robot.terrain import Ground
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

Array = NDArray[np.float64]

_ITERATIONS = 30
"""Of Newton: with 10, the default of other trainers, joints are up to 0.02 rad off in a second."""
_LINE_SEARCH = 50
_TOLERANCE = 1e-9
"""Of Newton's solver. mujoco-warp raises it to 1e-6, at which light links still move: an error of
milliradians once in some thousand steps."""
_STATE = ("history", "time", "qacc_warmstart", "act")


@cache
def _engine() -> SimpleNamespace:
    """Warp, mujoco-warp and the kernels; imported where a device is requested."""
    try:
        wp, mjw = import_module("warp"), import_module("mujoco_warp")
    except ImportError as error:
        raise InputError(
            f"Simulation on a Warp device needs mujoco-warp and warp-lang ({error}). Install them "
            'with: pip install "pupper-sysid[gpu]"'
        ) from None
    wp.config.log_level = wp.LOG_ERROR
    return SimpleNamespace(wp=wp, mjw=mjw, **_kernels(wp))


def _kernels(wp: Any) -> dict[str, Any]:
    ten = wp.types.vector(length=10, dtype=float)

    @wp.kernel(enable_backward=False)
    def turn_servos(
        time_step: wp.array(dtype=float),
        address: wp.array(dtype=int),
        gains: wp.array2d(dtype=ten),
        speeds: wp.array2d(dtype=ten),
        limits: wp.array2d(dtype=wp.vec2),
        setpoint: wp.array2d(dtype=float),
        length: wp.array2d(dtype=float),
        velocity: wp.array2d(dtype=float),
        setpoint_rate: wp.array2d(dtype=float),
        force: wp.array2d(dtype=float),
    ):
        """Torques and set-points of servos; `setpoint_rate` comes in as the delayed command."""
        world, servo = wp.tid()
        step = time_step[world % time_step.shape[0]]
        servo_address = address[servo]
        before = setpoint[world, servo_address]
        reach = speeds[world, servo][1] * step
        moved = wp.clamp(setpoint_rate[world, servo_address] - before, -reach, reach)
        setpoint_rate[world, servo_address] = moved / step
        gain = gains[world, servo]
        torque = gain[2] * velocity[world, servo]
        torque -= gain[1] * (before + moved - length[world, servo])
        most = limits[world, servo]
        force[world, servo] = wp.clamp(torque, most[0], most[1])

    @wp.kernel(enable_backward=False)
    def overwrite(
        rows: wp.array(dtype=int), values: wp.array2d(dtype=float), out: wp.array2d(dtype=float)
    ):
        """Rows of `out` become `values`."""
        row, column = wp.tid()
        out[rows[row], column] = values[row, column]

    return {"turn_servos": turn_servos, "overwrite": overwrite}


def _device_of(name: str) -> Any:
    """The Warp device of a name, `cpu`, `cuda` or `cuda:1`."""
    wp = _engine().wp
    try:
        return wp.get_device(name)
    except Exception:  # Warp raises several kinds, RuntimeError among them
        known = ", ".join(str(device) for device in wp.get_devices())
        raise InputError(
            f"There is no device {name} here for the simulation, only {known}. Leave it out to "
            "simulate on the processor's cores."
        ) from None


class Worlds:
    """State and model of many robots on a device.

    The model has `<pid>` servos; `fields` are those of the model that differ between worlds, shape
    (n, …). A call of `advance` takes `substeps` physics steps.
    """

    def __init__(
        self, model: Any, fields: dict[str, Array], worlds: int, substeps: int, device: str
    ):
        self._engine = _engine()
        self._wp = self._engine.wp
        self.device, self._substeps = _device_of(device), substeps
        self._graph, self._warm = None, False
        self._written: dict[str, NDArray[np.float32]] = {}
        bare, sizes = _without_pid(model), dict.fromkeys(fields, worlds)
        with self._wp.ScopedDevice(self.device):
            self._model = self._engine.mjw.put_model(bare, batch_sizes=sizes)
            self._model.opt.tolerance.fill_(_TOLERANCE)
            # robots that tumble reach the limit in most steps, and each would be a printed line
            self._model.opt.warn_overflow &= ~self._engine.mjw.OverflowType.ITERATIONS
            self._data = self._engine.mjw.make_data(bare, worlds)
            self._commands = self._wp.zeros((substeps, worlds, model.nu), dtype=float)
            self._records = {
                name: self._wp.zeros((substeps, *getattr(self._data, name).shape), dtype=float)
                for name in ("qpos", "actuator_force", "sensordata")
            }
        self._model.callback.act_bias = _servos

    def write_fields(self, fields: dict[str, Array]) -> None:
        """Give every world separate values of model fields, shape (n, …), where they have changed.

        Between episodes only the delays change; comparing is cheaper than a transfer.
        """
        for name, value in fields.items():
            new = value.astype(np.float32)
            if not np.array_equal(new, self._written.get(name, np.empty(0))):
                getattr(self._model, name).assign(new)
                self._written[name] = new

    def write(self, ids: NDArray[np.intp], state: dict[str, Array]) -> None:
        """Overwrite delay lines, times, warm starts and set-points of some worlds."""
        with self._wp.ScopedDevice(self.device):
            rows = self._wp.array(ids, dtype=int)
            for name in _STATE:
                field = getattr(self._data, name)
                out = field.reshape((field.shape[0], -1))
                values = self._wp.array(state[name].reshape(len(ids), -1), dtype=float)
                self._wp.launch(
                    self._engine.overwrite, values.shape, inputs=[rows, values], outputs=[out]
                )

    def read(self) -> dict[str, NDArray[np.float32]]:
        """Copies of what `write` overwrites, of all worlds."""
        return {name: getattr(self._data, name).numpy().copy() for name in _STATE}

    def advance(self, qpos: Array, qvel: Array, commands: Array) -> dict[str, NDArray[np.float32]]:
        """Let all worlds take the physics steps of one control step.

        Positions and speeds are (n, 19) and (n, 18), commands set-points [rad], held, (n,
        actuators), or of each physics step, (n, substeps, actuators). Gives `qpos`,
        `actuator_force` and `sensordata` of each physics step, (n, substeps, …); `qvel`, `act` and
        `site_xpos` at its end.
        """
        data = self._data
        held = commands if commands.ndim == 3 else commands[:, None]
        by_step = np.broadcast_to(held.swapaxes(0, 1), self._commands.shape)
        self._commands.assign(np.ascontiguousarray(by_step, np.float32))
        data.qpos.assign(np.asarray(qpos, np.float32))
        data.qvel.assign(np.asarray(qvel, np.float32))
        with self._wp.ScopedDevice(self.device):
            self._run()
        moved = {name: record.numpy().swapaxes(0, 1) for name, record in self._records.items()}
        return moved | {name: getattr(data, name).numpy() for name in ("qvel", "act", "site_xpos")}

    def _run(self) -> None:
        """The physics steps; on CUDA one graph of kernels, once all are loaded."""
        if not self.device.is_cuda or not self._warm:
            self._take_steps()
            self._warm = True
            return
        if self._graph is None:
            with self._wp.ScopedCapture() as capture:
                self._take_steps()
            self._graph = capture.graph
        self._wp.capture_launch(self._graph)

    def _take_steps(self) -> None:
        for k in range(self._substeps):
            self._wp.copy(self._data.ctrl, self._commands[k])
            self._engine.mjw.step(self._model, self._data)
            for name, record in self._records.items():
                self._wp.copy(record[k], getattr(self._data, name))


def _without_pid(model: Any) -> Any:
    """The model with what mujoco-warp has: integrators for servos, and Newton."""
    bare = copy(model)
    bare.actuator_dyntype[:] = mujoco.mjtDyn.mjDYN_INTEGRATOR
    bare.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_FIXED
    bare.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE  # damping is integrated implicitly
    bare.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    bare.opt.iterations, bare.opt.ls_iterations = _ITERATIONS, _LINE_SEARCH
    return bare


def _servos(model: Any, data: Any) -> None:
    """The callback of mujoco-warp that replaces its actuators' torques."""
    engine = _engine()
    engine.wp.launch(
        engine.turn_servos,
        dim=(data.nworld, model.nactuator),
        inputs=[
            model.opt.timestep, model.actuator_actadr, model.actuator_biasprm,
            model.actuator_dynprm, model.actuator_forcerange, data.act, data.actuator_length,
            data.actuator_velocity,
        ],
        outputs=[data.act_dot, data.actuator_force],
    )  # fmt: skip


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
