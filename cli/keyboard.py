"""Questions to a person, asked so that the servos can be read while nobody has answered yet."""

from __future__ import annotations

import os
import select
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager

from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError


class Keyboard:
    """Lines that a person types; waiting for one does not keep the servos from being read."""

    def __init__(self) -> None:
        try:
            self._input = sys.stdin.fileno()
        except (OSError, ValueError, AttributeError):
            raise _ended() from None
        self._typed = b""

    def ask(self, question: str) -> str:
        """What a person answers to a question, in small letters."""
        terminal.err.print(Text(question, "bold"))
        self.forget()
        while (line := self.line()) is None:
            select.select([self._input], [], [])
        return line

    def forget(self) -> None:
        """An Enter that was pressed too early answers no question that was not yet asked."""
        if os.isatty(self._input):
            termios.tcflush(self._input, termios.TCIFLUSH)
            self._typed = b""

    @contextmanager
    def unseen(self) -> Iterator[None]:
        """An Enter that is echoed would push a live table down by a line."""
        if not os.isatty(self._input):
            yield
            return
        self.forget()
        before = termios.tcgetattr(self._input)
        quiet = [*before[:3], before[3] & ~termios.ECHO, *before[4:]]
        termios.tcsetattr(self._input, termios.TCSANOW, quiet)
        try:
            yield
        finally:
            termios.tcsetattr(self._input, termios.TCSANOW, before)

    def line(self) -> str | None:
        """A line if there is one by now.

        Raises
        ------
        InputError
            If the input has ended.
        """
        if b"\n" not in self._typed and select.select([self._input], [], [], 0)[0]:
            typed = os.read(self._input, 1024)
            if not typed:
                raise _ended()
            self._typed += typed
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        return line.decode(errors="replace").strip().lower()


def _ended() -> InputError:
    return InputError(
        "the input ended before the calibration did, so nothing was written. Run it in a terminal, "
        "where questions can be answered; servos that went limp stay so."
    )
