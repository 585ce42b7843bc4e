"""Calibration: measured actuators and feedback of a robot's servos, in one YAML file.

A calibration holds, per joint, an actuator (from command to motion) and a feedback (from motion to
reading: stale, quantised, biased), each number with its 90 % interval and whether the data
identified it, and provenance: scores, input hashes, versions, seed. `load_calibration` reads a file
or a preset and refuses in a sentence what is not valid; `Calibration.save` writes one.
`Calibration.delayed_pd` and `Calibration.held_feedback` are the models that a simulator runs.

Presets are published settings in the same form: `paper` is the actuator of the paper
"Reinforcement Learning on Cost-Constrained Quadrupedal Hardware" (Mini Pupper 2) as its text gives
it, `release` the one in the training configuration its authors released. Neither is a measurement.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module, resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from pupper_sysid.common.border import Part, read_own, validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import as_path, write_text
from pupper_sysid.common.joints import in_order, strange_joint
from pupper_sysid.common.strict_yaml import dump
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Whole
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.servo_models.step_size import at_step

SCHEMA = "pupper-calibration"
SCHEMA_VERSION = 5
PRESETS = ("paper", "release")

_RENAMED = {
    1: {
        "delay_s": "dead_time_s",
        "ladder": "candidate_models",
        "naive_lag_s": "raw_lag_s",
        "rmse_free_run_naive_rad": "rmse_free_run_raw_rad",
        "rmse_naive_rad": "rmse_raw_rad",
    },
    4: {"under_load": "servo"},
}
"""Names in files up to a version, and what replaced them."""

UNITS = (
    "SI: radians of the simulator frame, seconds, N·m, kg·m²; every name ends in its unit; "
    "ratios_to_armature are per kg·m²; low and high are the ends of the 90 % interval."
)

_HEADER = """\
# Calibration of a robot's servos, written by pupper-sysid.
#
# Per joint: `actuator` leads from command to motion, `feedback` from motion to reading (stale,
# quantised, biased). Simulate them apart: the one on the torque, the other on the reading.
# A number reads {value, low, high, identified, why}: low and high are the ends of its 90 %
# interval (null: none), and `identified` says whether the recording determined it:
#   yes         the recording determined it
#   ratio only  its ratio to the armature was determined; the scale was assumed (see `scale`)
#   no          the recording says nothing about it (see `why`)
# Times are in seconds, angles in radians, torques in N·m. Unknown keys are refused.
"""


class InputFile(Part):
    """A recording the calibration was made from."""

    name: str
    """File name, without folders."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    """SHA-256 of the file, 64 hexadecimal digits."""


class Calibration(Part):
    """Measured servos of one robot. Frozen; see the module's text.

    Parameters
    ----------
    schema, schema_version : str, int
        Kind of the file, and version of its format.
    robot, created : str
        Name of the robot; time of the calibration (UTC, ISO 8601).
    inputs : tuple of InputFile
        Recordings it was made from.
    seed : int or None
        Seed of its random numbers.
    versions : dict of str to str
        Versions of this project and of the libraries that shape its numbers.
    units : str
        Units of the numbers.
    notes : tuple of str
        Notes for the reader.
    joints : dict of str to JointCalibration
        The joints, by name.
    """

    schema_name: Annotated[Literal["pupper-calibration"], Field(alias="schema")] = SCHEMA
    """Kind of the file."""
    schema_version: Literal[5] = SCHEMA_VERSION
    """Version of the file's format."""
    robot: str
    """The robot that was measured."""
    created: str
    """Time of the calibration, in UTC and ISO 8601."""
    inputs: Annotated[tuple[InputFile, ...], Field(strict=False)] = ()
    """Recordings it was made from."""
    seed: Whole | None = None
    """Seed of its random numbers, or null."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of this project and of the libraries that shape its numbers."""
    units: str = UNITS
    """Units of the numbers."""
    notes: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Notes for the reader, in sentences."""
    joints: Annotated[dict[str, JointCalibration], Field(min_length=1)]
    """The joints, by name."""

    @field_validator("created")
    @classmethod
    def _check_created(cls, text: str) -> str:
        try:
            offset = datetime.fromisoformat(text).utcoffset()
        except ValueError:
            offset = None
        if offset != timedelta(0):
            raise ValueError(f"'{text}' is no time in UTC; write it like 2026-01-31T12:00:00+00:00")
        return text

    @field_validator("joints")
    @classmethod
    def _check_joints(cls, joints: dict[str, JointCalibration]) -> dict[str, JointCalibration]:
        if strange := strange_joint(joints):
            raise ValueError(f"{strange[0]} is no joint; {strange[1].rstrip('.?')}")
        return {name: joints[name] for name in in_order(joints)}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of this calibration, in the order of `common.joints.in_order`."""
        return tuple(self.joints)

    def joint(self, name: str) -> JointCalibration:
        """Calibration of the joint `name`; refused if this one lacks it."""
        if name not in self.joints:
            raise InputError(
                f"The calibration of {self.robot} has no joint {name}. "
                f"It has {', '.join(self.joints)}."
            )
        return self.joints[name]

    def __repr__(self) -> str:
        lines = (f"{name}: {joint!r}" for name, joint in self.joints.items())
        return "\n  ".join([f"Calibration of {self.robot}", *lines])

    def operating_points(self) -> dict[str, list[str]]:
        """P gain, armature and load that the numbers hold for, in words, and the joints of each."""
        joints: dict[str, list[str]] = {}
        for name, joint in self.joints.items():
            joints.setdefault(str(joint.holds_at), []).append(name)
        return joints

    def at_p_gain(self, p_gain: float) -> Calibration:
        """The calibration of the same servos at another P gain, the register's value.

        Refused if a joint was recorded at one gain without a known load: it has no `servo`.
        """
        joints = {name: joint.at_p_gain(p_gain) for name, joint in self.joints.items()}
        return self.model_copy(update={"joints": joints})

    def delayed_pd(
        self, joints: Sequence[str] | None = None, time_step_s: float = TIME_STEP_S
    ) -> DelayedPD:
        """The servo model of some joints, vectorised over them.

        Parameters
        ----------
        joints : sequence of str, optional
            Their names; by default all of this calibration.
        time_step_s : float
            Time step of the model [s].

        Returns
        -------
        DelayedPD
            Its batch has shape (joints,), in the order of `joints`.
        """
        names = self.joint_names if joints is None else tuple(joints)
        actuators = [self.joint(name).actuator for name in names]
        if not actuators:
            raise InputError("No joint was named. Name at least one.")
        parameters = DelayedPDParameters(
            **{
                field: np.array([getattr(actuator, key).value for actuator in actuators])
                for field, key in PARAMETER_KEYS.items()
            }
        )
        continuous = np.array([a.numbers_in == "continuous time" for a in actuators])
        if continuous.any():
            numbers, stepped = parameters.arrays(), at_step(parameters, time_step_s).arrays()
            parameters = DelayedPDParameters(
                **{name: np.where(continuous, stepped[name], numbers[name]) for name in numbers}
            )
        return DelayedPD(parameters, time_step_s)

    def held_feedback(self, joint: str) -> HeldFeedback:
        """The feedback of one joint, as a simulator or another recording has it.

        Without an offset: `feedback.offset_rad` is that of the recordings that were calibrated
        (their zero), and neither the servo's nor another recording's.
        """
        feedback = self.joint(joint).feedback
        return HeldFeedback(
            poll_period_s=feedback.poll_period_s.value,
            loss=feedback.loss.value,
            quantum_rad=feedback.quantum_rad.value,
        )

    def export(self, to: str, out: Path | str = ".", **options: Any) -> Path:
        """Write these servos for another simulator, and return the file.

        `to`, `out` and the options (`physics_step_s`, `gain`, `link_inertia`, `model`, `force`) are
        those of `ps.export`.
        """
        # a room above this one: files import no simulator
        return import_module("pupper_sysid.sim.export.export").export(self, to, out, **options)

    def to_yaml(self) -> str:
        """Text of the file: a header that explains it, then the data."""
        return f"{_HEADER}\n{dump(self.model_dump(mode='json', by_alias=True))}"

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write this calibration to `path` as YAML, in one atomic step."""
        write_text(Path(path), self.to_yaml(), force)


def is_shipped(name: Path | str) -> bool:
    """Whether `name` is a preset's or a shipped servo card's, rather than a file's."""
    return str(name) in PRESETS or str(name) in _cards().card_names()


def preset_notes(names: Iterable[str]) -> list[str]:
    """Notes on the presets among `names` where readings have an age."""
    presets = [name for name in names if name in PRESETS]
    if not presets:
        return []
    return [
        f"{', '.join(presets)}: published with ideal feedback. Where its delay stands for the "
        "age of readings, too, that age counts twice here."
    ]


def _cards() -> Any:
    """Servo cards, which are made of calibrations and so cannot be imported before them."""
    return import_module("pupper_sysid.servo_models.cards.files")


def utc_now() -> str:
    """The present time in the form of `Calibration.created`."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def load_calibration(path_or_preset: Path | str) -> Calibration:
    """Read a calibration file or servo card, or a preset or shipped card by its name.

    Parameters
    ----------
    path_or_preset : Path or str
        A YAML file, one of `PRESETS`, or a shipped servo card (`cards.files.card_names`). A file
        that is named like a preset is `./paper`.

    Returns
    -------
    Calibration
        Always of the present version.

    Raises
    ------
    InputError
        If there is no such file, or anything in it is not valid: one sentence with the file, the
        place, the fault and what to do.

    Examples
    --------
    >>> paper = load_calibration("paper")
    >>> paper.joints["LF_hip"].actuator.stiffness_nm_per_rad.value
    70.0
    >>> paper.delayed_pd().batch
    (12,)
    """
    as_path(path_or_preset, "A calibration")
    if isinstance(path_or_preset, str) and path_or_preset in PRESETS:
        folder = resources.files("pupper_sysid.servo_models") / "presets"
        with resources.as_file(folder / f"{path_or_preset}.yaml") as file:
            return _load(file)
    if _cards().is_card(path_or_preset):
        return _cards().load_card(path_or_preset).calibration()
    path = Path(path_or_preset)
    if not path.exists():
        near = difflib.get_close_matches(path.name, PRESETS, n=1)
        cards = difflib.get_close_matches(path.name, _cards().card_names(), n=1)
        if near or cards:
            kind, name = ("preset", near[0]) if near else ("servo card", cards[0])
            hint = f"Did you mean the {kind} {name}?"
        else:
            hint = f"Presets: {', '.join(PRESETS)}."
        hint += "" if near else " `pupper-sysid servo list` shows servo cards."
        raise InputError(f"{path} does not exist. Check the name. {hint}")
    return _load(path)


def _load(path: Path) -> Calibration:
    remedy = "Give a file that `pupper-sysid calibrate` wrote."
    data, lines = read_own(path, SCHEMA, SCHEMA_VERSION, remedy)
    version = data["schema_version"]
    if version == SCHEMA_VERSION:
        return validated(Calibration, data, path, lines)
    names = {k: v for last, names in _RENAMED.items() if version <= last for k, v in names.items()}
    data = _renamed(data, names) | {"schema_version": SCHEMA_VERSION}
    if version == 3:
        data |= {"joints": _with_unseen_runs(data.get("joints"))}
    lines = {tuple(names.get(str(p), p) for p in place): n for place, n in lines.items()}
    try:
        return validated(Calibration, data, path, lines)
    except InputError as error:
        message = str(error)
        for old, new in names.items():  # as the file that is read has them
            message = re.sub(rf"(?<=\.){new}\b", old, message)
        raise InputError(message) from error


def _with_unseen_runs(joints: Any) -> Any:
    """Joints of a version 3 file, whose fits under load had errors under another's name."""
    if not isinstance(joints, dict):
        return joints
    renamed, old = dict(joints), "rmse_leave_one_frequency_out_rad"
    for name, joint in joints.items():
        if isinstance(joint, dict) and joint.get("servo") is not None:
            # root mean square errors of the model, mean absolute ones of the candidates
            new = {"scores": "rmse_unseen_runs_rad", "selection": "mae_unseen_runs_rad"}
            blocks = {p: _renamed(joint[p], {old: new[p]}) for p in new.keys() & joint.keys()}
            renamed[name] = joint | blocks
    return renamed


def _renamed(data: Any, names: dict[str, str]) -> Any:
    """`data` with the present names of keys; one that is there twice stays."""
    if isinstance(data, list):
        return [_renamed(entry, names) for entry in data]
    if not isinstance(data, dict):
        return data
    return {
        key if names.get(key) in data else names.get(key, key): _renamed(entry, names)
        for key, entry in data.items()
    }
