"""What the exports share: the servos to export, heads of files, and texts of Python modules.

`ExportedServos` is a calibration at one P gain, with or without the links that its armatures hold,
for one physics step. Every export states in its head what the servos are, for which P gain,
armature and physics step, in which units, from which calibration (by its hash), and what the
target cannot carry. Each holds the feedback as well as the actuator; for simulators on torch
with code that applies it (`sim.export.torch_servos`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from textwrap import indent, wrap
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions
from pupper_sysid.common.tones import fit_sine
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS, Actuator, JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, TORQUES
from pupper_sysid.servo_models.step_size import MUJOCO, MUJOCO_PID, Engine, nearest_in_loop

FEEDBACK_KEYS = ("poll_period_s", "loss", "quantum_rad", "offset_rad", "mean_age_s")
TORQUE_KEYS = tuple(PARAMETER_KEYS[name] for name in (*TORQUES, "armature"))
EXPLICIT_PD = Engine(slews=False, implicit=False)
"""PDs of Isaac Lab: torque before each step, set-points of unlimited speed."""
UNITS = "Units: N·m, rad, s, kg·m²; delays in steps are in physics steps."
NOT_CARRIED = (
    "The feedback is no part of an actuator, and without it the simulated robot sees more than the "
    "real one does: its readings are stale, lost at times, quantised and biased. See FEEDBACK and "
    "HeldFeedback below."
)
KNOWN = {"yes": "measured", "ratio only": "ratio measured, scale assumed", "no": "not measured"}
"""How well a number is known, by `Quantity.identified`."""
INCLUDES_LINK = (
    "An armature with the link and load counts their inertia twice in a model whose bodies have "
    "it, too: take it off with `link_inertia` or `model`."
)
_LONGEST_STEP_S = 0.1
_FASTEST_HZ, _AMPLITUDE_RAD = 4.0, 0.3  # the sweeps' fastest common tone


@dataclass(frozen=True)
class ExportedServos:
    """Servos of a calibration, as an export states them."""

    calibration: Calibration
    """At the exported P gain, its armatures without the links that were taken off."""
    physics_step_s: float
    """Of the simulator [s]."""
    sha256: str
    """Of the text of the calibration that all this was made from."""
    moving: Calibration
    """The same with all that its armatures hold, which is what moved in the recordings."""
    links: Mapping[str, float] = field(default_factory=dict)
    """By joint, the inertia that was taken off [kg·m²]."""
    _actuators: dict[Engine, dict[str, Actuator]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        physics_step_s: float,
        gain: float | None = None,
        link_inertia: Mapping[str, float] | None = None,
        sha256: str | None = None,
    ) -> ExportedServos:
        """The servos of a calibration, ready to be written.

        `gain` is a P gain, the register's value; by default that of the calibration, which is the
        servo's own when it was recorded. `link_inertia` is, by joint, the inertia of link and load
        to take off the armature [kg·m²]. `sha256` is that of the calibration's file; by default of
        the text that it would be saved as.
        """
        if not 0 < physics_step_s <= _LONGEST_STEP_S:
            raise InputError(
                f"`physics_step_s` is {physics_step_s:g} s; give the simulator's own, between 0 "
                f"and {_LONGEST_STEP_S:g}, such as 0.005."
            )
        sha256 = sha256 or hashlib.sha256(calibration.to_yaml().encode()).hexdigest()
        moving = calibration
        if gain is not None and any(j.holds_at.p_gain != gain for j in calibration.joints.values()):
            moving = calibration.at_p_gain(gain)
        links = dict(link_inertia or {})
        joints = dict(moving.joints)
        for name, inertia in links.items():
            joints[name] = without_link(name, moving.joint(name), inertia)
        written = moving.model_copy(update={"joints": joints})
        return cls(written, physics_step_s, sha256, moving, links)

    def actuators(self, engine: Engine = MUJOCO) -> dict[str, Actuator]:
        """Actuators with which joints in the simulator's steps and engine move like the servos.

        Numbers and ends of intervals are changed by what `step_size.nearest_in_loop` changes for
        what the armatures held in the recordings; the dead time is shifted, the others scaled.
        """
        if engine in self._actuators:
            return self._actuators[engine]
        stepped: dict[str, Actuator] = {}
        changes: dict[tuple[float, ...], dict[str, float]] = {}
        for name, joint in self.moving.joints.items():
            servo, fitted_s = joint.actuator.parameters, joint.actuator.fitted_step_s
            old = {key: float(x) for key, x in servo.arrays().items()}
            kind = (fitted_s, *old.values())
            if kind not in changes:  # one at a time: a short step of many servos fills the memory
                after = nearest_in_loop(servo, self.physics_step_s, fitted_s, engine).arrays()
                changes[kind] = {key: float(np.squeeze(x)) for key, x in after.items()}
            stepped[name] = _changed(self.calibration.joints[name].actuator, old, changes[kind])
        self._actuators[engine] = stepped
        return stepped

    def head(self, engine: Engine | None, *target: str) -> list[str]:
        """Sentences of a file's head, those about the `target` last; classes need no engine."""
        calibration = self.calibration
        inputs = ", ".join(f"{f.name} (sha256 {f.sha256[:12]}…)" for f in calibration.inputs)
        return [
            f"Servos of {calibration.robot}, calibrated {calibration.created}"
            + (f" from {inputs}" if inputs else "")
            + f", exported by pupper-sysid {versions()['pupper-sysid']}.",
            f"sha256 of the calibration: {self.sha256}.",
            *calibration.notes,
            UNITS,
            *self._scales(),
            *self.operating_points(),
            *([INCLUDES_LINK] if self.with_link else []),
            *self._beyond(),
            *self._step_note(engine),
            *target,
        ]

    def operating_points(self) -> Iterator[str]:
        """P gain, armature and load that the numbers hold for, joints alike in one sentence."""
        for point, names in self.calibration.operating_points().items():
            yield f"Numbers of {', '.join(names)} hold for: {point}."
        if self.links:
            links = ", ".join(f"{name} {inertia:.4g}" for name, inertia in self.links.items())
            yield f"Inertia of links that was taken off the armatures, kg·m²: {links}."

    @property
    def with_link(self) -> list[str]:
        """Joints whose armature still holds link and load."""
        joints = self.calibration.joints.items()
        return [name for name, joint in joints if joint.holds_at.armature == "servo and load"]

    def whole_step_costs(self, engine: Engine = EXPLICIT_PD) -> dict[str, float]:
        """Error of delays in whole steps at the sweeps' fastest tone, by joint [rad].

        RMS at 4 Hz and 0.3 rad of the motion by the nearest whole number of steps beside the
        motion by the delay itself.
        """
        h, turn = self.physics_step_s, 2 * np.pi * _FASTEST_HZ
        time = TIME_STEP_S * np.arange(round(0.75 / TIME_STEP_S))
        servo = self.moving.delayed_pd()
        servo.reset(np.zeros(servo.batch))
        moved = servo.rollout(_AMPLITUDE_RAD * np.sin(turn * time)[:, None])
        late = time >= 0.25  # two whole periods of the tone
        amplitudes = np.abs(fit_sine(turn * time[late], moved[late]).phasor)
        costs = {}
        for (name, a), amplitude in zip(self.actuators(engine).items(), amplitudes, strict=True):
            delay = a.dead_time_s.value
            shift = turn * (h * round(delay / h) - delay)
            costs[name] = float(2 * abs(np.sin(shift / 2)) * amplitude / np.sqrt(2))
        return costs

    def short_delays(self) -> Iterator[str]:
        """Which dead times MuJoCo's delay line cannot hold, in a sentence."""
        exact, written = self.actuators(), self.actuators(MUJOCO_PID)
        texts = [
            f"{name} {1e3 * a.dead_time_s.value:.2g} became "
            f"{1e3 * written[name].dead_time_s.value:.2g} ms"
            for name, a in exact.items()
            if 0 < a.dead_time_s.value < self.physics_step_s
        ]
        if texts:
            yield (
                f"MuJoCo has no delay between 0 and one step: {', '.join(texts)}. Take steps that "
                "are shorter than the dead time."
            )

    def _scales(self) -> Iterator[str]:
        scales = {
            j.actuator.scale.source: j.actuator.scale for j in self.calibration.joints.values()
        }
        for source, scale in scales.items():
            yield f"Torques are scaled by {scale.anchor} {scale.value_nm:g} N·m: {source}."

    def _beyond(self) -> Iterator[str]:
        """What of servos that were fitted under load no PD carries."""
        joints: dict[tuple[str, ...], list[str]] = {}
        for name, joint in self.calibration.joints.items():
            if joint.servo is not None:
                servo = joint.servo.parameters(joint.actuator.dead_time_s.value)
                if lost := servo.beyond_delayed_pd():
                    joints.setdefault(lost, []).append(name)
        for lost, names in joints.items():
            yield (
                f"Fitted under load, but not represented: {', '.join(lost)} ({', '.join(names)}). "
                "The friction here is that of one motor torque; `servo` of the calibration "
                "has the whole servo."
            )

    def _step_note(self, engine: Engine | None) -> Iterator[str]:
        """The step that the numbers are for, and what was changed for its length."""
        h = 1e3 * self.physics_step_s
        yield f"Made for physics steps of {h:g} ms; others: export again."
        if engine is None:
            yield "SERVOS has the numbers of the calibration as they are; the classes step them."
            return
        fitted = [joint.actuator.parameters.arrays() for joint in self.calibration.joints.values()]
        stepped = [a.parameters.arrays() for a in self.actuators(engine).values()]
        pairs = list(zip(fitted, stepped, strict=True))
        later = 1e3 * np.mean([new["dead_time_s"] - old["dead_time_s"] for old, new in pairs])
        gains = {
            name: np.mean([new[name] / old[name] for old, new in pairs if old[name] > 0] or [1.0])
            for name in ("stiffness", "back_emf")
        }
        if later or any(gain != 1.0 for gain in gains.values()):
            changes = f"torques x {gains['stiffness']:.2f}, back-EMF x {gains['back_emf']:.2f}"
            yield (
                f"Numbers below are those with which steps of {h:g} ms here move like the servo: "
                f"{changes} and delays {later:+.1f} ms (means of the joints) of the "
                "calibration's."
            )


def _changed(actuator: Actuator, old: Mapping[str, float], new: Mapping[str, float]) -> Actuator:
    """An actuator whose torques are scaled as from `old` to `new`, and its dead time shifted."""
    numbers = {}
    for name in TORQUES:
        key = PARAMETER_KEYS[name]
        factor = new[name] / old[name] if old[name] > 0 else 1.0
        numbers[key] = getattr(actuator, key).scaled(factor)
    later = new["dead_time_s"] - old["dead_time_s"]
    ends = (actuator.dead_time_s.value, *actuator.dead_time_interval_s)
    value, low, high = (max(end + later, 0.0) for end in ends)
    shifted = {"value": value, "low": low, "high": high}
    numbers["dead_time_s"] = actuator.dead_time_s.model_copy(update=shifted)
    return actuator.model_copy(update=numbers)


def without_link(name: str, joint: JointCalibration, inertia_kg_m2: float) -> JointCalibration:
    """The servo of a joint alone: its armature less the inertia of what it moved."""
    if inertia_kg_m2 == 0:
        return joint
    point, actuator = joint.holds_at, joint.actuator
    armature = actuator.armature_kg_m2
    if point.armature == "servo":
        raise InputError(
            f"The armature of {name} is that of motor and gears alone; there is no link to take "
            "off. Leave it out."
        )
    if not 0 < inertia_kg_m2 < armature.value:
        raise InputError(
            f"{name}: a link of {inertia_kg_m2:.4g} kg·m² cannot be taken off an armature of "
            f"{armature.value:.4g} kg·m² that holds it. Either the link of the recording was "
            "another one (its inertia can be stated), or the torque scale is wrong "
            f"({actuator.scale.anchor} {actuator.scale.value_nm:g} N·m): record with a known load, "
            "or give `calibrate` the servo's own stall torque."
        )
    ends = {
        end: None if value is None else max(value - inertia_kg_m2, 1e-12)
        for end, value in (("low", armature.low), ("high", armature.high))
    }
    servo_armature = armature.model_copy(update={"value": armature.value - inertia_kg_m2, **ends})
    return joint.model_copy(
        update={
            "actuator": actuator.model_copy(update={"armature_kg_m2": servo_armature}),
            "operating_point": point.model_copy(update={"armature": "servo"}),
        }
    )


# --------------------------------------------------------------------------- Python modules


def docstring(title: str, notes: Sequence[str]) -> str:
    """A module's docstring of paragraphs; names that a user chose cannot end it."""
    text = "\n\n".join("\n".join(wrap(note, 98, break_on_hyphens=False)) for note in notes)
    text = text.replace("\\", "/").replace('"', "'")
    return f'"""{title}\n\n{text}\n"""\n'


def block(name: str, rows: Sequence[str], brackets: str = "{}") -> str:
    """`NAME = {…}` with a row per line."""
    return f"{name} = {brackets[0]}\n" + indent("\n".join(rows), "    ") + f"\n{brackets[1]}\n"


def call(function: str, *arguments: tuple[str, Any] | tuple[str, Quantity, str] | str) -> str:
    """A call with a keyword argument per line.

    An argument is its name and value; a quantity also has its key in the calibration, and is
    followed by a comment: unit, how well it is known, interval. A text stands as it is.
    """
    lines = []
    for argument in arguments:
        if isinstance(argument, str):
            lines.append(argument + "\n")
            continue
        name, value, *key = argument
        comment = ""
        if key:
            comment = f"  # {unit_of(key[0])}, {known_text(value)}"
            value = value.value
        lines.append(f"{name}={value!r},{comment}\n")
    return f"{function}(\n{indent(''.join(lines), '    ')}),"


def known_text(quantity: Quantity) -> str:
    """How well a number is known, and its interval, in words."""
    text = KNOWN[quantity.identified]
    if quantity.low is not None and quantity.high is not None:
        text += f", 90 % interval {quantity.low:.4g} to {quantity.high:.4g}"
    return text


def feedback_block(calibration: Calibration) -> str:
    """`FEEDBACK = {…}`: the numbers of each joint's feedback; an offset is the recording's own."""
    return block("FEEDBACK", [
        f'"{name}": '
        + json.dumps(
            {key: getattr(joint.feedback, key).value for key in FEEDBACK_KEYS}
            | {"offset_rad": 0.0}
        )
        + ","
        for name, joint in calibration.joints.items()
    ])  # fmt: skip


def servos_block(servos: ExportedServos) -> str:
    """`SERVOS = {…}`: the numbers of each joint's servo, and all the inertia that it moved."""
    keys = {name: PARAMETER_KEYS[name] for name in (*TORQUES, "armature")} | {
        "velocity_limit_rad_s": "velocity_limit_rad_s", "jitter_s": "command_jitter_s",
        "dead_time_s": "dead_time_s",
    }  # fmt: skip
    rows = []
    for name, joint in servos.calibration.joints.items():
        actuator = joint.actuator
        quantities = {title: getattr(actuator, key) for title, key in keys.items()}
        lines = [
            f'    "{title}": {q.value!r},  # {unit_of(keys[title])}, {known_text(q)}'
            for title, q in quantities.items()
        ]
        inertia = servos.moving.joint(name).actuator.armature_kg_m2.value
        lines += [
            f'    "inertia": {inertia!r},  # kg·m², of all that moved in the recordings',
            f'    "step_s": {actuator.fitted_step_s!r},  # s, of MuJoCo, in which all this holds',
        ]
        rows.append("\n".join([f'"{name}": {{', *lines, "},"]))
    return block("SERVOS", rows) + '"""The servos by joint."""\n'


def torch_module(
    servos: ExportedServos,
    target: str,
    notes: Sequence[str],
    imports: str,
    actuators: str,
) -> str:
    """A Python module: what it is, its numbers, the classes that apply them, the target's own part.

    `notes` say in sentences what the target carries and does not, `imports` are the lines that
    import its names, and `actuators` is code that stands behind the numbers and the classes.
    """
    servos.actuators(MUJOCO)  # refuses steps in which a servo is not stable
    # read, not imported: that would load torch
    code = (resources.files("pupper_sysid.sim.export") / "torch_servos.py").read_text()
    return (
        f"{docstring(f'Servos for {target}.', servos.head(None, *notes))}\n"
        "from __future__ import annotations\n\n"
        "import math\nfrom collections.abc import Callable, Mapping, Sequence\n\n"
        f"import torch\n{imports}\n\n"
        f"PHYSICS_DT = {servos.physics_step_s!r}\n"
        '"""Physics step that the delays below are made for [s]."""\n\n'
        f"{servos_block(servos)}\n"
        f"{feedback_block(servos.calibration)}"
        '"""What makes each joint\'s readings stale and quantised; `HeldFeedback` applies it."""\n'
        f"\n\n{code[code.index('def _columns') :]}\n\n{actuators}"
    )
