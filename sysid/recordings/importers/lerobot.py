"""LeRobot datasets, v2.1 and v3: folders with `meta/info.json` and parquet files.

`action` and `observation.state` are lists with a number per joint, named in `meta/info.json`; an
episode is a trial. A turn of LeRobot's loop reads the state, then takes the action and sends it.
`timestamp` is the frame's number over the rate, so the true times are lost: a command is taken to
be sent half a frame after the state was read, and all lags are in doubt by half a frame.

Angles are shares of each joint's calibrated range (−100 … 100, a gripper's 0 … 100) or degrees, and
the calibration is not in the dataset. Feetech and Dynamixel servos have 4,096 counts a turn, so the
step of the readings gives the scale. Lag and dead time do not depend on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.border import parse_json
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.csv_table import MOST_CELLS, distinct, one_each
from pupper_sysid.common.reading.dialect import decoded
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.recordings.importers.log import (
    Log,
    joint_names,
    number,
    read_files,
    rows,
)
from pupper_sysid.sysid.recordings.importers.options import COUNT_RAD, LogOptions, smallest_step
from pupper_sysid.sysid.recordings.importers.parquet import read_columns
from pupper_sysid.sysid.recordings.importers.times import one_after_another

LAYOUT = "LeRobot dataset"

_ACTION, _STATE = "action", "observation.state"
_KEYS = (_ACTION, _STATE, "episode_index", "frame_index")
_SENT_AFTER = 0.5  # of a frame: it waits for the cameras' next pictures in between
_NOMINAL_RAD = np.pi  # range of a joint whose readings show no step
_MOST_FILES = 10_000
_FEETECH = ("so100", "so101", "lekiwi", "xlerobot")


def is_lerobot(folder: Path) -> bool:
    """Whether `folder` holds such a dataset."""
    return (folder / "meta" / "info.json").is_file()


def read_lerobot(folder: Path, options: LogOptions) -> Log:
    """The dataset's episodes as rows, a trial each."""
    info_path = folder / "meta" / "info.json"
    data_paths = sorted((folder / "data").rglob("*.parquet"))
    if not data_paths:
        raise InputError(
            f"{folder} is a LeRobot dataset without data/**/*.parquet. Fetch its data folder, too."
        )
    refuse_more(folder, len(data_paths), _MOST_FILES, "data files", "Give a part of it.")
    contents, digest = read_files(folder, [info_path, *data_paths])
    info = parse_json(decoded(info_path, contents[info_path]), str(info_path))
    names = _names(info_path, info)
    fps = options.rate or number(info_path, info.get("fps"), "fps")
    if not 1 <= fps <= 10_000:
        raise InputError(f"{info_path}, fps is {fps:g}. Write the dataset's frames per second.")
    of_key = {key: names.get(f"{key}, flat", [key]) for key in _KEYS}
    parts: dict[str, list[NDArray[np.float64]]] = {key: [] for key in _KEYS}
    for path in data_paths:
        read = read_columns(path, contents[path], [c for of in of_key.values() for c in of])
        for key, key_columns in of_key.items():
            parts[key].append(np.column_stack([read[c] for c in key_columns]))
    refuse_more(folder, sum(p.size for p in parts[_STATE]), MOST_CELLS, "values",
                "Give a part of it.")  # fmt: skip
    columns = {}
    for key, several in parts.items():
        if len({part.shape[1] for part in several}) > 1:
            raise InputError(f"{folder}: {key} has another length in one of the data files.")
        columns[key] = np.concatenate(several)
    for key in (_ACTION, _STATE):
        listed = {"its list of names in meta/info.json": len(names[key])}
        one_each(folder, {key: columns[key].shape[1]} | listed)
    commands, positions = (
        columns[key][:, [names[key].index(name) for name in names["joints"]]]
        for key in (_ACTION, _STATE)
    )
    joints = joint_names(info_path, names["joints"])
    for key in _KEYS[2:]:
        if not np.isfinite(columns[key]).all():
            raise InputError(f"{folder}, column {key}: a value is missing. Mend the dataset.")
    number_of, frame = (columns[key][:, 0] for key in _KEYS[2:])
    episode, time_s = one_after_another(frame / fps, number_of)
    one_scale, texts = _scales(positions, joints)
    scales = np.column_stack([one_scale, one_scale])  # of commands, of positions
    for k, joint in enumerate(joints):
        if pair := options.unit_of(names["joints"][k], joint):
            scales[k] = [unit.scale for unit in pair]
            texts[joint] = f"{scales[k, 1]:.5f} (given)"
    metadata: dict[str, Any] = {
        "imported_from": LAYOUT,
        "codebase_version": str(info.get("codebase_version"))[:20],
        "robot_type": str(info.get("robot_type"))[:80],
        "joints": joints,
        "readings": options.readings or "live",
        "times": f"nominal: frame / {fps:g} Hz",
        "assumed_units": texts,
        "bus": {"read_time_doubt_s": min(0.5 / fps, 1.0)},
    }
    if metadata["robot_type"].startswith(_FEETECH):
        metadata["servos"] = {joint: {"model": "STS3215"} for joint in joints}
    sent_s, angles = time_s + _SENT_AFTER / fps, (scales[:, 0] * commands, scales[:, 1] * positions)
    table = pd.concat(
        [
            rows(joint, sent_s, time_s, angles[0][:, k], angles[1][:, k], episode)
            for k, joint in enumerate(joints)
        ],
        ignore_index=True,
    )
    of_text = {text: [j for j in texts if texts[j] == text] for text in texts.values()}
    units = "; ".join(f"{', '.join(names_of)}: {text}" for text, names_of in of_text.items())
    warnings = [
        f"its times are frame numbers over {fps:g} Hz, not clock readings: lag and dead time scale "
        "with that rate (`pupper-sysid import --rate` gives another), and when a state was read "
        "and an action sent is not known within a frame, so they are in doubt by half a frame "
        f"({500 / fps:.0f} ms). Record with time stamps to know them better.",
        f"its angles are not in rad. Scales in rad per unit: {units}. Torques, speeds and errors "
        "scale with it; lag and dead time do not.",
    ]
    return Log(table, metadata, warnings, digest)


def _names(path: Path, info: Any) -> dict[str, list[str]]:
    """Names of the columns of action and state, and those in both that are positions."""
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict):
        raise InputError(f"{path}: features is missing, so this is no LeRobot dataset.")
    names_of: dict[str, list[str]] = {}
    for key in (_ACTION, _STATE):
        feature = features.get(key)
        flat = [name for name in features if str(name).startswith(f"{key}.")]
        if feature is None and flat:  # a column per joint
            names_of[key] = [name.removeprefix(f"{key}.") for name in flat]
            names_of[f"{key}, flat"] = flat
            distinct(f"{path}, {key}", names_of[key], "joints")
            continue
        if not isinstance(feature, dict):
            raise InputError(
                f"{path}, features: {key} is missing. A servo's dataset needs {_ACTION} and "
                f"{_STATE}."
            )
        names = _flat(feature.get("names"))
        if not names:
            shape = feature.get("shape")
            count = shape[0] if isinstance(shape, list) and shape else 0
            names = [f"joint_{k}" for k in range(count if isinstance(count, int) else 0)][:1000]
        names_of[key] = [str(name) for name in names]
        distinct(f"{path}, {key}", names_of[key], "joints")
    both = [name for name in names_of[_STATE] if name in names_of[_ACTION]]
    positions = [name for name in both if name.endswith(".pos")]
    if not both:
        raise InputError(
            f"{path}: no joint has both {_ACTION} and {_STATE}; action has "
            f"{printable(', '.join(names_of[_ACTION])[:200])}."
        )
    return names_of | {"joints": positions or both}


def _flat(names: Any) -> list[str]:
    """Names in lists within lists or dictionaries: `{"motors": [...]}`, `[[...]]`."""
    if isinstance(names, str):
        return [names]
    inside = names.values() if isinstance(names, dict) else names
    return [n for part in inside for n in _flat(part)] if isinstance(inside, Iterable) else []


def _scales(
    positions: NDArray[np.float64], joints: list[str]
) -> tuple[list[float], dict[str, str]]:
    """Radians per unit of each joint, and in words where the scale is from."""
    steps = [smallest_step(positions[:, k]) for k in range(len(joints))]
    by_step = [COUNT_RAD / step if step > 0 else 0.0 for step in steps]
    farthest = float(np.nanmax(np.abs(positions))) if positions.size else 0.0
    scales, texts = [], {}
    for k, joint in enumerate(joints):
        span = 100.0 if positions[:, k].min() >= 0 and "gripper" in joint else 200.0
        if abs(by_step[k] - 1) < 0.02:
            scale, text = 1.0, "1 (rad: readings are whole counts of 4096 a turn apart)"
        elif 0.2 <= span * by_step[k] <= 2 * np.pi:
            scale = by_step[k]
            text = f"{scale:.5f} (readings are {steps[k]:.4g} units apart, taken for 1/4096 turn)"
        elif farthest <= np.pi:
            scale, text = 1.0, "1 (assumed: no value is beyond ±π)"
        elif farthest > 101:
            scale, text = np.pi / 180, f"{np.pi / 180:.5f} (assumed: degrees)"
        else:
            scale = _NOMINAL_RAD / span
            text = f"{scale:.5f} (assumed: {span:g} units are a range of π)"
        scales.append(scale)
        texts[joint] = text
    return scales, texts
