"""One servo in free air, stepped by MuJoCo only as far, and as often, as its position is needed.

Commands come at any instant, not only on physics steps: the actuator gets the mean of the held
command over the step before (`sim.robot.servo_mjcf.for_commands_between_steps`). A position can be
evaluated at any instant. A servo at rest is not stepped until a command moves it.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.bench import held_over
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.servo_mjcf import (
    for_commands_between_steps,
    free_air_xml,
    rest_at,
    switch_torque,
)

PHYSICS_STEP_S = 0.001
"""Half the step of fitting, so that the truth is not made by the model that is fitted."""

_STILL_RAD_S = 1e-4  # MuJoCo's dry friction creeps at up to 3e-5 rad/s: invisible
_STILL_RAD_S2 = 1e-4
_STEPS_BETWEEN_LOOKS = 50


class FreeAirServo:
    """A servo in free air; time starts at 0 and must not go backwards.

    Parameters are scalars, the dead time at least two physics steps. It rests at `position_rad` at
    the start, commanded there for long.
    """

    def __init__(
        self,
        parameters: DelayedPDParameters,
        position_rad: float,
        time_step_s: float = PHYSICS_STEP_S,
    ):
        native = for_commands_between_steps(parameters, time_step_s, "servo")
        self._model = mujoco.MjModel.from_xml_string(free_air_xml([native], time_step_s))
        self._data = mujoco.MjData(self._model)
        rest_at(self._model, self._data, [position_rad])
        self._gains = self._model.actuator_biasprm.copy()
        self._effort = float(np.asarray(parameters.effort_limit))
        self._dt = time_step_s
        self._settled_after = int(float(np.asarray(parameters.dead_time_s)) / time_step_s) + 3
        self._step = 0
        self._changed = -self._settled_after - 1
        self._goal = float(position_rad)
        self._queue: deque[tuple[float, float]] = deque()
        self._limp = self._asleep = False

    def command(self, time_s: float, position_rad: float) -> None:
        """Set the command from `time_s` on; times must not go backwards."""
        latest = self._queue[-1][1] if self._queue else self._goal
        if not self._limp and position_rad != latest:
            self._queue.append((time_s, float(position_rad)))
            self._asleep = False

    def position_at(self, time_s: float) -> float:
        """True position [rad] at `time_s`, at most one physics step before the latest call."""
        if time_s <= 0 or self._asleep:
            return float(self._data.qpos[0])
        self._advance(int(np.ceil(time_s / self._dt - 1e-9)))
        # exact inside a step: MuJoCo moves the joint with the velocity at the step's end
        ahead = self._step * self._dt - time_s
        self._asleep = not self._queue and self._resting()
        return float(self._data.qpos[0]) - float(self._data.qvel[0]) * ahead

    @property
    def load(self) -> float:
        """Signed share of the effort limit in use at the time of the last call."""
        if self._limp or self._asleep:
            return 0.0
        return float(self._data.actuator_force[0]) / self._effort

    def torque(self, time_s: float, on: bool) -> None:
        """Hold the present position, or go limp, from `time_s` on."""
        position = self.position_at(time_s)
        self._limp = not on
        switch_torque(self._model, self._gains, on)
        velocity = float(self._data.qvel[0])
        rest_at(self._model, self._data, [position])
        self._data.qvel[0] = velocity
        self._goal = position
        self._queue.clear()
        self._changed = self._step
        self._asleep = False

    def _advance(self, last: int) -> None:
        """Take physics steps until the state is that of the start of step `last`."""
        while self._step < last:
            # step k sees the commands of step k - 1
            event = int(self._queue[0][0] / self._dt) + 1 if self._queue else last
            if event > self._step:
                steps = min(event, last) - self._step
                if not self._resting():
                    steps = min(steps, _STEPS_BETWEEN_LOOKS)
                    self._data.ctrl[0] = self._goal
                    mujoco.mj_step(self._model, self._data, nstep=steps)
                self._step += steps
            else:
                since, stop = (self._step - 1) * self._dt, self._step * self._dt
                integral, self._goal = held_over(since, stop, self._goal, self._queue)
                self._data.ctrl[0] = integral / self._dt
                mujoco.mj_step(self._model, self._data)
                self._changed = self._step
                self._step += 1

    def _resting(self) -> bool:
        """Whether another step would change nothing."""
        data = self._data
        return (
            self._step - self._changed > self._settled_after
            and abs(data.qvel[0]) < _STILL_RAD_S
            and abs(data.qacc[0]) < _STILL_RAD_S2
            and (self._limp or not len(data.act) or abs(data.act[0] - self._goal) < 1e-12)
        )
