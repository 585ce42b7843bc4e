"""Frames of Dynamixel's protocol 2.0: `FF FF FD 00 ID LEN_L LEN_H INST ... CRC_L CRC_H`.

A status frame has the instruction 55 and an error byte before its parameters. Bytes `FF FF FD`
inside a frame are followed by a stuffed `FD`, so that a header cannot occur there; LEN counts what
follows it, stuffing included. The CRC is CRC-16 with the polynomial 8005, from the header on.

Source: Robotis e-Manual, protocol 2.0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

HEADER = b"\xff\xff\xfd\x00"
STATUS = 0x55
_STUFFED, _STUFFING = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
_SHORTEST, _LONGEST = 10, 1024
_POLYNOMIAL = 0x8005


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes | bytearray) -> int:
    """CRC of a frame's bytes before it.

    Examples
    --------
    >>> hex(crc16(bytes.fromhex("ff ff fd 00 01 03 00 01")))
    '0x4e19'
    """
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _TABLE[crc >> 8 ^ byte]) & 0xFFFF
    return crc


@dataclass(frozen=True)
class Frame:
    """A frame with a correct CRC."""

    id: int
    code: int
    """Instruction of a request, error byte of a reply."""
    data: bytes
    """Parameters, without stuffing."""
    is_status: bool = False

    def encode(self) -> bytes:
        """The frame on the wire.

        Examples
        --------
        >>> Frame(1, 1, b"").encode().hex(" ")
        'ff ff fd 00 01 03 00 01 19 4e'
        """
        body = (bytes([STATUS]) if self.is_status else b"") + bytes([self.code]) + self.data
        body = body.replace(_STUFFED, _STUFFING)
        head = HEADER + bytes([self.id]) + (len(body) + 2).to_bytes(2, "little")
        return head + body + crc16(head + body).to_bytes(2, "little")


class FrameReader:
    """Finds frames in a stream that may hold anything.

    Where a frame is incomplete behind a new header, or its CRC wrong, its first byte is dropped and
    the search goes on, so garbage before, between or around frames is skipped.

    Parameters
    ----------
    plausible : callable
        `(id, parameter bytes) -> bool`: frames that can occur.
    status : bool
        Whether to take status frames, or requests.
    """

    def __init__(
        self,
        plausible: Callable[[int, int], bool] = lambda frame_id, size: True,
        status: bool = False,
    ):
        self._plausible, self._status = plausible, status
        self._buffer = bytearray()
        self.rejected_bytes = 0
        """Bytes outside valid frames."""
        self.crc_errors: list[int] = []
        """Ids of frames whose CRC was wrong."""

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`."""
        self._buffer += data
        frames: list[Frame] = []
        buffer = self._buffer
        while len(buffer) >= _SHORTEST:
            if not buffer.startswith(HEADER):
                at = buffer.find(HEADER, 1)
                self._drop(at if at >= 0 else len(buffer) - (len(HEADER) - 1))
                continue
            length = buffer[5] | buffer[6] << 8
            whole = length + 7
            if length < 3 or whole > _LONGEST:
                self._drop(1)
                continue
            # stuffing keeps headers out of a frame: one inside starts the next
            following = buffer.find(HEADER, 4, min(whole - 2, len(buffer)))
            if following >= 0:
                self._drop(following)
                continue
            if whole > len(buffer):
                break
            if crc16(buffer[: whole - 2]) != buffer[whole - 2] | buffer[whole - 1] << 8:
                self.crc_errors.append(buffer[4])
                self._drop(1)
                continue
            frame = self._frame(bytes(buffer[:whole]))
            if frame is None:
                self.rejected_bytes += whole
            else:
                frames.append(frame)
            del buffer[:whole]
        return frames

    def _drop(self, count: int) -> None:
        self.rejected_bytes += count
        del self._buffer[:count]

    def _frame(self, whole: bytes) -> Frame | None:
        """A frame of the kind that is read; None for any other."""
        body = whole[7:-2].replace(_STUFFING, _STUFFED)
        is_status = body[0] == STATUS
        if is_status != self._status or (is_status and len(body) < 2):
            return None
        code, data = (body[1], body[2:]) if is_status else (body[0], body[1:])
        frame = Frame(whole[4], code, data, is_status)
        return frame if self._plausible(frame.id, len(data)) else None
