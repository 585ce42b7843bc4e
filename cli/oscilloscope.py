"""Terminal oscilloscope: commands and readings of each joint as scrolling traces.

A second process draws. The loop that moves or reads the servos only hands it a message per
tick, which is dropped where the process is behind: a slow terminal delays no servo.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.live_views import LONGEST_MESSAGE, SideProcess
from pupper_sysid.hardware.bus import BusSample

Array = NDArray[np.float64]

_WINDOW_S = 4.0  # shown
_KEPT_S = 20.0  # for the lag
_MOST_TICKS = 20_000
_DRAW_EVERY_S = 0.2
_STAGE_EVERY_S = 0.5
_END_S = 2.0  # to draw a last time; a blocked terminal must not hold the command longer
_LONGEST_LAG_S, _LAG_STEP_S = 0.4, 0.004
_MOVES_RAD = 0.02  # smaller motions are not magnified, and have no lag
_STILL_RAD = 0.05  # joints that move less have no traces beside others that move more
_NARROWEST, _GAP = 36, 2  # columns of a joint's traces, and between them
_FEWEST_ROWS = 2
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])  # of braille
_BRAILLE = 0x2800
_SAMPLE, _TEXTS = b"S", b"T"
_SHOWN = {"load": "load {:.0%}", "voltage": "{:.1f} V", "temperature": "{:.0f} °C"}
_CHANNELS: tuple[str, ...] = ("command", "position", "load", "voltage", "temperature")


# ------------------------------------------------------------------------- the loop's side


class Oscilloscope:
    """Shows what a loop hands it, until the end of the block.

    `joints` are in the order of the arrays that it is given; `lag` shows how far readings lag
    behind commands.
    """

    def __init__(self, title: str, joints: Sequence[str], lag: bool = True):
        self._about = {"title": title, "joints": list(joints), "lag": lag}
        self._joints = len(joints)
        self._process: SideProcess | None = None
        self._stage_s = -np.inf

    def __enter__(self) -> Oscilloscope:
        self._process = SideProcess(__spec__.name)
        self._texts(self._about)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process is not None
        self._process.end(_END_S)

    def tick(
        self, time_s: float, command: NDArray[np.floating], reading: BusSample, missed: int = 0
    ) -> None:
        """Show one tick: what was sent [rad], NaN where nothing was; deadlines missed so far."""
        optional = (reading.load, reading.voltage_v, reading.temperature_c)
        nothing = np.full(self._joints, np.nan)
        rows = [command, reading.position_rad, *(nothing if x is None else x for x in optional)]
        self._send(_SAMPLE + np.concatenate([[time_s, missed], *rows], dtype=float).tobytes())

    def stage(self, done_s: float, total_s: float, what: str) -> None:
        """Show the present work: a `sysid.sweep.recorder.Progress`."""
        now = time.monotonic()
        if now - self._stage_s > _STAGE_EVERY_S:
            self._stage_s = now
            self._texts({"stage": f"{what}, {done_s:.0f} of {total_s:.0f} s"})

    def notes(self, notes: Sequence[str]) -> None:
        """Show a text beside each joint."""
        self._texts({"notes": list(notes)})

    def _texts(self, texts: dict) -> None:
        self._send(_TEXTS + json.dumps(texts).encode())

    def _send(self, message: bytes) -> None:
        assert self._process is not None
        self._process.send(message)


# ------------------------------------------------------------------------- the drawing process


@dataclass
class Screen:
    """What is known of the joints, and how it is drawn."""

    joints: tuple[str, ...] = ()
    title: str = ""
    stage: str = ""
    lag: bool = True
    notes: tuple[str, ...] = ()
    ticks: deque[Array] = field(default_factory=lambda: deque(maxlen=_MOST_TICKS))

    def take(self, message: bytes) -> None:
        """Take a message of `Oscilloscope`."""
        if message[:1] == _TEXTS:
            for name, value in json.loads(message[1:]).items():
                setattr(self, name, tuple(value) if isinstance(value, list) else value)
            return
        row = np.frombuffer(message[1:])
        self.ticks.append(row)
        while self.ticks[0][0] < row[0] - _KEPT_S:
            self.ticks.popleft()

    def frame(self, width: int, height: int) -> Text:
        """All joints that fit: lines of at most `width` columns, at most `height` of them."""
        text = Text(no_wrap=True, overflow="crop", end="")
        table = np.array(self.ticks)
        missed = f"missed deadlines {table[-1, 1]:.0f}" if len(table) else "waiting for the servos"
        head = "   ".join(part for part in (self.title, self.stage, missed) if part)
        text.append(head[:width] + "\n", "bold")
        legend = Text.assemble(
            ("command", "cyan"), ("  fresh", "green"), ("  stale reading", "dim"),
            f"   last {_WINDOW_S:g} s", no_wrap=True,
        )  # fmt: skip
        legend.truncate(width)
        text.append_text(legend).append("\n")
        if not len(table):
            return text
        values = table[:, 2:].reshape(len(table), len(_CHANNELS), -1)
        data = dict(zip(_CHANNELS, values.transpose(1, 0, 2), strict=True))
        known = np.isfinite(data["position"]) | np.isfinite(data["command"])
        seen = [k for k in range(len(self.joints)) if known[:, k].any()]
        extent = [max(_extent(data[c][:, k]) for c in ("command", "position")) for k in seen]
        moving = [k for k, e in zip(seen, extent, strict=True) if e > _STILL_RAD] or seen
        still = [k for k in seen if k not in moving]
        most = max((width + _GAP) // (_NARROWEST + _GAP), 1)
        spare = height - 2 - -(-len(still) // most)
        high = 1 + _FEWEST_ROWS
        columns = next((c for c in range(1, most) if -(-len(moving) // c) * high <= spare), most)
        moving = moving[: max(spare // high, 1) * columns]
        rows = max(spare // max(-(-len(moving) // columns), 1) - 1, 1)
        across = (width - _GAP * (columns - 1)) // columns
        blocks = [self._block(k, table[:, 0], data, across, rows) for k in moving]
        _append(text, blocks, columns, across)
        across = (width - _GAP * (most - 1)) // most
        _append(text, [[self._head(k, table[:, 0], data, across)] for k in still], most, across)
        lines = text.split("\n")[: max(height, 1)]
        return Text("\n", end="").join(lines)

    def _block(
        self, k: int, time_s: Array, data: dict[str, Array], width: int, rows: int
    ) -> list[Text]:
        command, position = data["command"][:, k], data["position"][:, k]
        inside = time_s >= time_s[-1] - _WINDOW_S
        x = 1 - (time_s[-1] - time_s[inside]) / _WINDOW_S
        command, position = command[inside], position[inside]
        fresh = np.r_[True, np.diff(position) != 0]
        shown_rad = np.concatenate([command, position])
        shown_rad = shown_rad[np.isfinite(shown_rad)]
        low, high = (shown_rad.min(), shown_rad.max()) if len(shown_rad) else (0.0, 0.0)
        span = max(high - low, _MOVES_RAD)
        low = (low + high - span) / 2
        layers = [
            ("green", braille(x[fresh], (position[fresh] - low) / span, width, rows)),
            ("dim", braille(x[~fresh], (position[~fresh] - low) / span, width, rows)),
            ("cyan", braille(*_joined(x, (command - low) / span, width), width, rows)),
        ]
        head = self._head(k, time_s, data, width)
        return [head, *(_line([(style, cells[r]) for style, cells in layers]) for r in range(rows))]

    def _head(self, k: int, time_s: Array, data: dict[str, Array], width: int) -> Text:
        head = Text(f"{self.joints[k]} ", "bold", no_wrap=True)
        head.append(" ".join(self._numbers(k, time_s, data)), "not bold")
        head.truncate(width, pad=True)
        return head

    def _numbers(self, k: int, time_s: Array, data: dict[str, Array]) -> list[str]:
        last = {name: values[-1, k] for name, values in data.items()}
        texts = [f"{last['position']:+.3f} rad" if np.isfinite(last["position"]) else "silent"]
        lag = lag_s(time_s, data["command"][:, k], data["position"][:, k]) if self.lag else np.nan
        if np.isfinite(lag):
            texts.append(f"lag {1e3 * lag:.0f} ms")
        texts += self.notes[k : k + 1]
        return texts + [
            text.format(last[name]) for name, text in _SHOWN.items() if np.isfinite(last[name])
        ]


def _append(text: Text, blocks: list[list[Text]], columns: int, across: int) -> None:
    """Append blocks of equally many lines, side by side."""
    for first in range(0, len(blocks), columns):
        for line in zip(*blocks[first : first + columns], strict=True):
            for k, part in enumerate(line):
                text.append(" " * _GAP if k else "").append_text(part)
            text.append("\n")


def _extent(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def braille(x: Array, y: Array, width: int, height: int) -> NDArray[np.int64]:
    """Points of the unit square as dots of braille letters, bits of shape (height, width).

    Points that are not finite, or outside, are left out.
    """
    cells = np.zeros((height, width), np.int64)
    inside = (x >= 0) & (x <= 1) & (y >= -1e-9) & (y <= 1 + 1e-9)  # NaN is not
    column = np.clip((x[inside] * (2 * width - 1)).round().astype(int), 0, 2 * width - 1)
    row = np.clip(((1 - y[inside]) * (4 * height - 1)).round().astype(int), 0, 4 * height - 1)
    np.bitwise_or.at(cells, (row // 4, column // 2), _DOTS[row % 4, column % 2])
    return cells


def _joined(x: Array, y: Array, width: int) -> tuple[Array, Array]:
    """Points at every column of dots, on straight lines between those given."""
    known = np.isfinite(y)
    if known.sum() < 2:
        return x, y
    dense = np.linspace(max(x[known][0], 0.0), x[known][-1], 4 * width)
    return dense, np.interp(dense, x[known], y[known])


def _line(layers: list[tuple[str, NDArray[np.int64]]]) -> Text:
    """One line of letters; where layers meet, in the colour of the first."""
    line = Text(no_wrap=True)
    for bits in zip(*(cells for _, cells in layers), strict=True):
        style = next((s for (s, _), b in zip(layers, bits, strict=True) if b), "")
        dots = int(np.bitwise_or.reduce(bits))
        line.append(chr(_BRAILLE + dots) if dots else " ", style)
    return line


def lag_s(time_s: Array, command: Array, position: Array) -> float:
    """Shift at which past commands are most like the readings [s]; NaN where nothing moves.

    It is the whole lag: bus, sensor and servo.
    """
    known = np.isfinite(position) & np.isfinite(command)
    time_s, command, position = time_s[known], command[known], position[known]
    later = time_s > time_s[0] + _LONGEST_LAG_S if len(time_s) else known[:0]
    if later.sum() < 20 or min(_extent(command), _extent(position[later])) < _MOVES_RAD:
        return float("nan")
    shifts = np.arange(0.0, _LONGEST_LAG_S + _LAG_STEP_S / 2, _LAG_STEP_S)
    past = np.interp(time_s[later] - shifts[:, None], time_s, command)
    past -= past.mean(axis=1, keepdims=True)
    read = position[later] - position[later].mean()
    size = np.sqrt((past**2).sum(axis=1) * (read**2).sum())
    likeness = past @ read / np.maximum(size, 1e-12)
    best = int(likeness.argmax())
    if likeness[best] < 0.5 or best in (0, len(shifts) - 1):
        return float("nan")
    before, at, after = likeness[best - 1 : best + 2]
    bend = before - 2 * at + after
    return float(shifts[best] + _LAG_STEP_S * 0.5 * (before - after) / min(bend, -1e-15))


def main() -> None:
    """Draw what comes through the socket whose descriptor is the argument."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which then ends this
    source = socket.socket(fileno=int(sys.argv[1]))
    source.settimeout(_DRAW_EVERY_S)
    from rich.live import Live

    screen, drawn_s = Screen(), -np.inf
    console = terminal.err
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while True:
            with contextlib.suppress(TimeoutError):
                message = source.recv(LONGEST_MESSAGE)
                if not message:
                    return
                screen.take(message)
            if time.monotonic() - drawn_s > _DRAW_EVERY_S:
                live.update(screen.frame(console.width - 1, console.height - 1), refresh=True)
                drawn_s = time.monotonic()


if __name__ == "__main__":
    main()
