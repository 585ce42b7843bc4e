"""A hand for emulated servos: keys at the emulator's terminal move joints while they are limp."""

from __future__ import annotations

import os
import sys
import termios
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress

from pupper_sysid.cli import terminal
from pupper_sysid.cli.keyboard import terminal_without
from pupper_sysid.sim.emulator.bench import ServoBench

HELP = (
    "Keys move limp joints, in this window: a and d by 0.05 rad, A and D by 0.4 rad, 0 back to "
    "where they went limp; n chooses the next joint (all at first)."
)
_STEPS_RAD = {"a": -0.05, "d": 0.05, "A": -0.4, "D": 0.4}


class Hand:
    """Moves all joints, or one.

    Parameters
    ----------
    bench : ServoBench
    """

    def __init__(self, bench: ServoBench):
        self._bench = bench
        self._names: Sequence[str] = bench.robot.joint_names
        self._chosen: int | None = None

    def press(self, key: str) -> str:
        """What to say of a key; empty if it has no meaning."""
        if key == "n":
            following = 0 if self._chosen is None else self._chosen + 1
            self._chosen = following if following < len(self._names) else None
            return f"{self._what}: chosen"
        if key not in _STEPS_RAD and key != "0":
            return ""
        indices = range(len(self._names)) if self._chosen is None else (self._chosen,)
        limp = [i for i in indices if not self._bench.is_on(i)]
        for i in limp:
            self._bench.move_by_hand(i, _STEPS_RAD.get(key))
        if not limp:
            return f"{self._what}: holds its position; only a limp joint moves by hand"
        return f"{self._what}: {self._bench.hand_rad[limp[0]]:+.2f} rad"

    @property
    def _what(self) -> str:
        return "all joints" if self._chosen is None else self._names[self._chosen]


@contextmanager
def keys_move(bench: ServoBench) -> Iterator[None]:
    """Keys of the standard input move limp joints of `bench` during the block."""
    hand, fd = Hand(bench), sys.stdin.fileno()

    def listen() -> None:
        with suppress(OSError):  # the terminal is gone
            while typed := os.read(fd, 64):
                for key in typed.decode(errors="ignore"):
                    if said := hand.press(key):
                        terminal.err.print(said)

    raw = terminal_without(termios.ICANON | termios.ECHO, fd) if os.isatty(fd) else nullcontext()
    with raw:
        terminal.out.print(HELP, soft_wrap=True)
        threading.Thread(target=listen, daemon=True).start()
        yield
