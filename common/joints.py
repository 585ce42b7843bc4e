"""The twelve joints of the Mini Pupper, in the one order that its arrays have; rules for others'.

What measures, fits and exports servos takes any robot's joints, by name; what simulates and walks
is of the Mini Pupper.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence

from pupper_sysid.common.errors import InputError

LEGS = ("LF", "RF", "LB", "RB")
KINDS = ("hip", "thigh", "calf")
JOINT_NAMES: tuple[str, ...] = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)

# Standing pose of the policy and of servo count 512 [rad], facts/hardware.md C5.
DEFAULT_POSE: dict[str, float] = {
    name: {"hip": 0.0, "thigh": 0.785, "calf": -1.57}[name.split("_")[1]] for name in JOINT_NAMES
}

STALL_TORQUE_NM = 0.35
STALL_TORQUES_NM = (1e-3, 100.0)
"""Smallest and largest stall torque that a servo can have [N·m]: what calibration files hold."""
STALL_TORQUE_SOURCE = (
    "data sheet of the Mini Pupper servo, 3.5 kg·cm; another data sheet of this servo class says "
    "0.23 N·m at 6 V, so take torques as good to a factor of 1.5 at best"
)
NO_LOAD_SPEED_RAD_S = 7.5
"""Speed of a Mini Pupper 2's servo without load, about; a vendor of its class states 10.5."""

# names become names of files, of XML elements and of columns
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
# a quantity: not part of a name ("STS3215"), a date, a range or a larger number, and not which
# trial, row or servo
_NUMBER = re.compile(
    r"(?<![\w.:/…–-])(?<!\d,)(?<!\btrial )(?<!\brow )(?<!\bline )(?<!\bservo )"
    r"[-−]?\d+(?:\.\d+)?(?![\w:/…–-]|[.,]\.?\d)"
)


def in_order(names: Iterable[str]) -> list[str]:
    """Each name once: the Mini Pupper's in its order, then others as they come."""
    once = dict.fromkeys(names)
    return [n for n in JOINT_NAMES if n in once] + [n for n in once if n not in JOINT_NAMES]


def strange_joint(names: Iterable[str], any_robot: bool = False) -> tuple[str, str] | None:
    """The first name that can be no joint's, and what to do; None if all are well.

    Either all joints are the Mini Pupper's or none is, which reveals a misspelt name; a log of
    `any_robot` may have some of them.

    Examples
    --------
    >>> strange_joint(["LF_hip", "LF_tigh"])
    ('LF_tigh', 'did you mean LF_thigh?')
    >>> strange_joint(["shoulder_pan", "gripper"]) is None
    True
    """
    listed = list(dict.fromkeys(map(str, names)))
    mini_pupper = not any_robot and any(n in JOINT_NAMES for n in listed)
    by_case = {n.lower(): n for n in JOINT_NAMES}
    for name in listed:
        if name in JOINT_NAMES:
            continue
        # among names of another robot only a slip of one letter is corrected
        near = difflib.get_close_matches(name, JOINT_NAMES, n=1, cutoff=0.7 if mini_pupper else 0.9)
        meant = by_case.get(name.lower()) or (near[0] if near else None)
        if meant and not any_robot:
            return name, f"did you mean {meant}?"
        if mini_pupper:
            return name, f"known are {', '.join(JOINT_NAMES)}."
        if not _NAME.fullmatch(name):
            return name, "use letters, digits and _, beginning with a letter."
    return None


def share_sentences(by_joint: Mapping[str, Iterable[str]]) -> list[tuple[str, str]]:
    """Sentences on joints, each once, with the joints that it is about.

    Sentences that differ in nothing but their numbers become one, with the range of each.

    Examples
    --------
    >>> share_sentences({"LF_hip": ["slow.", "weak."], "LF_thigh": ["slow."]})
    [('LF_hip, LF_thigh', 'slow.'), ('LF_hip', 'weak.')]
    >>> share_sentences({"LF_hip": ["late by 3.5 ms."], "LF_thigh": ["late by 4 ms."]})
    [('LF_hip, LF_thigh', 'late by 3.5 to 4 ms.')]
    """
    joints: dict[str, dict[str, str]] = {}
    for joint, sentences in by_joint.items():
        listed = list(sentences)
        kinds = [_NUMBER.sub("0", sentence) for sentence in listed]
        for sentence, kind in zip(listed, kinds, strict=True):
            # two of a kind about one joint, e.g. on two of its trials, are told apart
            shared = kind if kinds.count(kind) == 1 else sentence
            joints.setdefault(shared, {}).setdefault(joint, sentence)
    every_joint = ", ".join(by_joint) if len(by_joint) > 2 else None
    rows = [(", ".join(texts), _ranged(texts.values())) for texts in joints.values()]
    return [("All joints" if names == every_joint else names, text) for names, text in rows]


def with_joints(by_joint: Mapping[str, Iterable[str]]) -> list[str]:
    """Sentences on joints, each once, behind the names of all joints that it is about."""
    bare = {j: [text.removeprefix(f"{j}: ") for text in texts] for j, texts in by_joint.items()}
    return [f"{names}: {text}" for names, text in share_sentences(bare)]


def _ranged(sentences: Iterable[str]) -> str:
    """One sentence for some that differ in their numbers alone."""
    listed = list(sentences)
    numbers = zip(*(_NUMBER.findall(sentence) for sentence in listed), strict=True)
    ends = iter([(min(column, key=_value), max(column, key=_value)) for column in numbers])

    def written(_: re.Match[str]) -> str:
        low, high = next(ends)
        return low if _value(low) == _value(high) else f"{low} to {high}"

    return _NUMBER.sub(written, listed[0])


def _value(number: str) -> float:
    return float(number.replace("−", "-"))


def select_joints(text: str, available: Sequence[str] = JOINT_NAMES) -> list[str]:
    """Joints named by `text`: names, legs (`LF`), kinds (`hip`), mixed with commas, or `all`.

    Case does not matter; the answer keeps the order of `available`.

    Examples
    --------
    >>> select_joints("LF")
    ['LF_hip', 'LF_thigh', 'LF_calf']
    """
    chosen: set[str] = set()
    for word in (part.strip() for part in text.split(",")):
        if word.lower() == "all":
            chosen.update(available)
            continue
        matching = [n for n in available if word.lower() in (n.lower(), *n.lower().split("_"))]
        if not matching:
            mini_pupper = any(n in JOINT_NAMES for n in available)
            groups = [*LEGS, *KINDS] if mini_pupper else []
            if word.lower() in {n.lower() for n in (*JOINT_NAMES, *groups)}:
                raise InputError(
                    f"`joints`: there is no {word} here; there is {', '.join(available)}."
                )
            known = [g for g in groups if any(g in n.split("_") for n in available)]
            near = difflib.get_close_matches(word, [*available, *known, "all"], n=1, cutoff=0.4)
            hint = f" Did you mean {near[0]}?" if near else ""
            more = ", legs (LF, …), kinds (hip, …)" if mini_pupper else ""
            raise InputError(
                f"`joints`: '{word}' is no joint{', leg or kind' if mini_pupper else ''}.{hint} "
                f"Use names ({', '.join(available[:3])}, …){more} or all."
            )
        chosen.update(matching)
    return [n for n in available if n in chosen]
