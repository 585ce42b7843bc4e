"""A calibration as MJCF for MuJoCo ≥ 4.0: a file to include, or a user's model with these servos.

What is included inherits the defaults of the model around it: a class `main` with `damping="0.6"`
reaches every joint class that does not say otherwise. So each attribute that the measurement covers
is written, zeros too. A class cannot override what a joint or actuator states itself, and it
replaces the class that the joint had, with its axis and range; `to_model` therefore writes a
whole model: every attribute at the joint, the joint's own actuators replaced, and the inertia that
its bodies put on the joint taken off an armature that holds it. The result is compiled and
compared with the numbers that were to be written.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from pathlib import Path
from textwrap import wrap
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.cards.card import CardCalibration
from pupper_sysid.servo_models.step_size import MUJOCO_PID
from pupper_sysid.sim.export.shared import FEEDBACK_KEYS, TORQUE_KEYS, ExportedServos, known_text
from pupper_sysid.sim.robot.hinges import hinges_of
from pupper_sysid.sim.robot.servo_mjcf import (
    INTEGRATOR,
    actuator_attributes,
    attributes,
    joint_attributes,
)

NEUTRAL_JOINT = {
    "damping": "0 0 0", "stiffness": "0 0 0", "springref": "0", "springdamper": "0 0",
    "springyield": "0", "actuatorfrclimited": "false", "actuatorfrcrange": "0 0",
    "actuatorgravcomp": "false",
}  # fmt: skip
"""What else a default class can put on a joint, switched off; three numbers are a polynomial's."""
NEUTRAL_ACTUATOR = {
    "gear": "1 0 0 0 0 0", "ctrllimited": "false", "ctrlrange": "0 0", "forcelimited": "false",
    "forcerange": "0 0", "actlimited": "false", "actrange": "0 0", "armature": "0",
    "damping": "0 0 0", "cranklength": "0", "group": "0",
}  # fmt: skip
"""The same of an actuator, as attributes of `<general>`: `<pid>` takes not all of them."""
NEUTRAL_PID = {"ki": "0", "imax": "0", "inheritrange": "0", "slewmax": "0"}
_CARRIED = (
    "Represented: delay (to fractions of a step), gains, limits of torque and of the set-point's "
    "speed, dry friction, armature, back-EMF (as damping); of the feedback the poll period and, as "
    "a delay, the mean age that lost polls add. Not represented: which polls are lost (the age is "
    "even here), the readings' counts and offset, that servos are polled one after the other, and "
    "the jitter of commands."
)
_RESET = (
    "After a reset fill the delay lines (mj_initCtrlHistory), which MuJoCo sets to zero: a robot "
    "that is not at zero would be thrown there for one delay."
)


def to_mjcf(servos: ExportedServos) -> str:
    """Defaults, actuators and sensors to `<include>` in a model that has joints of these names."""
    names = {name: f"servo_{name}" for name in servos.calibration.joint_names}
    defaults, actuators, sensors = _parts(servos, names)
    for element, name in zip(defaults, servos.calibration.joint_names, strict=True):
        element.insert(0, Element("joint", _joint(servos, name)))
    first = servos.calibration.joint_names[0]
    notes = servos.head(
        MUJOCO_PID,
        "Include this file in your model, and give each servo's joint its class, such as "
        f"class='servo_{first}'. Take off the joint what it states of armature, damping, "
        "stiffness, springref, springdamper, frictionloss, solreffriction, solimpfriction and "
        "actuatorfrcrange, which would override the class, and write at the joint the axis and "
        "range that its former class gave it. Remove the model's own actuators of these joints. "
        "The option `model` of the export does all this. A position in ctrl is the command of the "
        "servo.",
        "The time step, the integrator and flags of your <option> override those here.",
        _RESET,
        _CARRIED,
        *servos.short_delays(),
    )
    option = f'  <option timestep="{servos.physics_step_s!r}" integrator="{INTEGRATOR}"/>'
    lines = [
        f'<mujoco model="{_plain(servos.calibration.robot)}: servos">', *_comment(notes), option,
        *_group("default", servos, TORQUE_KEYS, defaults),
        *_group("actuator", servos, (), actuators),
        *_group("sensor", servos, FEEDBACK_KEYS, sensors), "</mujoco>", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _parts(
    servos: ExportedServos, classes: Mapping[str, str]
) -> tuple[list[Element], list[Element], list[Element]]:
    """Per joint: default class of its actuator, `<pid>` and sensor."""
    defaults, actuators, sensors = [], [], []
    for name, joint in servos.calibration.joints.items():
        servo = servos.actuators(MUJOCO_PID)[name].parameters
        pid = actuator_attributes(servo, servos.physics_step_s)
        neutral = dict(NEUTRAL_ACTUATOR)
        if "forcerange" in pid:
            neutral |= {"forcelimited": "true", "forcerange": pid["forcerange"]}
        default = Element("default", {"class": classes[name]})
        default.append(Element("general", neutral))
        defaults.append(default)
        place = {"name": name, "class": classes[name], "joint": name}
        actuators.append(Element("pid", place | NEUTRAL_PID | pid))
        sensor = {"name": f"{name}_reading", "joint": name}
        period, age = joint.feedback.poll_period_s.value, joint.feedback.mean_age_s.value
        if period > 0:
            # half a period is the sensor's mean age; lost polls add a delay
            late = max(age - period / 2, 0.0)
            length = str(int(np.ceil(late / period)) + 2)
            sensor |= {"nsample": length, "interval": repr(period), "delay": repr(late)}
        sensors.append(Element("jointpos", sensor))
    return defaults, actuators, sensors


def _joint(servos: ExportedServos, name: str) -> dict[str, str]:
    """Every attribute of a joint that the measurement covers."""
    servo = servos.actuators(MUJOCO_PID)[name].parameters
    damping = {"damping": f"{float(np.asarray(servo.back_emf))!r} 0 0"}
    return NEUTRAL_JOINT | joint_attributes(servo, servos.physics_step_s) | damping


# ------------------------------------------------------------------------- a whole model


def to_model(
    calibration: Calibration,
    model: Path,
    out: Path,
    physics_step_s: float | None = None,
    gain: float | None = None,
    link_inertia: Mapping[str, float] | None = None,
    sha256: str | None = None,
) -> tuple[str, ExportedServos]:
    """A user's MJCF with these servos, in one file, and what it holds of them.

    The calibration is of joints that the model has; a servo card is of all hinges that the model
    drives. Includes of the model are resolved; its assets stay where they are, and paths to them
    are relative to `out`, where the text will be written. The physics step is the model's own by
    default; so are the links' inertias: what its bodies put on the joint in its reference pose, of
    armatures that hold it. Other parameters are those of `ExportedServos.of`.
    """
    from pupper_sysid.sim.robot.engine import mujoco

    hinges = hinges_of(model)
    root = _inlined(model)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    names, card = [h.name for h in hinges if h.name], isinstance(calibration, CardCalibration)
    if card:
        chosen = [h.name for h in hinges if h.name and h.driven]
    else:
        chosen = [name for name in calibration.joint_names if name in names]
    if not chosen and card:
        raise InputError(
            f"{model} drives none of its hinges ({', '.join(names) or 'it has none'}), and a card "
            "goes into every hinge that is driven. Give the servo's hinge an actuator, such as "
            "<motor joint=...>."
        )
    if not chosen:
        raise InputError(
            f"{model} has no hinge of the calibration's joints "
            f"({', '.join(calibration.joint_names)}); it has {', '.join(names) or 'none'}. Rename "
            "the joints of one of them."
        )
    absent = [] if card else [n for n in calibration.joint_names if n not in chosen]
    calibration = calibration.model_copy(
        update={"joints": {name: calibration.joint(name) for name in chosen}}
    )
    if strangers := [name for name in link_inertia or {} if name not in chosen]:
        raise InputError(
            f"{', '.join(strangers)}: a link's inertia was stated, but no servo goes into such a "
            f"joint of {model}; servos go into {', '.join(chosen)}. Leave it out, or correct the "
            "name."
        )
    bodies = link_inertias(compiled, chosen)
    held = [n for n in chosen if calibration.joint(n).holds_at.armature == "servo and load"]
    links = {name: bodies[name] for name in held if bodies[name] > 0}
    links |= dict(link_inertia or {})
    step_s = float(compiled.opt.timestep) if physics_step_s is None else physics_step_s
    servos = ExportedServos.of(calibration, step_s, gain, links, sha256)
    before = _actuators(root)
    # a group of actuators that the model's options do not disable
    group = next(n for n in range(31) if not int(compiled.opt.disableactuator) >> n & 1)
    changes = list(_put_servos(root, servos, model, str(group)))
    changes += _options(root, servos, compiled)
    if absent:
        changes.append(
            f"Servos of joints that the model has not were left out: {', '.join(absent)}."
        )
    _place_assets(root, model, out)
    _keyframes(root, servos, compiled, before)
    notes = servos.head(
        MUJOCO_PID,
        f"The model is {model.name}, with these changes:",
        *changes,
        _RESET,
        _CARRIED,
        *servos.short_delays(),
    )
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    head, body = text.split(">", 1) if not text.startswith("<!--") else ("", text)
    text = "\n".join([f"{head}>", *_comment(notes)]) + body + "\n"
    _compare(text, servos, out)
    return text, servos


def link_inertias(model: Any, joints: Sequence[str]) -> dict[str, float]:
    """Inertia that a compiled model's bodies put on joints, in its reference pose [kg·m²].

    The diagonal of the mass matrix without armatures: what each joint moves while the others are
    held, whatever the base does.
    """
    from pupper_sysid.sim.robot.engine import mujoco

    bare = copy(model)
    for armatures in (bare.dof_armature, bare.actuator_armature, bare.tendon_armature):
        armatures[:] = 0.0
    data = mujoco.MjData(bare)
    mujoco.mj_setConst(bare, data)  # a free-standing body's inertia is kept in the model
    mujoco.mj_forward(bare, data)
    full = np.zeros((bare.nv, bare.nv))
    mujoco.mj_fullM(bare, data, full)
    places = {name: int(model.joint(name).dofadr[0]) for name in joints}
    return {name: float(full[place, place]) for name, place in places.items()}


def _inlined(path: Path, root_folder: Path | None = None, depth: int = 0) -> Element:
    """The model's elements, those of included files in their place."""
    text = path.read_bytes()
    if b"<!DOCTYPE" in text or depth > 8:
        raise InputError(f"{path} cannot be edited: it defines entities or includes itself.")
    try:
        parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        root = ElementTree.fromstring(text, parser)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path} is no well-formed XML: {error}. Repair it.") from error
    if depth == 0 and root.tag != "mujoco":
        raise InputError(
            f"{path} is a <{root.tag}>; servos can be put into an MJCF only. Convert a URDF with "
            "MuJoCo's `compile`, or include the exported file by hand."
        )
    folder = root_folder or path.parent
    for parent in list(root.iter()):
        for place, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                file = folder / child.get("file", "")
                if not file.exists():  # as MuJoCo, which looks beside the including file then
                    file = path.parent / child.get("file", "")
                included = _inlined(file, folder, depth + 1)
                parent.remove(child)
                for n, element in enumerate(included):
                    parent.insert(place + n, element)
    return root


def _put_servos(root: Element, servos: ExportedServos, model: Path, group: str) -> Iterator[str]:
    """Write servos at the joints, in place of the model's actuators; yield what changed."""
    calibration = servos.calibration
    taken = {e.get("class") for e in root.iter("default")}
    classes = {}
    for name in calibration.joint_names:
        classes[name] = f"servo_{name}"
        while classes[name] in taken:
            classes[name] += "_"
    defaults, actuators, sensors = _parts(servos, classes)
    for default in defaults:
        default[0].set("group", group)
    joints: dict[str, list[Element]] = {}
    for joint in (e for world in root.iter("worldbody") for e in world.iter("joint")):
        joints.setdefault(joint.get("name", ""), []).append(joint)
    for name in calibration.joint_names:
        if len(joints.get(name, ())) != 1:
            raise InputError(
                f"{model}: the joint {name} is made by <replicate> or <attach>, so it has no "
                "element of its own to edit. Save the compiled model (`mj_saveLastXML`) and give "
                "that."
            )
        (element,) = joints[name]
        element.attrib |= _joint(servos, name)
    counts = dict.fromkeys(calibration.joint_names, 0)
    pids = {a.get("joint"): a for a in actuators}
    names = {e.get("name") for s in root.iter("actuator") for e in s}
    removed: dict[str, Element] = {}
    unnamed: list[str] = []
    for section in root.iter("actuator"):
        for place, element in [*enumerate(section)]:
            target = element.get("joint") or element.get("jointinparent")
            if target in counts:
                counts[target] += 1
                section.remove(element)
                if instance := element.get("instance"):  # of a plugin, which no other can have
                    for plugin in root.iter("plugin"):
                        for state in plugin.findall(f"instance[@name='{instance}']"):
                            plugin.remove(state)
                if actuator_name := element.get("name"):
                    removed[actuator_name] = pids[target]
                if counts[target] == 1:
                    unnamed.extend([target] * (not actuator_name))
                    pids[target].set("name", actuator_name or target)
                    section.insert(
                        place - sum(max(n - 1, 0) for n in counts.values()), pids[target]
                    )
    missing = [name for name, count in counts.items() if count == 0]
    for name in [*missing, *unnamed]:
        while pids[name].get("name") in names:
            pids[name].set("name", f"{pids[name].get('name')}_")
    if missing:
        ElementTree.SubElement(root, "actuator").extend(pids[name] for name in missing)
    ElementTree.SubElement(root, "default").extend(defaults)
    known = {e.get("name") for s in root.iter("sensor") for e in s}
    for sensor in sensors:
        while sensor.get("name") in known:
            sensor.set("name", f"{sensor.get('name')}_")
    ElementTree.SubElement(root, "sensor").extend(sensors)
    for element in root.iter():  # sensors and tuples of a removed actuator get the joint's servo
        key = "objname" if element.get("objtype") == "actuator" else "actuator"
        if (servo := removed.get(element.get(key, ""))) is not None:
            element.set(key, servo.get("name", ""))
    if replaced := [name for name, count in counts.items() if count]:
        yield f"Own actuators were replaced, under their names: {', '.join(replaced)}."
    if several := [f"{name} ({count})" for name, count in counts.items() if count > 1]:
        yield f"Joints had several actuators, of which one is left: {', '.join(several)}."
    if missing:
        yield f"Joints had no actuator of their own: {', '.join(missing)}."
    tendons = {
        tendon.get("name")
        for tendon in root.iter("fixed")
        if any(j.get("joint") in counts for j in tendon.iter("joint"))
    }
    driven = [e.get("name") or e.tag for e in _actuators(root) if e.get("tendon") in tendons]
    if tendons and driven:
        yield f"Actuators on tendons drive these joints, too, and were left: {', '.join(driven)}."


def _options(root: Element, servos: ExportedServos, compiled: Any) -> Iterator[str]:
    """Time step, integrator and flags that the servos need."""
    from pupper_sysid.sim.robot.engine import mujoco

    option = ElementTree.SubElement(root, "option")
    option.set("timestep", repr(servos.physics_step_s))
    if servos.physics_step_s != compiled.opt.timestep:
        yield f"The time step was {compiled.opt.timestep:g} s."
    implicit = (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_IMPLICIT)
    if compiled.opt.integrator not in implicit:
        option.set("integrator", INTEGRATOR)
        name = mujoco.mjtIntegrator(compiled.opt.integrator).name.removeprefix("mjINT_")
        yield f"The integrator was {name}; the servos' damping needs {INTEGRATOR}."
    bits = mujoco.mjtDisableBit
    flags = {
        "frictionloss": bits.mjDSBL_FRICTIONLOSS, "damper": bits.mjDSBL_DAMPER,
        "actuation": bits.mjDSBL_ACTUATION,
    }  # fmt: skip
    disabled = [name for name, bit in flags.items() if compiled.opt.disableflags & bit]
    settings = dict.fromkeys(disabled, "enable")
    if compiled.opt.disableflags & bits.mjDSBL_CONSTRAINT:
        # dry friction is a constraint; the others stay off
        disabled.append("constraint")
        settings |= dict.fromkeys(("contact", "limit", "equality"), "disable")
        settings["constraint"] = "enable"
    if disabled:
        ElementTree.SubElement(option, "flag", settings)
        yield f"Flags were disabled that the servos need: {', '.join(disabled)}."


def _place_assets(root: Element, model: Path, out: Path) -> None:
    """Make the folders of assets relative to the new file."""
    if model.resolve().parent == out.resolve().parent:
        return
    here, there = model.resolve().parent, out.resolve().parent
    for attached in root.iter("model"):
        attached.set("file", os.path.relpath(here / attached.get("file", ""), there))
    compilers = list(root.iter("compiler")) or [ElementTree.SubElement(root, "compiler")]
    settings = {k: v for c in compilers for k, v in c.attrib.items()}
    for compiler in compilers:
        for key in ("assetdir", "meshdir", "texturedir"):
            compiler.attrib.pop(key, None)
    for key in ("meshdir", "texturedir"):
        folder = here / settings.get(key, settings.get("assetdir", ""))
        compilers[-1].set(key, os.path.relpath(folder, there))


def _actuators(root: Element) -> list[Element]:
    return [e for section in root.iter("actuator") for e in section if isinstance(e.tag, str)]


def _keyframes(
    root: Element, servos: ExportedServos, compiled: Any, before: Sequence[Element]
) -> None:
    """Commands and set-points of the servos in keyframes, which are there by default 0.

    A keyframe's command is that of the position actuator which the servo replaces, else where the
    joint is.
    """
    keys = [k for frame in root.iter("keyframe") for k in frame if isinstance(k.tag, str)]
    if not keys:
        return
    places = {id(e): n for n, e in enumerate(before)}
    commanded = {
        e.get("joint"): n for n, e in reversed([*enumerate(before)]) if e.tag in ("position", "pid")
    }
    servo_of = {place: e.get("joint", "") for place, e in enumerate(_actuators(root))}
    now = [places.get(id(e)) for e in _actuators(root)]
    # those of attached models are in no element, and are behind all others
    now += range(len(before), compiled.nactuator)
    for k, key in enumerate(keys):
        ctrl, act = [], []
        for place, old in enumerate(now):
            if old is not None:
                # several of each in one actuator, or none
                for values, kept, kind in ((ctrl, "key_ctrl", "ctrl"), (act, "key_act", "act")):
                    first, count = (
                        getattr(compiled, f"actuator_{kind}{end}")[old] for end in ("adr", "num")
                    )
                    values += getattr(compiled, kept)[k, first : first + count].tolist()
                continue
            joint = servo_of[place]
            at = float(compiled.key_qpos[k, compiled.joint(joint).qposadr[0]])
            if key.get("ctrl") is not None and joint in commanded:
                at = float(compiled.key_ctrl[k, compiled.actuator_ctrladr[commanded[joint]]])
            ctrl.append(at)
            servo = servos.calibration.joint(joint).actuator
            act += [at] if np.isfinite(servo.velocity_limit_rad_s.value) else []
        key.set("ctrl", " ".join(map(repr, ctrl)))
        key.attrib.pop("act", None)
        if act:
            key.set("act", " ".join(map(repr, act)))


def _compare(text: str, servos: ExportedServos, out: Path) -> None:
    """Compile the model where it will be, and compare the servos in it with their numbers."""
    from pupper_sysid.sim.robot.engine import mujoco

    trial = out.resolve().parent / f".{out.name}.{os.getpid()}.xml"
    try:
        trial.parent.mkdir(parents=True, exist_ok=True)
        trial.write_text(text, encoding="utf-8")
        model = mujoco.MjModel.from_xml_path(str(trial))
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error}.") from error
    except ValueError as error:
        raise PupperError(f"The model with the servos does not compile: {error}") from error
    finally:
        trial.unlink(missing_ok=True)
    for name, (compiled, written) in compiled_numbers(model, servos).items():
        if not np.allclose(compiled, written, rtol=1e-12, atol=0):
            raise PupperError(
                f"{name} of the model with the servos is {compiled} where {written} was written."
            )


def compiled_numbers(model: Any, servos: ExportedServos) -> dict[str, tuple[Any, Any]]:
    """Numbers of compiled joints and actuators, each beside the servo's: (compiled, wanted)."""
    from pupper_sysid.sim.robot.engine import mujoco

    of_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT  # ids of tendons count apart
    driven = {int(model.actuator_trnid[i, 0]): i for i in np.flatnonzero(of_joints)}
    numbers: dict[str, tuple[Any, Any]] = {}
    for name, actuator in servos.actuators(MUJOCO_PID).items():
        servo = actuator.parameters
        j, dof = model.joint(name).id, int(model.joint(name).dofadr[0])
        i = driven[j]
        pairs = {
            "armature": (model.dof_armature[dof], servo.armature),
            "frictionloss": (model.dof_frictionloss[dof], servo.friction_loss),
            "damping": (model.dof_damping[dof], servo.back_emf),
            "damping of higher order": (model.dof_dampingpoly[dof], np.zeros(2)),
            "stiffness": (model.jnt_stiffness[j], 0.0),
            "stiffness of higher order": (model.jnt_stiffnesspoly[j], np.zeros(2)),
            "actuatorfrclimited": (model.jnt_actfrclimited[j], 0),
            "kp": (-model.actuator_biasprm[i, 1], servo.stiffness),
            "kv": (-model.actuator_biasprm[i, 2], servo.damping),
            "slewmax": (model.actuator_dynprm[i, 1], servo.velocity_limit),
            "delay": (model.actuator_delay[i], servo.dead_time_s),
            "forcerange": (model.actuator_forcerange[i, 1], servo.effort_limit),
            "gear": (model.actuator_gear[i], np.eye(6)[0]),
            "ctrllimited": (model.actuator_ctrllimited[model.actuator_ctrladr[i]], 0),
            "actlimited": (model.actuator_actlimited[i], 0),
            "armature of the actuator": (model.actuator_armature[i], 0.0),
            "damping of the actuator": (model.actuator_damping[i], 0.0),
        }
        numbers |= {f"{name}: {key}": pair for key, pair in pairs.items()}
    return numbers


# ------------------------------------------------------------------------- texts


def _group(
    tag: str, servos: ExportedServos, keys: Sequence[str], elements: Sequence[Element]
) -> list[str]:
    """Lines of a section, each element under a comment with its numbers and their intervals."""
    lines = [f"  <{tag}>"]
    for element, (name, joint) in zip(elements, servos.calibration.joints.items(), strict=True):
        numbers = joint.feedback if keys == FEEDBACK_KEYS else joint.actuator
        texts = [
            f"{key} {getattr(numbers, key).value:.4g} ({known_text(getattr(numbers, key))})"
            for key in (*keys, *(("dead_time_s",) if keys == TORQUE_KEYS else ()))
        ]
        if texts:
            lines.append(f"    <!-- {_plain(name)}: {_plain(', '.join(texts))} -->")
        children = "".join(f"<{c.tag} {attributes(c.attrib)}/>" for c in element)
        end = f">{children}</{element.tag}>" if children else "/>"
        lines.append(f"    <{element.tag} {attributes(element.attrib)}{end}")
    return [*lines, f"  </{tag}>"]


def _comment(notes: Sequence[str]) -> list[str]:
    lines = [line for note in notes for line in (*wrap(_plain(note), 94), "")]
    return ["  <!--", *(f"    {line}".rstrip() for line in lines[:-1]), "  -->"]


def _plain(text: str) -> str:
    """Text for a comment or an attribute: two hyphens would end the one, a quote the other."""
    return text.translate(str.maketrans({"<": "‹", ">": "›", "&": "+", '"': "'"})).replace(
        "--", "–"
    )
