"""Processes for work that takes seconds: joints, stages of a calibration, robots of a fleet.

    with Workers(2, __name__) as workers:
        for joint, trials in every.items():
            workers.submit(joint, fit_joint, joint, trials)
        for joint, fit in workers.results():
            ...

Workers are forked by a server: a fresh process with one thread, which imports the modules of the
work once. Forking the program itself would copy locks that another of its threads may hold. The
server is kept for the next pool.

Each worker has a socket to this process and nothing else in common with it: no semaphore, no
shared memory, no thread here. When the socket closes, because the block of its pool has
ended or this process has died, the worker ends at once. Workers and server ignore the signals of a
terminal, which only this process handles.
"""

from __future__ import annotations

import atexit
import ctypes
import json
import os
import pickle
import select
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from pupper_sysid.common.errors import PupperError
from pupper_sysid.common.processes.stop import SIGNALS

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # parameters of mallopt(3)
_NEVER = 2**31 - 1


def keep_freed_memory() -> None:
    """Let this process keep what it frees, for its next request; does nothing without glibc."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            mallopt = ctypes.CDLL("libc.so.6").mallopt
            mallopt(_MMAP_MAX, 0)
            mallopt(_TRIM_THRESHOLD, _NEVER)


_START = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from pupper_sysid.common.processes.workers import serve
serve(int(sys.argv[2]), int(sys.argv[3]))
"""
_ONE_THREAD = {
    "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",  # of pyarrow, which pandas imports
}  # fmt: skip
"""Environment of the server: only a process of one thread can be forked safely, and each worker is
for one core."""
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_DEATH_S = 1.0  # for the server to say how a worker ended
_STOP_S = 0.05  # for the signal that ended it, sent to a group of processes, to reach this one


class Workers:
    """Processes that do what is submitted; leaving the context ends them.

    With a `count` of one, or where processes cannot be forked, the work is done in this one.
    `modules` are imported once, in the server; those of what is submitted first are as well.
    `option` is the caller's argument that set `count`, for messages.
    """

    def __init__(self, count: int, *modules: str, option: str = "workers"):
        self._count = count if hasattr(os, "fork") else 1
        self._modules, self._option = set(modules), option
        self._tasks: deque[tuple[Any, Callable[..., Any], tuple[Any, ...]]] = deque()
        self._streams: list[Connection] = []
        self._server: _Server | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *raised: object) -> None:
        for stream in self._streams:
            stream.close()

    def submit(self, key: Any, work: Callable[..., Any], *arguments: Any) -> None:
        """Have `work(*arguments)` done. All must be picklable if there are several processes."""
        self._tasks.append((key, work, arguments))

    def results(self) -> Iterator[tuple[Any, Any]]:
        """Yield key and result of all that was submitted, in the order in which they are done.

        More can be submitted meanwhile. What `work` raises is raised here, and the rest is left.
        """
        if min(self._count, len(self._tasks)) <= 1 and not self._streams:
            while self._tasks:
                key, work, arguments = self._tasks.popleft()
                yield key, work(*arguments)
            return
        busy: dict[Connection, Any] = {}
        with selectors.DefaultSelector() as answers:
            while self._tasks or busy:
                while self._tasks and (stream := self._idle(busy)):
                    key, *task = self._tasks.popleft()
                    answers.register(stream, selectors.EVENT_READ)
                    busy[stream] = key
                    self._send(stream, task)
                for ready, _ in answers.select():
                    stream: Any = ready.fileobj
                    answers.unregister(stream)
                    key, (result, error) = busy.pop(stream), self._answer(stream)
                    if error is not None:
                        raise error
                    yield key, result

    def _idle(self, busy: dict[Connection, Any]) -> Connection | None:
        """A worker without work, perhaps a new one."""
        for stream in self._streams:
            if stream not in busy:
                return stream
        if len(self._streams) == self._count:
            return None
        if self._server is None:
            works = [work for _, work, _ in self._tasks]
            self._modules |= {getattr(work, "func", work).__module__ for work in works}
            self._server = _server()
        self._streams.append(self._server.fork(self._modules))
        return self._streams[-1]

    def _send(self, stream: Connection, task: list[Any]) -> None:
        data = pickle.dumps(task)  # first, so that the caller gets its errors
        try:
            stream.send_bytes(data)
        except OSError:
            raise self._death() from None

    def _answer(self, stream: Connection) -> tuple[Any, BaseException | None]:
        try:
            return pickle.loads(stream.recv_bytes())
        except (EOFError, OSError):
            raise self._death() from None

    def _death(self) -> PupperError:
        """Why a worker has ended by itself."""
        time.sleep(_STOP_S)
        ended = self._server.death() if self._server else ""
        what = f"A process that computed was ended by {ended}."
        if ended.startswith("cannot"):
            what = f"Another process {ended}."
        elif "SIGKILL" in ended:
            what += " Most likely the memory ran out."
        return PupperError(
            f"{what} Use fewer processes (`{self._option}`), or end other programs, then run it "
            "again."
        )


def prepare(*modules: str) -> None:
    """Begin to import modules in the server, while this process does something else."""
    if hasattr(os, "fork"):
        with suppress(PupperError):
            _server().order(modules)


class _Server:
    """This process's end of the server."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._socket, server_end = socket.socketpair()
        paths = json.dumps([path for path in sys.path if isinstance(path, str)])
        # the kernel would end the server with the thread that started it
        in_main = threading.current_thread() is threading.main_thread()
        parent = str(os.getpid() if in_main else 0)
        with server_end, _blocked_signals():
            try:
                self._process = subprocess.Popen(
                    # -P: no file of the user's folder is imported before `sys.path` is set
                    [sys.executable, "-P", "-c", _START, paths, str(server_end.fileno()), parent],
                    pass_fds=[server_end.fileno()], stdin=subprocess.DEVNULL,
                    env=os.environ | _ONE_THREAD,
                )  # fmt: skip
            except OSError as error:
                raise PupperError(f"No process could be started: {error.strerror}.") from error

    @property
    def usable(self) -> bool:
        """Whether it runs and was started by this process (which may be a fork of the owner)."""
        return self.owner == os.getpid() and self._process.poll() is None

    def close(self) -> None:
        """Have the server end, and wait for it, so that its processor time counts as this one's."""
        if self.owner == os.getpid():
            self._socket.close()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_DEATH_S)

    def order(self, modules: Any, *descriptors: int) -> None:
        """Have modules imported, and a worker forked if there is a descriptor of its socket."""
        text = json.dumps(
            {"modules": sorted(modules), "folder": _folder(), "fork": len(descriptors)}
        )
        try:
            socket.send_fds(self._socket, [f"{text}\n".encode()], list(descriptors))
        except OSError:
            raise PupperError("The process that starts workers has ended. Run it again.") from None

    def fork(self, modules: Any) -> Connection:
        """A new worker, to which a task can be written."""
        parent_end, worker_end = Pipe()
        with worker_end:
            self.order(modules, worker_end.fileno())
        return parent_end

    def death(self) -> str:
        """How the last worker ended, as the server reports it."""
        if select.select([self._socket], [], [], _DEATH_S)[0] and (
            lines := self._socket.recv(65536).decode().splitlines()
        ):
            return lines[-1]
        code = self._process.poll()
        return _ending(-code) if code is not None and code < 0 else "an unknown cause"


_kept: _Server | None = None
"""Importing the modules takes a second, so the server stays for the next pool."""
_keeping = threading.Lock()


def _server() -> _Server:
    global _kept
    with _keeping:
        if _kept is None or not _kept.usable:
            _kept = _Server()
            atexit.register(_kept.close)
        return _kept


@contextmanager
def _blocked_signals() -> Iterator[None]:
    """Start a process that takes no signal before it can ignore them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _folder() -> str:
    with suppress(FileNotFoundError):  # it was removed
        return os.getcwd()
    return "/"


def _ending(number: int) -> str:
    with suppress(ValueError):
        return signal.Signals(number).name
    return f"signal {number}"


# ---------------------------------------------------------------------- in the other processes


def serve(descriptor: int, parent: int) -> None:
    """Import modules and fork workers, as ordered through a socket, until it closes.

    This process ends with its parent, at once where the kernel does it, if there is one (not 0).
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    orders = socket.socket(fileno=descriptor)
    if parent:
        _end_with(parent)

    def report(*_: object) -> None:
        """Report how workers ended, unless their end was requested."""
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                if os.WIFSIGNALED(ended[1]):
                    orders.send(f"{_ending(os.WTERMSIG(ended[1]))}\n".encode())

    signal.signal(signal.SIGCHLD, report)
    text, descriptors = b"", deque[int]()
    while True:
        data, more, *_ = socket.recv_fds(orders, 65536, 64)
        if not data:
            os._exit(0)
        descriptors.extend(more)
        *lines, text = (text + data).split(b"\n")
        for line in lines:
            order = json.loads(line)
            for module in order["modules"]:
                with suppress(Exception):  # a missing module is reported by the work that needs it
                    import_module(module)
            for _ in range(order["fork"]):
                _fork(orders, descriptors.popleft(), order["folder"])


def _fork(orders: socket.socket, descriptor: int, folder: str) -> None:
    """Fork a worker that has `descriptor`."""
    server = os.getpid()
    try:
        process = os.fork()
    except OSError as error:
        orders.send(f"cannot be started: {error.strerror}\n".encode())
        os.close(descriptor)
        return
    if process:
        os.close(descriptor)
        return
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        orders.close()
        _end_with(server)
        with suppress(OSError):
            os.chdir(folder)
        _work(Connection(descriptor))
    finally:
        os._exit(1)


def _end_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends; only Linux can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the call to the kernel
        os._exit(1)


def _work(tasks: Connection) -> None:
    """Do what comes through a socket, until it closes."""
    threading.Thread(target=_end_when_closed, args=(tasks,), daemon=True).start()
    while True:
        try:
            work, arguments = pickle.loads(tasks.recv_bytes())
            answer = pickle.dumps((work(*arguments), None))
        except EOFError:
            os._exit(0)
        except BaseException as error:
            answer = _pickled(error)
        sys.stdout.flush()
        tasks.send_bytes(answer)


def _end_when_closed(tasks: Connection) -> None:
    """End this process when the other end of its socket is closed, whatever it is doing."""
    closed = select.poll()
    closed.register(tasks, 0)  # no event but the end, which is always reported
    closed.poll()
    os._exit(0)


def _pickled(error: BaseException) -> bytes:
    """An answer that raises `error`, or its text where it cannot be sent."""
    error.add_note(f"In a process that computed:\n{''.join(traceback.format_exception(error))}")
    try:
        data = pickle.dumps((None, error))
        pickle.loads(data)
        return data
    except Exception:
        return pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}")))
