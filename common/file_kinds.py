"""What a file of this project is, by its first lines, where another kind is expected.

`refuse_other_kind(path, RECORDING)` refuses a calibration in a sentence that names what it is and
what reads it, instead of the first fault that a reader of recordings would meet.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import open_regular

RECORDING = "pupper-sysid recording"
_TRUTH = "truth"
_KINDS = {
    RECORDING: ("a recording", "`pupper-sysid doctor`, `delay` and `calibrate` read it"),
    _TRUTH: ("the truth of an emulated recording", "`pupper-sysid compare-truth` reads it"),
    "pupper-calibration": (
        "a calibration", "`pupper-sysid export` reads it, `compare` takes it as one of `models`"),
    "pupper-servo-card": ("a servo card", "`pupper-sysid servo show` and `servo diff` read it"),
    "pupper-servo-model": (
        "a fitted servo model", "`pupper-sysid compare` takes its folder as one of `models`"),
    "pupper-sysid plan": ("a plan", "`pupper-sysid sweep` takes it as `plan`"),
    "pupper-policy": ("a policy", "`pupper-eval`, `pupper-play` and `pupper-deploy` read it"),
    "pupper-run": ("a training run", "`pupper-eval` reads its folder, `pupper-train` resumes it"),
}  # fmt: skip
"""By the schema that a file states: what it is, and what reads it."""
_INSIDE = ("contract.json", "run.yaml")  # of a folder
_HEAD = 8192
_SCHEMA = re.compile(r"^[ \t{]*\"?schema\"?: *\"?(pupper-[\w -]*\w)", re.MULTILINE)
_OURS = re.compile(rf"# {RECORDING}|[\w,]*\b(send_time_s|motor_idx)\b")
_EMULATED = re.compile(r"spec:\s+dead_time_s:")


def refuse_other_kind(path: Path, expected: str) -> None:
    """Refuse what is another kind of file, or folder, of this project, and name what reads it.

    What is no file of this project, or cannot be read, is left to its reader. `expected` is
    `RECORDING`, or the schema that the expected kind states.
    """
    kind = _kind_of(path)
    if kind not in (None, expected):
        what, readers = _KINDS[kind]
        raise InputError(f"{path} is {what}, not {_KINDS[expected][0]}: {readers}.")


def _kind_of(path: Path) -> str | None:
    with suppress(InputError, OSError):
        if path.is_dir():
            inside = (path / name for name in _INSIDE)
            return next((kind for p in inside if p.is_file() and (kind := _kind_of(p))), None)
        with open_regular(path) as file:
            head = file.read(_HEAD).decode(errors="replace")
        if _OURS.match(head):
            return RECORDING
        if _EMULATED.match(head):
            return _TRUTH
        stated = _SCHEMA.search(head)
        return stated[1] if stated and stated[1] in _KINDS else None
    return None
