"""A serial line of Feetech servos (`scservo_sdk`).

Beside the faults that all SDKs share (`hardware.serial_servos.line`), version 1.0.0 of this one
keeps the byte order in a module global, does not check a reply's length, and loses the replies of a
group read after one silent servo. Byte order, lengths and group reads are therefore handled here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.feetech.frames import Frame, FrameReader
from pupper_sysid.hardware.feetech.registers import (
    BROADCAST_ID,
    MODEL_ADDRESS,
    PING,
    TORQUE_ADDRESS,
)
from pupper_sysid.hardware.serial_servos.line import Reply, SerialLine


class FeetechLine(SerialLine):
    """An open serial line of Feetech servos; parameters and errors are those of `SerialLine`."""

    reply_bytes = 6
    longest_return_delay_s = 0.00051  # 254 units of 2 µs
    model_bytes = 2
    rates_in_words = "1000000, 500000, 250000, 128000, 115200, 57600 or 38400"

    def __init__(self, device: str, baud: int, exclusive: bool = True):
        super().__init__(device, baud, exclusive)
        self._packets = self._sdk().protocol_packet_handler()

    def ping(self, servo: int) -> Frame | None:
        """Status frame of `servo`, or None if it does not answer."""
        reply = self._exchange(
            lambda: self._packets.txPacket(self._port, [0, 0, servo, 2, PING, 0]), [servo], 0
        ).get(servo)
        return reply.frame if reply else None  # pyright: ignore[reportReturnType]

    def sync_read(self, servos: Sequence[int], address: int, size: int) -> dict[int, Reply]:
        """The same bytes of several servos with one request (not on the SCS series)."""
        ids = list(servos)
        return self._exchange(
            lambda: self._packets.syncReadTx(self._port, address, size, ids, len(ids)), ids, size
        )

    def sync_write(self, address: int, values: dict[int, bytes]) -> float:
        """Write to several servos, unacknowledged; `time.monotonic()` of sending, NaN if failed.

        Raises
        ------
        ValueError
            If the values differ in length.
        """
        sizes = {len(v) for v in values.values()}
        if len(sizes) != 1:
            raise ValueError(f"sync_write: values of {sorted(sizes)} bytes; all must be as long.")
        size = sizes.pop()
        params = [byte for servo, value in values.items() for byte in (servo, *value)]
        return self._sync_written(
            lambda: self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
        )

    def torque_off(self, servos: Sequence[int] | None = None) -> None:
        """Switch the torque of these (default: all) off at once; unacknowledged."""
        if servos is None:
            off = Frame(BROADCAST_ID, 3, bytes([TORQUE_ADDRESS, 0])).encode()
            self._sync_written(lambda: self._send_raw(off))
        else:
            self.sync_write(TORQUE_ADDRESS, {servo: b"\0" for servo in servos})

    def ask_model(self, servo: int) -> int:
        """Send the request whose reply holds the model number; 0 if sent."""
        return self._packets.readTx(self._port, servo, MODEL_ADDRESS, 2)

    def echo_probe(self) -> bytes:
        """A request to which no servo answers."""
        return Frame(BROADCAST_ID - 1, PING, b"").encode()

    def _reader(self, accepted: Callable[[int, int], bool]) -> FrameReader:
        return FrameReader(lambda servo, length: accepted(servo, length - 2))

    def _request(self, frame: Any) -> bytes:
        return frame.encode()

    def _sdk(self) -> Any:
        """The vendor's SDK; refuses another package of the same module name."""
        try:
            import scservo_sdk
        except ImportError as error:
            raise BusError(
                "the Feetech SDK is not installed. Run `pip install 'feetech-servo-sdk>=1.0,<2'`."
            ) from error
        if not hasattr(scservo_sdk, "PacketHandler"):
            raise BusError(
                "the package ftservo-python-sdk is installed, which puts another library under the "
                "name scservo_sdk. Run `pip uninstall ftservo-python-sdk` and then "
                "`pip install --force-reinstall 'feetech-servo-sdk>=1.0,<2'`."
            )
        return scservo_sdk
