"""How a program answers Ctrl-C, SIGTERM and SIGHUP: one line, an exit code, nothing left behind.

A program has one `Stop`, which `stop_process` installs in its first lines. What a signal does
depends on the program's phase::

    start    the libraries are being imported, or the program ends: nothing has to be undone, so the
             process ends at once
    work     KeyboardInterrupt, so that files and processes are cleaned up on the way out. If that
             takes longer than `_UNWIND_S` (an interrupt was swallowed, compiled code does not
             return), a thread ends the process; a second signal does so at once
    robot    KeyboardInterrupt, and as much time as parking the joints takes
    finish   the first Ctrl-C is only noted (`finishing`), the second one ends the work

Exit codes are 128 and the signal's number: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.
Within a library call, without a program, Ctrl-C is Python's own KeyboardInterrupt.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any, Literal, NoReturn

Phase = Literal["start", "work", "robot", "finish"]

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
STOPPED = "Stopped."
FINISHING = "finishing this iteration; again ends at once"
_UNWIND_S = 0.5
"""Longest time from a signal to the end of a process that holds no robot [s], of the second that a
user waits at most."""
_FINISH_S = 0.7  # longest time that an iteration may take after SIGTERM or SIGHUP [s]
_REPEAT_S = 0.3
"""Signals that follow each other faster [s] are one: `torchrun`, `make` and others pass on to a
process what the terminal has sent it already."""
_SWALLOWED_S = 0.01  # time for a callback that swallowed a KeyboardInterrupt to return [s]


class Stop:
    """Handlers of the three signals, and what the first of them was.

    `ends_process` says whether this process is a whole program, which may be ended; else only
    KeyboardInterrupt is raised.
    """

    def __init__(self, ends_process: bool):
        self.number = 0
        self.ends_process = ends_process
        self.removals: set[Callable[[], object]] = set()
        """What removes temporary and lock files if the process is ended."""
        self._phase: Phase = "start" if ends_process else "work"
        self._begun_s = self._first_s = 0.0  # of the phase, of the first signal
        self._before: dict[int, Any] = {}
        self._line = threading.Lock()  # acquired by the thread that writes the last line
        self._held, self._pending, self._swallowed = 0, False, False
        self._say: Callable[[str], None] = _write_line
        self._wake, self._seen = -1, 0
        self._timer: threading.Timer | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of a program that was stopped; 0 if none was."""
        return 128 + self.number if self.number else 0

    @property
    def phase(self) -> Phase:
        """What the program does; see the module."""
        return self._phase

    @phase.setter
    def phase(self, phase: Phase) -> None:
        self._begun_s, self._phase = time.monotonic(), phase
        if self.number and self._wake >= 0:
            self._write_byte(1)  # the watching thread's deadline has changed

    def install(self) -> None:
        """Take over the signals that are not ignored; `nohup` and a script's `&` ignore some."""
        for number in SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:
                self._take(number)
        if self.ends_process:
            wake_end, self._wake = os.pipe()
            os.set_blocking(self._wake, False)
            signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
            sys.unraisablehook = self._unraisable
            threading.Thread(target=self._watch, args=(wake_end,), daemon=True, name="stop").start()

    def hold_robot(self) -> None:
        """Park the joints first, from now on, also where a script's `&` has Ctrl-C ignored."""
        if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
            self._take(signal.SIGINT)
        self.phase = "robot"

    def uninstall(self) -> None:
        """Put back the handlers that were there before."""
        if self._timer:
            self._timer.cancel()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def end(self) -> NoReturn:
        """End this process now, with the line if it was not written yet."""
        if self._line.acquire(blocking=False):
            _write_line(STOPPED)
        for remove in tuple(self.removals):
            with suppress(OSError):
                remove()
        os._exit(self.exit_code)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Raise KeyboardInterrupt after the block, not in it; `end` is not held up."""
        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread is interrupted
            return
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1
        if self._pending and not self._held:
            self._pending = False
            raise KeyboardInterrupt

    @contextmanager
    def finishing(self, say: Callable[[str], None]) -> Iterator[None]:
        """The phase `finish` during a block; `say` is called with `FINISHING`."""
        before, self._say = self.phase, say
        self.phase = "finish"
        try:
            yield
        finally:
            self.phase = before
            if self._timer:
                self._timer.cancel()

    # --------------------------------------------------------------------- what a signal does

    def _take(self, number: int) -> None:
        self._before[number] = signal.signal(number, self._received)

    def _received(self, number: int, frame: object) -> None:
        """Handler, in the main thread."""
        now, again = time.monotonic(), False
        if not self.number:
            self.number, self._first_s = number, now
        elif self._swallowed:
            self._swallowed = False
        elif now - self._first_s < _REPEAT_S and self._phase != "robot":
            return
        else:
            again = True
        if self._phase == "finish" and not again:
            self._note(number)
            return
        if self.ends_process and (
            self._phase == "start" or (again and self._phase in ("work", "finish"))
        ):
            self._end_at_once()
        if self._held:
            self._pending = True
            return
        raise KeyboardInterrupt

    def _end_at_once(self) -> NoReturn:
        """End in the phase `start`, or after a second signal: the line is not what was noted."""
        if self._phase == "finish":
            with suppress(RuntimeError):
                self._line.release()
        self.end()

    def _note(self, number: int) -> None:
        """The first signal of the phase `finish`."""
        if number == signal.SIGINT:
            self._line.acquire(blocking=False)  # `STOPPED` is for the second one
            self._say(FINISHING)
        elif not self.ends_process:
            signal.signal(number, signal.SIG_DFL)
            self._timer = threading.Timer(_FINISH_S, signal.raise_signal, (number,))
            self._timer.daemon = True
            self._timer.start()

    def _unraisable(self, unraisable: Any) -> None:
        """Raise a KeyboardInterrupt again that Python swallows, as in a weak reference's callback.

        What else fails on the way out of a program that was stopped is not worth a traceback.
        """
        if self.number and issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._write_byte(0)
        elif not self.number or self._phase == "robot":
            sys.__unraisablehook__(unraisable)

    # --------------------------------------------------------------------- the watching thread

    def _write_byte(self, value: int) -> None:
        with suppress(OSError):  # full: it is awake
            os.write(self._wake, bytes([value]))

    def _watch(self, descriptor: int) -> None:
        """End the process if the main thread does not; Python writes each signal's number here."""
        pressed_s: list[float] = []
        while True:
            left_s = self._deadline_s(pressed_s) - time.monotonic()
            if left_s <= 0:
                self.number = self.number or self._seen
                if len(pressed_s) > 1:
                    self._end_at_once()
                self.end()
            ready = select.select([descriptor], [], [], None if left_s == float("inf") else left_s)
            for number in os.read(descriptor, 64) if ready[0] else b"":
                now = time.monotonic()
                if number == 0:
                    time.sleep(_SWALLOWED_S)
                    self._swallowed = True
                    signal.pthread_kill(threading.main_thread().ident or 0, self.number)
                elif number in SIGNALS and (not pressed_s or now - pressed_s[-1] >= _REPEAT_S):
                    if not pressed_s:
                        self._seen = number  # the handler may not have run yet
                    pressed_s.append(now)

    def _deadline_s(self, pressed_s: list[float]) -> float:
        """When the process is ended [s], on the monotonic clock."""
        if not pressed_s or self._phase == "robot":
            return float("inf")
        if self._phase == "finish":
            if self._seen == signal.SIGINT:
                return pressed_s[1] + _UNWIND_S if len(pressed_s) > 1 else float("inf")
            return pressed_s[0] + _FINISH_S
        return max(pressed_s[0], self._begun_s) + _UNWIND_S


_current: Stop | None = None  # the Stop in force. Signals are a process's, so this is, too


def stop_process() -> None:
    """Have signals stop this process, which is a whole program; the first thing that it does."""
    global _current
    if _current is None:
        _current = Stop(ends_process=True)
        _current.install()


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Yield the program's Stop; outside of a program (in a test) one for the block."""
    global _current
    if _current is not None or threading.current_thread() is not threading.main_thread():
        yield _current or Stop(ends_process=False)
        return
    _current = stop = Stop(ends_process=False)
    stop.install()
    try:
        yield stop
    finally:
        stop.uninstall()
        _current = None


def end_politely() -> None:
    """Treat SIGTERM and a closed terminal as Ctrl-C, and give parking the time that it takes."""
    global _current
    if threading.current_thread() is threading.main_thread():
        if _current is None:
            _current = Stop(ends_process=False)
            _current.install()
        _current.hold_robot()


def held() -> AbstractContextManager[None]:
    """Have a stop wait for the block, at most `_UNWIND_S`: for files that belong together."""
    return _current.held() if _current else nullcontext()


@contextmanager
def removed_at_stop(remove: Callable[[], object]) -> Iterator[None]:
    """Call `remove` if the process is ended within the block, past every `finally`."""
    removals = _current.removals if _current else set[Callable[[], object]]()
    removals.add(remove)
    try:
        yield
    finally:
        removals.discard(remove)


@contextmanager
def finishing(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Note the first stop, for work that is saved between iterations.

    Yields whether it was requested. `say` is called with `FINISHING` after Ctrl-C; a second one
    raises KeyboardInterrupt, and ends a program. SIGTERM and SIGHUP leave `_FINISH_S` for the
    iteration.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    with stoppable() as stop, stop.finishing(say):
        yield lambda: bool(stop.number)


def _write_line(line: str) -> None:
    """Write a line to stderr past Python's streams, whose locks another thread may hold."""
    with suppress(OSError, ValueError):
        # over a progress bar, with the cursor that it has hidden
        start = "\r\x1b[2K\x1b[?25h" if os.isatty(2) else ""
        if select.select([], [2], [], 0.1)[1]:  # a full pipe must not delay the end
            os.write(2, f"{start}{line}\n".encode())
