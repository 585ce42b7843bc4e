"""What programs of one user know of each other's robots: locks, and notes of a torque that is on.

The folder is `$XDG_RUNTIME_DIR/pupper-sysid`, else `/tmp/pupper-sysid-<user id>`; only its
user may write there, and files in it are opened without following links and without waiting. A lock
is held by each process that has its file open, also by a child that inherited it; actions that must
not wait, such as switching the torque off, therefore take no lock.

A note is for the case that driver and watchdog both die. A driver writes one before it switches the
torque on; it names the bus, the joints, the driver and its watchdog. The process that switches the
torque off removes it. `pupper-sysid park` switches off the robots of notes whose processes do not
run.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import BusError, PupperError
from pupper_sysid.common.files import resolved
from pupper_sysid.hardware.address import BusAddress
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from

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


_END = ".on"
_MOST_BYTES = 100_000
_NOT_RUNNING = "ZXxTt"  # of proc(5): zombie, dead, stopped


@dataclass(frozen=True)
class Note:
    """A robot whose torque was switched on."""

    address: BusAddress
    joint_map: JointMap
    joints: tuple[str, ...]
    driver: int
    """Process id."""
    processes: tuple[tuple[int, int], ...]
    """Ids of driver and watchdog, and when each was started [clock ticks since the system was]."""
    registers: dict[str, dict[str, int]]
    """Original values of the registers that the driver changed, by joint."""

    @property
    def robot(self) -> str:
        """Device or socket, whatever link leads to it."""
        return os.path.realpath(self.address.where)

    def in_control(self) -> bool:
        """Whether the driver or the watchdog runs."""
        return any(_runs(number, start) for number, start in self.processes)

    def remove(self) -> None:
        """Take the note away, unless another driver has replaced it."""
        if any(note.processes == self.processes for note in notes()):
            remove_note(self.address.where)


def write_note(orders: dict[str, Any], joints: Sequence[str], watchdog: int) -> None:
    """Note that the torque of these joints is on.

    `orders` are the first message to the watchdog, and the registers to be set back; `watchdog` is
    its process id.
    """
    processes = [[number, _state(number)[1]] for number in (orders["driver"], watchdog)]
    text = json.dumps(orders | {"joints": list(joints), "processes": processes}).encode()
    with suppress(PupperError, OSError):  # may be impossible; not needed
        descriptor = open_here(_note_name(orders["where"]), os.O_WRONLY | os.O_TRUNC)
        try:
            os.write(descriptor, text)
        finally:
            os.close(descriptor)


def remove_note(where: str) -> None:
    """Note that the torque of the robot at this device or socket is off."""
    with suppress(PupperError, OSError):
        os.unlink(runtime_folder() / _note_name(where))


def notes() -> list[Note]:
    """All notes that can be read."""
    readable = []
    for path in sorted(runtime_folder().glob(f"*{_END}")):
        # incomplete, of another version, or removed meanwhile
        with suppress(PupperError, OSError, ValueError, KeyError, TypeError, AttributeError):
            readable.append(_read_note(path.name))
    return readable


def _read_note(name: str) -> Note:
    descriptor = open_here(name, os.O_RDONLY)
    try:
        orders = json.loads(os.read(descriptor, _MOST_BYTES))
    finally:
        os.close(descriptor)
    registers = orders.get("registers", {})
    return Note(
        *robot_of(orders, name),
        tuple(orders["joints"]),
        int(orders["driver"]),
        tuple((int(number), int(start)) for number, start in orders["processes"]),
        {j: {n: int(v) for n, v in values.items()} for j, values in registers.items()},
    )


def robot_of(orders: dict[str, Any], name: str) -> tuple[BusAddress, JointMap]:
    """Address and joint map of the first message to a watchdog."""
    joint_map = joint_map_from(orders["map"], name)
    address = BusAddress(orders["kind"], orders["where"], orders["baud"])
    return address, joint_map if orders["coordinates"] == "joint" else joint_map.per_servo()


def _note_name(where: str) -> str:
    """By the name under which it was opened: a link to an unplugged device leads nowhere."""
    return hashlib.sha256(os.fsencode(os.path.abspath(where))).hexdigest()[:16] + _END


def _runs(number: int, start: int) -> bool:
    """Whether a process runs that was started then: ids are used again."""
    state, started = _state(number)
    return started == start and state not in _NOT_RUNNING


def _state(number: int) -> tuple[str, int]:
    """State and start time of a process; ("X", -1) if there is none."""
    try:
        # the name in parentheses may have spaces and parentheses itself
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "X", -1
    return fields[0], int(fields[19])
