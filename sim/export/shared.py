"""What the exports share: delays for a physics step, notes, refusals, and texts of Python modules.

Every export says where its numbers come from (`origin`), how well each is known, and what the
target cannot hold: most simulators have no delay shorter than a physics step, no limit on the speed
of a set-point, and none models stale readings. The feedback stands beside the actuator in every
one; for simulators on torch with code that applies it (`sim.export.held_feedback_torch`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from importlib import resources
from textwrap import indent, wrap
from typing import Any

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import versions
from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of
from pupper_sysid.servo_models.step_size import MUJOCO, Engine, delay_at_step

FEEDBACK_KEYS = ("poll_period_s", "loss", "quantum_rad", "offset_rad", "mean_age_s")
TORQUE_KEYS = (
    "stiffness_nm_per_rad", "damping_nm_s_per_rad", "friction_loss_nm", "armature_kg_m2",
    "effort_limit_nm", "back_emf_nm_s_per_rad",
)  # fmt: skip
EXPLICIT_PD = Engine(slews=False, implicit=False)
"""Isaac Lab and Newton: torque computed before each step, set-points of unlimited speed."""
NOT_CARRIED = (
    "The feedback is no part of an actuator, and without it the simulated robot sees more than the "
    "real one does: its readings are stale, lost at times, quantised and biased. See FEEDBACK "
    "below."
)
KNOWN = {"yes": "measured", "ratio only": "ratio measured, scale assumed", "no": "not measured"}
"""How well a number is known, by `Quantity.identified`."""
_LONGEST_STEP_S = 0.1


def delays_at_step(
    calibration: Calibration, physics_step_s: float, engine: Engine = MUJOCO
) -> dict[str, Interval]:
    """Delays [s] of joints for another physics step or engine than the calibration's (`step_size`).

    Raises
    ------
    InputError
        If the step is not a physics step of a simulator, or too long for the servos.
    """
    if not 0 < physics_step_s <= _LONGEST_STEP_S:
        raise InputError(
            f"`physics_step_s` is {physics_step_s:g} s; give the simulator's own, between 0 and "
            f"{_LONGEST_STEP_S:g}, such as 0.005."
        )
    found = {}
    for name, joint in calibration.joints.items():
        a = joint.actuator
        (fitting,) = delay_at_step(a.parameters, physics_step_s, a.fitted_step_s, engine)
        more = float(fitting) - a.dead_time_s.value
        numbers = (max(t + more, 0.0) for t in (a.dead_time_s.value, *a.dead_time_interval_s))
        found[name] = Interval(*numbers)
    return found


def step_note(
    calibration: Calibration, delays: dict[str, Interval], physics_step_s: float
) -> Iterator[str]:
    """What was added to the delays for the length of a step, if anything was."""
    added = [
        1e3 * (delays[name].value - joint.actuator.dead_time_s.value)
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


def origin(calibration: Calibration) -> Iterator[str]:
    """Where the numbers come from, and what of servos under load they leave out, in sentences."""
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
    yield from operating_points(calibration)
    yield from _beyond(calibration)


def operating_points(calibration: Calibration) -> Iterator[str]:
    """P gain, armature and load that the numbers hold for, joints alike in one sentence."""
    for point, names in calibration.operating_points().items():
        yield f"Numbers of {', '.join(names)} are for {point}."
    if any(j.holds_at.armature == "servo and load" for j in calibration.joints.values()):
        yield (
            "An armature with the link and load counts their inertia twice in a model whose bodies "
            "have it, too: take it off the armature there."
        )


def _beyond(calibration: Calibration) -> Iterator[str]:
    """What of servos that were fitted under load no target carries."""
    joints: dict[tuple[str, ...], list[str]] = {}
    for name, joint in calibration.joints.items():
        if joint.under_load is not None:
            servo = joint.under_load.servo(joint.actuator.dead_time_s.value)
            if lost := servo.beyond_delayed_pd():
                joints.setdefault(lost, []).append(name)
    for lost, names in joints.items():
        yield (
            f"Fitted under load, but not carried over: {', '.join(lost)} ({', '.join(names)}). "
            "The friction here is that of one motor torque; `under_load` of the calibration has "
            "the whole servo."
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
            comment = f"  # {unit_of(key[0])}, {KNOWN[value.identified]}"
            if value.low is not None and value.high is not None:
                comment += f", 90 % interval {value.low:.4g} to {value.high:.4g}"
            value = value.value
        lines.append(f"{name}={value!r},{comment}\n")
    return f"{function}(\n{indent(''.join(lines), '    ')}),"


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


def torch_module(
    calibration: Calibration,
    target: str,
    notes: Sequence[str],
    import_line: str,
    physics_step_s: float,
    actuators: str,
) -> str:
    """A Python module: what it is, the actuators, the feedback and the code that applies it."""
    # read, not imported: that would load torch
    code = (resources.files("pupper_sysid.sim.export") / "held_feedback_torch.py").read_text()
    return (
        f"{docstring(f'Servos for {target}.', notes)}\n"
        "from __future__ import annotations\n\n"
        "from collections.abc import Mapping, Sequence\n\n"
        f"import torch\n{import_line}\n\n"
        f"PHYSICS_DT = {physics_step_s!r}\n"
        '"""Physics step that the delays below are counted in [s]."""\n\n'
        f"{actuators}\n"
        f"{feedback_block(calibration)}"
        '"""What makes each joint\'s readings stale, quantised and biased; `HeldFeedback` applies '
        'it."""\n'
        f"\n\n{code[code.index('class HeldFeedback') :]}"
    )
