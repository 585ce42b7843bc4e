"""One program at a time: a lock per robot in a folder that only the user can write to.

The folder is `$XDG_RUNTIME_DIR/pupper-sysid`, else `/tmp/pupper-sysid-<user id>`; only its
user may write there, and files in it are opened without following links and without waiting. A lock
is held by each process that has its file open, also by a child that inherited it; actions that must
not wait, such as switching the torque off, therefore take no lock.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pupper_sysid.common.errors import BusError
from pupper_sysid.common.files import resolved

LOG = "watchdog.log"
"""File of this folder in which the watchdog says what it could not do."""


def runtime_folder() -> Path:
    """The folder, made if missing."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = Path(f"/tmp/pupper-sysid-{os.getuid()}")
    if runtime and Path(runtime).is_absolute() and Path(runtime).is_dir():
        folder = Path(runtime) / "pupper-sysid"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise BusError(f"{folder} cannot be made: {error.strerror}. Make it yourself.") from error
    private = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    if not private or stat.S_IMODE(status.st_mode) & 0o022:
        raise BusError(
            f"{folder} is not a folder that only you can write to, so what it says of robots in "
            "use cannot be trusted. Remove it."
        )
    return folder


def open_here(name: str, flags: int) -> int:
    """Descriptor of a regular file in the folder, made if missing."""
    path = runtime_folder() / name
    safe = os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags | safe, 0o600)
    except OSError as error:
        raise BusError(f"{path} cannot be opened: {error.strerror}. Remove it.") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise BusError(f"{path} is not a regular file. Remove it.")
    return descriptor


def lock_name(robot: Path) -> str:
    """Name of the lock's file of a robot at this path, whatever link leads to it."""
    return hashlib.sha256(os.fsencode(resolved(robot))).hexdigest()[:16] + ".lock"


def acquire(robot: Path) -> int:
    """Descriptor of the lock of a robot at this path, locked until it is closed."""
    descriptor = open_here(lock_name(robot), os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise BusError(
            f"{robot}: another pupper-sysid is driving this robot. Stop it first: servos execute "
            "whichever command arrived last, so only one program may command them."
        ) from None
    return descriptor


@contextmanager
def announced(device: str | Path) -> Iterator[None]:
    """Within the block, `announced_devices` of other programs has this emulated device."""
    name = f"{os.getpid()}.emulated"
    descriptor = open_here(name, os.O_RDWR | os.O_TRUNC)
    try:
        # held until this process ends, however it ends; another terminal may have the device then
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        os.write(descriptor, os.fsencode(Path(device).absolute()))
        yield
    finally:
        (runtime_folder() / name).unlink(missing_ok=True)
        os.close(descriptor)


def announced_devices() -> list[Path]:
    """Devices and sockets of this user's emulators that run now."""
    devices = []
    for path in sorted(runtime_folder().glob("*.emulated")):
        descriptor = open_here(path.name, os.O_RDWR)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)  # of an emulator that was killed
        except OSError:
            devices.append(Path(os.fsdecode(path.read_bytes())))
        finally:
            os.close(descriptor)
    return devices
