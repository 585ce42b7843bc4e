"""Servos as other files state them: actuators of an MJCF, and configuration modules in Python.

    servo = foreign_servo("robot.xml", "LF_hip")    # for `servo_models.cards.compare`

MuJoCo compiles the MJCF, so that class defaults and damping ratios are resolved; the inertia that
the bodies put on the joint is stated apart from the armature. A Python file is read, not run:
keyword arguments and dictionaries of numbers, such as Isaac Lab's and mjlab's actuators have, and
nested classes as of legged_gym; numbers may be arithmetic with constants at the top of the file.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pupper_sysid.common.border import validated
from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.parts import ARMATURES, Armature
from pupper_sysid.servo_models.cards.compare import Servo
from pupper_sysid.servo_models.cards.numbers import TorquePD
from pupper_sysid.sim.export.mjcf import link_inertias
from pupper_sysid.sim.robot.hinges import hinges_of

_LARGEST_BYTES = 1_000_000
_MOST_REPEATS = 5  # of a pattern: names of 40 letters take a fraction of a second
_NO_LIMIT_NM = 100.0  # stands for an effort that is not limited; beyond any hobby servo's
_NO_LIMIT_RAD_S = 1000.0  # as our exports write it

_WORDS = {
    "stiffness_nm_per_rad": ("stiffness", "kp", "p_gain"),
    "damping_nm_s_per_rad": ("damping", "kv", "kd", "d_gain"),
    "armature_kg_m2": ("armature",),
    "friction_loss_nm": ("frictionloss", "friction_loss", "friction"),
    "effort_limit_nm": ("effort_limit", "actuator_effort_limit", "effort_limit_sim", "max_effort"),
    "back_emf_nm_s_per_rad": ("viscous_friction", "viscous_damping", "back_emf"),
    "dead_time_s": ("dead_time_s",),
    "velocity_limit_rad_s": ("velocity_limit_rad_s",),
}
"""Numbers of a PD by the names that configurations have for them, in small letters."""
_STEPS = (
    ("min_delay", "delay_min_lag", "delay_steps"),
    ("max_delay", "delay_max_lag", "delay_steps"),
)
_STEP_S = ("physics_dt", "sim_dt", "dt", "timestep")
"""A physics step, by the names that it has at the top of a file or in its simulator's settings."""
_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.Pow: math.pow,
}  # fmt: skip
_NAMES = ("joint_names_expr", "target_names_expr", "joint_names")


def foreign_servo(path: Path | str, joint: str | None = None) -> Servo:
    """One servo of an MJCF or of a Python configuration."""
    path = Path(path)
    if path.suffix == ".py":
        return _in_python(path, joint)
    model, driven = _compiled(path)
    if not driven or (joint is not None and joint not in driven):
        raise InputError(
            f"{path}: no position actuator drives {joint or 'a joint'}"
            + (f"; they drive {', '.join(driven)}." if driven else ".")
        )
    name = joint or next(iter(driven))
    return _driven_servo(path, model, name, driven[name])


def position_servos(path: Path) -> dict[str, Servo]:
    """Servos that the position actuators of an MJCF make of its joints, by joint; may be none."""
    model, driven = _compiled(path)
    return {name: _driven_servo(path, model, name, i) for name, i in driven.items()}


def _compiled(path: Path) -> tuple[Any, dict[str, int]]:
    """The model, and the position actuator of each joint that has one."""
    from pupper_sysid.sim.robot.engine import in_a_line, mujoco

    hinges_of(path)  # refuses files that take too much memory or time
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(f"{path} cannot be compiled by MuJoCo: {in_a_line(error)}.") from None
    driven: dict[str, int] = {}
    for i in range(model.nactuator):
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        pid = model.actuator_dyntype[i] == getattr(mujoco.mjtDyn, "mjDYN_PID", -1)
        # a velocity actuator has no stiffness
        if on_joint and (affine or pid) and model.actuator_biasprm[i, 1] < 0:
            driven.setdefault(model.joint(int(model.actuator_trnid[i, 0])).name, i)
    return model, driven


def _driven_servo(path: Path, model: Any, name: str, i: int) -> Servo:
    """The servo that actuator `i` makes of a joint."""
    dof, j = int(model.joint(name).dofadr[0]), model.joint(name).id
    gear = float(model.actuator_gear[i, 0])
    efforts = [_NO_LIMIT_NM]
    if model.actuator_forcelimited[i]:
        efforts.append(abs(gear) * float(np.max(np.abs(model.actuator_forcerange[i]))))
    if model.jnt_actfrclimited[j]:
        efforts.append(float(np.max(np.abs(model.jnt_actfrcrange[j]))))
    numbers = {
        "stiffness_nm_per_rad": -(gear**2) * model.actuator_biasprm[i, 1],
        "damping_nm_s_per_rad": gear**2 * abs(model.actuator_biasprm[i, 2]),
        "friction_loss_nm": model.dof_frictionloss[dof],
        "armature_kg_m2": model.dof_armature[dof] + gear**2 * model.actuator_armature[i],
        "effort_limit_nm": min(efforts),
        "back_emf_nm_s_per_rad": model.dof_damping[dof],
        "dead_time_s": model.actuator_delay[i],
    }
    speed = float(model.actuator_dynprm[i, 1]) if model.actuator_actnum[i] else 0.0
    if 0 < speed < _NO_LIMIT_RAD_S:
        numbers["velocity_limit_rad_s"] = speed
    notes, assumed = [], []
    on_joints = model.actuator_trntype == model.actuator_trntype[i]
    if (several := int(np.sum(on_joints & (model.actuator_trnid[:, 0] == j)))) > 1:
        notes.append(f"{path.name} drives {name} by {several} actuators; one is compared.")
    if min(efforts) == _NO_LIMIT_NM:
        assumed.append("effort_limit_nm")
        notes.append(f"{path.name} does not limit the effort; {_NO_LIMIT_NM:g} N·m stand for it.")
    if model.jnt_stiffness[j] > 0:
        notes.append(
            f"{path.name} has a spring of {model.jnt_stiffness[j]:.3g} N·m/rad on {name}, which "
            "no servo has."
        )
    text = path.read_text(encoding="utf-8", errors="replace")
    return Servo(
        path.name, name, None, False, _armature(text, name), None, _pd(path, numbers),
        link_kg_m2=link_inertias(model, [name])[name], notes=tuple(notes), as_it_stands=True,
        assumed=tuple(assumed),
    )  # fmt: skip


def _in_python(path: Path, joint: str | None) -> Servo:
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    if not path.is_file() or path.stat().st_size > _LARGEST_BYTES:
        raise InputError(f"{path} is no Python file of a configuration.")
    try:
        text = path.read_text(encoding="utf-8-sig")
        tree = ast.parse(text, path.name)
    except (SyntaxError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is no Python that can be read: {error}.") from error
    # names at the top of the file that stand for literals, or for arithmetic with such names
    literals: dict[str, Any] = {}
    for node in tree.body:
        name, value = _assigned(node)
        names, values = [name], [value]
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):  # A, B = 1, 2
            names, values = map(ast.unparse, node.targets[0].elts), getattr(node.value, "elts", [])
        pairs = zip(names, values, strict=False)  # a call gives several, too
        literals |= {k: v for k, e in pairs if k and (v := _value(e, literals)) is not None}
    literals_and_groups = (literals, *_groups(tree, literals))
    constants, *groups = ({k.lower(): v for k, v in g.items()} for g in literals_and_groups)
    fitting = [
        group for group in groups
        if _first(group, _WORDS["stiffness_nm_per_rad"], joint) and _is_of(group, joint)
    ]  # fmt: skip
    if not fitting:
        raise InputError(
            f"{path}: no stiffness{f' of {joint}' if joint else ''} stands there as a number. "
            "Gains must be keyword arguments, dictionary entries or settings of a class "
            "(stiffness, damping, armature, friction, effort_limit), as numbers or arithmetic with "
            "constants at the top of the file."
        )
    group = fitting[0]
    numbers = {key: _first(group, words, joint) for key, words in _WORDS.items()}
    notes, assumed = [], []
    ends = [n for words in _STEPS if (n := _first(group, words, joint)) is not None]
    steps, between = float(np.mean(ends or [0.0])), " to ".join(f"{n:g}" for n in sorted({*ends}))
    if steps and numbers["dead_time_s"] is None:
        lengths = {n for g in (constants, *groups) if (n := _first(g, _STEP_S, None)) is not None}
        if len(lengths) == 1:
            numbers["dead_time_s"] = steps * lengths.pop()
            notes += [f"{path.name} delays by {between} physics steps; their mean is compared."] * (
                len({*ends}) > 1
            )
        else:
            notes.append(
                f"{path.name} delays by {between} physics steps, but their length is "
                + ("ambiguous" if lengths else "missing")
                + " there: state it as PHYSICS_DT (s)."
            )
    numbers["armature_kg_m2"] = numbers["armature_kg_m2"] or None  # 0 stands for none
    if (numbers["effort_limit_nm"] or 0.0) > _NO_LIMIT_NM:
        numbers["effort_limit_nm"] = None
    if (numbers["velocity_limit_rad_s"] or 0.0) >= _NO_LIMIT_RAD_S:
        numbers["velocity_limit_rad_s"] = None
    for key, stand_in in (
        ("damping_nm_s_per_rad", 0.0), ("friction_loss_nm", 0.0), ("armature_kg_m2", 1e-4),
        ("effort_limit_nm", _NO_LIMIT_NM),
    ):  # fmt: skip
        if numbers[key] is None:
            numbers[key] = stand_in
            assumed.append(key)
            word = _WORDS[key][0] + f" up to {stand_in:g} N·m" * (key == "effort_limit_nm")
            notes.append(f"{path.name} states no {word}; {stand_in:g} stands for it.")
    known = {key: value for key, value in numbers.items() if value is not None}
    return Servo(
        path.name, joint, None, False, _armature(text, joint), None, _pd(path, known),
        notes=tuple(notes), as_it_stands=True, assumed=tuple(assumed),
    )  # fmt: skip


def _armature(text: str, joint: str | None) -> Armature:
    """What an armature includes by the head of our own exports, else the servo alone."""
    heads = re.findall(
        r"Numbers of ([^;]*) (?:hold for:|are for) [^;]*; armature: ([^;]*);",
        " ".join(text.split()),
    )
    said = next((words for names, words in heads if joint in (None, *names.split(", "))), "")
    return "servo and load" if said == ARMATURES["servo and load"] else "servo"


def _pd(path: Path, numbers: Mapping[str, float]) -> TorquePD:
    plain = {key: float(value) for key, value in numbers.items()}
    # a joint may have no armature, a servo has
    plain["armature_kg_m2"] = max(plain["armature_kg_m2"], 1e-9)
    return validated(TorquePD, {"model": "delayed_pd", **plain}, path)


def _assigned(node: ast.stmt) -> tuple[str, ast.expr | None]:
    """Name and value of an assignment, annotated or not; no name of anything else."""
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id, node.value
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return node.target.id, node.value
    return "", None


def _value(node: ast.expr | None, literals: Mapping[str, Any]) -> Any:
    """A literal, a name of one, or arithmetic of such numbers; None for anything else."""
    if node is None:
        return None
    if isinstance(node, ast.Name):
        return literals.get(node.id)
    if isinstance(node, ast.Attribute):
        if ast.unparse(node) in ("math.pi", "np.pi", "torch.pi"):
            return np.pi
        settings = _value(node.value, literals)  # of an object made with keyword arguments
        return getattr(settings, node.attr, None) if isinstance(settings, SimpleNamespace) else None
    if isinstance(node, ast.Call):
        keywords = {k.arg: k.value for k in node.keywords if k.arg}
        if isinstance(factory := keywords.get("default_factory"), ast.Lambda):
            return _value(factory.body, literals)
        if isinstance(node.func, ast.Name) and node.func.id == "reflected_inertia":  # mjlab's
            sides = [*node.args, *keywords.values()]
            numbers = [_value(side, literals) for side in sides]
            if len(sides) == 2 and all(isinstance(n, int | float) for n in numbers):
                return float(numbers[0]) * float(numbers[1]) ** 2
        return SimpleNamespace(
            **{name: _value(value, literals) for name, value in keywords.items()}
        )
    if isinstance(node, ast.Dict):
        entries = zip(node.keys, node.values, strict=True)
        return {_value(k, literals): _value(v, literals) for k, v in entries if k is not None}
    if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
        sides = [_value(side, literals) for side in (node.left, node.right)]
        if not all(isinstance(side, int | float) for side in sides):
            return None
        try:
            # as floats, which overflow where whole numbers would grow without end
            return _ARITHMETIC[type(node.op)](*map(float, sides))
        except (ArithmeticError, ValueError):
            return None
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None


def _groups(tree: ast.Module, literals: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Keyword arguments, dictionaries with text as keys, bodies of classes, as far as literal."""

    def value_of(node: ast.expr) -> Any:
        return _value(node, literals)

    bodies: dict[ast.ClassDef, dict[str, Any]] = {
        node: {
            name: value_of(value)
            for inner in node.body
            for name, value in (_assigned(inner),)
            if name and value is not None
        }
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    gains = {*_WORDS["stiffness_nm_per_rad"]}
    of_servos = {node.name for node, body in bodies.items() if gains & body.keys()}
    classes: dict[str, dict[str, Any]] = {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):  # settings in nested classes, as of legged_gym
            bases = [classes.get(base.id, {}) for base in node.bases if isinstance(base, ast.Name)]
            settings = {key: value for base in bases[::-1] for key, value in base.items()}
            for part in ast.walk(node):
                if isinstance(part, ast.ClassDef):  # others have a ground's friction
                    other = () if part.name in of_servos else ("friction", "damping")
                    settings |= {k: v for k, v in bodies[part].items() if k not in other}
            classes[node.name] = settings
    yield from reversed(classes.values())
    named = {name: value for node in tree.body for name, value in (_assigned(node),) if name}

    def wraps(call: ast.AST) -> ast.Call | None:
        """Call that makes the actuator which this one delays, as mjlab's `base_cfg`."""
        base = next((k.value for k in getattr(call, "keywords", ()) if k.arg == "base_cfg"), None)
        base = named.get(base.id) if isinstance(base, ast.Name) else base
        return base if isinstance(base, ast.Call) else None

    for node in sorted(ast.walk(tree), key=lambda node: wraps(node) is None):
        if isinstance(node, ast.Call):
            base = wraps(node)
            keywords = [*(base.keywords if base else ()), *node.keywords]
            group = {k.arg: value_of(k.value) for k in keywords if k.arg}
            for keyword in node.keywords:  # `**dict(…)`, as of limits under other names
                if keyword.arg is None and isinstance(keyword.value, ast.Call):
                    group |= {k.arg: value_of(k.value) for k in keyword.value.keywords if k.arg}
            yield group
        elif isinstance(node, ast.Dict):
            keys = [getattr(key, "value", None) for key in node.keys]
            values = [value_of(value) for value in node.values]
            group = {k: v for k, v in zip(keys, values, strict=True) if isinstance(k, str)}
            yield group
            for name, value in group.items():
                if isinstance(value, dict) and all(isinstance(k, str) for k in value):
                    yield value | {"joint_names_expr": [name]}


def _names(group: Mapping[str, Any]) -> list[str] | None:
    """Names or patterns of the joints that a group is of; None if it does not say."""
    names = next((group[n] for n in _NAMES if isinstance(group.get(n), list | tuple | str)), None)
    return [names] if isinstance(names, str) else names and [n for n in names if isinstance(n, str)]


def _is_of(group: Mapping[str, Any], joint: str | None) -> bool:
    names = _names(group)
    return joint is None or names is None or any(_matches(name, joint) for name in names)


def _first(group: Mapping[str, Any], words: tuple[str, ...], joint: str | None) -> float | None:
    """The first of some names that is a number, or one for the joint."""
    for word in words:
        value, names = group.get(word), _names(group) or []
        if isinstance(value, dict):
            fitting = [v for k, v in value.items() if joint is None or _matches(str(k), joint)]
            # legged_gym's keys are parts of names, of which the last counts
            fitting += [v for k, v in [*value.items()][::-1] if joint and str(k) in joint]
            value = fitting[0] if fitting else None
        elif isinstance(value, list | tuple) and len(value) == len(names):  # in their order
            value = next((v for n, v in zip(names, value, strict=True) if n == joint), None)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    return None


def _matches(pattern: str, joint: str) -> bool:
    if "(" not in pattern and "|" in pattern:
        return any(_matches(part, joint) for part in pattern.split("|"))
    # a search of `re` has no time limit: without repeated groups it takes at most a power of the
    # name's length, whose exponent is the number of repeats
    repeats = re.sub(r"\\.|\[\]?[^]]*\]", "x", pattern).replace("(?", "(")
    if re.search(r"\)[*+{]", repeats) or len(re.findall(r"[*+?{]", repeats)) > _MOST_REPEATS:
        raise InputError(
            f"The joint pattern {pattern[:80]!r} repeats a group or has more than {_MOST_REPEATS} "
            "repeats, and may take forever to match. Write the names of the joints instead."
        )
    try:
        return re.fullmatch(pattern, joint) is not None
    except re.error:
        return pattern == joint
