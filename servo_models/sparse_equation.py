"""SparseEquation: a servo as one short, readable equation of motion.

    q̈ = stiffness · e + saturated_stiffness · sat(e, e₀)
        − damping · q̇ − drag · q̇|q̇| − friction · sign(q̇),      e = u(t − dead time) − q

`u` is the command, `q` the position, sat(e, e₀) is e clipped to ±e₀. A term whose coefficient is
zero is absent. All coefficients are per unit of inertia, because positions in free air determine
no more. Each term is a part of a servo: `stiffness` is its proportional controller;
`saturated_stiffness` the same with a limit on the motor's voltage, reached at an error of e₀;
`damping` is back-EMF and derivative action, `drag` grows with the square of speed; `friction` is
dry (Coulomb) and holds the servo still where the drive is weaker.

The fit, the class and the tests all run `integrate`. Damping and drag act on the mean of the
speeds before and after a step, so that the coefficients are those of the equation above; a fully
implicit step, as in MuJoCo and `DelayedPD`, adds step · damping / 2 to the inertia, 8 % for a hobby
servo. Friction removes at most the present velocity: it holds the servo still without chatter [1]_.
As in `DelayedPD`, a step responds to the command and the error at its beginning, so the dead time
contains half a time step, 1 ms, of integration.

.. [1] D. Stewart, J. Trinkle, "An implicit time-stepping scheme for rigid body dynamics with
   inelastic collisions and Coulomb friction", 1996.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedServo, refuse_time_step


class Coefficient(NamedTuple):
    """Unit and meaning of one number of the equation."""

    unit: str
    meaning: str


COEFFICIENTS: dict[str, Coefficient] = {
    "stiffness_per_s2": Coefficient("s⁻²", "stiffness: acceleration per radian of error"),
    "saturated_stiffness_per_s2": Coefficient(
        "s⁻²", "stiffness with a limited drive: acceleration per radian of error, up to e₀"
    ),
    "saturation_error_rad": Coefficient("rad", "e₀: the error at which the drive is at its limit"),
    "damping_per_s": Coefficient("s⁻¹", "damping and back-EMF: deceleration per rad/s"),
    "drag_per_rad": Coefficient("rad⁻¹", "drag: deceleration per (rad/s)²"),
    "friction_rad_s2": Coefficient(
        "rad/s²", "dry (Coulomb) friction: deceleration at any speed; holds the servo when at rest"
    ),
}
"""The numbers of the equation, by name; each name ends in its unit."""

_NEVER = {"saturation_error_rad": np.inf}  # every other coefficient is 0 when absent


class SparseEquation(DelayedServo):
    """A servo that moves by the equation in the module's text; a `ServoModel`.

    Parameters
    ----------
    coefficients : mapping of str to array_like
        Names of `COEFFICIENTS`; those left out are absent from the equation.
    dead_time_s : array_like
        From a command's arrival to its first effect [s].
    offset_rad : array_like
        Added to every position [rad]: bias of the servo's readings.
    time_step_s : float
        Time step [s]; commands and positions are at this step.

    Raises
    ------
    InputError
        If a name is unknown, a number is negative or not finite, or the integration would be
        unstable because the time step is too long for the stiffness.

    Examples
    --------
    >>> servo = SparseEquation({"stiffness_per_s2": 2500.0, "damping_per_s": 100.0}, 0.02)
    >>> servo.reset(0.0)
    >>> float(servo.rollout(np.ones(500))[-1].round(6))
    1.0
    """

    def __init__(
        self,
        coefficients: Mapping[str, ArrayLike],
        dead_time_s: ArrayLike,
        offset_rad: ArrayLike = 0.0,
        time_step_s: float = TIME_STEP_S,
    ):
        refuse_time_step("SparseEquation", time_step_s)
        for name in coefficients:
            if name not in COEFFICIENTS:
                near = difflib.get_close_matches(name, COEFFICIENTS, 1, 0.3)
                hint = (
                    f"did you mean {near[0]}?" if near else f"known are {', '.join(COEFFICIENTS)}."
                )
                raise InputError(f"SparseEquation: there is no coefficient {name}; {hint}")
        values = {name: np.asarray(value, float) for name, value in coefficients.items()}
        self.dead_time_s = np.asarray(dead_time_s, float)
        self.offset_rad = np.asarray(offset_rad, float)
        for name, value in [*values.items(), ("dead_time_s", self.dead_time_s)]:
            infinite = np.isinf(value).any() and name not in _NEVER
            if np.isnan(value).any() or np.min(value) < 0 or infinite:
                raise InputError(f"SparseEquation: {name} is {value}; it must be 0 or positive.")
        if not np.isfinite(self.offset_rad).all():
            raise InputError(f"SparseEquation: offset_rad is {self.offset_rad}; it must be finite.")
        self.coefficients = values
        h = float(time_step_s)
        # the roots of y₊ − 2y + y₋ = −h² · stiffness · y leave the unit circle there
        spring = sum(values.get(n, 0.0) for n in ("stiffness_per_s2", "saturated_stiffness_per_s2"))
        if np.max(h * h * spring) >= 4.0:
            raise InputError(
                f"SparseEquation: steps of {1e3 * h:g} ms are too long for a stiffness of "
                f"{np.max(spring):g} s⁻²; use {1e3 * TIME_STEP_S:g} ms."
            )
        numbers = (*values.values(), self.dead_time_s, self.offset_rad)
        super().__init__(numbers, self.dead_time_s, h)

    def _rest(self, position: NDArray[np.float64]) -> None:
        self._state = (position.copy(), np.zeros(self.batch))

    def _integrate(self, delayed: NDArray[np.float64]) -> NDArray[np.float64]:
        positions, self._state = integrate(
            delayed, self._state, self.coefficients, self.time_step_s
        )
        return positions + self.offset_rad


def integrate(
    delayed: NDArray[np.float64],
    state: tuple[NDArray, NDArray],
    coefficients: Mapping[str, NDArray],
    time_step_s: float,
) -> tuple[NDArray[np.float64], tuple[NDArray, NDArray]]:
    """Step the equation through commands that have already been delayed.

    Commands as they take effect [rad] and positions have the shape (steps, *batch); the state is
    (position, velocity), each of shape batch. Coefficients have names of `COEFFICIENTS`, each
    broadcastable to batch; those left out cost no time. Gives positions and the state after the
    last step.
    """
    h, batch = time_step_s, delayed.shape[1:]

    def flat(value: ArrayLike) -> NDArray:  # one contiguous axis: the fastest for small steps
        return np.ascontiguousarray(np.broadcast_to(value, batch), dtype=float).reshape(-1)

    def part(name: str, scale: float) -> NDArray | None:
        return flat(coefficients[name]) * scale if name in coefficients else None

    spring, limited = part("stiffness_per_s2", h), part("saturated_stiffness_per_s2", h)
    drag, friction = part("drag_per_rad", 0.5 * h), part("friction_rad_s2", h)
    limit = flat(coefficients.get("saturation_error_rad", np.inf))
    low_limit, low_friction = -limit, None if friction is None else -friction
    damping = 0.5 * h * flat(coefficients.get("damping_per_s", 0.0))
    positions = np.empty(delayed.shape)
    flat_positions = positions.reshape(len(delayed), -1)
    delayed = delayed.reshape(len(delayed), -1)
    position, velocity = (flat(x).copy() for x in state)
    error, work, loss = (np.empty_like(position) for _ in range(3))
    # numpy.clip costs five times minimum + maximum on small arrays, hence the pairs below
    for k in range(len(delayed)):
        np.subtract(delayed[k], position, out=error)
        loss[:] = damping
        if drag is not None:
            np.abs(velocity, out=work)
            work *= drag
            loss += work
        np.multiply(velocity, loss, out=work)
        velocity -= work
        if spring is not None:
            np.multiply(spring, error, out=work)
            velocity += work
        if limited is not None:
            np.minimum(error, limit, out=work)
            np.maximum(work, low_limit, out=work)
            work *= limited
            velocity += work
        if friction is not None and low_friction is not None:
            np.minimum(velocity, friction, out=work)
            np.maximum(work, low_friction, out=work)
            velocity -= work
        loss += 1.0
        velocity /= loss
        np.multiply(velocity, h, out=work)
        position += work
        flat_positions[k] = position
    return positions, (position.reshape(batch), velocity.reshape(batch))


# ------------------------------------------------------------------------------- in words


def equation(coefficients: Mapping[str, float], dead_time_s: float) -> str:
    """The equation with its numbers and units, on one line; all numbers are scalars.

    Examples
    --------
    >>> equation({"stiffness_per_s2": 9120.0, "friction_rad_s2": 118.4}, dead_time_s=0.0246)
    'q̈ = 9 120 s⁻² · e − 118 rad/s² · sign(q̇),  e = u(t − 24.6 ms) − q'
    """
    limit = digits(coefficients.get("saturation_error_rad", np.inf))
    shapes = {
        "stiffness_per_s2": "+ {} · e",
        "saturated_stiffness_per_s2": f"+ {{}} · sat(e, {limit} rad)",
        "damping_per_s": "− {} · q̇",
        "drag_per_rad": "− {} · q̇|q̇|",
        "friction_rad_s2": "− {} · sign(q̇)",
    }
    terms = [
        shape.format(f"{digits(coefficients[name])} {COEFFICIENTS[name].unit}")
        for name, shape in shapes.items()
        if coefficients.get(name)
    ]
    right = " ".join(terms).removeprefix("+ ")
    return f"q̈ = {right or '0'},  e = u(t − {digits(1e3 * dead_time_s)} ms) − q"


def explain(
    coefficients: Mapping[str, float],
    dead_time_s: float,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> list[str]:
    """One line per number: value, unit, meaning, and its range over parts of the data.

    Examples
    --------
    >>> explain({"stiffness_per_s2": 9120.0}, dead_time_s=0.0246)[0]
    '9 120 s⁻²: stiffness: acceleration per radian of error'
    """
    lines = []
    dead_time = Coefficient("s", "dead time: from a command's arrival to its first effect")
    rows = [(name, value, COEFFICIENTS[name]) for name, value in coefficients.items()]
    for name, value, (unit, meaning) in [*rows, ("dead_time_s", dead_time_s, dead_time)]:
        low, high = (ranges or {}).get(name, (value, value))
        around = f" ({digits(low)} … {digits(high)} with one frequency left out)"
        lines.append(f"{digits(value)} {unit}: {meaning}{around if low < high else ''}")
    # only where the drive ends and one term alone brakes is there a top speed
    limited = {"saturated_stiffness_per_s2", "saturation_error_rad", "damping_per_s"}
    if limited <= set(coefficients) and not {"stiffness_per_s2", "drag_per_rad"} & set(
        coefficients
    ):
        drive = coefficients["saturated_stiffness_per_s2"] * coefficients["saturation_error_rad"]
        net, damping = drive - coefficients.get("friction_rad_s2", 0), coefficients["damping_per_s"]
        if net > 0:
            lines.append(
                f"so its full drive is {digits(drive)} rad/s², and its top speed (drive − friction)"
                f" / damping = {digits(net / damping)} rad/s"
            )
    return lines


def digits(value: float) -> str:
    """A number with three significant digits, thousands set apart.

    Examples
    --------
    >>> digits(9123.4), digits(0.04567), digits(118.0), digits(2.0)
    ('9 120', '0.0457', '118', '2')
    """
    if not np.isfinite(value) or value == 0:
        return "∞" if np.isinf(value) else f"{value:g}"
    places = 2 - int(np.floor(np.log10(abs(value))))
    rounded = round(float(value), places)
    text = f"{rounded:,.{max(places, 0)}f}".replace(",", " ")
    return text.rstrip("0").rstrip(".") if "." in text else text
