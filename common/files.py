"""How this project writes files: never over something else, never half, always with provenance.

A program holds each of its outputs from the check before the work (`refuse_overwrite`) until it
ends (`holding_outputs`); another program that would write the same one is refused, `force` or not.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.processes.stop import held, removed_at_stop
from pupper_sysid.common.reading.content import open_regular

PACKAGE = "pupper-sysid"

_LONGEST_NAME = 100  # bytes; file systems take 255, and endings are added
_SYNC_S = 1.0  # at most this much is lost in a power failure


def resolved(path: Path) -> Path:
    """`path` as an absolute one without links.

    A link to itself stays one (`Path.resolve` raises for it): it is refused where it is opened.
    """
    return Path(os.path.realpath(path))


def refuse_overwrite(path: Path, force: bool = False) -> None:
    """Raise unless `path` is free, or a file and `force` was given; then hold it (`hold_output`).

    Devices, pipes and sockets are never replaced.
    """
    _refuse_existing(path, force)
    hold_output(path)


def _refuse_existing(path: Path, force: bool) -> None:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be written: {getattr(error, 'strerror', None) or error}."
        ) from error
    if not stat.S_ISREG(mode):
        raise InputError(f"{path} is there and is not a file. Choose another name.")
    if not force:
        raise FileExistsRefusal(
            f"{path} exists already. Choose another name, or replace it with `force=True`."
        )


def as_path(value: object, what: str) -> Path:
    """`value` as a path; `what` says for the message what it leads to."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{what} is named by a path or a str, not by a {type(value).__name__}.")
    return Path(os.fspath(value))


def refuse_path(name: str, option: str) -> None:
    """Refuse a name of a run or walk that would not be one folder: a path, or an odd name."""
    if not name.strip() or name[0] == "." or set(name) & set("/\\") or not name.isprintable():
        raise InputError(
            f"{option} {name!r} is not the name of one folder. Use letters, digits, '-' and '_'."
        )
    if len(name.encode()) > _LONGEST_NAME:
        raise InputError(
            f"{option} has {len(name)} characters; use at most {_LONGEST_NAME}, in ASCII."
        )


def write_text(path: Path, text: str, force: bool = False) -> None:
    """Write `text` to `path` in one atomic step, so that no reader ever sees half of it."""
    write_bytes(path, text.encode(), force)


def write_bytes(path: Path, data: bytes, force: bool = False) -> None:
    """Write `data` to `path` in one atomic step, so that no reader ever sees half of it."""
    with replacing(path, force) as temporary:
        temporary.write_bytes(data)


@contextmanager
def replacing(path: Path, force: bool = False, hold: bool = True) -> Iterator[Path]:
    """Yield the name of a temporary file that takes the place of `path` after the block.

    It is beside `path`, has the same ending, and is removed after an error or a stop. With `hold` a
    stop waits for the block; not for one that takes long.
    """
    _refuse_existing(path, force)
    _refuse_held(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with held() if hold else nullcontext():
            handle, name = tempfile.mkstemp(path.suffix, f".{path.stem}.", path.parent)
            with removed_at_stop(partial(os.unlink, name)):
                try:
                    os.close(handle)
                    yield Path(name)
                    os.chmod(name, 0o644)  # mkstemp makes it private; results are to be shared
                    os.replace(name, path)
                except BaseException:
                    with suppress(FileNotFoundError):
                        os.unlink(name)
                    raise
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


class SyncedText:
    """A text file that grows line by line; what was written is on the disk within a second.

    Syncing is done in a thread, because a memory card can take seconds. With `append_at` an
    existing file is written on from this byte; what follows it is cut off. `advice` is what to do
    when it can no longer be written, for the error's sentence.
    """

    def __init__(
        self, path: Path, force: bool = False, append_at: int | None = None, advice: str = ""
    ):
        self.path, self._advice = path, advice
        if append_at is None:
            refuse_overwrite(path, force)
        else:
            hold_output(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            mode = "w" if append_at is None else "r+"
            self._file = path.open(mode, encoding="utf-8", newline="\n")
            if append_at is not None:
                self._file.seek(append_at)
                self._file.truncate()
        except OSError as error:
            raise InputError(f"{path} cannot be written: {error.strerror}.") from error
        self._closing = threading.Event()
        self._syncer = threading.Thread(target=self._sync, daemon=True)
        self._syncer.start()

    @property
    def closed(self) -> bool:
        """Whether it has been closed."""
        return self._file.closed

    def write(self, lines: Sequence[str]) -> None:
        """Write whole lines."""
        try:
            self._file.writelines(f"{line}\n" for line in lines)
            self._file.flush()
        except OSError as error:
            self._end()
            raise InputError(
                f"{self.path} cannot be written: {error.strerror}. Make room{self._advice}."
            ) from error

    def close(self, lines: Sequence[str] = ()) -> None:
        """Write the last lines and close. May be called twice."""
        if self.closed:
            return
        try:
            self.write(lines)
        finally:
            self._end()

    def _end(self) -> None:
        self._closing.set()
        self._syncer.join()
        with suppress(OSError):
            os.fsync(self._file.fileno())
        with suppress(OSError):
            self._file.close()

    def _sync(self) -> None:
        while not self._closing.wait(_SYNC_S):
            with suppress(OSError):  # the next write raises the error
                os.fsync(self._file.fileno())


_held: ContextVar[dict[Path, _Lock] | None] = ContextVar("held_outputs", default=None)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # of a file system without them


@contextmanager
def holding_outputs() -> Iterator[None]:
    """Within the block, hold the outputs that `refuse_overwrite` and `hold_output` name.

    A lock file beside each output, `.NAME.lock`, holds the process id. It is locked (flock) for as
    long as the process lives, and removed at the end of the block. One that a killed process has
    left behind is not locked, and does not count.
    """
    if _held.get() is not None:  # an inner program's holder serves both
        yield
        return
    locks: dict[Path, _Lock] = {}
    before = _held.set(locks)
    if hasattr(os, "register_at_fork"):
        # else a worker that outlives this process would keep its locks
        os.register_at_fork(after_in_child=lambda: [lock.forget() for lock in locks.values()])
    with removed_at_stop(lambda: [lock.remove() for lock in tuple(locks.values())]):
        try:
            yield
        finally:
            with held():
                _held.reset(before)
                for lock in locks.values():
                    lock.remove()
                    lock.forget()
                locks.clear()


def hold_output(path: Path) -> None:
    """Hold a file or folder against other programs; does nothing outside `holding_outputs`."""
    locks, output = _held.get(), resolved(path)
    if locks is None:
        _refuse_held(path)
    elif output not in locks:
        with held():  # an interrupt between locking and noting would leave the lock
            locks[output] = _Lock(path, output)


def _refuse_held(path: Path) -> None:
    """Refuse a path that another process holds."""
    output = resolved(path)
    if output in (_held.get() or {}):
        return
    try:
        descriptor = os.open(_lock_file(output), os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except (OSError, ValueError):  # there is none
        return
    try:
        _lock_or_refuse(descriptor, path)
    finally:
        os.close(descriptor)


def _lock_file(output: Path) -> Path:
    return output.with_name(f".{output.name}.lock")


def _lock_or_refuse(descriptor: int, path: Path) -> None:
    """Lock an open lock file without waiting, unless this process holds it already."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip()
        # this process holds it: another thread does not see `_held`
        if error.errno in _NO_LOCKS or holder == str(os.getpid()):
            return
        raise InputError(
            f"{path} is being written by another process{f' ({holder})' if holder else ''}. Wait "
            "until it has ended, or choose another name."
        ) from None


class _Lock:
    """Lock of one output of this process."""

    def __init__(self, path: Path, output: Path):
        self._file = _lock_file(output)
        self._descriptor: int | None = None
        self._created: list[Path] = []
        try:
            while self._descriptor is None:
                self._descriptor = self._open(path)
        except (OSError, ValueError) as error:
            self._remove_folders()
            if not output.is_dir():  # a folder can be written where its neighbours cannot
                raise InputError(
                    f"{path} cannot be written: {getattr(error, 'strerror', None) or error}."
                ) from error
        except InputError:
            self._remove_folders()
            raise

    def _open(self, path: Path) -> int | None:
        """Descriptor of the locked file; None if its last holder has just removed it."""
        folder = self._file.parent
        missing = [p for p in (folder, *folder.parents) if not p.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        self._created = missing or self._created
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            descriptor = os.open(self._file, flags, 0o666)
        except FileNotFoundError:
            if folder.is_dir():
                raise
            return None  # the last holder has removed its empty folders
        try:
            _lock_or_refuse(descriptor, path)
            if not os.path.exists(self._file) or not os.path.samestat(
                os.fstat(descriptor), os.stat(self._file)
            ):
                os.close(descriptor)
                return None
            with suppress(OSError):  # so that another user's is no obstacle once it is left behind
                os.fchmod(descriptor, 0o666)
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    def remove(self) -> None:
        """Remove the lock file, and the folders made for it that are still empty."""
        if self._descriptor is not None:
            with suppress(OSError):
                os.unlink(self._file)
            self._remove_folders()

    def forget(self) -> None:
        """Close the lock file and leave it, as in a child process: its parent holds it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _remove_folders(self) -> None:
        with suppress(OSError):  # not empty: the output is there
            for folder in self._created:
                folder.rmdir()


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of the file at `path`."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions(*more: str) -> dict[str, str]:
    """Versions of this project and of the libraries that shape its numbers, `more` included."""
    return {name: _version(name) for name in (PACKAGE, "numpy", "scipy", "mujoco", *more)}


@cache
def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
