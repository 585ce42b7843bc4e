"""A calibration for other simulators: MuJoCo (MJCF), Isaac Lab, mjlab, or any (JSON).

    text = SIMULATORS["isaaclab"](load_calibration("calibrated.yaml"), physics_step_s=0.005)

Each text says where every number comes from, how well it is known, and what that simulator cannot
hold: most have no delay shorter than a physics step, no limit on the speed of a set-point, and none
knows that readings are old. The feedback stands beside the actuator in every one of them; for the
simulators on torch with code that applies it (`sim.export.held_feedback_torch`).

Field names are those of Isaac Lab 2.3.2 (3.0 takes them, too), mjlab 1.6.0 and MuJoCo 4.0;
`benchmarks/peers/check_exports.py` holds them against the released packages.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from textwrap import indent, wrap
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Actuator, Quantity, unit_of
from pupper_sysid.servo_models.delayed_pd import whole_steps
from pupper_sysid.servo_models.step_size import MUJOCO, Engine, delay_at_step
from pupper_sysid.sim.robot.servo_mjcf import (
    INTEGRATOR,
    actuator_attributes,
    attributes,
    joint_attributes,
)

SCHEMA = "pupper-actuators"
SCHEMA_VERSION = 2
ENDINGS = {"mjcf": ".xml", "isaaclab": "_isaaclab.py", "mjlab": "_mjlab.py", "json": ".json"}
_LONGEST_STEP_S = 0.1
EXPLICIT_PD, MJLAB_PD = Engine(slews=False, implicit=False), Engine(slews=False)
FEEDBACK_KEYS = ("poll_period_s", "loss", "quantum_rad", "offset_rad", "mean_age_s")
_TORQUES = (
    "stiffness_nm_per_rad", "damping_nm_s_per_rad", "friction_loss_nm", "armature_kg_m2",
    "effort_limit_nm",
)  # fmt: skip

_NOT_CARRIED = (
    "The feedback is no part of an actuator, and without it the simulated robot sees more than the "
    "real one does: its readings are old, lost at times, coarse and off. See FEEDBACK below."
)


def to_mjcf(calibration: Calibration, physics_step_s: float) -> str:
    """Defaults, actuators and sensors to `<include>` in a model that has joints of these names.

    Parameters
    ----------
    calibration : Calibration
    physics_step_s : float
        Of the model [s].

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s)
    defaults, actuators, sensors = [], [], []
    for name, joint in calibration.joints.items():
        servo = replace(joint.actuator.parameters, dead_time_s=delays[name].value_s)
        feedback = joint.feedback
        period, age = feedback.poll_period_s.value, feedback.mean_age_s.value
        told = ", ".join(_said(joint.actuator, key) for key in (*_TORQUES, "dead_time_s"))
        defaults += [
            f"<!-- {_xml(name)}: {_xml(told)} -->",
            f'<default class="servo_{name}">'
            f"<joint {attributes(joint_attributes(servo, physics_step_s))}/></default>",
        ]
        pid = {"name": name, "joint": name} | actuator_attributes(servo, physics_step_s)
        actuators.append(f"<pid {attributes(pid)}/>")
        sensor = {"name": f"{name}_reading", "joint": name}
        if period > 0:
            # half a period is the sensor's own mean age; what polls are lost adds is a delay
            late = max(age - period / 2, 0.0)
            sensor |= {
                "nsample": str(int(np.ceil(late / period)) + 2),
                "interval": repr(period),
                "delay": repr(late),
            }
        said = ", ".join(_told(key, getattr(feedback, key)) for key in FEEDBACK_KEYS)
        sensors += [f"<!-- {_xml(name)}: {_xml(said)} -->", f"<jointpos {attributes(sensor)}/>"]
    notes = (
        *origin(calibration),
        f"For a time step of {physics_step_s:g} s: delay and the dry friction's reference time "
        "depend on it, so export again for another one.",
        *step_note(calibration, delays, physics_step_s),
        "Include this file in your model, and give each servo's joint its class, such as class=\""
        f'servo_{calibration.joint_names[0]}". A position in ctrl is what the servo is told.',
        "After a reset fill the delay lines (mj_initCtrlHistory), which MuJoCo sets to zero: a "
        "robot that is not at zero would be thrown there for one delay.",
        "Carried over: delay (to fractions of a step), gains, limits of torque and of the "
        "set-point's speed, dry friction, armature; of the feedback the poll period and, as a "
        "delay, the mean age that lost polls add.",
        "Not carried over: which polls are lost (the age is even here), the readings' counts and "
        "offset, and that servos are polled one after the other.",
    )
    return "\n".join(
        [
            f'<mujoco model="{_xml(calibration.robot)}: servos">',
            *_xml_comment(notes),
            f'  <option timestep="{physics_step_s!r}" integrator="{INTEGRATOR}"/>',
            *_xml_group("default", defaults),
            *_xml_group("actuator", actuators),
            *_xml_group("sensor", sensors),
            "</mujoco>",
            "",
        ]
    )


def to_isaaclab(calibration: Calibration, physics_step_s: float) -> str:
    """A Python module with a `DelayedPDActuatorCfg` per joint, and the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s, EXPLICIT_PD)
    groups = []
    for name, joint in calibration.joints.items():
        a = joint.actuator
        low, high = delays[name].steps(physics_step_s)
        groups.append(
            f'"{name}": '
            + _call(
                "DelayedPDActuatorCfg",
                ("joint_names_expr", [name], ""),
                ("stiffness", a.stiffness_nm_per_rad, "stiffness_nm_per_rad"),
                ("damping", a.damping_nm_s_per_rad, "damping_nm_s_per_rad"),
                ("armature", a.armature_kg_m2, "armature_kg_m2"),
                ("friction", a.friction_loss_nm, "friction_loss_nm"),
                ("dynamic_friction", a.friction_loss_nm.value, ""),
                ("effort_limit", a.effort_limit_nm, "effort_limit_nm"),
                ("velocity_limit", a.velocity_limit_rad_s, "velocity_limit_rad_s"),
                ("min_delay", low, ""),
                ("max_delay", high, ""),
            )
        )
    notes = (
        *origin(calibration),
        f"Delays are whole physics steps of {1e3 * physics_step_s:g} ms, the measured interval "
        "rounded outward; one delay is drawn per robot and reset, for each joint alone. Set "
        "sim.dt to this, or export again with --physics-step.",
        *step_note(calibration, delays, physics_step_s),
        "friction is a torque from Isaac Sim 5.0 on; 4.5 takes a coefficient there, so leave both "
        "friction lines out with it.",
        "Not carried over: the limit on the set-point's speed (velocity_limit is only told to "
        "Isaac Lab, no PD of its uses it) but for the lag it makes, and parts of a step. The PD "
        "here is computed once per physics step, before it: keep steps at 5 ms or less.",
        _NOT_CARRIED,
    )
    return _module(
        calibration, "Isaac Lab", notes, "from isaaclab.actuators import DelayedPDActuatorCfg",
        physics_step_s,
        "ACTUATORS = {\n" + indent("\n".join(groups), "    ") + "\n}\n"
        '"""For `ArticulationCfg(actuators=ACTUATORS)`."""\n',
    )  # fmt: skip


def to_mjlab(calibration: Calibration, physics_step_s: float) -> str:
    """A Python module with a `BuiltinPositionActuatorCfg` per joint, and the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s, MJLAB_PD)
    groups, bounds = [], []
    for name, joint in calibration.joints.items():
        a = joint.actuator
        steps = round(delays[name].value_s / physics_step_s)
        groups.append(
            _call(
                "BuiltinPositionActuatorCfg",
                ("target_names_expr", (name,), ""),
                ("stiffness", a.stiffness_nm_per_rad, "stiffness_nm_per_rad"),
                ("damping", a.damping_nm_s_per_rad, "damping_nm_s_per_rad"),
                ("effort_limit", a.effort_limit_nm, "effort_limit_nm"),
                ("armature", a.armature_kg_m2, "armature_kg_m2"),
                ("frictionloss", a.friction_loss_nm, "friction_loss_nm"),
                ("delay_min_lag", steps, ""),
                ("delay_max_lag", steps, ""),
                ("delay_hold_prob", 0.0, ""),
                ("delay_update_period", 0, ""),
                ("delay_per_env_phase", False, ""),
            )
        )
        low, high = delays[name].steps(physics_step_s)
        bounds.append(f'"{name}": ({low}, {high}),')
    notes = (
        *origin(calibration),
        f"Delays are whole physics steps of {1e3 * physics_step_s:g} ms, the nearest one; the "
        "interval, rounded outward, is in DELAY_STEPS.",
        *step_note(calibration, delays, physics_step_s),
        "The least and the greatest lag are equal on purpose. With two different ones mjlab draws "
        "a lag in every physics step, so that commands overtake each other; with "
        "delay_hold_prob=1, or with a long delay_update_period, robots begin without any delay.",
        "Not carried over: the limit on the set-point's speed, parts of a step, and the stiffness "
        "of dry friction (MuJoCo's default lets a held joint creep: set solreffriction of the "
        "joints as `--to mjcf` writes it).",
        _NOT_CARRIED,
    )
    return _module(
        calibration, "mjlab", notes, "from mjlab.actuator import BuiltinPositionActuatorCfg",
        physics_step_s,
        "ACTUATORS = (\n" + indent("\n".join(groups), "    ") + "\n)\n"
        '"""For `EntityArticulationInfoCfg(actuators=ACTUATORS)`."""\n\n'
        "DELAY_STEPS = {\n" + indent("\n".join(bounds), "    ") + "\n}\n"
        '"""Least and greatest delay of each joint, in physics steps."""\n',
    )  # fmt: skip


def to_json(calibration: Calibration, physics_step_s: float) -> str:
    """All of it as JSON: every number with its interval, delays also in steps, the feedback.

    Raises
    ------
    InputError
        If the step is not a sensible one.
    """
    delays = delays_at_step(calibration, physics_step_s)
    joints = {}
    for name, joint in calibration.joints.items():
        a = joint.actuator
        low, high = delays[name].steps(physics_step_s)
        numbers = {key: _plain(getattr(a, key)) for key in (*_TORQUES, "velocity_limit_rad_s")}
        joints[name] = {
            "actuator": numbers
            | {
                "dead_time_s": _plain(a.dead_time_s),
                "delay_steps_min": low,
                "delay_steps_max": high,
            },
            "feedback": {key: _plain(getattr(joint.feedback, key)) for key in FEEDBACK_KEYS},
            "torque_scale": a.scale.model_dump(mode="json"),
        }
    return json.dumps(
        {
            "schema": SCHEMA, "schema_version": SCHEMA_VERSION, "robot": calibration.robot,
            "created": calibration.created, "exported_by": versions(),
            "inputs": [f.model_dump(mode="json") for f in calibration.inputs],
            "notes": [
                *calibration.notes, "Delays in steps are rounded outward.",
                *step_note(calibration, delays, physics_step_s),
            ],
            "units": calibration.units, "physics_step_s": physics_step_s, "joints": joints,
        },
        indent=1, ensure_ascii=False,
    ) + "\n"  # fmt: skip


SIMULATORS: dict[str, Callable[[Calibration, float], str]] = {
    "mjcf": to_mjcf, "isaaclab": to_isaaclab, "mjlab": to_mjlab, "json": to_json,
}  # fmt: skip


# ------------------------------------------------------------------------------------- parts


@dataclass(frozen=True)
class Delay:
    """A joint's delay for one physics step: its value and the interval to train with [s]."""

    value_s: float
    low_s: float
    high_s: float

    def steps(self, physics_step_s: float) -> tuple[int, int]:
        """The interval in whole steps, rounded outward."""
        return whole_steps(self.low_s, self.high_s, physics_step_s)


def delays_at_step(
    calibration: Calibration, physics_step_s: float, engine: Engine = MUJOCO
) -> dict[str, Delay]:
    """Each joint's delay for another physics step or engine than the calibration's (`step_size`).

    Raises
    ------
    InputError
        If the step is not a sensible one, or too long for the servos.
    """
    refuse_step(physics_step_s)
    found = {}
    for name, joint in calibration.joints.items():
        a = joint.actuator
        (fitting,) = delay_at_step(a.parameters, physics_step_s, a.physics_step_s, engine)
        more = float(fitting) - a.dead_time_s.value
        numbers = (max(t + more, 0.0) for t in (a.dead_time_s.value, *a.dead_time_interval_s))
        found[name] = Delay(*numbers)
    return found


def step_note(
    calibration: Calibration, delays: dict[str, Delay], physics_step_s: float
) -> Iterator[str]:
    """What was added to the delays for the length of a step, if anything was."""
    added = [
        1e3 * (delays[name].value_s - joint.actuator.dead_time_s.value)
        for name, joint in calibration.joints.items()
    ]
    steps = {1e3 * joint.actuator.physics_step_s for joint in calibration.joints.values()}
    if np.any(added):
        yield (
            f"Measured delays are for steps of {' or '.join(f'{s:g}' for s in sorted(steps))} ms "
            f"in MuJoCo with set-points of limited speed; steps of {1e3 * physics_step_s:g} ms "
            f"here give another lag, so {np.mean(added):+.1f} ms (mean of the joints) are in the "
            "delays below."
        )


def refuse_step(physics_step_s: float) -> None:
    """Raise `InputError` unless this is a physics step of a simulator."""
    if not 0 < physics_step_s <= _LONGEST_STEP_S:
        raise InputError(
            f"--physics-step is {physics_step_s:g} s; give the simulator's own, between 0 and "
            f"{_LONGEST_STEP_S:g}, such as 0.005."
        )


def origin(calibration: Calibration) -> Iterator[str]:
    """Where the numbers come from, in sentences."""
    made = ", ".join(f"{f.name} (sha256 {f.sha256[:12]}…)" for f in calibration.inputs)
    yield (
        f"Servos of {calibration.robot}, calibrated {calibration.created}"
        + (f" from {made}" if made else "")
        + f", exported by pupper-sysid {versions()['pupper-sysid']}."
    )
    yield from calibration.notes
    scales = {j.actuator.scale.source: j.actuator.scale for j in calibration.joints.values()}
    for source, scale in scales.items():
        yield f"Torques are scaled by {scale.anchor} {scale.value_nm:g} N·m: {source}."


def _told(key: str, quantity: Quantity) -> str:
    """A number with its name, unit, interval and what the recording said of it."""
    text = f"{key} {quantity.value:.4g}"
    if quantity.low is not None and quantity.high is not None:
        text += f" ({quantity.low:.4g} to {quantity.high:.4g})"
    return text if quantity.identified == "yes" else f"{text} [{_known(quantity)}]"


def _said(actuator: Actuator, key: str) -> str:
    return _told(key, getattr(actuator, key))


def _known(quantity: Quantity) -> str:
    known = {"yes": "measured", "ratio only": "ratio measured, scale assumed", "no": "not measured"}
    return known[quantity.identified]


def _plain(quantity: Quantity) -> dict[str, Any]:
    return quantity.model_dump(mode="json")


def _call(function: str, *arguments: tuple[str, Any, str]) -> str:
    """A call with a keyword argument per line; behind a measured one what is known of it."""
    lines = []
    for name, value, key in arguments:
        if isinstance(value, Quantity):
            text = f"{unit_of(key)}, {_known(value)}"
            if value.low is not None and value.high is not None:
                text += f", 90 % interval {value.low:.4g} to {value.high:.4g}"
            lines.append(f"{name}={value.value!r},  # {text}\n")
        else:
            lines.append(f"{name}={value!r},\n")
    return f"{function}(\n{indent(''.join(lines), '    ')}),"


def _module(
    calibration: Calibration,
    target: str,
    notes: tuple[str, ...],
    import_line: str,
    physics_step_s: float,
    actuators: str,
) -> str:
    """A Python module: what it is, the actuators, the feedback and the code that applies it."""
    # read, not imported: that would load torch
    code = (resources.files("pupper_sysid.sim.export") / "held_feedback_torch.py").read_text()
    rows = [
        f'"{name}": '
        + json.dumps({key: getattr(joint.feedback, key).value for key in FEEDBACK_KEYS})
        + ","
        for name, joint in calibration.joints.items()
    ]
    return (
        f"{docstring(f'Servos for {target}.', notes)}\n"
        "from __future__ import annotations\n\n"
        "from collections.abc import Mapping, Sequence\n\n"
        f"import torch\n{import_line}\n\n"
        f"PHYSICS_DT = {physics_step_s!r}\n"
        '"""Physics step that the delays below are counted in [s]."""\n\n'
        f"{actuators}\n"
        "FEEDBACK = {\n" + indent("\n".join(rows), "    ") + "\n}\n"
        '"""What makes each joint\'s readings old, coarse and off; `HeldFeedback` applies it."""\n'
        f"\n\n{code[code.index('class HeldFeedback') :]}"
    )


def docstring(title: str, notes: Sequence[str]) -> str:
    """A module's, of paragraphs; what a user called a recording cannot end it."""
    text = "\n\n".join("\n".join(wrap(note, 98, break_on_hyphens=False)) for note in notes)
    text = text.replace("\\", "/").replace('"', "'")
    return f'"""{title}\n\n{text}\n"""\n'


def _xml(text: str) -> str:
    """Text for a comment or an attribute: two hyphens would end the one, a quote the other."""
    return text.translate(str.maketrans({"<": "‹", ">": "›", "&": "+", '"': "'"})).replace(
        "--", "–"
    )


def _xml_comment(notes: tuple[str, ...]) -> list[str]:
    lines = [line for note in notes for line in (*wrap(_xml(note), 94), "")]
    return ["  <!--", *(f"    {line}".rstrip() for line in lines[:-1]), "  -->"]


def _xml_group(name: str, lines: list[str]) -> list[str]:
    return [f"  <{name}>", *(f"    {line}" for line in lines), f"  </{name}>"]
