"""What a recording's header says of a servo and its load: model, registers, pendulum.

    # servos: {"knee": {"model": "STS3215", "p_gain": 16, "registers": {"acceleration": 254}}}
    # loads: {"knee": {"mass_kg": 0.49, "length_m": 0.1}}

Both are optional. With a known load the servo's torques can be identified in N·m.
"""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from pupper_sysid.common.data_sheet import counts_of

_Positive = Annotated[float, Field(gt=0, le=1e6)]
_NotNegative = Annotated[float, Field(ge=0, le=1e6)]

GRAVITY_M_S2 = 9.81


class ServoSetup(BaseModel):
    """Servo of one joint as it was set; unknown keys are kept."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    model: str | None = None
    """Manufacturer's model name, such as `STS3215`."""
    firmware: str | None = None
    """Version of its firmware."""
    p_gain: _NotNegative | None = None
    """P gain of its position loop, the register's value; the column `p_gain` overrides it."""
    i_gain: _NotNegative | None = None
    """I gain, the register's value."""
    d_gain: _NotNegative | None = None
    """D gain, the register's value."""
    supply_voltage_v: _Positive | None = None
    """Nominal supply voltage [V]; the column `voltage_v` overrides it."""
    registers: dict[str, int] = {}
    """Other registers by name (`hardware.feetech.registers`)."""

    @property
    def set_point_acceleration_rad_s2(self) -> float | None:
        """Largest acceleration of the set-point by the servo's registers [rad/s²].

        None where it is not stated; infinite where there is no limit. The header has the number, or
        Feetech's register `acceleration`, in units of 100 counts/s².
        """
        units = self.registers.get("acceleration")
        if self.set_point_duration_s:
            unlimited = None
        elif units:
            unlimited = 100 * units * self._count_rad
        else:
            stated = units == 0 or "profile_velocity" in self.registers
            unlimited = math.inf if stated else None
        return (self.model_extra or {}).get("set_point_acceleration_rad_s2", unlimited)

    @property
    def set_point_speed_rad_s(self) -> float | None:
        """Largest speed of the set-point by the servo's registers [rad/s]; None for no limit.

        The header has the number, or Feetech's register `goal_speed`, in counts/s.
        """
        speed = self.registers.get("goal_speed", 0) * self._count_rad
        return (self.model_extra or {}).get("set_point_speed_rad_s", speed or None)

    @property
    def set_point_duration_s(self) -> float:
        """Duration that the servo's registers give to every motion [s]; 0 for none.

        The header has the number, or Feetech's register `goal_time` [ms], which a speed overrides.
        """
        duration = 0 if self.set_point_speed_rad_s else self.registers.get("goal_time", 0) / 1e3
        return (self.model_extra or {}).get("set_point_duration_s", duration)

    @property
    def _count_rad(self) -> float:
        return math.tau / (counts_of(self.model or "STS3215") or 4096.0)


class PendulumLoad(BaseModel):
    """Point mass on an arm that the servo swings about a horizontal axis.

    The gravity torque on the joint is `-gravity_nm * sin(position - hanging_rad)`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mass_kg: _NotNegative
    """Mass at the end of the arm [kg]."""
    length_m: _NotNegative
    """From the axis to the mass [m]."""
    arm_mass_kg: _NotNegative = 0.0
    """Mass of the arm, a uniform rod [kg]."""
    hanging_rad: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Position at which the mass hangs straight down [rad]."""

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia about the axis [kg·m²]: `(mass + arm_mass / 3) * length**2`."""
        return (self.mass_kg + self.arm_mass_kg / 3) * self.length_m**2

    @property
    def gravity_nm(self) -> float:
        """Largest torque of gravity [N·m]: `(mass + arm_mass / 2) * g * length`."""
        return (self.mass_kg + self.arm_mass_kg / 2) * GRAVITY_M_S2 * self.length_m
