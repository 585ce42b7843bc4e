"""Data sheet values of servos by model number: stall torque, no-load speed, supply, counts.

A free-air recording leaves the scale of the torques open; the stall torque of the servo's data
sheet sets it. `stall_torque` gives that of the recorded servo at its supply voltage;
`STALL_TORQUE_NM` of `common.joints` is the Mini Pupper's. `no_load_speed` bounds what a sweep asks
of a servo.

Data sheets state a few voltages. Between them torque and speed are taken as proportional to the
voltage of the nearest one, as those of a DC motor are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pupper_sysid.common.errors import InputError

_RPM = 2 * 3.141592653589793 / 60
_KG_CM = 0.0980665


@dataclass(frozen=True)
class Rating:
    """What a data sheet states at one supply voltage."""

    supply_v: float
    stall_torque_nm: float
    no_load_speed_rad_s: float | None
    """None where it is not stated."""
    source: str
    """Where it is stated."""


@dataclass(frozen=True)
class DataSheet:
    """One servo model; several ratings may be of several variants."""

    name: str
    """Manufacturer's model name."""
    model_number: int
    """What its model register holds."""
    counts_per_turn: float
    """Readings per turn of the output."""
    ratings: tuple[Rating, ...]
    """By rising voltage."""
    supply_range_v: tuple[float, float] | None = None
    """Lowest and highest supply of all variants [V]; None where it is not known."""

    def at(self, supply_v: float | None = None) -> Rating:
        """Rating at a supply voltage [V], in proportion to the nearest that is stated.

        Without one it is the lowest stated rating, whose source then says so.
        """
        if supply_v is None:
            lowest = self.ratings[0]
            if len(self.ratings) == 1:
                return lowest
            others = ", ".join(
                f"{r.stall_torque_nm:.2f} N·m at {r.supply_v:g} V" for r in self.ratings[1:]
            )
            doubt = f"{lowest.source}; the supply voltage is not recorded, and there is {others}"
            return replace(lowest, source=doubt)
        nearest = min(self.ratings, key=lambda r: abs(r.supply_v - supply_v))
        share, speed = supply_v / nearest.supply_v, nearest.no_load_speed_rad_s
        if share == 1:
            return nearest
        return Rating(
            supply_v, nearest.stall_torque_nm * share, None if speed is None else speed * share,
            f"{nearest.source}; in proportion from {nearest.supply_v:g} V to {supply_v:g} V",
        )  # fmt: skip


def _sheet(
    name: str, number: int, counts: float, supply_v: tuple[float, float] | None,
    source: str, *stated: tuple[float, float, float | None],
) -> DataSheet:  # fmt: skip
    """Stated are supply [V], stall torque [N·m] and no-load speed [rpm]."""
    ratings = (Rating(v, torque, rpm and rpm * _RPM, source) for v, torque, rpm in stated)
    return DataSheet(name, number, counts, tuple(ratings), supply_v)


_EMANUAL = "Robotis e-Manual of the {}"
_SHEETS = (
    DataSheet(
        "STS3215", 777, 4096,
        (
            Rating(
                7.4, 19.5 * _KG_CM, 52 * _RPM,
                "data sheet of the 7.4 V variant, 19.5 kg·cm and 52 rpm, as quoted by DFRobot for "
                "SER0069",
            ),
            Rating(
                12.0, 30 * _KG_CM, 45 * _RPM,
                "Feetech data sheet of the 12 V variant (C018), 30 kg·cm and 45 rpm, as quoted in "
                "TheRobotStudio/SO-ARM100 issue 134",
            ),
        ),
        (4.0, 14.0),  # factory registers: 4.0 V, and 14.0 V of the 12 V variant
    ),
    _sheet(
        "STS3250", 2825, 4096, None,
        "Feetech specification of 2024-01-16, 50 kg·cm and 0.133 s/60°, as quoted by robonine.com",
        (12.0, 50 * _KG_CM, 10 / 0.133),
    ),
    _sheet(
        "HD-1910", 0, 4096, (4.0, 8.4),  # its model number is not published
        "vendor's sheet of the HD-1910-C001, 10 kg·cm and 0.09 s/60°, as quoted by Microduck's "
        "builders, of whom others state 12 kg·cm",
        (7.4, 10 * _KG_CM, 110),
    ),
    _sheet(
        # a Mini Pupper switches them off at 4.0 V; two lithium cells, freshly charged
        "SCS0009", 1284, 1024 * 1.2, (4.0, 8.7),
        "vendor's page, 2.3 kg·cm at 6 V; the shop of the Mini Pupper states 3.5 kg·cm for its "
        "servo of this class",
        (6.0, 2.3 * _KG_CM, None),
    ),
    _sheet(
        "XL330-M288", 1200, 4096, (3.7, 6.0), _EMANUAL.format("XL330-M288-T"),
        (3.7, 0.42, 76), (5.0, 0.52, 103), (6.0, 0.60, 123),
    ),
    _sheet(
        # factory registers; 6.5 to 12.0 V are recommended
        "XL430-W250", 1060, 4096, (6.0, 14.0), _EMANUAL.format("XL430-W250"),
        (9.0, 1.0, 47), (11.1, 1.4, 57), (12.0, 1.5, 61),
    ),
    _sheet(
        "XM430-W350", 1020, 4096, (9.5, 16.0), _EMANUAL.format("XM430-W350"),
        (11.1, 3.8, 43), (12.0, 4.1, 46), (14.8, 4.8, 57),
    ),
    _sheet(
        "XM430-W210", 1030, 4096, (9.5, 16.0), _EMANUAL.format("XM430-W210"),
        (11.1, 2.7, 70), (12.0, 3.0, 77), (14.8, 3.7, 95),
    ),
    _sheet(
        "MX-28", 30, 4096, (9.5, 16.0), _EMANUAL.format("MX-28"),
        (12.0, 2.5, 55), (14.8, 3.1, 67),
    ),
)  # fmt: skip


def data_sheet(model: str | int) -> DataSheet | None:
    """Data sheet of a servo by its model number, or by a name that contains the model's.

    Examples
    --------
    >>> data_sheet(777).name, data_sheet("Feetech STS3215").name, data_sheet("MG90S")
    ('STS3215', 'STS3215', None)
    """
    if isinstance(model, int):
        return next((s for s in _SHEETS if s.model_number == model), None)
    plain = model.upper().replace(" ", "").replace("_", "-")
    return next((s for s in _SHEETS if s.name in plain), None)


_FACTORY_P_GAINS = {
    "STS3215": (32.0, "the default that LeRobot's settings name"),
    "XL330": (400.0, "Robotis e-Manual of the XL330, Position P Gain (84)"),
    "XL430": (640.0, "Robotis e-Manual of the XL430, Position P Gain (84)"),
    "XM430": (800.0, "Robotis e-Manual of the XM430, Position P Gain (84)"),
    "MX-28": (850.0, "Robotis e-Manual of the MX-28(2.0), Position P Gain (84)"),
    "SCS0009": (15.0, "register of a servo as delivered"),
}
"""P gain registers as servos leave the factory, by family, and their sources."""


def factory_p_gain(model: str | int) -> tuple[float, str] | None:
    """P gain of a servo model as it leaves the factory, and its source; None if it is not known.

    Examples
    --------
    >>> factory_p_gain("Feetech STS3215")[0], factory_p_gain("xl330")[0], factory_p_gain("MG90S")
    (32.0, 400.0, None)
    """
    sheet = data_sheet(model)
    name = sheet.name if sheet else str(model).upper().replace(" ", "").replace("-", "")
    return next((known for family, known in _FACTORY_P_GAINS.items() if family in name), None)


def counts_of(model: str | int) -> float | None:
    """Readings per turn of a servo model; None if it is not known."""
    sheet = data_sheet(model)
    return sheet.counts_per_turn if sheet else None


def stall_torque(model: str | int, supply_v: float | None = None) -> tuple[float, str]:
    """Stall torque [N·m] of a servo model at a supply voltage, and its source in words.

    Examples
    --------
    >>> torque, source = stall_torque("STS3215", 12.0)
    >>> round(torque, 2)
    2.94
    """
    sheet = data_sheet(model)
    if sheet is None:
        raise InputError(
            f"No data sheet of the servo {model} is known here. Give its stall torque with "
            f"`stall_torque_nm`; known are {', '.join(s.name for s in _SHEETS)}."
        )
    rating = sheet.at(supply_v)
    return rating.stall_torque_nm, f"{sheet.name} at {rating.supply_v:g} V: {rating.source}"


def no_load_speed(model: str | int, supply_v: float | None = None) -> float | None:
    """Speed without load [rad/s] of a servo model at a supply voltage; None if it is not known.

    Examples
    --------
    >>> round(no_load_speed("STS3215", 12.0), 2), no_load_speed("SCS0009")
    (4.71, None)
    """
    sheet = data_sheet(model)
    return sheet.at(supply_v).no_load_speed_rad_s if sheet else None


def supply_range(model: str | int) -> tuple[float, float] | None:
    """Lowest and highest supply voltage [V] of a servo model; None if it is not known.

    Examples
    --------
    >>> supply_range("STS3215"), supply_range("MG90S")
    ((4.0, 14.0), None)
    """
    sheet = data_sheet(model)
    return sheet.supply_range_v if sheet else None


def recorded_stall_torque(servos: Iterable[Mapping[str, Any]]) -> tuple[float, str] | None:
    """Stall torque [N·m] of a joint's servo by what its recordings say of it, and the source.

    `servos` are its set-ups in the recordings' headers: `model` and `supply_voltage_v`, where they
    are known. None where no recording names a model whose data sheet is known.

    Examples
    --------
    >>> torque = recorded_stall_torque([{"model": "STS3215", "supply_voltage_v": 12.0}])
    >>> round(torque[0], 2), recorded_stall_torque([{}]) is None
    (2.94, True)
    """
    known = [s for s in servos if s.get("model") and data_sheet(s["model"])]
    if not known:
        return None
    volts = next((s["supply_voltage_v"] for s in known if s.get("supply_voltage_v")), None)
    return stall_torque(known[0]["model"], volts)
