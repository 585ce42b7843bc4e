"""LoadedServo: a position loop in duty, a DC motor, gears with friction, and a load on the joint.

What a hobby servo's firmware does is known in outline: the position error times a P gain is a duty
cycle, which the motor turns into torque. One servo under several gains and loads is then one set of
numbers::

    duty   = clip(duty_per_rad · P · error - duty_s_per_rad · velocity, ±1)
    motor  = stall_torque · duty · V / V0 - back_emf · velocity,   at most ±torque_limit
    weight = -gravity · sin(position - hanging)
    limit  = friction_loss + stribeck_friction · s
             + (1 + load_friction_static · s) · (load_friction_motor · |motor|
                + load_friction_load · |weight|) + load_friction_quadratic · motor²
    (armature + load inertia) · acceleration = motor + weight - friction,   |friction| ≤ limit

with s = 1 / (1 + (velocity / stribeck_speed)²), 1 at standstill. Friction grows with the torques
that the gears transmit, as in the models M3 to M6 of BAM (Duclusaud et al., "Extended friction
models for the physics simulation of servo actuators", ICRA 2025). `error` is zero within
`dead_zone_rad` and counts from its edge on; `start_duty` is added wherever the error is not zero.
With the torque switched off no duty is applied and `off_brake` of the back-EMF remains: 0 with open
motor terminals and no viscous friction, 1 with shorted ones. Commands, and switching the torque,
take effect after `dead_time_s`, as in `DelayedPD`. The set-point follows the command at once, or
as a trajectory generator moves it: at `velocity_limit` at most, and with an `acceleration_limit` at
a rate from which it can stop on the command, sqrt(2 · limit · distance), that changes by the limit
at most.

Without the terms of the load-dependent and Stribeck friction this is `DelayedPD` with stiffness
duty_per_rad · P · stall_torque, damping duty_s_per_rad · stall_torque and effort limit
stall_torque, and MuJoCo runs it natively (`delayed_pd`); tests hold the three together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import (
    FRICTION_IMPEDANCE,
    TIME_STEP_S,
    DelayedPDParameters,
    DelayedServo,
    DelayLine,
    compiled,
)

START_ERROR_RAD = 0.0015
"""Error from which on `start_duty` acts in full [rad]: a count of 4,096 a turn."""


@dataclass(frozen=True)
class LoadedServoParameters:
    """Numbers of a servo; floats or arrays that broadcast against each other."""

    duty_per_rad: ArrayLike
    """Duty per position error and unit of the P gain [1/rad]."""
    duty_s_per_rad: ArrayLike
    """Duty per velocity, inside of the limit on the duty [s/rad]."""
    stall_torque: ArrayLike
    """Torque at full duty and standstill, at the reference voltage [N·m]."""
    back_emf: ArrayLike
    """Torque lost per velocity: back-EMF of the motor, viscous friction of the gears
    [N·m·s/rad]."""
    armature: ArrayLike
    """Reflected inertia of motor and gears [kg·m²]."""
    friction_loss: ArrayLike
    """Dry friction at speed without load [N·m]."""
    dead_time_s: ArrayLike
    """From a command's arrival to its first effect on the torque [s]."""
    stribeck_friction: ArrayLike = 0.0
    """Dry friction at standstill beyond `friction_loss` [N·m]."""
    stribeck_speed: ArrayLike = 0.1
    """Speed at which half of it is left [rad/s]."""
    load_friction_motor: ArrayLike = 0.0
    load_friction_load: ArrayLike = 0.0
    """`load_friction_motor` and `load_friction_load`: dry friction per torque of the motor, and of
    the load's weight."""
    load_friction_quadratic: ArrayLike = 0.0
    """Dry friction per squared torque of the motor [1/(N·m)]."""
    load_friction_static: ArrayLike = 0.0
    """By what share friction per torque is larger at standstill."""
    torque_limit: ArrayLike = np.inf
    """Largest torque of the motor, a limit on its current [N·m]."""
    off_brake: ArrayLike = 0.0
    """Share of `back_emf` that remains with the torque off."""
    dead_zone_rad: ArrayLike = 0.0
    """Half-width of the error that the loop ignores [rad]."""
    start_duty: ArrayLike = 0.0
    """Duty added to overcome friction wherever there is an error."""
    acceleration_limit: ArrayLike = np.inf
    """Largest acceleration of the set-point [rad/s²]: the firmware's trajectory generator."""
    velocity_limit: ArrayLike = np.inf
    """Largest speed of the set-point [rad/s]."""

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The numbers as arrays, by name."""
        return {f.name: np.asarray(getattr(self, f.name), float) for f in fields(self)}

    def beyond_delayed_pd(self) -> tuple[str, ...]:
        """Terms of this servo that `DelayedPD`, and with it simulators' actuators, do not have."""
        values = self.arrays()
        present = [words for name, words in _BEYOND.items() if np.max(values[name]) > 0]
        limited = [words for name, words in _LIMITS_BEYOND.items() if np.min(values[name]) < np.inf]
        return (*present, *limited)

    def delayed_pd(
        self, p_gain: ArrayLike, load_inertia_kg_m2: ArrayLike = 0.0, torque_nm: ArrayLike = 0.0
    ) -> DelayedPDParameters:
        """DelayedPD at one P gain: the same servo without what simulators' actuators lack.

        Gravity is the simulator's. The effort limit is the smaller of stall torque and torque
        limit; the friction does not grow with the load: it is that for a torque of motor and load
        of `torque_nm`. `load_inertia_kg_m2` is added to the armature, where no body of the
        simulator has it.
        """
        values, torque = self.arrays(), np.asarray(torque_nm, float)
        friction = values["friction_loss"] + values["load_friction_quadratic"] * torque**2
        per_torque = values["load_friction_motor"] + values["load_friction_load"]
        friction = friction + per_torque * torque
        return DelayedPDParameters(
            stiffness=values["duty_per_rad"] * np.asarray(p_gain) * values["stall_torque"],
            damping=values["duty_s_per_rad"] * values["stall_torque"],
            friction_loss=friction,
            armature=values["armature"] + np.asarray(load_inertia_kg_m2),
            effort_limit=np.minimum(values["stall_torque"], values["torque_limit"]),
            velocity_limit=values["velocity_limit"],
            dead_time_s=values["dead_time_s"],
            back_emf=values["back_emf"],
        )


_BEYOND = {
    "load_friction_motor": "friction that grows with the motor's torque",
    "load_friction_load": "friction that grows with the load",
    "load_friction_quadratic": "friction that grows with the squared torque",
    "stribeck_friction": "friction that is larger at standstill",
    "start_duty": "the minimum start force",
    "dead_zone_rad": "the dead zone",
}
_LIMITS_BEYOND = {
    "acceleration_limit": "the limit on the set-point's acceleration",
    "torque_limit": "a torque limit below the stall torque at speed",
}


@dataclass(frozen=True)
class Load:
    """What the servo turns; floats or arrays that broadcast with the servo's."""

    inertia_kg_m2: ArrayLike = 0.0
    """About the joint [kg·m²]."""
    gravity_nm: ArrayLike = 0.0
    """Largest torque of gravity [N·m]."""
    hanging_rad: ArrayLike = 0.0
    """Position at which the load hangs [rad]."""


class LoadedServo(DelayedServo):
    """The servo model that is fitted to recordings under load. See the module's text.

    `p_gain` is that of the position loop, the register's value; commands and positions are at the
    time step.

    Examples
    --------
    >>> servo = LoadedServoParameters(
    ...     duty_per_rad=0.05, duty_s_per_rad=0.0, stall_torque=2.5, back_emf=0.3, armature=0.02,
    ...     friction_loss=0.05, dead_time_s=0.01,
    ... )
    >>> model = LoadedServo(servo, p_gain=16.0, load=Load(0.01, 0.5, 0.0))
    >>> model.reset(0.0)
    >>> bool(0.7 < model.rollout(np.full(1000, 1.0))[-1] < 0.9)  # it droops under its load
    True
    """

    def __init__(
        self,
        parameters: LoadedServoParameters,
        p_gain: ArrayLike = 1.0,
        load: Load | None = None,
        time_step_s: float = TIME_STEP_S,
    ):
        load = load or Load()
        self.parameters, self._values = parameters, parameters.arrays()
        for name, value in self._values.items():
            if np.isnan(value).any() or np.min(value) < 0:
                raise InputError(
                    f"LoadedServo: {name} is {np.min(value)}; it must be a positive number."
                )
        self._gain = np.asarray(p_gain, float)
        self._load = [
            np.asarray(x, float) for x in (load.inertia_kg_m2, load.gravity_nm, load.hanging_rad)
        ]
        if not np.min(self._values["armature"] + self._load[0]) > 0:
            raise InputError("LoadedServo: armature and load have no inertia together.")
        self._torque = DelayLine(self._values["dead_time_s"], time_step_s)
        shapes = [*self._values.values(), self._gain, *self._load]
        super().__init__(shapes, self._values["dead_time_s"], time_step_s)

    def rollout(
        self, commands: ArrayLike, torque_on: ArrayLike = 1.0, voltage_ratio: ArrayLike = 1.0
    ) -> NDArray[np.float64]:
        """Positions [rad] after each command, shape (steps, *batch); continues from the state.

        `torque_on`, one number or one per step, is the share of each step for which the torque is
        on, `voltage_ratio` the supply voltage over the reference.
        """
        commands = np.asarray(commands, float)
        steps = len(commands)
        on = np.broadcast_to(np.asarray(torque_on, float), (steps,))
        on = np.broadcast_to(on.reshape(-1, *[1] * len(self.batch)), (steps, *self.batch))
        self._on = self._torque.shift(on)
        self._volts = np.broadcast_to(np.asarray(voltage_ratio, float), (steps,))
        return super().rollout(commands)

    def _rest(self, position: NDArray[np.float64]) -> None:
        still = np.zeros(self.batch)
        self._state = (position.copy(), still, position.copy(), still)
        self._torque.reset(np.ones(self.batch))

    def _integrate(self, delayed: NDArray[np.float64]) -> NDArray[np.float64]:
        inertia, gravity, hanging = self._load
        values = self._values | {
            "per_inertia": 1.0 / (self._values["armature"] + inertia), "gravity": gravity,
            "hanging": hanging, "stiffness": self._values["duty_per_rad"] * self._gain,
        }  # fmt: skip
        table = np.stack([np.broadcast_to(values[n], self.batch).reshape(-1) for n in _ROWS])
        state = [np.array(x).reshape(-1) for x in self._state]
        steps, out = len(delayed), np.empty(delayed.shape)
        delayed, on = (np.ascontiguousarray(x).reshape(steps, -1) for x in (delayed, self._on))
        compiled(_steps)(
            delayed, on, np.ascontiguousarray(self._volts), out.reshape(steps, -1), *state, table,
            self.time_step_s,
        )  # fmt: skip
        self._state = tuple(x.reshape(self.batch) for x in state)
        return out


_ROWS = (
    "stiffness", "duty_s_per_rad", "stall_torque", "back_emf", "friction_loss", "torque_limit",
    "dead_zone_rad", "start_duty", "off_brake", "acceleration_limit", "velocity_limit",
    "stribeck_friction", "stribeck_speed", "load_friction_static", "load_friction_motor",
    "load_friction_load", "load_friction_quadratic", "per_inertia", "gravity", "hanging",
)  # fmt: skip
"""Rows of the table of `_steps`."""


def _steps(delayed, on, volts, positions, position, velocity, setpoint, rates, table, h):
    """Fill `positions`, shape (steps, servos); the four of the state move in place."""
    for k in range(delayed.shape[0]):
        for n in range(delayed.shape[1]):
            (stiffness, damper, stall, emf, loss, torque_limit, zone, start, off_brake, ramp, slew,
             stribeck, stribeck_speed, static, by_motor, by_load, quadratic, per, gravity,
             hanging) = table[:, n]  # fmt: skip
            y, v, target = position[n], velocity[n], setpoint[n]
            way = delayed[k, n] - target
            if np.isfinite(ramp):
                # at which the step may end for the set-point to come to rest at the command
                brake = 0.5 * h * ramp
                toward = rates[n] * np.sign(way)
                room = max(brake**2 + 2.0 * (ramp * abs(way) - brake * toward), brake**2)
                rate = min(math.sqrt(room) - brake, abs(way) / h, slew) * np.sign(way)
                change = min(max(rate - rates[n], -ramp * h), ramp * h)
                target += (rates[n] + 0.5 * change) * h
                rates[n] += change
            else:
                target += min(max(way, -slew * h), slew * h)
            error = target - y
            error -= min(max(error, -zone), zone)
            demand = stiffness * error - damper * v
            demand += start * min(max(error / START_ERROR_RAD, -1.0), 1.0)
            duty = min(max(demand, -1.0), 1.0)
            top = stall * volts[k] * on[k, n]
            back = emf * (off_brake + (1.0 - off_brake) * on[k, n])
            drawn = duty * top - back * v
            motor = min(max(drawn, -torque_limit), torque_limit)
            damping = (damper * top if duty == demand else 0.0) + back
            if motor != drawn:
                damping = 0.0
            weight = -gravity * math.sin(y - hanging)
            standing = 1.0 / (1.0 + (v / stribeck_speed) ** 2)
            limit = loss + stribeck * standing
            limit += (1.0 + static * standing) * (by_motor * abs(motor) + by_load * abs(weight))
            limit = (limit + quadratic * motor**2) * per
            force = (motor + weight) * per
            force += min(max(-FRICTION_IMPEDANCE * (v / h + force), -limit), limit)
            v += force * h / (1.0 + h * damping * per)
            y += v * h
            position[n], velocity[n], setpoint[n], positions[k, n] = y, v, target, y
