"""Questions at the terminal; the servos can be read while an answer is awaited."""

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


@contextmanager
def terminal_without(flags: int, fd: int) -> Iterator[None]:
    """Local flags of a terminal, such as `termios.ECHO`, off during the block."""
    before = termios.tcgetattr(fd)
    changed = [*before[:3], before[3] & ~flags, *before[4:]]
    termios.tcsetattr(fd, termios.TCSANOW, changed)
    try:
        yield
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)


class Keyboard:
    """Lines typed at the terminal, read without blocking."""

    def __init__(self) -> None:
        try:
            self._fd = sys.stdin.fileno()
        except (OSError, ValueError, AttributeError):
            raise _ended() from None
        self._typed = b""

    def ask(self, question: str) -> str:
        """Answer to a question, in lower case; waits for it."""
        terminal.err.print(Text(question, "bold"))
        self.forget()
        while (line := self.line()) is None:
            select.select([self._fd], [], [])
        return line

    def forget(self) -> None:
        """Discard what was typed before the question."""
        if os.isatty(self._fd):
            termios.tcflush(self._fd, termios.TCIFLUSH)
            self._typed = b""

    @contextmanager
    def unseen(self) -> Iterator[None]:
        """Without echo during the block: Enter would push a live table down by a line."""
        if not os.isatty(self._fd):
            yield
            return
        self.forget()
        with terminal_without(termios.ECHO, self._fd):
            yield

    def line(self) -> str | None:
        """A line if one has been typed."""
        if b"\n" not in self._typed and select.select([self._fd], [], [], 0)[0]:
            typed = os.read(self._fd, 1024)
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
