"""A serial line of Dynamixel servos, protocol 2.0 (`dynamixel_sdk`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.dynamixel.frames import Frame, FrameReader
from pupper_sysid.hardware.dynamixel.registers import BROADCAST_ID, HIGHEST_ID, PING, SERIES, WRITE
from pupper_sysid.hardware.serial_servos.line import Reply, SerialLine

_PROTOCOL = 2.0
_TORQUE = SERIES[1200].register("torque_enable").address


class DynamixelLine(SerialLine):
    """An open serial line of Dynamixel servos; parameters and errors are those of `SerialLine`."""

    reply_bytes = 11
    longest_return_delay_s = 0.00051  # 254 units of 2 µs
    model_bytes = 3  # model number and firmware, in the reply to a ping
    rates_in_words = "57600, 115200, 1000000, 2000000, 3000000 or 4000000"

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        super().__init__(device, baud, exclusive)
        self._packets = self._sdk().PacketHandler(_PROTOCOL)

    def ping(self, servo: int) -> Frame | None:
        """Status frame of `servo`, or None if it does not answer."""
        reply = self._exchange(lambda: self.ask_model(servo), [servo], self.model_bytes).get(servo)
        return reply.frame if reply else None  # pyright: ignore[reportReturnType]

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request."""
        ids = list(servos)
        return self._exchange(
            lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids), False),
            ids, size,
        )  # fmt: skip

    def sync_write(self, address: int, values: dict[int, bytes]) -> float:
        """Write to several servos, unacknowledged; `time.monotonic()` of sending, NaN if failed."""
        size = len(next(iter(values.values())))
        params = [byte for servo, value in values.items() for byte in (servo, *value)]
        return self._sync_written(
            lambda: self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
        )

    def torque_off(self, servos: Sequence[int] | None = None) -> None:
        """Switch the torque of these (default: all) off at once; unacknowledged."""
        if servos is None:
            off = Frame(BROADCAST_ID, WRITE, _TORQUE.to_bytes(2, "little") + b"\0").encode()
            self._sync_written(lambda: self._send_raw(off))
        else:
            self.sync_write(_TORQUE, {servo: b"\0" for servo in servos})

    def ask_model(self, servo: int) -> int:
        """Send a ping, whose reply holds the model number; 0 if sent."""
        request = [0, 0, 0, 0, servo, 3, 0, PING, 0, 0]
        return self._packets.txPacket(self._port, request)

    def echo_probe(self) -> bytes:
        """A request to which no servo answers."""
        return Frame(HIGHEST_ID, PING, b"").encode()

    def _reader(self, accepted: Callable[[int, int], bool]) -> FrameReader:
        return FrameReader(accepted, status=True)

    def _request(self, frame: Any) -> bytes:
        return b""  # an echo is no status frame

    def _sdk(self) -> Any:
        try:
            import dynamixel_sdk
        except ImportError as error:
            raise BusError(
                "the Dynamixel SDK is not installed. Run `pip install 'dynamixel-sdk>=3.8'`."
            ) from error
        return dynamixel_sdk
