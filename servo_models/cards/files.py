"""Servo cards from files and back: our YAML, those that are shipped, parameter files of BAM.

card = load_card("sts3215-bam-m1")         # shipped, see `card_names`
card = load_card("my_servo.yaml")
card = load_card("params/m6.json")         # as BAM's fit writes it

"Better actuator models" (BAM, Rhoban/bam) identifies servos on a pendulum and writes one JSON file
per friction model, M1 to M6. The file has the motor as torque constant kt [N·m/A = V·s/rad] and
resistance R [Ω]; supply voltage, P gain, duty per error and largest duty are constants of BAM's
class for that actuator (`ACTUATORS`). Ours follow as::

    stall torque = kt / R * supply voltage        at full duty, standstill
    back-EMF     = kt^2 / R
    duty_per_rad = error_gain of the class * error_gain_ratio

and back as kt = back-EMF / s, R = kt / s with s = stall torque / supply voltage. `q_offset` is the
zero of the test bench, no number of the servo. The largest duty clips the torque; BAM's own
`to_mujoco` multiplies the stiffness by it, too, which makes it 3 % smaller than here.
"""

from __future__ import annotations

import difflib
import math
from datetime import UTC, datetime
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import ConfigDict

from pupper_sysid.common.border import Part, read_json, read_own, read_text, read_yaml, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import LOADED_KEYS, FittedServo
from pupper_sysid.servo_models.calibration.quantity import NotNegative, Number
from pupper_sysid.servo_models.cards.card import SCHEMA, SCHEMA_VERSION, Gains, ServoCard, Source
from pupper_sysid.servo_models.cards.numbers import PositionLoop, stated

URL = "https://github.com/Rhoban/bam"


class Actuator(NamedTuple):
    """Constants of one of BAM's actuator classes."""

    servo: str
    supply_v: float
    p_gain: float
    error_gain: float
    """Duty per unit of the P register and radian [1/rad]."""
    duty_limit: float
    has_ratio: bool
    """Whether the file may scale the error gain and limit the set-point's speed."""


ACTUATORS = {
    "sts3215": Actuator("Feetech STS3215", 7.4, 32, 0.166, 0.97, True),
    "xl330": Actuator("Dynamixel XL330-M288", 7.4, 400, 0.00246, 1.0, False),
    "sts3215v12": Actuator("Feetech STS3215", 12.1, 32, 0.164890901, 1.0, False),
    "sts3215_12v": Actuator("Feetech STS3215", 12.1, 32, 0.164787755, 1.0, True),
}
"""By the file's `actuator`: the first two are BAM's, the others K-Scale's."""


class BamParameters(Part):
    """Content of a parameter file; a friction that its model lacks is absent."""

    model_config = ConfigDict(protected_namespaces=())

    model: Literal["m1", "m2", "m3", "m4", "m5", "m6"]
    """Friction model."""
    actuator: str
    """Name of BAM's actuator class."""
    kt: NotNegative
    """Torque constant [N·m/A]."""
    R: NotNegative
    """Resistance [Ω]."""
    armature: NotNegative
    """Reflected inertia [kg·m²]."""
    friction_base: NotNegative
    """Coulomb friction [N·m]."""
    friction_viscous: NotNegative
    """Viscous friction [N·m·s/rad]."""
    error_gain_ratio: NotNegative | None = None
    """Factor on the class's error gain."""
    max_velocity: NotNegative | None = None
    """Largest rate of the set-point [rad/s]."""
    command_delay: NotNegative | None = None
    """Dead time [s]."""
    q_offset: Number | None = None
    """Zero of the test bench [rad]."""
    friction_stribeck: NotNegative | None = None
    """Friction that is added at standstill [N·m]."""
    dtheta_stribeck: NotNegative | None = None
    """Speed over which it fades [rad/s]."""
    alpha: NotNegative | None = None
    """Exponent of its decay."""
    load_friction_base: NotNegative | None = None
    """Friction per torque, M3 and M4."""
    load_friction_stribeck: NotNegative | None = None
    """The same that is added at standstill, M4."""
    load_friction_motor: NotNegative | None = None
    """Friction per torque of the motor, M5 and M6."""
    load_friction_external: NotNegative | None = None
    """Friction per torque of the load, M5 and M6."""
    load_friction_motor_stribeck: NotNegative | None = None
    """Per torque of the motor, added at standstill, M5 and M6."""
    load_friction_external_stribeck: NotNegative | None = None
    """Per torque of the load, added at standstill, M5 and M6."""
    load_friction_motor_quad: NotNegative | None = None
    """Per squared torque of the motor, M6."""
    load_friction_external_quad: NotNegative | None = None
    """Per squared torque of the load, M6."""
    score: Number | None = None
    """Mean absolute error of the fit [rad], as K-Scale writes it."""
    trial_number: Number | None = None
    """Trial of the search, as K-Scale writes it."""


_BAM_NAMES = {
    "armature_kg_m2": "armature", "friction_loss_nm": "friction_base",
    "viscous_friction_nm_s_per_rad": "friction_viscous",
    "stribeck_friction_nm": "friction_stribeck", "stribeck_speed_rad_s": "dtheta_stribeck",
    "stribeck_exponent": "alpha", "load_friction_motor": "load_friction_motor",
    "load_friction_load": "load_friction_external",
    "load_stribeck_motor": "load_friction_motor_stribeck",
    "load_stribeck_load": "load_friction_external_stribeck",
    "load_quadratic_motor": "load_friction_motor_quad",
    "load_quadratic_load": "load_friction_external_quad",
    "velocity_limit_rad_s": "max_velocity", "dead_time_s": "command_delay",
}  # fmt: skip
"""Numbers of a `PositionLoop` and BAM's parameters that are the same."""
_ON_TORQUE = ("load_friction_motor", "load_friction_external")


def load_bam(path: Path) -> ServoCard:
    """A card of a BAM parameter file, with the constants of its actuator class."""
    data = read_json(path)
    if not isinstance(data, dict) or not {"kt", "R", "model"} <= data.keys():
        raise InputError(
            f"{path} is neither a servo card nor a parameter file of BAM: it has no kt, R and "
            "model. Give a card (.yaml) or a file that BAM's fit wrote."
        )
    parameters = validated(BamParameters, data, path)
    kind = ACTUATORS.get(parameters.actuator)
    if kind is None:
        raise InputError(
            f"{path}: the actuator {printable(parameters.actuator)} is not known here, so its P "
            f"gain and supply voltage are not, either. Known are {', '.join(ACTUATORS)}."
        )
    return ServoCard(
        name=_name(path.stem),
        servo=kind.servo,
        supply_v=kind.supply_v,
        gains=Gains(p=kind.p_gain, i=0, d=0),
        load="pendulum",
        published=True,
        source=Source(
            title=f"BAM parameter file {printable(path.name)}", url=URL, licence="that of the file"
        ),
        date=datetime.now(UTC).date().isoformat(),
        as_published=data,
        specimens={"servo": from_bam(parameters, kind, path)},
    )


def from_bam(
    parameters: BamParameters, kind: Actuator, name: Path | str = "The parameters"
) -> PositionLoop:
    """Numbers of a card from BAM's; see the module's text."""
    p = parameters
    if p.R == 0 or p.kt == 0:
        raise InputError(f"{name}: kt and R must be above 0. Fit it again.")
    if p.error_gain_ratio == 0:
        raise InputError(f"{name}: error_gain_ratio is 0; it must be above 0. Fit it again.")
    ratio = 1.0 if p.error_gain_ratio is None else p.error_gain_ratio
    shared: dict[str, float | None] = dict.fromkeys(_ON_TORQUE, p.load_friction_base)
    shared |= {f"{name}_stribeck": p.load_friction_stribeck for name in _ON_TORQUE}  # M3, M4
    numbers = {
        "duty_per_rad": kind.error_gain * ratio,
        "duty_limit": kind.duty_limit,
        "stall_torque_nm": p.kt / p.R * kind.supply_v,
        "back_emf_nm_s_per_rad": p.kt**2 / p.R,
    } | {
        ours: shared.get(theirs) if (value := getattr(p, theirs)) is None else value
        for ours, theirs in _BAM_NAMES.items()
    }  # fmt: skip
    values = {key: stated(value) for key, value in numbers.items() if value is not None}
    return validated(
        PositionLoop, {"model": "position_loop", **values}, name, remedy="Fit it again."
    )


def to_bam(card: ServoCard) -> dict[str, Any]:
    """Content of a BAM parameter file with the numbers of a card's default specimen."""
    numbers = card.numbers
    if not isinstance(numbers, PositionLoop) or card.supply_v is None:
        raise InputError(
            f"{card.name} states torques of a simulator, not position loop and motor, which BAM "
            "needs. Take a card of a position_loop (`pupper-sysid servo list`)."
        )
    name, kind = class_of(card)
    per_volt, emf = numbers.stall_torque_nm.value / card.supply_v, numbers.back_emf_nm_s_per_rad
    if per_volt == 0 or emf.value == 0:
        raise InputError(f"{card.name} has no stall torque or no back-EMF, so kt is unknown.")
    kt = emf.value / per_volt
    values: dict[str, Any] = {"kt": kt}
    if kind.has_ratio:
        values["error_gain_ratio"] = numbers.duty_per_rad.value / kind.error_gain
    values |= {"R": kt / per_volt, "armature": numbers.armature_kg_m2.value, "q_offset": 0.0}
    if kind.has_ratio:
        values["max_velocity"] = numbers.velocity_limit_rad_s
    values |= {"command_delay": numbers.dead_time_s, "friction_base": numbers.friction_loss_nm}
    model, frictions = _frictions(numbers)
    values |= frictions
    values["friction_viscous"] = numbers.viscous_friction_nm_s_per_rad or stated(0.0)
    plain = {k: getattr(v, "value", v) for k, v in values.items() if v is not None}
    return plain | {"model": model, "actuator": name}


def not_in_bam(card: ServoCard) -> list[str]:
    """What BAM's class for this servo fixes and the card has otherwise, in sentences."""
    name, kind = class_of(card)
    numbers, notes = card.numbers, []
    if isinstance(numbers, PositionLoop):
        gain = numbers.duty_per_rad.value
        if not kind.has_ratio and abs(gain / kind.error_gain - 1) > 1e-6:
            notes.append(
                f"BAM's class {name} has the error gain {kind.error_gain:g} built in; the card's "
                f"is {gain:.5g}, so its stiffness will differ by that ratio."
            )
        if abs(numbers.duty_limit.value - kind.duty_limit) > 1e-9:
            notes.append(
                f"BAM's class {name} limits the duty to {kind.duty_limit:g}; the card has "
                f"{numbers.duty_limit.value:g}."
            )
        if not kind.has_ratio and numbers.velocity_limit_rad_s is not None:
            notes.append(f"BAM's class {name} has no limit of the set-point's speed.")
    if (card.supply_v, card.gains.p) != (kind.supply_v, kind.p_gain):
        notes.append(
            f"BAM's logs state supply voltage and P gain; where one does not, its class takes "
            f"{kind.supply_v:g} V and {kind.p_gain:g}, the card is for {card.supply_v:g} V and "
            f"{card.gains.p:g}."
        )
    return notes


def class_of(card: ServoCard) -> tuple[str, Actuator]:
    """BAM's actuator class for the servo of a card."""
    bam_class = card.as_published.get("actuator")
    if isinstance(bam_class, str) and bam_class in ACTUATORS:
        return bam_class, ACTUATORS[bam_class]
    return _class_for(card.servo)


def _class_for(servo: str) -> tuple[str, Actuator]:
    for name, kind in ACTUATORS.items():
        if kind.servo.split()[-1] in servo:
            return name, kind
    raise InputError(
        f"BAM has no actuator class for {servo}; known here are "
        f"{', '.join(ACTUATORS)}. Its parameter file would not be readable there."
    )


STRIBECK_EXPONENT = 1.35
"""Decay of the friction at standstill where a source states none: that of BAM's own fits."""

_NOT_IN_BAM = {
    "duty_s_per_rad": "duty per velocity (a D gain)",
    "load_friction_quadratic_per_nm": "friction that grows with the squared torque",
    "dead_zone_rad": "the dead zone",
    "start_duty": "the minimum start force",
    "acceleration_limit_rad_s2": "the limit on the set-point's acceleration",
    "velocity_limit_rad_s": "the limit on the set-point's speed",
}


def motor_of(servo: FittedServo) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Motor and friction of a servo fitted under load, by the names of Isaac Lab's `BamMotorCfg`.

    BAM's friction at standstill decays as exp(-(v / v0)^a), ours as 1 / (1 + (v / v1)^2); v0 is
    such that half of it is left at the same speed. The second value is what BAM's models do not
    have, in words.
    """
    quantities = {key: getattr(servo, key) for key in LOADED_KEYS.values()}
    value = {key: 0.0 if q is None else q.value for key, q in quantities.items()}
    viscous = value["off_brake"] * value["back_emf_nm_s_per_rad"]
    emf = value["back_emf_nm_s_per_rad"] - viscous
    per_volt = value["stall_torque_nm"] / (servo.reference_voltage_v or 1.0)
    if not emf > 0:
        raise InputError(
            "This servo was fitted without a back-EMF, so its kt is unknown. Export it to isaaclab."
        )
    kt = emf / per_volt
    static = value["load_friction_static"]
    on_motor, on_load = value["load_friction_motor"], value["load_friction_load"]
    decay = math.log(2) ** (1 / STRIBECK_EXPONENT)
    stribeck, loaded = value["stribeck_friction_nm"], on_motor + on_load
    motor = {
        "model": "m5" if loaded else "m2" if stribeck else "m1",
        "kt": kt,
        "resistance": kt / per_volt,
        "error_gain": value["duty_per_rad"],
        "max_pwm": 1.0,
        "max_current": value["torque_limit_nm"] / kt,
        "friction_base": value["friction_loss_nm"],
        "friction_viscous": viscous,
        "friction_stribeck": stribeck,
        "dtheta_stribeck": (value["stribeck_speed_rad_s"] or 0.1) / decay,
        "alpha": STRIBECK_EXPONENT,
        "load_friction_motor": on_motor,
        "load_friction_external": on_load,
        "load_friction_motor_stribeck": static * on_motor,
        "load_friction_external_stribeck": static * on_load,
    }
    return motor, tuple(words for key, words in _NOT_IN_BAM.items() if value.get(key))


def bam_card(calibration: Calibration) -> ServoCard:
    """The servo of a calibration under load as a card whose numbers are those of BAM's models.

    Refused if it is of several joints, was not fitted under a known load, states no supply voltage,
    or is not of a servo that BAM knows.
    """
    (name, joint), *others = calibration.joints.items()
    block = joint.servo
    if block is None or not block.known_load:
        raise InputError(
            f"{name} was fitted without a known load: its torques are known only relative to the "
            "inertia that it moved, so that BAM's kt and R are not. Record it as it swings a known "
            "pendulum (`pupper-sysid sweep`), or give a servo card."
        )
    if others:
        raise InputError(
            f"BAM's file is of one servo, and this calibration of {len(others) + 1} joints: "
            f"{', '.join(calibration.joints)}. Calibrate one of them alone."
        )
    if block.reference_voltage_v is None:
        raise InputError(
            f"{name}: its recordings state no supply voltage, without which kt and R are unknown."
        )
    motor, (_, kind) = motor_of(block)[0], _class_for(calibration.robot)
    # our full duty is the largest that the servo's firmware gives
    numbers = {
        "duty_per_rad": motor["error_gain"] * kind.duty_limit,
        "duty_limit": kind.duty_limit,
        "stall_torque_nm": block.stall_torque_nm.value / kind.duty_limit,
        "back_emf_nm_s_per_rad": block.back_emf_nm_s_per_rad.value - motor["friction_viscous"],
        "armature_kg_m2": block.armature_kg_m2.value,
        "friction_loss_nm": motor["friction_base"],
        "viscous_friction_nm_s_per_rad": motor["friction_viscous"] or None,
        "dead_time_s": joint.actuator.dead_time_s.value,
        "velocity_limit_rad_s": block.velocity_limit_rad_s and block.velocity_limit_rad_s.value,
    }
    prefixes = {"m1": (), "m2": ("stribeck",), "m5": ("stribeck", "load_")}[motor["model"]]
    numbers |= {k: motor.get(bam) for k, bam in _BAM_NAMES.items() if k.startswith(prefixes)}
    values = {key: stated(value) for key, value in numbers.items() if value is not None}
    return ServoCard(
        name="calibration",
        servo=calibration.robot,
        supply_v=block.reference_voltage_v,
        gains=Gains(p=block.p_gain),
        load="known",
        published=False,
        source=Source(title="a calibration of this project", url=URL, licence="its owner's"),
        date=str(calibration.created)[:10],
        specimens={"servo": PositionLoop(model="position_loop", **values)},
    )


def lost_in_bam(calibration: Calibration) -> list[str]:
    """What BAM's models do not have of a servo under load, in sentences."""
    (joint,) = calibration.joints.values()
    assert joint.servo is not None
    return [f"Not represented: {words}." for words in motor_of(joint.servo)[1]]


def _frictions(numbers: PositionLoop) -> tuple[str, dict[str, Any]]:
    """The smallest friction model that holds the numbers, and its parameters."""
    n = numbers
    stribeck = {
        "friction_stribeck": n.stribeck_friction_nm or stated(0.0),
        "dtheta_stribeck": n.stribeck_speed_rad_s or stated(0.2),
        "alpha": n.stribeck_exponent or stated(STRIBECK_EXPONENT),
    }
    slow = n.stribeck_friction_nm is not None or n.load_stribeck_load is not None
    if n.load_friction_load is None:
        return ("m2", stribeck) if slow else ("m1", {})
    motor, external = n.load_friction_motor or stated(0.0), n.load_friction_load
    slow_pair = n.load_stribeck_motor or stated(0.0), n.load_stribeck_load or stated(0.0)
    same = motor == external and slow_pair[0] == slow_pair[1]
    if same and n.load_quadratic_load is None:
        frictions = {"load_friction_base": external}
        if not slow:
            return "m3", frictions
        return "m4", stribeck | frictions | {"load_friction_stribeck": slow_pair[1]}
    both = dict(zip(_ON_TORQUE, (motor, external), strict=True))
    both_slow = {f"{k}_stribeck": q for k, q in zip(_ON_TORQUE, slow_pair, strict=True)}
    frictions = stribeck | both | both_slow
    if n.load_quadratic_load is None:
        return "m5", frictions
    return "m6", frictions | {
        "load_friction_motor_quad": n.load_quadratic_motor or stated(0.0),
        "load_friction_external_quad": n.load_quadratic_load,
    }


def _name(stem: str) -> str:
    plain = "".join(c if c.isascii() and c.isalnum() else "-" for c in stem.lower()).strip("-")
    return plain[:64] or "bam"


def _folder() -> Traversable:
    return resources.files("pupper_sysid.servo_models.cards") / "data"


def card_names() -> tuple[str, ...]:
    """Names of the cards that are shipped."""
    files = (f.name for f in _folder().iterdir())
    return tuple(sorted(f.removesuffix(".yaml") for f in files if f.endswith(".yaml")))


def is_card(path: Path | str) -> bool:
    """Whether this is the name of a shipped card, the file of one, or a parameter file of BAM."""
    if str(path) in card_names():
        return True
    file = Path(path)
    if not file.is_file():
        return False
    if file.suffix.lower() == ".json":
        data = read_json(file)
        return isinstance(data, dict) and {"kt", "R"} <= data.keys()
    if file.suffix.lower() not in (".yaml", ".yml"):
        return False
    if SCHEMA not in read_text(file):  # most files are calibrations, which are long
        return False
    data, _ = read_yaml(file)
    return isinstance(data, dict) and data.get("schema") == SCHEMA


def load_card(path_or_name: Path | str) -> ServoCard:
    """Read a servo card from a file, a shipped one by its name, or a parameter file of BAM.

    It is a YAML file, one of `card_names()`, or a JSON file that BAM's `fit` wrote.

    Examples
    --------
    >>> card = load_card("sts3215-bam-m1-early")
    >>> card.servo, card.supply_v, round(card.pd().stiffness_nm_per_rad.value, 1)
    ('Feetech STS3215', 7.4, 17.8)
    """
    names = card_names()
    if str(path_or_name) in names:
        with resources.as_file(_folder() / f"{path_or_name}.yaml") as file:
            return _load(file)
    path = Path(path_or_name)
    if not path.exists():
        near = difflib.get_close_matches(str(path_or_name), names, n=1)
        hint = f"Did you mean {near[0]}?" if near else "`pupper-sysid servo list` shows the cards."
        raise InputError(f"{path} is neither a file nor a servo card of this tool. {hint}")
    return _load(path)


def _load(path: Path) -> ServoCard:
    if path.suffix.lower() == ".json":
        return load_bam(path)
    example = "`pupper-sysid servo show sts3215-bam-m1 --yaml` prints one as an example."
    data, lines = read_own(path, SCHEMA, SCHEMA_VERSION, example)
    return validated(ServoCard, data, path, lines)
