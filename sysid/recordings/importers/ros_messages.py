"""Three ROS 2 messages from their bytes (CDR), since a bag in SQLite holds no definitions of them.

`decode` reads `sensor_msgs/JointState`, `trajectory_msgs/JointTrajectory` and
`std_msgs/Float64MultiArray`. No length in the bytes is believed beyond the bytes there are.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

JOINT_STATE = "sensor_msgs/JointState"
TRAJECTORY = "trajectory_msgs/JointTrajectory"
MULTI_ARRAY = "std_msgs/Float64MultiArray"
KINDS = (JOINT_STATE, TRAJECTORY, MULTI_ARRAY)


@dataclass(frozen=True)
class Message:
    """Positions of joints at a time.

    Attributes
    ----------
    stamp_ns : int
        Of the header; 0 where there is none.
    names : tuple of str
        Empty where the message has none.
    positions : tuple of float
    points : int
        How many points a trajectory has; its first one is in `positions`.
    """

    stamp_ns: int
    names: tuple[str, ...]
    positions: tuple[float, ...]
    points: int = 1


def plain_type(name: str) -> str:
    """A type's name without the `msg` between package and message.

    Examples
    --------
    >>> plain_type("sensor_msgs/msg/JointState")
    'sensor_msgs/JointState'
    """
    return name.replace("/msg/", "/")


def decode(kind: str, data: bytes) -> Message:
    """A message of type `kind`, one of this module's.

    Raises
    ------
    ValueError
        If the bytes are too short, or no such message.
    """
    return _DECODERS[kind](_Cdr(data))


class _Cdr:
    """Values one after another, aligned to their size (OMG CDR, with its four bytes of header)."""

    def __init__(self, data: bytes):
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError("no CDR header")
        self._data, self._at = memoryview(data)[4:], 0
        self._order = "<" if data[1] == 1 else ">"

    def values(self, code: str, size: int, count: int = 1) -> tuple[float, ...]:
        """`count` numbers of `size` bytes each."""
        if count == 0:
            return ()
        start = -(-self._at // size) * size
        end = start + size * count
        if end > len(self._data):
            raise ValueError("message is cut short")
        self._at = end
        return struct.unpack(f"{self._order}{count}{code}", self._data[start:end])

    def length(self) -> int:
        """Length of the sequence that follows."""
        count = int(self.values("I", 4)[0])
        if count > len(self._data) - self._at:
            raise ValueError("a length in the message is larger than the message")
        return count

    def text(self) -> str:
        """Text that ends with a zero byte."""
        count = self.length()
        start, self._at = self._at, self._at + count
        return bytes(self._data[start : self._at]).rstrip(b"\0").decode("utf-8", "replace")

    def texts(self) -> tuple[str, ...]:
        """A sequence of texts."""
        return tuple(self.text() for _ in range(self.length()))

    def doubles(self) -> tuple[float, ...]:
        """A sequence of numbers."""
        return self.values("d", 8, self.length())

    def stamp_ns(self) -> int:
        """Time of a header, whose frame is read over."""
        seconds, rest = self.values("i", 4)[0], self.values("I", 4)[0]
        self.text()
        return int(seconds) * 10**9 + int(rest)


def _joint_state(cdr: _Cdr) -> Message:
    return Message(cdr.stamp_ns(), cdr.texts(), cdr.doubles())


def _trajectory(cdr: _Cdr) -> Message:
    stamp, names = cdr.stamp_ns(), cdr.texts()
    points = cdr.length()
    return Message(stamp, names, cdr.doubles() if points else (), points)


def _multi_array(cdr: _Cdr) -> Message:
    for _ in range(cdr.length()):
        cdr.text()
        cdr.values("I", 4, 2)
    cdr.values("I", 4)
    return Message(0, (), cdr.doubles())


_DECODERS: dict[str, Callable[[_Cdr], Message]] = {
    JOINT_STATE: _joint_state,
    TRAJECTORY: _trajectory,
    MULTI_ARRAY: _multi_array,
}
