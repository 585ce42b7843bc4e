"""Structures of a servo that are fitted: which terms it has, their boxes and priors.

A servo is a position loop with an effort limit, a limit on its speed, dry friction, inertia and a
dead time; `FEATURES` are what may be added. In free air the armature is 1 and there is no load:
positions tell torques per inertia only. Under a known load torques are in N·m. A `Structure`
translates between fitted coordinates and the columns of `servo_models.kernel`; `SERVO_TERMS` is the
one table of its numbers.

The linear models (a pure delay, one and two poles) are what other people fit, and stand beside the
servo in tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models import kernel
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.fit.servo_prior import PER_INERTIA, ServoPrior

LONGEST_DEAD_TIME_S = 0.4


AT_BOUND = 0.03
"""Distance from a bound, in fitted coordinates, that counts as on it."""


@dataclass(frozen=True)
class Parameter:
    """One number of a structure, fitted as its logarithm unless it may be negative.

    Attributes
    ----------
    name : str
        Ends in its unit where that does not depend on the load.
    nominal, low, high : float
        Where the search starts and the box it stays in.
    prior_sd : float
        Standard deviation of a Gaussian prior about `nominal`, of the logarithm where that is
        what is fitted. Wide: it decides only what the data leave open, such as a speed limit
        that was never reached.
    shared_sd : float
        Standard deviation of what the numbers of one prior have in common besides.
    prior_source : str
        Calibration or card of another unit that the prior comes from; empty without one.
    """

    name: str
    nominal: float
    low: float
    high: float
    prior_sd: float = float("inf")
    shared_sd: float = 0.0
    prior_source: str = ""

    @property
    def logarithmic(self) -> bool:
        """Whether the logarithm is fitted."""
        return self.low > 0

    @property
    def marginal_sd(self) -> float:
        """Standard deviation of the prior, with what is common to several numbers."""
        return float(np.hypot(self.prior_sd, self.shared_sd))

    def encode(self, value):
        """Fitted coordinate of a value."""
        return np.log(value) if self.logarithmic else np.asarray(value, float)

    def decode(self, coordinate):
        """Value of a fitted coordinate."""
        return np.exp(coordinate) if self.logarithmic else np.asarray(coordinate, float)

    def near(self, value: float, bound: float, within: float = AT_BOUND) -> bool:
        """Whether a value is on a bound, or beyond the lower end of the box."""
        distance = self.encode(max(value, self.low)) - self.encode(bound)
        return abs(float(distance)) < within


@dataclass(frozen=True)
class Scales:
    """What the recordings of a joint say of its load, which places the search.

    Attributes
    ----------
    torque : float
        Of the load: its gravity, or what moves it [N·m]; 1 without a known load.
    inertia : float
        Of the load [kg·m²]; 1 without a known load.
    p_gain : float
        The gain that `stiffness` is for; 1 where the recordings do not say it.
    free_air : bool
        Whether the joint moved without a load at one gain.
    known_load : bool
        Whether torques are in N·m; otherwise they are per inertia.
    torque_off : bool
        Whether a run has the torque switched off.
    acceleration_rad_s2 : float
        Limit on the set-point's acceleration that headers state; NaN if none.
    set_point_speed_rad_s : float
        Limit on the set-point's speed that headers state; NaN if none.
    top_speed_rad_s : float
        Speed without load by the data sheet of the servo's model; NaN if that is not known.
    prior : ServoPrior or None
        Numbers of another unit of the servo.
    """

    torque: float = 1.0
    inertia: float = 1.0
    p_gain: float = 1.0
    free_air: bool = True
    known_load: bool = False
    torque_off: bool = False
    acceleration_rad_s2: float = float("nan")
    set_point_speed_rad_s: float = float("nan")
    top_speed_rad_s: float = float("nan")
    prior: ServoPrior | None = None

    @property
    def gravity(self) -> bool:
        """Whether the gravity of an unknown load is fitted."""
        return not (self.free_air or self.known_load)

    @property
    def stated(self) -> dict[str, float]:
        """Limits that headers state, by the names of their terms."""
        limits = {
            "velocity_limit_rad_s": self.set_point_speed_rad_s,
            "acceleration_limit": self.acceleration_rad_s2,
        }
        return {name: limit for name, limit in limits.items() if np.isfinite(limit)}

    @property
    def stated_features(self) -> tuple[str, ...]:
        """Features (`FEATURES`) whose limits headers state."""
        return tuple(f for f, names in FEATURES.items() if self.stated.keys() & {*names})


FREE_AIR = Scales()

FEATURES: dict[str, tuple[str, ...]] = {
    "slew": ("velocity_limit_rad_s",),
    "back-EMF": ("no_load_speed_rad_s",),
    "damping": ("damping",),
    "backlash": ("backlash_rad",),
    "load friction": ("load_friction_motor", "load_friction_load"),
    "quadratic": ("load_friction_quadratic",),
    "torque limit": ("torque_limit_share",),
    "stribeck": ("stribeck_friction", "stribeck_speed_rad_s"),
    "static": ("load_friction_static", "stribeck_speed_rad_s"),
    "acceleration": ("acceleration_limit",),
    "dead zone": ("dead_zone_rad",),
    "start duty": ("start_duty",),
    "integral": ("integral_per_s",),
    "gravity": ("gravity_sin", "gravity_cos"),
    "flexible": ("link_share", "link_hz", "link_damping_ratio"),
}
"""Terms beside stiffness, effort limit and dry friction, and their parameters."""


@dataclass(frozen=True)
class Term:
    """One number of the servo: a row of `SERVO_TERMS`.

    Attributes
    ----------
    name : str
        Under a known load; a torque then is in N·m.
    free_name : str
        Per inertia, the unit in its name.
    column : str
        Of the kernel, or what the column follows from (`Structure.columns`).
    scale : {"", "torque", "inertia", "per torque"}
        What `nominal`, `low` and `high` are in.
    nominal, low, high, prior_sd : float
        Under load: a factor of 5 to 10 either way.
    free : tuple of float, optional
        Nominal value, box and prior of a hobby servo in free air, per inertia.
    """

    name: str
    free_name: str
    column: str
    scale: str
    nominal: float
    low: float
    high: float
    prior_sd: float
    free: tuple[float, float, float, float] | None = None


# Free air: wide priors, from a weak hobby servo on a long link to a stiff joint of a BLDC motor.
# Two standard deviations of the speed go from 1 to 130 rad/s, so that a limit may be out of reach;
# of the stiffness from 450 to 180,000 1/s², of the torque from 50 to 6,600 rad/s².
SERVO_TERMS = {t.name: t for t in (
    Term("dead_time_s", "dead_time_s", "", "", 0.015, 1e-4, LONGEST_DEAD_TIME_S, 1.5,
         (0.02, 0.001, LONGEST_DEAD_TIME_S, np.inf)),
    Term("stiffness", "stiffness_per_s2", "stiffness", "torque", 5, 0.02, 2000, 2.0,
         (9000.0, 30.0, 200000.0, 1.5)),
    Term("damping", "damping_per_s", "damping", "torque", 0.05, 1e-5, 200, 2.0,
         (60.0, 0.05, 2000.0, 1.5)),
    Term("friction_loss", "friction_rad_s2", "friction_loss", "torque", 0.1, 1e-5, 10, 2.0,
         (50.0, 0.1, 10000.0, 1.7)),
    Term("stall_torque", "effort_rad_s2", "effort_limit", "torque", 3, 0.05, 300, 1.2,
         (575.0, 5.0, 50000.0, 1.2)),
    Term("velocity_limit_rad_s", "velocity_limit_rad_s", "velocity_limit", "",
         8.3, 0.3, 200.0, 0.8, (11.5, 0.3, 500.0, 1.2)),
    Term("no_load_speed_rad_s", "no_load_speed_rad_s", "back_emf", "", 9.0, 0.3, 200.0, 0.8,
         (11.5, 0.3, 500.0, 1.2)),
    Term("armature", "armature", "armature", "inertia", 0.3, 1e-4, 300, 2.0),
    Term("backlash_rad", "backlash_rad", "backlash_rad", "", 0.01, 5e-4, 0.15, 1.0),
    Term("hanging_rad", "hanging_rad", "hanging_rad", "", 0.0, -0.3, 0.3, 0.03),
    Term("off_brake", "off_brake", "off_brake", "", 0.5, 0.0, 1.0, 1.0),
    Term("gravity_sin", "gravity_sin", "gravity_nm", "torque", 0.0, -2, 2, 0.3),
    Term("gravity_cos", "gravity_cos", "gravity_nm", "torque", 0.0, -2, 2, 0.3),
    Term("load_friction_motor", "load_friction_motor", "load_friction_motor", "",
         0.1, 1e-4, 0.95, 2.0),
    Term("load_friction_load", "load_friction_load", "load_friction_load", "",
         0.05, 1e-4, 0.95, 2.0),
    Term("load_friction_quadratic", "load_friction_quadratic", "load_friction_quadratic",
         "per torque", 0.05, 1e-5, 10, 2.0),
    Term("load_friction_static", "load_friction_static", "load_friction_static", "",
         0.3, 1e-3, 20.0, 2.0),
    Term("torque_limit_share", "torque_limit_share", "torque_limit", "", 0.8, 0.1, 1.0, 0.5),
    Term("stribeck_friction", "stribeck_friction", "stribeck_friction", "torque",
         0.05, 1e-5, 10, 2.0),
    Term("stribeck_speed_rad_s", "stribeck_speed_rad_s", "stribeck_speed", "",
         0.1, 0.005, 3.0, 1.5),
    Term("acceleration_limit", "acceleration_limit", "acceleration_limit", "",
         60.0, 1.0, 3000.0, 1.2),
    Term("dead_zone_rad", "dead_zone_rad", "dead_zone_rad", "", 0.003, 1e-4, 0.05, 1.0),
    Term("start_duty", "start_duty", "start_duty", "", 0.01, 1e-4, 0.2, 1.5),
    Term("integral_per_s", "integral_per_s", "integral_per_s", "", 2.0, 0.02, 100.0, 1.5),
    Term("link_share", "link_share", "link_share", "", 0.2, 0.05, 0.8, 1.0),
    Term("link_hz", "link_hz", "link_hz", "", 12.0, 2.0, 60.0, 1.0),
    Term("link_damping_ratio", "link_damping_ratio", "link_damping_ratio", "",
         0.05, 0.005, 1.0, 1.0),
    Term("offset_rad", "offset_rad", "offset_rad", "", 0.0, -0.3, 0.3, 0.02,
         (0.0, -2.0, 2.0, np.inf)),
)}  # fmt: skip
"""Numbers of a servo, by name, in the order in which they are fitted."""

LIMITS = (
    "effort_rad_s2", "stall_torque", "velocity_limit_rad_s", "no_load_speed_rad_s",
    "acceleration_limit",
)  # fmt: skip
"""Numbers that do nothing where the motion does not reach them."""
_LEAST_SCALE = 0.02  # of angles [rad]
_STATED_SD = 0.03  # of the logarithm of a limit that a register states
_SPEEDS = ("velocity_limit_rad_s", "no_load_speed_rad_s")
_DATA_SHEET_SD = 0.35
"""Of the logarithm of a speed by a data sheet: supplies from 4.8 to 7.4 V are 20 % either way,
units and sheets of one class differ by as much, and friction takes its share."""
_KNOWN_OFFSET_SD_RAD = 0.002  # where command and reading share the encoder's zero
_BASE = ("dead_time_s", "stiffness", "damping", "friction_loss", "stall_torque")
_NEUTRAL = {
    "torque_limit_share": 0.98, "acceleration_limit": 500.0, "stribeck_speed_rad_s": 0.1,
    "off_brake": 0.5,
}  # fmt: skip
"""Values with nearly no effect, of numbers whose least value is not that."""


@dataclass(frozen=True)
class Structure:
    """What is fitted: some numbers of a servo, or a linear model.

    Attributes
    ----------
    name : str
    parameters : tuple of Parameter
        The dead time [s] is the first and the offset [rad] the last, in every structure.
    kind : int
        Which arithmetic of `servo_models.kernel` it is.
    features : tuple of str
        Of `FEATURES`, of a servo.
    scales : Scales
    columns_of : callable or None
        From values (candidates, parameters) to the kernel's columns, where those do not follow from
        the parameters' names.
    """

    name: str
    parameters: tuple[Parameter, ...]
    kind: int = kernel.SERVO
    features: tuple[str, ...] = ()
    scales: Scales = FREE_AIR
    columns_of: Callable[[NDArray], NDArray] | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of `parameters`."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Which coordinates are logarithms."""
        return np.array([p.logarithmic for p in self.parameters])

    @cached_property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds of the fitted coordinates, shape (parameters,) each."""
        ends = np.array([[float(p.encode(x)) for x in (p.low, p.high)] for p in self.parameters])
        return ends[:, 0], ends[:, 1]

    @cached_property
    def prior(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre and precision (inverse variance) of the fitted coordinates."""
        centre = np.array([float(p.encode(p.nominal)) for p in self.parameters])
        return centre, np.array([p.prior_sd**-2.0 for p in self.parameters])

    @cached_property
    def shared(self) -> NDArray[np.float64] | None:
        """Vector u of a prior in which numbers have a factor in common; None without one.

        With variances D and the common one S², the precision is D⁻¹ − uuᵀ (Sherman and Morrison).
        """
        common = np.array([p.shared_sd for p in self.parameters])
        if not common.any():
            return None
        weights = np.where(common > 0, self.prior[1], 0.0)
        return weights / np.sqrt(common.max() ** -2 + weights.sum())

    def prior_cost(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the logarithm of the prior at points (..., parameters), but for a constant."""
        centre, precision = self.prior
        cost = 0.5 * np.sum(precision * (points - centre) ** 2, axis=-1)
        if self.shared is not None:
            cost = cost - 0.5 * ((points - centre) @ self.shared) ** 2
        return cost

    def prior_slope(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient of `prior_cost` at points (..., parameters)."""
        centre, precision = self.prior
        slope = precision * (points - centre)
        if self.shared is not None:
            slope = slope - ((points - centre) @ self.shared)[..., None] * self.shared
        return slope

    @cached_property
    def prior_precision(self) -> NDArray[np.float64]:
        """Hessian of `prior_cost`, shape (parameters, parameters)."""
        precision = np.diag(self.prior[1])
        return precision if self.shared is None else precision - np.outer(self.shared, self.shared)

    @cached_property
    def scale(self) -> NDArray[np.float64]:
        """Length of a usual move of each fitted coordinate: of logarithms 1, else by the prior."""
        return np.array([
            1.0 if p.logarithmic
            else max(0.1 * p.prior_sd, _LEAST_SCALE) if np.isfinite(p.prior_sd)
            else _LEAST_SCALE
            for p in self.parameters
        ])  # fmt: skip

    def encode(self, values: NDArray) -> NDArray[np.float64]:
        """Fitted coordinates of values (..., parameters)."""
        points = np.array(values, float)
        points[..., self.logarithmic] = np.log(points[..., self.logarithmic])
        return points

    def decode(self, points: NDArray) -> NDArray[np.float64]:
        """Values of fitted coordinates (..., parameters)."""
        values = np.array(points, float)
        values[..., self.logarithmic] = np.exp(values[..., self.logarithmic])
        return values

    def columns(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Columns of the kernel for values (candidates, parameters)."""
        if self.columns_of is not None:
            return self.columns_of(values)
        if self.kind != kernel.SERVO:
            return values[:, 1:].copy()
        by_name = dict(zip(self.names, values.T, strict=True))
        by_term = {_TERM[name].name: value for name, value in by_name.items()}
        effort, zero = by_term["stall_torque"], np.zeros(len(values))
        sine, cosine = by_term.get("gravity_sin", zero), by_term.get("gravity_cos", zero)
        numbers = {SERVO_TERMS[name].column: value for name, value in by_term.items()}
        numbers |= {
            "stiffness": by_term["stiffness"] / self.scales.p_gain,
            "gravity_nm": np.hypot(sine, cosine),
            "hanging_rad": by_term.get("hanging_rad", zero) + np.arctan2(cosine, sine),
        }
        if "no_load_speed_rad_s" in by_term:
            numbers["back_emf"] = effort / by_term["no_load_speed_rad_s"]
        if "torque_limit_share" in by_term:
            numbers["torque_limit"] = by_term["torque_limit_share"] * effort
        columns = np.tile(kernel.ABSENT, (len(values), 1))
        for j, name in enumerate(kernel.COLUMNS):
            if name in numbers:
                columns[:, j] = numbers[name]
        return columns

    def contains(self, other: Structure) -> bool:
        """Whether this structure can move as the other does, for some of its numbers."""
        both_servos = self.kind == other.kind == kernel.SERVO
        return both_servos and self is not other and set(other.features) < set(self.features)

    def adopt(self, other: Structure, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of another structure as points of this one; what is new is nearly without effect.

        `points` of shape (..., parameters of the other).
        """
        low, high = self.box
        adopted = np.empty((*points.shape[:-1], len(self.parameters)))
        for j, p in enumerate(self.parameters):
            if p.name in other.names:
                adopted[..., j] = points[..., other.names.index(p.name)]
            elif p.name in _SPEEDS:
                adopted[..., j] = high[j]
            elif p.name in _NEUTRAL or not p.logarithmic:
                adopted[..., j] = float(p.encode(_NEUTRAL.get(p.name, p.nominal)))
            else:
                adopted[..., j] = low[j]
        return np.clip(adopted, low, high)

    def servo(self, values: NDArray[np.float64]) -> LoadedServoParameters:
        """The servo of one vector of values, its torques per inertia without a known load."""
        return loaded_servo(self.columns(values[None])[0], float(values[0]))


_TERM = {name: t for t in SERVO_TERMS.values() for name in (t.name, t.free_name)}


def servo_structure(
    features: Sequence[str], scales: Scales = FREE_AIR, name: str = ""
) -> Structure:
    """The servo with some features.

    `features`: of `FEATURES`. `name`: by default the features in words.
    """
    names = [n for n in _BASE if n != "damping"]
    names += dict.fromkeys(n for f in features for n in FEATURES[f])
    if scales.known_load:
        names += ["armature", "hanging_rad"]
    if scales.torque_off:
        names.append("off_brake")
    if scales.gravity:
        names += ["gravity_sin", "gravity_cos"]
    names.append("offset_rad")
    parameters = tuple(_parameter(t, scales) for n, t in SERVO_TERMS.items() if n in names)
    words = " + ".join(f for f in features if f not in ("back-EMF", "damping")) or "base"
    return Structure(name or words, parameters, features=tuple(features), scales=scales)


def _parameter(term: Term, scales: Scales) -> Parameter:
    """The number of the table as it is fitted, with the prior of another unit if there is one."""
    plain = _plain_parameter(term, scales)
    if scales.prior is None or plain.name not in scales.prior.logarithms:
        return plain
    mean, sd = scales.prior.logarithms[plain.name]
    nominal = float(np.clip(np.exp(mean), plain.low, plain.high))
    shared = scales.prior.shared_sd if plain.name in PER_INERTIA else 0.0
    return replace(
        plain, nominal=nominal, prior_sd=sd, shared_sd=shared, prior_source=scales.prior.source
    )


def _plain_parameter(term: Term, scales: Scales) -> Parameter:
    if scales.free_air and term.free is not None:
        nominal, low, high, sd = term.free
        if term.name in _SPEEDS and np.isfinite(scales.top_speed_rad_s):
            nominal, sd = scales.top_speed_rad_s, _DATA_SHEET_SD
        if term.name in scales.stated:
            nominal, sd = scales.stated[term.name], _STATED_SD
        return Parameter(term.free_name, nominal, low, high, sd)
    name = term.name if scales.known_load else term.free_name
    # per inertia, torques are about those of a joint that gains 10 rad/s within 0.1 s
    torque = scales.torque if scales.known_load else 100.0
    factor = {
        "": 1.0, "torque": torque, "inertia": scales.inertia, "per torque": 1.0 / torque
    }[term.scale]  # fmt: skip
    nominal, low, high, sd = term.nominal, term.low, term.high, term.prior_sd
    if term.name in scales.stated:
        nominal, sd = scales.stated[term.name], _STATED_SD
    if term.scale == "torque" and term.name.startswith("gravity"):
        sd *= factor
    if term.name == "offset_rad" and scales.known_load:
        sd = _KNOWN_OFFSET_SD_RAD
    return Parameter(name, factor * nominal, factor * low, factor * high, sd)


def _linear(name: str, *parameters: Parameter) -> Structure:
    delay, offset = (_parameter(SERVO_TERMS[n], FREE_AIR) for n in ("dead_time_s", "offset_rad"))
    gain = Parameter("gain", 1.0, 0.5, 1.5)
    return Structure(name, (delay, gain, *parameters, offset), kernel.LINEAR[name])


LINEAR = (
    _linear("pure_delay"),
    _linear("fopdt", Parameter("time_constant_s", 0.02, 0.0005, 0.5)),
    _linear(
        "sopdt",
        Parameter("natural_frequency_rad_s", 90.0, 8.0, 600.0),
        Parameter("damping_ratio", 0.8, 0.1, 4.0),
    ),
)
"""Linear models, simplest first."""

PREFERRED = "delayed_pd"
"""DelayedPD with a set-point of limited rate: what a simulator runs unless the data say more."""

SIMULATED = (PREFERRED, "delayed_pd_back_emf")
"""Structures in free air that simulators and training can run: DelayedPD with one limit on its
speed."""

CANDIDATES = (*(s.name for s in LINEAR), "dc_servo", *SIMULATED, "delayed_pd_backlash")
"""What is fitted to a joint in free air, simplest first."""

_FEATURES_OF = {
    "dc_servo": ("back-EMF",),
    PREFERRED: ("damping", "slew"),
    SIMULATED[1]: ("damping", "back-EMF"),
    "delayed_pd_backlash": ("damping", "slew", "backlash"),
}


def candidate(name: str, scales: Scales = FREE_AIR) -> Structure:
    """The candidate of free air called `name`, one of `CANDIDATES`."""
    if name in _FEATURES_OF:
        return servo_structure(_FEATURES_OF[name], scales, name)
    return next(s for s in LINEAR if s.name == name)


def loaded_servo(columns: NDArray[np.float64], dead_time_s: float) -> LoadedServoParameters:
    """The servo of one row of the kernel's columns; its stiffness is per unit of the P gain."""
    by_column = {name: float(x) for name, x in zip(kernel.COLUMNS, columns, strict=True)}
    stall = by_column["effort_limit"]
    shared = {f.name for f in fields(LoadedServoParameters)} & by_column.keys()
    return LoadedServoParameters(
        duty_per_rad=by_column["stiffness"] / stall, duty_s_per_rad=by_column["damping"] / stall,
        stall_torque=stall, dead_time_s=dead_time_s, **{name: by_column[name] for name in shared},
    )  # fmt: skip


def loaded_columns(servo: LoadedServoParameters) -> NDArray[np.float64]:
    """The kernel's columns of a servo, shape (columns,): stiffness per unit of the P gain."""
    by_column = {name: float(x) for name, x in servo.arrays().items()}
    stall = by_column["stall_torque"]
    by_column |= {
        "stiffness": by_column["duty_per_rad"] * stall,
        "damping": by_column["duty_s_per_rad"] * stall,
        "effort_limit": stall,
    }
    columns = kernel.ABSENT.copy()
    for j, name in enumerate(kernel.COLUMNS):
        if name in by_column:
            columns[j] = by_column[name]
    return columns
