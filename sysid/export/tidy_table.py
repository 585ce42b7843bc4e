"""A calibration or a recording as a tidy table, for a spreadsheet or for pandas.

Both open with comment lines (`# key: JSON value`) on the origin of the numbers;
`pandas.read_csv(path, comment="#")` skips them. A calibration becomes one row per joint and
quantity; a recording becomes a recording file of this project, from whatever layout it was read.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pupper_sysid.common.files import write_text
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.recordings.table import comments

CALIBRATION_COLUMNS = (
    "joint", "part", "quantity", "unit", "value", "low", "high", "identified", "why",
)  # fmt: skip


def to_csv(source: Calibration | Recording, path: Path | None = None, force: bool = False) -> str:
    """`source` as CSV text, written to `path` if one is given.

    A calibration gives the columns `CALIBRATION_COLUMNS`: `part` is where the quantity stands in
    the calibration file (`actuator`, `feedback`, `lag`, `scores`, …), `low` and `high` are the ends
    of its 90 % interval, and a number that is not a measured quantity (a score, a count of steps)
    leaves the last four empty. What the calibration does not hold has no row. A recording gives its
    rows with the columns of `sysid.recordings.recording`.
    """
    text = _calibration(source) if isinstance(source, Calibration) else source.to_csv()
    if path is not None:
        write_text(path, text, force)
    return text


def _calibration(calibration: Calibration) -> str:
    header = calibration.model_dump(mode="json", by_alias=True, exclude={"joints"})
    header["operating_points"] = {
        name: joint.holds_at.model_dump(mode="json") for name, joint in calibration.joints.items()
    }
    buffer = io.StringIO()
    buffer.write(comments("pupper-sysid calibration table", header))
    # text is quoted: a '#' in a sentence must not begin a comment
    table = csv.writer(buffer, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
    buffer.write(",".join(CALIBRATION_COLUMNS) + "\n")
    for name, joint in calibration.joints.items():
        table.writerows([name, *row] for row in _rows(joint))
    return buffer.getvalue()


def _rows(joint: JointCalibration) -> Iterator[list[Any]]:
    """Part, quantity, unit, value, low, high, identified, why of all numbers of one joint."""
    parts: dict[str, BaseModel] = {
        "actuator": joint.actuator,
        "ratios_to_armature": joint.actuator.ratios_to_armature,
        "scale": joint.actuator.scale,
        "feedback": joint.feedback,
        "lag": joint.lag,
        "scores": joint.scores,
    }
    for part, model in parts.items():
        for name, entry in model:
            if isinstance(entry, Quantity):
                numbers = [entry.value, entry.low, entry.high]
                yield [part, name, unit_of(name), *numbers, entry.identified, entry.why]
            elif isinstance(entry, int | float):
                yield [part, name, unit_of(name), entry, "", "", "", ""]
