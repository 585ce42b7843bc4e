"""Candidate structures of a servo under load: which terms of `LoadedServo` are fitted.

The base of every structure is a position loop in duty, a DC motor, dry friction, inertia, gravity
and dead time. `FEATURES` are what may be added. A `Structure` translates between fitted coordinates
and the columns of `sysid.loaded.kernel`.

With a known load torques are in N·m. Without one, positions tell torques per inertia only: the
armature is 1, and all torques are in rad/s².
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.loaded_servo import COLUMNS, LoadedServoParameters
from pupper_sysid.sysid.identify.candidates.models import Parameter
from pupper_sysid.sysid.loaded.kernel import OFFSET, WIDTH

LONGEST_DEAD_TIME_S = 0.4

FEATURES: dict[str, tuple[str, ...]] = {
    "load friction": ("load_friction_motor", "load_friction_load"),
    "quadratic": ("load_friction_quadratic",),
    "torque limit": ("torque_limit_share",),
    "stribeck": ("stribeck_friction", "stribeck_speed_rad_s"),
    "static": ("load_friction_static", "stribeck_speed_rad_s"),
    "damping": ("damping",),
    "acceleration": ("acceleration_limit",),
    "dead zone": ("dead_zone_rad",),
    "start duty": ("start_duty",),
}
"""Terms that may be added to the base, and their parameters."""


@dataclass(frozen=True)
class Scales:
    """Magnitudes that place the search for parameters.

    Attributes
    ----------
    torque : float
        Of the load: its gravity, or what moves it [N·m]; per inertia without a known load.
    inertia : float
        Of the load [kg·m²]; 1 without a known load.
    p_gain : float
        The gain that `stiffness` is for.
    known_load : bool
    torque_off : bool
        Whether a run has the torque switched off.
    gravity : bool
        Whether an unknown gravity is fitted.
    acceleration_rad_s2 : float
        Limit on the set-point's acceleration that the runs state or show; NaN if none.
    acceleration_stated : bool
        Whether a register states it.
    """

    torque: float
    inertia: float
    p_gain: float
    known_load: bool
    torque_off: bool = False
    gravity: bool = False
    acceleration_rad_s2: float = float("nan")
    acceleration_stated: bool = False


@dataclass(frozen=True)
class Structure:
    """The base and some features.

    Attributes
    ----------
    features : tuple of str
        Of `FEATURES`.
    scales : Scales
    """

    features: tuple[str, ...]
    scales: Scales

    @property
    def name(self) -> str:
        """The features in words."""
        return " + ".join(self.features) or "base"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Fitted numbers, the dead time first and the offset last."""
        s = self.scales
        torque, inertia = s.torque, s.inertia
        # Wide priors: a factor of 5 to 10 either way; they decide only what the data leave open.
        own = [
            Parameter("dead_time_s", 0.015, 1e-4, LONGEST_DEAD_TIME_S, 1.5),
            Parameter("stiffness", 5 * torque, 0.02 * torque, 2000 * torque, 2.0),
            Parameter("stall_torque", 3 * torque, 0.05 * torque, 300 * torque, 1.2),
            Parameter("no_load_speed_rad_s", 9.0, 0.3, 200.0, 0.8),
            Parameter("friction_loss", 0.1 * torque, 1e-5 * torque, 10 * torque, 2.0),
        ]
        if s.known_load:
            own.append(Parameter("armature", 0.3 * inertia, 1e-4 * inertia, 300 * inertia, 2.0))
            own.append(Parameter("hanging_rad", 0.0, -0.3, 0.3, 0.03))
        if s.torque_off:
            own.append(Parameter("off_brake", 0.5, 0.0, 1.0, 1.0))
        if s.gravity:
            own.append(Parameter("gravity_sin", 0.0, -2 * torque, 2 * torque, 0.3 * torque))
            own.append(Parameter("gravity_cos", 0.0, -2 * torque, 2 * torque, 0.3 * torque))
        ramp = s.acceleration_rad_s2 if np.isfinite(s.acceleration_rad_s2) else 60.0
        extra = {
            "load_friction_motor": Parameter("load_friction_motor", 0.1, 1e-4, 0.95, 2.0),
            "load_friction_load": Parameter("load_friction_load", 0.05, 1e-4, 0.95, 2.0),
            "load_friction_quadratic": Parameter(
                "load_friction_quadratic", 0.05 / torque, 1e-5 / torque, 10 / torque, 2.0
            ),
            "load_friction_static": Parameter("load_friction_static", 0.3, 1e-3, 20.0, 2.0),
            "torque_limit_share": Parameter("torque_limit_share", 0.8, 0.1, 1.0, 0.5),
            "stribeck_friction": Parameter(
                "stribeck_friction", 0.05 * torque, 1e-5 * torque, 10 * torque, 2.0
            ),
            "stribeck_speed_rad_s": Parameter("stribeck_speed_rad_s", 0.1, 0.005, 3.0, 1.5),
            "acceleration_limit": Parameter(
                "acceleration_limit", ramp, 1.0, 3000.0, 0.03 if s.acceleration_stated else 1.2
            ),
            "damping": Parameter("damping", 0.05 * torque, 1e-5 * torque, 200 * torque, 2.0),
            "dead_zone_rad": Parameter("dead_zone_rad", 0.003, 1e-4, 0.05, 1.0),
            "start_duty": Parameter("start_duty", 0.01, 1e-4, 0.2, 1.5),
        }
        wanted = dict.fromkeys(name for f in self.features for name in FEATURES[f])
        own += [extra[name] for name in wanted]
        return (*own, Parameter("offset_rad", 0.0, -0.3, 0.3, 0.002 if s.known_load else 0.02))

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
        """Lower and upper bounds of the fitted coordinates."""
        ends = np.array([[float(p.encode(x)) for x in (p.low, p.high)] for p in self.parameters])
        return ends[:, 0], ends[:, 1]

    @cached_property
    def prior(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre and standard deviation of the fitted coordinates."""
        centre = np.array([float(p.encode(p.nominal)) for p in self.parameters])
        return centre, np.array([p.prior_sd for p in self.parameters])

    def decode(self, points: NDArray) -> NDArray[np.float64]:
        """Values of fitted coordinates (..., parameters)."""
        values = np.array(points, float)
        values[..., self.logarithmic] = np.exp(values[..., self.logarithmic])
        return values

    def encode(self, values: NDArray) -> NDArray[np.float64]:
        """Fitted coordinates of values (..., parameters)."""
        points = np.array(values, float)
        points[..., self.logarithmic] = np.log(points[..., self.logarithmic])
        return points

    def columns(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Columns of the kernel for values (candidates, parameters)."""
        own = dict(zip(self.names, values.T, strict=True))
        zero = np.zeros(len(values))
        stall, s = own["stall_torque"], self.scales
        sine, cosine = own.get("gravity_sin", zero), own.get("gravity_cos", zero)
        found = {
            "duty_per_rad": own["stiffness"] / (s.p_gain * stall),
            "duty_s_per_rad": own.get("damping", zero) / stall,
            "stall_torque": stall,
            "back_emf": stall / own["no_load_speed_rad_s"],
            "armature": own.get("armature", zero + 1.0),
            "friction_loss": own["friction_loss"],
            "stribeck_friction": own.get("stribeck_friction", zero),
            "stribeck_speed": own.get("stribeck_speed_rad_s", zero + 0.1),
            "torque_limit": own["torque_limit_share"] * stall
            if "torque_limit_share" in own
            else zero + np.inf,
            "off_brake": own.get("off_brake", zero),
            "acceleration_limit": own.get("acceleration_limit", zero + np.inf),
        }
        out = np.empty((len(values), WIDTH))
        for j, name in enumerate(COLUMNS):
            out[:, j] = found[name] if name in found else own.get(name, zero)
        out[:, OFFSET - 2] = np.hypot(sine, cosine)
        out[:, OFFSET - 1] = own.get("hanging_rad", zero) + np.arctan2(cosine, sine)
        out[:, OFFSET] = own["offset_rad"]
        return out

    def servo(self, values: NDArray[np.float64]) -> LoadedServoParameters:
        """The servo of one vector of values, its torques per inertia without a known load."""
        row = self.columns(values[None])[0]
        own = {name: float(row[j]) for j, name in enumerate(COLUMNS)}
        return LoadedServoParameters(**own, dead_time_s=float(values[0]))

    def adopt(self, other: Structure, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of another structure as points of this one; what is new is nearly without effect.

        Parameters
        ----------
        other : Structure
        points : ndarray, shape (..., parameters of the other)
        """
        neutral = {
            "torque_limit_share": 0.98,
            "acceleration_limit": 500.0,
            "stribeck_speed_rad_s": 0.1,
            "off_brake": 0.5,
        }
        out = np.empty((*points.shape[:-1], len(self.parameters)))
        low, high = self.box
        for j, p in enumerate(self.parameters):
            if p.name in other.names:
                out[..., j] = points[..., other.names.index(p.name)]
            else:
                value = neutral.get(p.name, 0.1 * p.nominal if p.logarithmic else p.nominal)
                out[..., j] = float(p.encode(value))
        return np.clip(out, low, high)
