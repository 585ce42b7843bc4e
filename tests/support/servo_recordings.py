"""Recordings in memory whose commands and readings are written out by hand."""

import numpy as np
import pandas as pd

from pupper_sysid.sysid.recordings.recording import Recording

P = 0.02
JOINT = "LF_hip"


def trial(
    number: int,
    start_s: float,
    command,
    position,
    *,
    joint: str = JOINT,
    frequency_hz: float = float("nan"),
    period_s: float = P,
    read_after_s: float = 0.005,
) -> pd.DataFrame:
    """Rows of one trial: a command every period, a reading `read_after_s` later."""
    send = start_s + period_s * np.arange(len(command))
    return pd.DataFrame(
        {
            "send_time_s": send,
            "read_time_s": send + read_after_s,
            "trial": number,
            "joint": joint,
            "frequency_hz": frequency_hz,
            "command_rad": np.asarray(command, float),
            "position_rad": np.asarray(position, float),
        }
    )


def recording(*trials: pd.DataFrame, name: str = "made", rest: float | None = 0.0) -> Recording:
    """A recording in memory, that started at `rest` (None: it does not say where)."""
    table = pd.concat(trials, ignore_index=True)
    pose = {} if rest is None else {j: rest for j in table["joint"].unique()}
    return Recording(table, {"start_pose_rad": pose}, name, None, "")


def everything(number, elapsed, group):
    """The part that is all of it."""
    return np.ones(len(number), bool)


def ramp(rows: int, start: float = 0.0) -> np.ndarray:
    return start + 0.01 * np.arange(rows)


def sine(rows: int) -> np.ndarray:
    """2 Hz, 0.5 rad: the command moves by more than 5 mrad in nearly every tick."""
    return 0.5 * np.sin(2 * np.pi * 2 * P * np.arange(rows))
