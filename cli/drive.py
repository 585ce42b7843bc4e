"""Driving a robot by keys, with a live table of commands and readings."""

from __future__ import annotations

import os
import select
import sys
import termios
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.terminal import terminal_without
from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.policies.deploy.deployment import Tick
from pupper_sysid.policies.network.policy_file import CommandRanges

STEP = np.array([0.05, 0.04, 0.1])
"""Increment of one key press [m/s, m/s, rad/s]."""
KEYS = {
    "w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1),
}  # fmt: skip
CLIPPED = "   clipped to what it was trained for"
_HELP = "w/s forward  a/d sideways  q/e turn  space stands  x ends"
_SHOWN_EVERY_S = 0.2


class Driver:
    """Commands from the keyboard, no further than those `trained`, and a live table of the ticks.

    Use it as a context; it is a `policies.deploy.commands.Commands`.
    """

    def __init__(self, trained: CommandRanges) -> None:
        self._trained, self._clipped = trained, False
        self._command = np.zeros(3)
        self._ended = False
        self._live = Live(console=terminal.err, auto_refresh=False)
        self._shown_s = -np.inf
        self._age = np.zeros(0)
        self._joints: Sequence[str] = ()
        self._seen: BusSample | None = None
        self._seen_s = 0.0

    def __call__(self, elapsed_s: float) -> np.ndarray | None:
        """Command at this moment, shape (3,); None once x was pressed."""
        while select.select([sys.stdin], [], [], 0)[0]:
            typed = os.read(sys.stdin.fileno(), 64).decode(errors="ignore").lower()
            if not typed:
                self._ended = True  # the terminal is gone
                break
            for key in typed:
                self._ended |= key == "x"
                if key == " ":
                    self._command, self._clipped = np.zeros(3), False
                elif key in KEYS:
                    axis, sign = KEYS[key]
                    command = self._command.copy()
                    # rounded: steps back to standing end at 0
                    command[axis] = np.round(command[axis] + sign * STEP[axis], 6)
                    self._command = self._trained.clip(command)
                    self._clipped = bool((self._command != command).any())
        return None if self._ended else self._command.copy()

    def watching(self, joints: Sequence[str]) -> Callable[[Tick], None]:
        """Watcher of a walk of these joints, for the table."""
        self._joints, self._age = joints, np.zeros(len(joints))
        return self.watch

    def watch(self, tick: Tick) -> None:
        """Show a tick, a few times a second."""
        if self._seen is not None:
            changed = tick.reading.position_rad != self._seen.position_rad
            self._age = np.where(changed, 0.0, self._age + tick.elapsed_s - self._seen_s)
        self._seen, self._seen_s = tick.reading, tick.elapsed_s
        if tick.elapsed_s - self._shown_s < _SHOWN_EVERY_S:
            return
        self._shown_s = tick.elapsed_s
        notice = CLIPPED if self._clipped else ""
        self._live.update(_table(tick, self._joints, self._age, notice), refresh=True)

    @contextmanager
    def driving(self) -> Iterator[Driver]:
        """Read keys one by one, without echo, during the block."""
        if not sys.stdin.isatty():
            raise InputError("--keyboard needs a terminal to type in; use --command or --script.")
        with terminal_without(termios.ICANON | termios.ECHO, sys.stdin.fileno()), self._live:
            yield self


def _table(tick: Tick, joints: Sequence[str], age_s: np.ndarray, notice: str) -> Table:
    forward, left, turn = tick.senses.command
    table = terminal.table(
        f"{tick.elapsed_s:6.1f} s   {forward:+.2f} m/s forward  {left:+.2f} left  "
        f"{turn:+.2f} rad/s{notice}\n{_HELP}",
        "joint", "sent rad", "read rad", "unchanged ms", "load N·m", "margin rad",
    )  # fmt: skip
    for i, joint in enumerate(joints):
        room = tick.decision.margin[i]
        table.add_row(
            joint, terminal.number(tick.sent[i], 3),
            terminal.number(float(tick.reading.position_rad[i]), 3), terminal.ms(age_s[i], 0),
            terminal.number(tick.senses.load[i], 2),
            Text(f"{room:.2f}", "red") if room < 0.02 else terminal.number(room, 2),
        )  # fmt: skip
    return table
