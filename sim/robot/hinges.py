"""Hinges of a robot's MJCF or URDF, read in a child process with limits on memory and time.

A URDF states joints, limits and followers in its XML, and nothing else of it is read: many that
other programs use have links without masses, paths of packages or numbers that MuJoCo refuses. An
MJCF has defaults, includes and tendons, so MuJoCo compiles it.

A model file can ask for any amount of memory (height fields, textures, `replicate`) or block (an
include of a pipe). It is therefore read in a second process, which prints the hinges as JSON:
`python -m pupper_sysid.sim.robot.hinges FILE`.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import resolved

_LARGEST_BYTES = 50_000_000
_MEMORY_BYTES = 2 << 30
_TIME_S, _PATIENCE_S = 10, 60  # of the processor; and by the clock, for a busy machine takes longer
_ADVICE = "Give a URDF, or an MJCF that MuJoCo's viewer opens."
_NO_LIMIT_RAD = 1e4
"""Limits beyond say that there are none."""


@dataclass(frozen=True)
class Hinge:
    """A hinge joint of a model."""

    name: str
    """Empty if it has none."""
    limited: bool
    low: float | None
    high: float | None
    """`low` and `high`: its range [rad]; where it is not limited as the file has them, None for
    other than finite numbers."""
    driven: bool
    """Whether an actuator drives it, by itself or through a tendon; in a model without actuators
    every hinge that does not follow another."""
    follows: str = ""
    """Joint that it follows (URDF `mimic`, MJCF equality of two joints); empty for none."""
    zero_range: bool = False
    """Whether the file states a range of 0 to 0, which MuJoCo takes for no limits."""


def hinges_of(path: Path) -> list[Hinge]:
    """All hinges of the model in `path`, in its order; meshes need not be there."""
    if not path.is_file():
        raise InputError(f"{path} is no file. Give your robot's MJCF or URDF.")
    if path.stat().st_size > _LARGEST_BYTES:
        raise InputError(f"{path} has more than {_LARGEST_BYTES / 1e6:.0f} MB: no robot's MJCF.")
    command = [sys.executable, "-m", __name__, str(resolved(path))]
    try:
        ended = subprocess.run(command, capture_output=True, timeout=_PATIENCE_S, check=False)
        lines = ended.stdout.decode(errors="replace").splitlines()
        reply: dict[str, Any] = json.loads(lines[-1]) if lines else {"out_of": "memory or time"}
    except (subprocess.TimeoutExpired, ValueError):
        reply = {"out_of": "time"}
    if "out_of" in reply:
        raise InputError(
            f"{path} takes MuJoCo more than {_MEMORY_BYTES >> 30} GB or {_TIME_S} s to read. A "
            "joint map needs joints and actuators only: take height fields, textures, replicated "
            "bodies and includes out."
        )
    if "reason" in reply:
        reason = "".join(c if c.isprintable() else " " for c in reply["reason"])
        reason = " ".join(reason.split()).rstrip(".")
        raise InputError(f"{path} cannot be read as a robot: {reason}. {_ADVICE}")
    return [Hinge(**hinge) for hinge in reply["hinges"]]


def _limit_this_process() -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limits; the time is limited from outside
        return
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (_TIME_S, _TIME_S))


def _read(path: str) -> list[Hinge]:
    _limit_this_process()
    root = _xml(path)
    if root is not None and root.tag == "robot":
        return _of_urdf(root)
    from pupper_sysid.sim.robot.engine import mujoco

    model = _model(mujoco, path)
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    led = leaders(model)
    driven = driven_joints(model) if model.nu else set(hinges) - set(led)
    zero = set() if root is None else _zero_ranges(root)
    read = []
    for j in hinges:
        low, high = (float(x) if abs(x) < 1e6 else None for x in model.jnt_range[j])
        limited = bool(model.jnt_limited[j])
        name = model.joint(j).name
        follows = model.joint(led[j]).name if j in led else ""
        read.append(Hinge(name, limited, low, high, j in driven, follows, name in zero))
    return read


def _of_urdf(root: Element) -> list[Hinge]:
    """Hinges of a URDF, each limb from its base on, whatever the order of the file."""
    tags = (element.tag for element in root.iter() if isinstance(element.tag, str))
    values = (
        value for joint in root.iter("joint") for e in joint.iter() for value in e.attrib.values()
    )
    if any(tag.startswith("{") and "xacro" in tag for tag in tags) or any(
        "${" in v for v in values
    ):
        raise ValueError("it is a xacro file, to be expanded: `xacro FILE > robot.urdf`")
    hinges: list[Hinge] = []
    for joint in _depth_first(root.findall("joint")):
        kind, limit = joint.get("type"), joint.find("limit")
        if kind not in ("revolute", "continuous"):
            continue
        ends = {} if limit is None or kind == "continuous" else limit.attrib
        low, high = (_number(ends.get(end, "0")) for end in ("lower", "upper"))
        free = kind == "continuous" or (
            low is not None and high is not None and min(-low, high) > _NO_LIMIT_RAD
        )
        mimic = joint.find("mimic")
        follows = "" if mimic is None else mimic.get("joint", "")
        zero = not free and low == high == 0.0
        if joint.get("name") in {hinge.name for hinge in hinges}:
            raise ValueError(f"two joints are called '{joint.get('name')}'")
        hinges.append(
            Hinge(joint.get("name", ""), not free, 0.0 if free else low, 0.0 if free else high,
                  not follows, follows, zero)
        )  # fmt: skip
    return hinges


def _depth_first(joints: list[Element]) -> list[Element]:
    """Joints depth first, as MuJoCo has them; those that belong to no tree are the last."""

    def link(joint: Element, end: str) -> str | None:
        element = joint.find(end)
        return None if element is None else element.get("link")

    moved = {link(joint, "child") for joint in joints}
    waiting = [joint for joint in joints if link(joint, "parent") not in moved][::-1]
    ordered: list[Element] = []
    while waiting:
        joint = waiting.pop()
        if joint in ordered:  # a loop
            continue
        ordered.append(joint)
        child = link(joint, "child")
        waiting += [j for j in joints if link(j, "parent") == child][::-1]
    return ordered + [joint for joint in joints if joint not in ordered]


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return None if math.isnan(value) else value


def _xml(path: str) -> Element | None:
    """Root of an XML file; None where it is not XML, of which MuJoCo takes more."""
    text = Path(path).read_bytes()
    for attempt in (text, _bound(text)):
        with contextlib.suppress(ParseError):
            return fromstring(attempt)
    return None


def _model(mujoco, path: str):
    """The compiled model; where it does not compile as it is, without all but its joints."""
    try:
        return mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        reason = error
    try:
        spec = mujoco.MjSpec.from_file(path)
        for element in (*spec.geoms, *spec.sites, *spec.tendons):
            element.material = ""
        for geom in list(spec.geoms):
            if geom.meshname or geom.hfieldname:
                spec.delete(geom)
        for pieces in (spec.skins, spec.meshes, spec.hfields, spec.materials, spec.textures):
            for piece in list(pieces):
                spec.delete(piece)
        for body in spec.bodies[1:]:  # no number of these is used
            body.explicitinertial, body.mass, body.inertia = True, 1.0, [1.0, 1.0, 1.0]
            body.fullinertia = [float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0]
        return spec.compile()
    except ValueError:
        raise reason from None


def leaders(model: Any) -> dict[int, int]:
    """Joints that follow another by an active equality, and which."""
    from pupper_sysid.sim.robot.engine import mujoco

    return {
        int(model.eq_obj1id[k]): int(model.eq_obj2id[k])
        for k in range(model.neq)
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT
        and model.eq_obj2id[k] >= 0
        and model.eq_active0[k]
    }


def _zero_ranges(root: Element) -> set[str]:
    """Joints for which an MJCF itself states a range of 0 to 0."""
    ranges = {joint.get("name", ""): joint.get("range", "").split() for joint in root.iter("joint")}
    return {
        name
        for name, ends in ranges.items()
        if len(ends) == 2 and all(_number(e) == 0 for e in ends)
    }


def _bound(text: bytes) -> bytes:
    """XML whose prefixes are all declared: URDF of Drake and of ROS often has some that are not."""
    used = set(re.findall(rb"[<\s/]([A-Za-z_][\w.-]*):[A-Za-z_][\w.-]*(?=[\s=>/])", text))
    used -= {b"xml", b"xmlns", *re.findall(rb"xmlns:([\w.-]+)\s*=", text)}
    declared = b"".join(b' xmlns:%s="%s"' % (prefix, prefix) for prefix in sorted(used))
    return re.sub(rb"<(robot|mujoco)\b", lambda begin: begin[0] + declared, text, count=1)


def driven_joints(model: Any) -> set[int]:
    """Joints that an actuator drives, by itself or through a tendon."""
    from pupper_sysid.sim.robot.engine import mujoco

    driven: set[int] = set()
    trn = mujoco.mjtTrn
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        if kind == trn.mjTRN_JOINT or kind == trn.mjTRN_JOINTINPARENT:
            driven.add(int(target))
        elif kind == trn.mjTRN_TENDON:
            first = model.tendon_adr[target]
            for wrap in range(first, first + model.tendon_num[target]):
                if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT:
                    driven.add(int(model.wrap_objid[wrap]))
    return driven


def _main() -> None:
    try:
        reply = {"hinges": [asdict(hinge) for hinge in _read(sys.argv[1])]}
    except MemoryError:
        reply = {"out_of": "memory"}
    except Exception as error:  # whatever MuJoCo raises is about the file
        # a failed allocation is reported by MuJoCo or as pybind11's "unknown exception"
        memory = any(words in str(error) for words in ("allocate memory", "unknown exception"))
        reply = {"out_of": "memory"} if memory else {"reason": str(error)}
    print(json.dumps(reply))


if __name__ == "__main__":
    import os
    import tempfile

    with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes its log where it runs
        os.chdir(folder)
        _main()
        os.chdir("/")
