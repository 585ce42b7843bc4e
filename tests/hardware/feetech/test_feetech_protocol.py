"""The vendor's SDK, the emulator and our frames agree on every byte of facts/hardware.md B1."""

from collections.abc import Iterator

import numpy as np
import pytest
import scservo_sdk
from scservo_sdk import scservo_def

from pupper_sysid.hardware.feetech import SCS0009, STS3215, FeetechLine, Frame, FrameReader, Series
from support.damage import damaged
from support.servo_servers import Listening, bench_of, on_a_port, still_servos
from support.stopwatch import wait_until

GOLDEN = {
    "ping 1": ("FF FF 01 02 01 FB", 1, 1, ""),
    "ping answer 1": ("FF FF 01 02 00 FC", 1, 0, ""),
    "read model 1": ("FF FF 01 04 02 03 02 F3", 1, 2, "03 02"),
    "STS model answer": ("FF FF 01 04 00 09 03 EE", 1, 0, "09 03"),
    "SCS model answer": ("FF FF 03 04 00 05 04 EF", 3, 0, "05 04"),
    "read position 1": ("FF FF 01 04 02 38 02 BE", 1, 2, "38 02"),
    "STS position answer": ("FF FF 01 04 00 05 08 ED", 1, 0, "05 08"),
    "SCS position answer": ("FF FF 03 04 00 01 F6 01", 3, 0, "01 F6"),
    "firmware read 3": ("FF FF 03 04 02 38 06 B8", 3, 2, "38 06"),
    "firmware answer 3": ("FF FF 03 08 00 01 F6 80 14 04 37 2E", 3, 0, "01 F6 80 14 04 37"),
    "write goal 1": ("FF FF 01 05 03 2A 00 08 C4", 1, 3, "2A 00 08"),
    "STS sync write": (
        "FF FF FE 0A 83 2A 02 01 00 08 02 23 01 19", 254, 0x83, "2A 02 01 00 08 02 23 01",
    ),
    "SCS sync write of twelve": (
        "FF FF FE 28 83 2A 02 01 02 00 02 02 00 03 02 00 04 02 00 05 02 00 06 02 00 "
        "07 02 00 08 02 00 09 02 00 0A 02 00 0B 02 00 0C 02 00 C4",
        254, 0x83,
        "2A 02 01 02 00 02 02 00 03 02 00 04 02 00 05 02 00 06 02 00 "
        "07 02 00 08 02 00 09 02 00 0A 02 00 0B 02 00 0C 02 00",
    ),
    "SCS position, time, speed": (
        "FF FF FE 0B 83 2A 06 01 02 00 00 00 03 E8 55", 254, 0x83, "2A 06 01 02 00 00 00 03 E8",
    ),
    "STS sync read": ("FF FF FE 06 82 38 06 01 02 38", 254, 0x82, "38 06 01 02"),
    "broadcast action": ("FF FF FE 02 05 FA", 254, 5, ""),
}  # fmt: skip


def golden(name: str) -> bytes:
    return bytes.fromhex(GOLDEN[name][0])


class SdkClient:
    """The vendor's SDK as its manual uses it, with nothing of ours."""

    def __init__(self, device: str, end: int, monkeypatch: pytest.MonkeyPatch):
        # the SDK's 34 ms are too few on a busy machine that plays the servos too
        monkeypatch.setattr(scservo_sdk.port_handler, "LATENCY_TIMER", 200)
        self.port = scservo_sdk.PortHandler(device)
        self.handler = scservo_sdk.PacketHandler(end)
        assert self.port.openPort() and self.port.setBaudRate(1_000_000)


@pytest.fixture(autouse=True)
def byte_order_is_put_back() -> Iterator[None]:
    before = scservo_def.SCS_GETEND()
    yield
    scservo_def.SCS_SETEND(before)


@pytest.fixture
def sts(monkeypatch) -> Iterator[tuple[Listening, SdkClient]]:
    yield from talking(STS3215, 0, monkeypatch)


@pytest.fixture
def scs(monkeypatch) -> Iterator[tuple[Listening, SdkClient]]:
    yield from talking(SCS0009, 1, monkeypatch)


def talking(
    series: Series, end: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Listening, SdkClient]]:
    servos = still_servos(series)
    bench_of(servos).counts |= {1: 2053, 2: 1000} if series is STS3215 else {3: 502}
    bench_of(servos).loads[3] = -55
    servos.servos[3].memory[58:60] = series.encode("present_speed", -20)
    with on_a_port(servos) as server:
        client = SdkClient(server.device, end, monkeypatch)
        yield servos, client
        client.port.closePort()


def test_our_frames_encode_and_parse_the_golden_bytes_also_byte_by_byte():
    for name, (text, frame_id, code, data) in GOLDEN.items():
        frame = Frame(frame_id, code, bytes.fromhex(data))
        assert frame.encode() == bytes.fromhex(text), name
        assert FrameReader().feed(bytes.fromhex(text)) == [frame], name
        reader = FrameReader()
        pieces = [reader.feed(bytes([byte])) for byte in bytes.fromhex(text)]
        assert pieces[:-1] == [[]] * (len(pieces) - 1) and pieces[-1] == [frame], name


@pytest.mark.parametrize("count", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_damaged_frames_raise_nothing(count):
    rng, reader, servos = np.random.default_rng(0), FrameReader(), still_servos(ids=[1, 2])
    frames, whole = [golden(name) for name in GOLDEN], 0
    for _ in range(count):
        data = damaged(rng, frames)
        for frame in reader.feed(data):
            assert sum(frame.encode()[2:]) % 256 == 255
            whole += 1
        servos.receive(data, servos._free_at)
        assert len(reader._buffer) <= 1024
    assert whole > count / 8


def test_sdk_ping_read_write_and_groups_of_an_sts_are_golden_and_obeyed(sts):
    servos, sdk = sts
    done = scservo_sdk.COMM_SUCCESS
    assert sdk.handler.ping(sdk.port, 1) == (777, done, 0)
    assert servos.heard == golden("ping 1") + golden("read model 1")
    assert servos.said == golden("ping answer 1") + golden("STS model answer")
    servos.heard = servos.said = b""
    assert sdk.handler.read2ByteTxRx(sdk.port, 1, 56) == (2053, done, 0)
    assert (servos.heard, servos.said) == (golden("read position 1"), golden("STS position answer"))
    servos.heard = servos.said = b""
    group = scservo_sdk.GroupSyncRead(sdk.port, sdk.handler, 56, 6)
    assert group.addParam(1) and group.addParam(2) and group.txRxPacket() == done
    assert [group.getData(i, 56, 2) for i in (1, 2)] == [2053, 1000]
    assert servos.heard == golden("STS sync read")
    assert [f.id for f in FrameReader().feed(servos.said)] == [1, 2], "both answer in order"
    servos.heard = servos.said = b""
    assert sdk.handler.write2ByteTxRx(sdk.port, 1, 42, 2048) == (done, 0)
    assert (servos.heard, servos.said) == (golden("write goal 1"), golden("ping answer 1"))
    assert bench_of(servos).goals.pop() == (1, 2048)
    assert sdk.handler.regWriteTxRx(sdk.port, 1, 42, 2, word(2100)) == (done, 0)
    assert bench_of(servos).goals == []
    assert sdk.handler.action(sdk.port, 254) == done
    assert wait_until(lambda: bench_of(servos).goals == [(1, 2100)])


def test_sdk_ping_and_reads_of_an_scs_are_answered_in_its_byte_order(scs):
    servos, sdk = scs
    assert sdk.handler.ping(sdk.port, 3) == (1284, scservo_sdk.COMM_SUCCESS, 0)
    assert servos.said.endswith(golden("SCS model answer"))
    servos.heard = servos.said = b""
    assert sdk.handler.read2ByteTxRx(sdk.port, 3, 56) == (502, scservo_sdk.COMM_SUCCESS, 0)
    assert servos.said == golden("SCS position answer")
    servos.heard = servos.said = b""
    # as the firmware of the robot reads: position, speed and load
    data, result, error = sdk.handler.readTxRx(sdk.port, 3, 56, 6)
    assert (result, error) == (scservo_sdk.COMM_SUCCESS, 0)
    assert (servos.heard, servos.said) == (golden("firmware read 3"), golden("firmware answer 3"))
    names = ("present_position", "present_speed", "present_load")
    assert [SCS0009.decode(name, bytes(data), 56) for name in names] == [502, -20, -55]


def sync_write(sdk: SdkClient, address: int, values: dict[int, list[int]]) -> None:
    size = len(next(iter(values.values())))
    group = scservo_sdk.GroupSyncWrite(sdk.port, sdk.handler, address, size)
    for servo, data in values.items():
        assert group.addParam(servo, data)
    assert group.txPacket() == scservo_sdk.COMM_SUCCESS


def word(value: int) -> list[int]:
    return [scservo_def.SCS_LOBYTE(value), scservo_def.SCS_HIBYTE(value)]


def test_sdk_sync_write_and_action_are_golden_unanswered_and_obeyed(sts):
    servos, sdk = sts
    sync_write(sdk, 42, {1: word(2048), 2: word(291)})
    assert wait_until(lambda: servos.heard == golden("STS sync write"))
    assert bench_of(servos).goals == [(1, 2048), (2, 291)]
    assert sdk.handler.action(sdk.port, 254) == scservo_sdk.COMM_SUCCESS
    assert wait_until(lambda: servos.heard.endswith(golden("broadcast action")))
    assert servos.said == b""


def test_sdk_sync_writes_to_scs_are_golden_unanswered_and_obeyed(scs):
    servos, sdk = scs
    sync_write(sdk, 42, {i: word(512) for i in range(1, 13)})
    assert wait_until(lambda: servos.heard == golden("SCS sync write of twelve"))
    assert bench_of(servos).goals == [(i, 512) for i in range(1, 13)]
    servos.heard = b""
    sync_write(sdk, 42, {1: word(512) + word(0) + word(1000)})
    assert wait_until(lambda: servos.heard == golden("SCS position, time, speed"))
    memory = bytes(servos.servos[1].memory)
    names = ("goal_position", "goal_time", "goal_speed")
    assert [SCS0009.decode(name, memory) for name in names] == [512, 0, 1000]
    assert servos.said == b""


def test_scs_servos_do_not_know_the_sync_read(scs):
    servos, sdk = scs
    group = scservo_sdk.GroupSyncRead(sdk.port, sdk.handler, 56, 6)
    assert group.addParam(1) and group.addParam(2)
    assert group.txRxPacket() == scservo_sdk.COMM_RX_TIMEOUT
    assert servos.heard == golden("STS sync read") and servos.said == b""


@pytest.mark.parametrize(("series", "end"), [(STS3215, 0), (SCS0009, 1)])
def test_our_line_sends_the_golden_bytes(series, end):
    servos = still_servos(series)
    with on_a_port(servos) as server:
        line = FeetechLine(server.device, 1_000_000)
        line.patience_s = 0.4  # the servos share this process and a busy machine
        asked = {
            "ping 1": lambda: line.answers_ping(1),
            "read model 1": lambda: line.model(1),
            "read position 1": lambda: line.read(1, 56, 2),
            "firmware read 3": lambda: line.read(3, 56, 6),
        }
        asked |= (
            {
                "write goal 1": lambda: line.write(1, 42, bytes([0, 8])),
                "STS sync write": lambda: line.sync_write(42, {1: b"\x00\x08", 2: b"\x23\x01"}),
                "STS sync read": lambda: line.sync_read([1, 2], 56, 6),
            }
            if end == 0
            else {
                "SCS sync write of twelve": lambda: line.sync_write(
                    42, {i: b"\x02\x00" for i in range(1, 13)}
                ),
                "SCS position, time, speed": lambda: line.sync_write(
                    42, {1: b"\x02\x00\x00\x00\x03\xe8"}
                ),
            }
        )
        for name, ask in asked.items():
            servos.heard = b""
            assert ask() is not None
            assert wait_until(lambda name=name: servos.heard == golden(name)), name
        line.close()


def test_negative_registers_are_sign_and_magnitude_and_others_take_none():
    for series, order in ((STS3215, "little"), (SCS0009, "big")):
        for name, value, magnitude_bit in (
            ("present_speed", -300, 0x8000), ("present_load", -55, 0x0400),
        ):  # fmt: skip
            encoded = series.encode(name, value)
            assert int.from_bytes(encoded, order) == magnitude_bit + abs(value)
            assert series.decode(name, encoded, series.registers[name].address) == value
    for value in (-1, 65_536):
        with pytest.raises(OverflowError):
            SCS0009.encode("goal_position", value)


def test_no_frame_with_one_flipped_bit_is_accepted():
    # the sum over a frame changes by 2**bit, which no other byte makes up for
    for at in range(2, 8):
        for bit in range(8):
            spoiled = bytearray(golden("STS position answer"))
            spoiled[at] ^= 1 << bit
            assert FrameReader().feed(bytes(spoiled)) == [], (at, bit)


def test_the_emulated_servo_has_its_rate_the_time_of_its_wire_and_its_own_limits():
    servos = still_servos(STS3215)
    assert servos.receive(golden("ping 1"), 0.0, baud=500_000) == []
    assert [p for _, p in servos.receive(golden("ping 1"), 0.1, 1_000_000)] == [
        golden("ping answer 1")
    ]
    [(at, answer)] = servos.receive(golden("read position 1"), 1.0)
    # 8 bytes out and 8 back at 10 us, and 250 units of 2 us in between
    assert len(answer) == 8
    assert at == pytest.approx(1.0 + 80e-6 + 500e-6 + 80e-6, abs=1e-9)
    servos = still_servos(SCS0009)
    servos.receive(Frame(1, 3, bytes([42, 0, 5])).encode(), 0.0)
    servos.receive(Frame(1, 3, bytes([42, 3, 0xFF])).encode(), 0.1)
    assert bench_of(servos).goals == [(1, 20), (1, 1003)]
