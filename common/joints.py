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
    given = list(dict.fromkeys(names))
    return [n for n in JOINT_NAMES if n in given] + [n for n in given if n not in JOINT_NAMES]


def strange_joint(names: Iterable[str], any_robot: bool = False) -> tuple[str, str] | None:
    """The first name that can be no joint's, and what to do; None if all are well.

    Joints are all the Mini Pupper's or none is, so that a misspelt one among them is found; of a
    log of `any_robot` they may have some of its names.

    Examples
    --------
    >>> strange_joint(["LF_hip", "LF_tigh"])
    ('LF_tigh', 'did you mean LF_thigh?')
    >>> strange_joint(["shoulder_pan", "gripper"]) is None
    True
    """
    given = list(dict.fromkeys(map(str, names)))
    own = not any_robot and any(n in JOINT_NAMES for n in given)
    by_case = {n.lower(): n for n in JOINT_NAMES}
    for name in given:
        if name in JOINT_NAMES:
            continue
        # without a sister to tell by, only a slip of one letter is taken for one
        near = difflib.get_close_matches(name, JOINT_NAMES, n=1, cutoff=0.7 if own else 0.9)
        meant = by_case.get(name.lower()) or (near[0] if near else None)
        if meant and not any_robot:
            return name, f"did you mean {meant}?"
        if own:
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
        given = list(sentences)
        kinds = [_NUMBER.sub("0", sentence) for sentence in given]
        for sentence, kind in zip(given, kinds, strict=True):
            # two of a kind about one joint, e.g. on two of its trials, are told apart
            shared = kind if kinds.count(kind) == 1 else sentence
            joints.setdefault(shared, {}).setdefault(joint, sentence)
    return [
        ("All joints" if len(own) == len(by_joint) > 2 else ", ".join(own), _ranged(own.values()))
        for own in joints.values()
    ]


def _ranged(sentences: Iterable[str]) -> str:
    """One sentence for some that differ in their numbers alone."""
    given = list(sentences)
    numbers = zip(*(_NUMBER.findall(sentence) for sentence in given), strict=True)
    ends = iter([(min(own, key=_value), max(own, key=_value)) for own in numbers])

    def written(_: re.Match[str]) -> str:
        low, high = next(ends)
        return low if _value(low) == _value(high) else f"{low} to {high}"

    return _NUMBER.sub(written, given[0])


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
        found = [n for n in available if word.lower() in (n.lower(), *n.lower().split("_"))]
        if not found:
            own = any(n in JOINT_NAMES for n in available)
            groups = [*LEGS, *KINDS] if own else []
            if word.lower() in {n.lower() for n in (*JOINT_NAMES, *groups)}:
                raise InputError(
                    f"`joints`: there is no {word} here; there is {', '.join(available)}."
                )
            there = [g for g in groups if any(g in n.split("_") for n in available)]
            near = difflib.get_close_matches(word, [*available, *there, "all"], n=1, cutoff=0.4)
            hint = f" Did you mean {near[0]}?" if near else ""
            more = ", legs (LF, …), kinds (hip, …)" if own else ""
            raise InputError(
                f"`joints`: '{word}' is no joint{', leg or kind' if own else ''}.{hint} "
                f"Use names ({', '.join(available[:3])}, …){more} or all."
            )
        chosen.update(found)
    return [n for n in available if n in chosen]
