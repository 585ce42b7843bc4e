"""Frames of the Feetech bus: `FF FF ID LEN X ... CHK`, found in a stream that may hold anything.

Instruction and status frames have one layout; `X` is the instruction or the error byte, `LEN`
counts it, the parameters and the checksum, which is the inverted sum of all bytes from ID on.

`FrameReader` is the only parser: the bus reads replies with it, the emulator reads requests. Where
a frame is incomplete or its checksum wrong, its first byte is dropped and the search goes on, so
garbage before, between or around frames is skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

HEADER = b"\xff\xff"
SHORTEST = 6
_HIGHEST_LENGTH = 252


@dataclass(frozen=True)
class Frame:
    """A frame with a correct checksum."""

    id: int
    code: int
    """Instruction of a request, error byte of a reply."""
    data: bytes
    """Parameters."""

    def encode(self) -> bytes:
        """The frame on the wire.

        Examples
        --------
        >>> Frame(1, 2, bytes([56, 2])).encode().hex(" ")
        'ff ff 01 04 02 38 02 be'
        """
        body = bytes([self.id, len(self.data) + 2, self.code]) + self.data
        return HEADER + body + bytes([checksum(body)])


def checksum(body: bytes | bytearray) -> int:
    """Checksum of the bytes from ID to the last parameter."""
    return ~sum(body) & 0xFF


class FrameReader:
    """Finds frames in a stream of bytes.

    Parameters
    ----------
    plausible : callable
        `(id, length byte) -> bool`: frames that can occur. Garbage that looks like the start of a
        long frame would otherwise hide the true ones behind it.
    """

    def __init__(self, plausible: Callable[[int, int], bool] = lambda frame_id, length: True):
        self._plausible = plausible
        self._buffer = bytearray()
        self.rejected_bytes = 0
        """Bytes outside valid frames."""

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`."""
        self._buffer += data
        found: list[Frame] = []
        buffer, start, end = self._buffer, 0, len(self._buffer)
        while end - start >= SHORTEST:
            if buffer[start] != 0xFF or buffer[start + 1] != 0xFF:
                at = buffer.find(HEADER, start)
                # the last byte may be the first of a header
                at = at if at >= 0 else end - (buffer[end - 1] == 0xFF)
                self.rejected_bytes += at - start
                start = at
                continue
            frame_id, length = buffer[start + 2], buffer[start + 3]
            whole = start + length + 4
            if (
                frame_id == 0xFF
                or not 2 <= length <= _HIGHEST_LENGTH
                or not self._plausible(frame_id, length)
            ):
                start += 1
                self.rejected_bytes += 1
            elif whole > end:
                break
            elif checksum(buffer[start + 2 : whole - 1]) != buffer[whole - 1]:
                start += 1
                self.rejected_bytes += 1
            else:
                found.append(
                    Frame(frame_id, buffer[start + 4], bytes(buffer[start + 5 : whole - 1]))
                )
                start = whole
        del buffer[:start]
        return found
