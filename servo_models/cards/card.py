"""Servo card: a calibration without a robot, in one YAML file.

A card holds the numbers of one servo type at one supply voltage and one set of gains, their origin
(repository, file, commit, licence; for our own fits hashes of the data and scores), and whether
they are published by others or measured here. A card of several specimens, such as the joints of an
arm, has their numbers by name; a joint of that name takes its own, any other the default's.
`cards.files` reads one.

`ServoCard.calibration` is the same as a calibration, which every joint name fits, so that a card is
accepted wherever a calibration is. Its feedback is ideal: a card has no bus.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pupper_sysid.common.border import Part
from pupper_sysid.common.data_sheet import counts_of
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import write_text
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.calibration import Calibration, InputFile
from pupper_sysid.servo_models.calibration.parts import (
    NO_SPEED_LIMIT_RAD_S,
    NOT_STATED,
    P_GAINS,
    PARAMETER_KEYS,
    Actuator,
    Armature,
    Feedback,
    FittedServo,
    JointCalibration,
    OperatingPoint,
    RatiosToArmature,
    Scale,
    Selection,
)
from pupper_sysid.servo_models.calibration.quantity import NotNegative, Number, Quantity
from pupper_sysid.servo_models.cards.numbers import (
    LOADED_KEYS,
    LoadedLoop,
    PositionLoop,
    ServoNumbers,
    TorquePD,
    stated,
)
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, whole_steps
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters

SCHEMA = "pupper-servo-card"
SCHEMA_VERSION = 1

_Text = Annotated[str, Field(min_length=1)]

_HEADER = """\
# Servo card of pupper-sysid: numbers of one servo type, and where they come from.
#
# A bare number is stated without an interval. One that was measured here reads
# {value, low, high, identified, why}; low and high are the ends of its 90 % interval.
# SI units, at the end of each name; torques hold at `supply_v`. Unknown keys are refused.
"""


class Gains(Part):
    """Gains of the firmware's position loop, as registers hold them."""

    p: Annotated[Number, Field(gt=0)] | None = None
    """P gain, or null where the source does not state it."""
    i: NotNegative | None = None
    """I gain, or null."""
    d: NotNegative | None = None
    """D gain, or null."""


class Source(Part):
    """Origin of the numbers."""

    title: _Text
    """Name of the work or data set."""
    url: Annotated[str, Field(pattern=r"^https://\S+$")]
    """Its address."""
    file: str | None = None
    """File inside the repository that states the numbers."""
    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None = None
    """Commit at which that file was read."""
    licence: _Text
    """Licence of that file, in words."""


class Score(Part):
    """One error of the numbers on recordings."""

    what: _Text
    """Which error, and on which recordings."""
    value: NotNegative
    """Its value, in `unit`."""
    unit: _Text
    """Its unit, such as rad."""


class ServoCard(Part):
    """Numbers of one servo type. Frozen; see the module's text."""

    schema_name: Annotated[Literal["pupper-servo-card"], Field(alias="schema")] = SCHEMA
    """Kind of the file."""
    schema_version: Literal[1] = SCHEMA_VERSION
    """Version of the file's format."""
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
    """Name of the card: lower-case letters, digits and hyphens."""
    servo: _Text
    """Manufacturer and model of the servo."""
    sku: str | None = None
    """Manufacturer's order number of the variant, or null."""
    supply_v: Annotated[Number, Field(gt=0, le=100)] | None = None
    """Supply voltage of the numbers [V], or null where the source does not state it."""
    gains: Gains = Gains()
    """Gains at which the numbers hold."""
    load: _Text
    """What the servo moved when it was measured."""
    armature: Armature = "servo"
    """What the armature includes: `servo` is motor and gears alone."""
    published: bool
    """Whether the numbers are cited from others; false for a fit of this project."""
    source: Source
    """Origin of the numbers; of our own fits, of their recordings."""
    data: Annotated[tuple[InputFile, ...], Field(strict=False)] = ()
    """Recordings of our own fit, by name and hash."""
    scores: Annotated[tuple[Score, ...], Field(strict=False)] = ()
    """Errors of the numbers on recordings."""
    date: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$")]
    """Day on which the numbers were read from the source, or fitted: year-month-day."""
    notes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Notes for the reader, in sentences."""
    as_published: dict[str, Number | str] = Field(default_factory=dict)
    """Parameters word for word as the source has them, where ours are derived from them."""
    default: _Text = "servo"
    """Specimen that stands for the servo type."""
    specimens: Annotated[dict[str, ServoNumbers], Field(min_length=1)]
    """Numbers by specimen; a single one is called servo."""

    @model_validator(mode="after")
    def _check(self) -> ServoCard:
        if self.default not in self.specimens:
            known = ", ".join(self.specimens)
            raise ValueError(f"default is {self.default}, which is no specimen of it ({known})")
        loops = any(not isinstance(n, TorquePD) for n in self.specimens.values())
        if loops and (self.gains.p is None or self.supply_v is None):
            raise ValueError("numbers of a position loop need gains.p and supply_v")
        return self

    @property
    def numbers(self) -> PositionLoop | LoadedLoop | TorquePD:
        """Numbers of the default specimen."""
        return self.specimens[self.default]

    def pd(self, joint: str | None = None, p_gain: float | None = None) -> TorquePD:
        """The servo as a PD in torque, perhaps at another P gain than the card's.

        A joint with the name of a specimen is that; any other means the default.
        """
        numbers = self.specimens.get(joint or self.default, self.numbers)
        if not isinstance(numbers, TorquePD):
            gain = self.gains.p if p_gain is None else p_gain
            assert gain is not None
            refuse_outside("`p_gain`", gain, *P_GAINS)
            return numbers.as_pd(gain)
        if p_gain is not None and p_gain != self.gains.p:
            raise InputError(
                f"{self.name} states torques, not how they follow from the P gain, so they hold "
                f"only as they are. Leave `p_gain` out, or take a card of a position loop."
            )
        return numbers

    def loaded(self, joint: str | None = None) -> tuple[LoadedServoParameters, float]:
        """The servo as a position loop with motor and friction, for `LoadedServo`, and its P gain.

        Joints are as for `pd`. The gain is that at which the numbers are the card's; 1 where the
        card states torques without one.
        """
        numbers = self.specimens.get(joint or self.default, self.numbers)
        gain = self.gains.p
        if isinstance(numbers, TorquePD):
            stated_at = 1.0 if gain is None else gain
            return numbers.loaded(stated_at), stated_at
        assert gain is not None
        return numbers.loaded(), gain

    @property
    def operating_point(self) -> OperatingPoint:
        """P gain, armature and load that the numbers hold for."""
        known = self.gains.p is not None
        return OperatingPoint(
            p_gain=self.gains.p, p_gain_source=f"card {self.name}" if known else NOT_STATED,
            armature=self.armature, load=self.load,
        )  # fmt: skip

    def calibration(self) -> Calibration:
        """The card as a calibration that fits every joint name."""
        return CardCalibration(
            robot=f"any robot with {self.servo} (card {self.name})",
            created=f"{self.date}T00:00:00+00:00",
            inputs=self.data,
            notes=tuple(self._notes()),
            # the default first: it is what other joints fall back on
            joints={
                name: self._joint(name)
                for name in sorted(self.specimens, key=lambda name: name != self.default)
            },
        )

    def to_yaml(self) -> str:
        """Text of the file: a header that explains it, then the data."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        return f"{_HEADER}\n{dump(data)}"

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write this card to `path` as YAML, in one atomic step."""
        write_text(Path(path), self.to_yaml(), force)

    def _notes(self) -> list[str]:
        kind = "cited from" if self.published else "fitted here to recordings of"
        notes = [
            f"Servo card {self.name}: {kind} {self.source.title}, {self.source.url}.",
            "A card has no bus: its feedback is ideal, every reading fresh and on time.",
        ]
        numbers = self.numbers
        if not isinstance(numbers, TorquePD) and numbers.left_out_of_pd:
            notes.append(numbers.left_out_of_pd)
        if self.pd().dead_time_s is None:
            notes.append("The source has no dead time; 0 stands for it.")
        return [*notes, *self.notes]

    def _joint(self, name: str) -> JointCalibration:
        pd = self.pd(name)
        armature = pd.armature_kg_m2.value
        dead = pd.dead_time_s or Quantity(value=0.0, identified="no", why="the source has none")
        low, high = whole_steps(dead.interval.low, dead.interval.high, TIME_STEP_S)
        torques: dict[str, Any] = {
            "stiffness": pd.stiffness_nm_per_rad,
            "damping": pd.damping_nm_s_per_rad or _absent(),
            "friction_loss": pd.friction_loss_nm,
            "effort_limit": pd.effort_limit_nm,
            "back_emf": pd.back_emf_nm_s_per_rad or _absent(),
        }
        counts = counts_of(self.servo)
        return JointCalibration(
            operating_point=self.operating_point,
            actuator=Actuator(
                model="delayed_pd",
                armature_kg_m2=pd.armature_kg_m2,
                velocity_limit_rad_s=pd.velocity_limit_rad_s or _absent(NO_SPEED_LIMIT_RAD_S),
                dead_time_s=dead,
                delay_steps_min=low,
                delay_steps_max=high,
                physics_step_s=TIME_STEP_S,
                **{PARAMETER_KEYS[name]: quantity for name, quantity in torques.items()},
                ratios_to_armature=RatiosToArmature(
                    **{n: stated(q.value / armature) for n, q in torques.items()}
                ),
                scale=Scale(
                    anchor="preset" if self.published else "loaded recording",
                    value_nm=pd.effort_limit_nm.value,
                    source=f"servo card {self.name} ({self.source.title})",
                ),
            ),
            servo=self._fitted_servo(name),
            feedback=Feedback(
                poll_period_s=_ideal(), loss=_ideal(), offset_rad=_ideal(), mean_age_s=_ideal(),
                quantum_rad=_ideal(2 * float(np.pi) / counts if counts else 0.0),
            ),
            selection=Selection(model=f"card {self.name}"),
        )  # fmt: skip

    def _fitted_servo(self, name: str) -> FittedServo | None:
        """The servo at any P gain and load; None where the card states torques at one gain."""
        numbers, gain = self.specimens[name], self.gains.p
        if isinstance(numbers, TorquePD) or gain is None:
            return None
        values: dict[str, Any] = {key: getattr(numbers, key, None) for key in LOADED_KEYS.values()}
        if isinstance(numbers, PositionLoop):
            arrays = numbers.loaded().arrays()
            finite = {n: float(x) for n, x in arrays.items() if np.isfinite(x) and x != 0}
            values = {key: stated(finite[n]) for n, key in LOADED_KEYS.items() if n in finite}
            values.setdefault("friction_loss_nm", stated(0.0))
        values["duty_s_per_rad"] = values.get("duty_s_per_rad") or stated(0.0)
        values.pop("dead_time_s", None)
        return FittedServo(
            structure=f"card {self.name}", known_load=True, p_gain=gain, p_gains_tested=(gain,),
            reference_voltage_v=self.supply_v, **values,
        )  # fmt: skip


class CardCalibration(Calibration):
    """A card as a calibration: joints without a specimen take the default's."""

    def joint(self, name: str) -> JointCalibration:
        """Calibration of the joint `name`, whatever its name."""
        return self.joints.get(name) or next(iter(self.joints.values()))


def _absent(value: float = 0.0) -> Quantity:
    return Quantity(value=value, identified="no", why="the model has none")


def _ideal(value: float = 0.0) -> Quantity:
    return Quantity(value=value, identified="no", why="a card has no bus")
