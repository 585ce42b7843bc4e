"""Recordings in which something is wrong, each by one fault on a good one.

`GARBAGE` maps a fault's name to a `Fault`, which changes the rows of a good recording. `spoilt`
makes the recording, which may be refused right there, as a file would be when it is read.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pupper_sysid.sysid.recordings.recording import Recording
from support.made_recordings import USUAL_SERVO, Setup, made, record

DEGREE = 180 / np.pi


Rows = pd.DataFrame
Change = Callable[[Rows, np.random.Generator], Rows]


class Fault(NamedTuple):
    """How to spoil a recording."""

    change: Change
    refused: bool
    """Whether no number may come of it; else a warning will do."""
    base: dict[str, Any]
    """Keywords of `good`."""


GARBAGE: dict[str, Fault] = {}


def spoilt(name: str, rng: np.random.Generator, rows: Rows | None = None) -> Recording:
    """A good recording, or other rows, with the fault `name`."""
    fault = GARBAGE[name]
    return made(fault.change(good(**fault.base) if rows is None else rows, rng))


@cache
def _good(kind: str, quantum: float, rate: float) -> pd.DataFrame:
    setup = Setup(USUAL_SERVO, rate, kind=kind, quantum_rad=quantum)
    return record(setup, np.random.default_rng([5, round(rate)])).table.drop(columns="joint")


def good(kind: str = "tones", quantum: float = 2 * np.pi / 4096, rate: float = 50.0):
    """Rows of a good recording."""
    return _good(kind, quantum, rate).copy()


def _add(name: str, change: Change, refused: bool = True, **base: Any) -> None:
    GARBAGE[name] = Fault(change, refused, base)


def _each(table: pd.DataFrame, change: Callable[[pd.DataFrame], pd.DataFrame]) -> pd.DataFrame:
    return pd.concat([change(rows.copy()) for _, rows in table.groupby("trial")])


def _set(**columns):
    """Change columns by functions of the table and the generator."""

    def change(table: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
        return table.assign(**{c: f(table, rng) for c, f in columns.items()})

    return change


def _late(table: pd.DataFrame, rows: int, column: str = "command_rad") -> pd.Series:
    """A column some rows late (early if negative), trial by trial."""
    moved = table.groupby("trial")[column].shift(rows)
    return moved.fillna(table.groupby("trial")[column].transform("first"))


def _scaled(factor: float, *columns: str):
    return lambda t, rng: t.assign(**{c: factor * t[c] for c in columns})


def _walk(t: pd.DataFrame, rng: np.random.Generator) -> np.ndarray:
    step = rng.standard_normal(len(t))
    walk = np.cumsum(step - step.mean())
    return 0.3 * walk / np.abs(walk).max()


def _noise(t: pd.DataFrame, rng: np.random.Generator) -> np.ndarray:
    return 0.2 * rng.standard_normal(len(t))


# ----- commands and positions that are not of a servo
_add("constant command", _set(command_rad=lambda t, rng: 0.1))
_add("constant command, noisy position", _set(command_rad=lambda t, rng: 0.1, position_rad=_noise))
_add("command of one count", _set(command_rad=lambda t, rng: 5e-4 * (t.index % 2)))
_add("echo in the same row", _set(position_rad=lambda t, rng: t.command_rad))
_add("echo one row late", _set(position_rad=lambda t, rng: _late(t, 1)))
_add("echo three rows late", _set(position_rad=lambda t, rng: _late(t, 3)))
_add("echo with an offset", _set(position_rad=lambda t, rng: _late(t, 1) + 0.2))
_add("echo in counts", _set(position_rad=lambda t, rng: 0.0015 * np.round(_late(t, 1) / 0.0015)))
_add("echo in coarse counts", _set(
    position_rad=lambda t, rng: 0.0057 * np.round(_late(t, 2) / 0.0057)))  # fmt: skip
_add("echo with noise", _set(
    position_rad=lambda t, rng: t.command_rad + 0.003 * rng.standard_normal(len(t))))  # fmt: skip
_add("echo between rows", lambda t, rng: _each(t, lambda r: r.assign(
    position_rad=np.interp(r.send_time_s - 0.033, r.send_time_s, r.command_rad))))  # fmt: skip
_add("echo of teleoperation between rows", lambda t, rng: _each(t, lambda r: r.assign(
    position_rad=np.interp(r.send_time_s - 0.033, r.send_time_s, r.command_rad))),
    kind="teleoperation")  # fmt: skip
_add("echo of a chirp", _set(position_rad=lambda t, rng: _late(t, 1)), kind="chirp")
_add("echo of teleoperation", _set(position_rad=lambda t, rng: t.command_rad), kind="teleoperation")
_add("echo of steps", _set(position_rad=lambda t, rng: _late(t, 1)), kind="steps")
_add("white position", _set(position_rad=_noise))
_add("white command", _set(command_rad=_noise, frequency_hz=lambda t, rng: np.nan))
_add("white command and position", _set(
    command_rad=_noise, position_rad=_noise, frequency_hz=lambda t, rng: np.nan))  # fmt: skip
_add("white command under a tone's name", _set(command_rad=_noise))
_add("random walks", _set(
    command_rad=_walk, position_rad=_walk, frequency_hz=lambda t, rng: np.nan), False)  # fmt: skip
_add("position of another tone", _set(
    position_rad=lambda t, rng: 0.3 * np.sin(2 * np.pi * 1.37 * t.send_time_s)))  # fmt: skip
_add("position in another order", _set(
    position_rad=lambda t, rng: rng.permutation(t.position_rad)))  # fmt: skip
_add("position backwards in time", lambda t, rng: _each(
    t, lambda r: r.assign(position_rad=r.position_rad.to_numpy()[::-1])), kind="prbs")  # fmt: skip
_add("unsigned position", _set(position_rad=lambda t, rng: t.position_rad.abs()))
_add("speed instead of position", lambda t, rng: _each(
    t, lambda r: r.assign(position_rad=np.gradient(r.position_rad, r.send_time_s))))  # fmt: skip
_add("error instead of position", _set(position_rad=lambda t, rng: t.command_rad - t.position_rad),
     False)  # fmt: skip
_add("noise twice the motion", _set(
    position_rad=lambda t, rng: t.position_rad + 0.6 * rng.standard_normal(len(t))))  # fmt: skip
_add("noise as large as the motion", _set(
    position_rad=lambda t, rng: t.position_rad + 0.25 * rng.standard_normal(len(t))),
    False)  # fmt: skip

# ----- sign, order, columns
_add("inverted", _scaled(-1.0, "position_rad"))
_add("inverted steps", _scaled(-1.0, "position_rad"), kind="steps")
_add("inverted teleoperation", _scaled(-1.0, "position_rad"), kind="teleoperation")
_add("inverted and far", _set(position_rad=lambda t, rng: 1.2 - t.position_rad))
_add("swapped columns", lambda t, rng: t.rename(
    columns={"command_rad": "position_rad", "position_rad": "command_rad"}))  # fmt: skip
_add("swapped columns of a PRBS", lambda t, rng: t.rename(
    columns={"command_rad": "position_rad", "position_rad": "command_rad"}),
    kind="prbs")  # fmt: skip
_add("position 60 ms ahead", _set(position_rad=lambda t, rng: _late(t, -3)))
_add("position three servo lags ahead", _set(
    position_rad=lambda t, rng: _late(t, -8, "position_rad")), kind="chirp")  # fmt: skip
_add(
    "read times too early",
    _set(read_time_s=lambda t, rng: t.read_time_s - 0.15, send_time_s=lambda t, rng: t.send_time_s),
)
_add("reading of five rows before the command", _set(
    position_rad=lambda t, rng: _late(t, -5, "position_rad")), kind="prbs")  # fmt: skip

# ----- times
for unit, factor in (("ms", 1e3), ("µs", 1e6), ("ns", 1e9), ("minutes", 1 / 60),
                     ("hours", 1 / 3600)):  # fmt: skip
    _add(f"times in {unit}", _scaled(factor, "send_time_s", "read_time_s"))
_add("row numbers as times", _set(
    send_time_s=lambda t, rng: np.arange(len(t)) * 1.0,
    read_time_s=lambda t, rng: np.arange(len(t)) + 0.1))  # fmt: skip
_add("a day between two rows", lambda t, rng: t.assign(
    send_time_s=t.send_time_s + 86400 * (np.arange(len(t)) > 40),
    read_time_s=t.read_time_s + 86400 * (np.arange(len(t)) > 40)))  # fmt: skip


def _cut(first: float, last: float):
    def rows(r: pd.DataFrame) -> pd.DataFrame:
        since = r.send_time_s - r.send_time_s.iloc[0]
        return r[(since < first) | (since > last)]

    return lambda t, rng: _each(t, rows)


_add("gaps of 1.8 s", _cut(0.8, 2.6))
_add("gaps of 0.5 s", _cut(1.0, 1.5), False)
_add("clock steps of 1 s", lambda t, rng: _each(t, lambda r: r.assign(
    send_time_s=r.send_time_s + (np.arange(len(r)) > 60),
    read_time_s=r.read_time_s + (np.arange(len(r)) > 60))), False)  # fmt: skip
_add("clock steps back", lambda t, rng: _each(t, lambda r: r.assign(
    send_time_s=r.send_time_s - (np.arange(len(r)) > 60),
    read_time_s=r.read_time_s - (np.arange(len(r)) > 60))))  # fmt: skip
_add("rows in another order", lambda t, rng: t.sample(frac=1, random_state=int(rng.integers(99))))
_add("each time twice", lambda t, rng: t.assign(
    send_time_s=np.repeat(t.send_time_s.to_numpy()[::2], 2)[: len(t)]))  # fmt: skip
_add("times of 0.1 s", _set(send_time_s=lambda t, rng: np.round(t.send_time_s, 1),
                            read_time_s=lambda t, rng: np.round(t.read_time_s, 1)))  # fmt: skip
_add("two logs in one trial", lambda t, rng: pd.concat([t, t.assign(
    position_rad=-t.position_rad)]).sort_values("send_time_s"))  # fmt: skip
_add("readings by another clock", _set(read_time_s=lambda t, rng: t.read_time_s + 5))
_add("readings by a clock that drifts", _set(
    read_time_s=lambda t, rng: t.read_time_s + 0.1 * (t.send_time_s - 1)), False)  # fmt: skip
_add("loop of 1 Hz", lambda t, rng: t[t.index % 50 == 0].assign(trial=0, frequency_hz=np.nan))
_add("uneven loop", lambda t, rng: _each(t, lambda r: r[rng.random(len(r)) < 0.4]), False)

# ----- names of tones, trials
_add("tones called ω", _set(frequency_hz=lambda t, rng: 2 * np.pi * t.frequency_hz))
_add("tones called by periods", _set(frequency_hz=lambda t, rng: 1 / (3.3 * t.frequency_hz)))
_add("tones called 1,000 times faster", _scaled(1000.0, "frequency_hz"))
_add("tones called 1e300 Hz", _set(frequency_hz=lambda t, rng: 1e300))
_add("all tones called 1 Hz", _set(frequency_hz=lambda t, rng: 1.0))
_add("two recordings in one trial", lambda t, rng: t.assign(
    trial=0, frequency_hz=np.nan,
    position_rad=t.position_rad + 0.5 * (np.arange(len(t)) > len(t) // 2)), False)  # fmt: skip
_add("zero moves within a trial", lambda t, rng: _each(t, lambda r: r.assign(
    position_rad=r.position_rad + 0.4 * (np.arange(len(r)) > 100))), False)  # fmt: skip
_add("two servos in turn", lambda t, rng: t.assign(
    position_rad=np.where(t.index % 2, t.position_rad, 0.8 - 0.5 * t.position_rad)),
    False)  # fmt: skip


def _twice(t: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    again = t.assign(
        trial=t.trial + 10, send_time_s=t.send_time_s + 60, read_time_s=t.read_time_s + 60,
        position_rad=0.45 * t.position_rad,
    )  # fmt: skip
    return pd.concat([t, again])


_add("two servos under one name", _twice, False)

# ----- units, scale, zero
_add("degrees", _scaled(DEGREE, "command_rad", "position_rad"))
# slow enough, they could be radians of a very fast servo
_add("small degrees", _scaled(0.06 * DEGREE, "command_rad", "position_rad"), False)
_add("small degrees of 4,096 counts", lambda t, rng: _scaled(
    0.1 * DEGREE, "command_rad", "position_rad")(t, rng).pipe(lambda d: d.assign(
        position_rad=360 / 4096 * np.round(d.position_rad * 4096 / 360))))  # fmt: skip
_add("small degrees of 16,384 counts", lambda t, rng: _scaled(
    0.1 * DEGREE, "command_rad", "position_rad")(t, rng).pipe(lambda d: d.assign(
        position_rad=360 / 16384 * np.round(d.position_rad * 16384 / 360))), False,
    quantum=0.0)  # fmt: skip
_add("positions in degrees", _scaled(DEGREE, "position_rad"))
_add("small positions in degrees", lambda t, rng: t.assign(
    command_rad=0.1 * t.command_rad, position_rad=0.1 * DEGREE * t.position_rad))  # fmt: skip
_add("commands in degrees, small", lambda t, rng: t.assign(
    command_rad=0.1 * DEGREE * t.command_rad, position_rad=0.1 * t.position_rad))  # fmt: skip
_add("inverted degrees, small", lambda t, rng: t.assign(
    command_rad=0.1 * t.command_rad, position_rad=-0.1 * DEGREE * t.position_rad))  # fmt: skip
_add("counts", _scaled(651.9, "position_rad"))
_add("small counts", lambda t, rng: t.assign(
    command_rad=0.02 * t.command_rad, position_rad=0.02 * 651.9 * t.position_rad))  # fmt: skip
_add("counts around the centre", _set(
    position_rad=lambda t, rng: 2048 + np.round(651.9 * t.position_rad)))  # fmt: skip
_add("milliradians, small", lambda t, rng: t.assign(
    command_rad=0.02 * t.command_rad, position_rad=20.0 * t.position_rad))  # fmt: skip
_add("turns", _scaled(1 / (2 * np.pi), "position_rad"), False)
for gain, refused in ((3.0, True), (2.3, True), (1.7, False), (0.3, False), (0.04, True)):
    _add(f"gain {gain:g}", _scaled(gain, "position_rad"), refused)
for away, refused in ((2 * np.pi, True), (-2 * np.pi, True), (6.0, True), (np.pi, True),
                      (1.6, False)):  # fmt: skip
    _add(f"offset {away:.2f}", _set(
        position_rad=lambda t, rng, away=away: t.position_rad + away), refused)  # fmt: skip
_add(
    "command and position far away",
    _set(
        command_rad=lambda t, rng: t.command_rad + 5, position_rad=lambda t, rng: t.position_rad + 5
    ),
)

# ----- sensor
_add("never moves", _set(position_rad=lambda t, rng: 0.1))
_add("moves by one count", _set(position_rad=lambda t, rng: 0.0015 * (rng.random(len(t)) < 0.1)))
_add("frozen at a third", lambda t, rng: _each(t, lambda r: r.assign(
    position_rad=r.position_rad.where(np.arange(len(r)) < len(r) // 3,
                                      r.position_rad.iloc[len(r) // 3]))))  # fmt: skip
_add("frozen in one trial", lambda t, rng: t.assign(
    position_rad=t.position_rad.where(t.trial != 1, 0.05)), False)  # fmt: skip
_add("frozen in most trials", lambda t, rng: t.assign(
    position_rad=t.position_rad.where(t.trial == 2, 0.05)), False)  # fmt: skip
_add("one jump", _set(position_rad=lambda t, rng: 0.3 * (np.arange(len(t)) > 70)))
_add("wrapped at π", _set(
    position_rad=lambda t, rng: (t.position_rad + np.pi + 3.1) % (2 * np.pi) - np.pi))  # fmt: skip
_add("wrapped at a turn", _set(position_rad=lambda t, rng: t.position_rad % (2 * np.pi)))
_add("wrapped at 300 degrees", _set(position_rad=lambda t, rng: t.position_rad % 5.236))
_add("saturated", _set(position_rad=lambda t, rng: t.position_rad.clip(-0.15, 0.15)), False)
_add("saturated on one side", _set(position_rad=lambda t, rng: t.position_rad.clip(upper=0.05)),
     False)  # fmt: skip
_add("single wrong readings", _set(position_rad=lambda t, rng: np.where(
    rng.random(len(t)) < 0.03, t.position_rad + 2.0, t.position_rad)), False)  # fmt: skip
_add("a zero for each lost reading", _set(position_rad=lambda t, rng: np.where(
    rng.random(len(t)) < 0.15, -3.0, t.position_rad)), False)  # fmt: skip
_add("most readings missing", _set(
    position_rad=lambda t, rng: t.position_rad.where(rng.random(len(t)) < 0.3)))  # fmt: skip
_add("all readings missing", _set(position_rad=lambda t, rng: np.nan))
_add("some readings missing", _set(
    position_rad=lambda t, rng: t.position_rad.where(rng.random(len(t)) < 0.8)), False)  # fmt: skip
_add("huge readings", _set(position_rad=lambda t, rng: 1e300 * t.position_rad))
_add("sixteen-bit overflow", _set(position_rad=lambda t, rng: t.position_rad.where(
    t.position_rad > 0, t.position_rad + 65536 / 651.9)))  # fmt: skip
_add("motion of three counts", lambda t, rng: t.assign(
    command_rad=0.1 * t.command_rad, position_rad=0.02 * np.round(0.1 * t.position_rad / 0.02)),
    False)  # fmt: skip


def _interpolated(t: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    def rows(r: pd.DataFrame) -> pd.DataFrame:
        kept = r.iloc[::8]
        return r.assign(position_rad=np.interp(r.read_time_s, kept.read_time_s, kept.position_rad))

    return _each(t, rows)


_add("interpolated between readings", _interpolated, False, rate=100.0)
_add("three rows", lambda t, rng: t[:3])
_add("a quarter of a second", lambda t, rng: t[:22], False)


def _exchanged(t: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Two joints that move at the same time, each with the other's position."""
    setup = Setup(USUAL_SERVO, kind="teleoperation")
    hip, thigh = (record(setup, np.random.default_rng([9, n])).table for n in range(2))
    rows = min(len(hip), len(thigh))
    hip, thigh = hip[:rows].copy(), thigh[:rows].copy()
    thigh[["send_time_s", "read_time_s"]] = hip[["send_time_s", "read_time_s"]]
    hip["position_rad"], thigh["position_rad"] = thigh.position_rad, hip.position_rad
    return pd.concat([hip.assign(joint="LF_hip"), thigh.assign(joint="LF_thigh")])


_add("positions of two joints exchanged", _exchanged)
