"""Protocol 2.0 on the wire: the manual's examples, damaged frames, and the vendor's SDK."""

from collections.abc import Iterator

import dynamixel_sdk
import numpy as np
import pytest

from pupper_sysid.hardware.dynamixel import (
    ACCESS,
    DATA_LIMIT,
    MODELS,
    Frame,
    FrameReader,
    crc16,
    fast_replies,
)
from pupper_sysid.hardware.serial_servos import line as serial_line
from support.damage import damaged
from support.servo_servers import bench_of, on_a_port, still_dynamixels

# Robotis e-Manual, protocol 2.0: examples of instruction and status packets
EXAMPLES = {
    "ping": ("FF FF FD 00 01 03 00 01 19 4E", Frame(1, 1, b"")),
    "ping answer": (
        "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", Frame(1, 0, b"\x06\x04\x26", True)
    ),
    "read": ("FF FF FD 00 01 07 00 02 84 00 04 00 1D 15", Frame(1, 2, b"\x84\x00\x04\x00")),
    "read answer": (
        "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0", Frame(1, 0, b"\xa6\x00\x00\x00", True)
    ),
    "write": (
        "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
        Frame(1, 3, b"\x74\x00\x00\x02\x00\x00"),
    ),
    "write answer": ("FF FF FD 00 01 04 00 55 00 A1 0C", Frame(1, 0, b"", True)),
    "sync read": (
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
        Frame(254, 0x82, b"\x84\x00\x04\x00\x01\x02"),
    ),
    "sync read answer": (
        "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE", Frame(2, 0, b"\x1f\x08\x00\x00", True)
    ),
    "sync write": (
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
        Frame(254, 0x83, b"\x74\x00\x04\x00\x01\x96\x00\x00\x00\x02\xaa\x00\x00\x00"),
    ),
    "reboot": ("FF FF FD 00 01 03 00 08 2F 4E", Frame(1, 8, b"")),
}  # fmt: skip

# the same: fast sync read of Present_Position from ids 3, 7 and 4
FAST_ANSWER = bytes.fromhex(
    "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA00 04 FF 03 00 00 D1 9E"
)


def wire(name: str) -> bytes:
    return bytes.fromhex(EXAMPLES[name][0])


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.1)


@pytest.fixture(scope="module")
def served() -> Iterator:
    """Two servos behind a port, shared."""
    servos = still_dynamixels([1, 2], model=1030)
    with on_a_port(servos) as server:
        yield servos, server.device


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_manuals_examples_are_written_and_read(name):
    data, frame = wire(name), EXAMPLES[name][1]
    assert frame.encode() == data
    assert FrameReader(status=frame.is_status).feed(b"\x00\xff" + data) == [frame]


def test_the_emulated_servo_answers_the_manuals_requests_as_the_manual_says():
    servos = still_dynamixels([1, 2], model=1030)
    for servo_id in (1, 2):
        servos._set(servo_id, "firmware", 0x26)
        servos._set(servo_id, "torque_enable", 0)
    bench_of(servos).counts.update({1: 0xA6, 2: 0x81F})

    def answer(name: str) -> bytes:
        return b"".join(piece for _, piece in servos.receive(wire(name), servos._free_at))

    assert answer("ping") == wire("ping answer")
    assert answer("read") == wire("read answer")
    assert answer("write") == wire("write answer")
    assert answer("sync read") == wire("read answer") + wire("sync read answer")
    assert answer("sync write") == b""
    assert (servos._get(1, "goal_position"), servos._get(2, "goal_position")) == (0x96, 0xAA)


def test_servos_build_the_manuals_answer_to_a_fast_sync_read_and_it_is_read():
    servos = still_dynamixels([3, 4, 7], model=1030)
    bench_of(servos).counts.update({3: 0xA6, 7: 0x81F, 4: 0x3FF})
    request = Frame(254, 0x8A, b"\x84\x00\x04\x00\x03\x07\x04").encode()
    pieces = servos.receive(request, 0.0)
    answer = b"".join(piece for _, piece in pieces)
    assert answer == FAST_ANSWER
    # one return delay of 500 µs, then 10 µs a byte without a pause
    ends = [17 + 8 + 8, 17 + 8 + 16, 17 + 8 + 24]
    np.testing.assert_allclose([at for at, _ in pieces], 5e-4 + 1e-5 * np.array(ends))
    frames = fast_replies(answer, [3, 7, 4], 4)
    assert [(f.id, int.from_bytes(f.data, "little")) for f in frames] == [
        (3, 0xA6), (7, 0x81F), (4, 0x3FF)
    ]  # fmt: skip
    assert fast_replies(answer, [3, 4, 7], 4) == frames[:1]


def test_requests_that_the_host_sends_without_a_pause_act_each_at_its_own_end():
    servos = still_dynamixels([1, 2], model=1030, registers={None: {"return_delay_time": 0}})
    goals = {}
    for apart in (False, True):
        parts = [wire("sync write"), wire("read")]
        start = servos._free_at
        servos.bench.command = lambda k, at, count, start=start: goals.setdefault(start, at - start)
        pieces = []
        for part in parts if apart else [b"".join(parts)]:
            pieces += servos.receive(part, start)
        arrived = len(b"".join(parts)) + len(wire("read answer"))
        assert pieces[-1][0] - start == pytest.approx(arrived * 1e-5)
    assert list(goals.values()) == pytest.approx([len(wire("sync write")) * 1e-5] * 2)


@pytest.mark.parametrize("bit", range(0, 8 * len(FAST_ANSWER), 5))
def test_of_a_damaged_fast_answer_only_the_blocks_before_the_damage_are_taken(bit):
    damaged = bytearray(FAST_ANSWER)
    damaged[bit // 8] ^= 1 << bit % 8
    frames = fast_replies(bytes(damaged), [3, 7, 4], 4)
    assert len(frames) == max(bit // 8 - 8, 0) // 8
    assert frames == fast_replies(FAST_ANSWER, [3, 7, 4], 4)[: len(frames)]


def test_a_header_inside_the_data_is_stuffed_and_comes_out_again():
    data = bytes.fromhex("ff ff fd 00 ff ff fd fd ff ff")
    frame = Frame(7, 0, data, True)
    assert b"\xff\xff\xfd\xfd\x00" in frame.encode()
    assert FrameReader(status=True).feed(frame.encode()) == [frame]


@pytest.mark.parametrize("count", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_damaged_frames_raise_nothing_and_good_ones_between_them_are_found(count):
    rng = np.random.default_rng(0)
    frames = [wire(name) for name in EXAMPLES]
    readers = FrameReader(), FrameReader(status=True)
    servos = still_dynamixels([1, 2])
    whole = 0
    for _ in range(count):
        data = damaged(rng, frames)
        for reader in readers:
            for frame in reader.feed(data):
                assert crc16(frame.encode()[:-2]) == int.from_bytes(frame.encode()[-2:], "little")
                whole += 1
        servos.receive(data, servos._free_at)
        assert max(len(reader._buffer) for reader in readers) <= 1024
    assert whole > count / 8
    reader = FrameReader(status=True)
    assert reader.feed(wire("read answer")[:-3] + wire("sync read answer")) == [
        EXAMPLES["sync read answer"][1]
    ]


def test_the_vendors_sdk_reads_writes_and_groups(served, monkeypatch):
    # of its replies the SDK awaits two of these latencies [ms]; a busy host is later than 2 x 16
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 500)
    servos, device = served
    port = dynamixel_sdk.PortHandler(device)
    packets = dynamixel_sdk.PacketHandler(2.0)
    assert port.openPort() and port.setBaudRate(1_000_000)
    try:
        model, result, error = packets.ping(port, 1)
        assert (model, result, error) == (1030, 0, 0)
        found, result = packets.broadcastPing(port)
        assert result == 0 and sorted(found) == [1, 2]
        assert packets.write1ByteTxRx(port, 1, 64, 0) == (0, 0)
        assert packets.write4ByteTxRx(port, 1, 116, 2100) == (0, 0)
        assert packets.read4ByteTxRx(port, 1, 116) == (2100, 0, 0)
        # beyond the position limit, and EEPROM while the torque is on
        assert packets.write4ByteTxRx(port, 1, 116, 9000) == (0, DATA_LIMIT)
        assert packets.write1ByteTxRx(port, 1, 64, 1) == (0, 0)
        assert packets.write1ByteTxRx(port, 1, 11, 1) == (0, ACCESS)
        assert packets.write1ByteTxRx(port, 1, 64, 0) == (0, 0)
        group = dynamixel_sdk.GroupSyncWrite(port, packets, 116, 4)
        for servo, goal in ((1, 2000), (2, 2200)):
            assert group.addParam(servo, list(goal.to_bytes(4, "little")))
        assert group.txPacket() == 0
        bench_of(servos).counts.update({1: 1999, 2: 2201})
        readings = dynamixel_sdk.GroupSyncRead(port, packets, 132, 4)
        assert readings.addParam(1) and readings.addParam(2)
        assert readings.txRxPacket() == 0
        assert [readings.getData(i, 132, 4) for i in (1, 2)] == [1999, 2201]
        bench_of(servos).counts.update({1: 1899, 2: 2301})
        assert readings.fastSyncRead() == 0
        assert [readings.getData(i, 132, 4) for i in (1, 2)] == [1899, 2301]
    finally:
        port.closePort()
    assert bench_of(servos).goals[-2:] == [(1, 2000), (2, 2200)]


def test_the_vendors_sdk_writes_in_bulk_reboots_and_gives_ids_and_rates(monkeypatch):
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 200)
    servos = still_dynamixels([1, 2], model=1030)
    with on_a_port(servos) as server:
        port = dynamixel_sdk.PortHandler(server.device)
        packets = dynamixel_sdk.PacketHandler(2.0)
        assert port.openPort() and port.setBaudRate(1_000_000)

        def read(address: int, size: int, servo: int = 1) -> int:
            data, result, error = packets.readTxRx(port, servo, address, size)
            assert (result, error) == (0, 0)
            return int.from_bytes(bytes(data), "little")

        def write(address: int, size: int, value: int, servo: int = 1) -> None:
            data = list(value.to_bytes(size, "little"))
            assert packets.writeTxRx(port, servo, address, size, data) == (0, 0)

        bulk = dynamixel_sdk.GroupBulkWrite(port, packets)
        assert bulk.addParam(1, 116, 4, [200, 7, 0, 0]) and bulk.addParam(2, 65, 1, [1])
        assert bulk.txPacket() == 0
        mixed = dynamixel_sdk.GroupBulkRead(port, packets)
        assert mixed.addParam(1, 116, 4) and mixed.addParam(2, 65, 1)
        for ask in (mixed.txRxPacket, mixed.fastBulkRead):
            assert ask() == 0
            assert (mixed.getData(1, 116, 4), mixed.getData(2, 65, 1)) == (1992, 1)
        assert packets.regWriteTxRx(port, 1, 116, 4, [8, 8, 0, 0]) == (0, 0)
        assert (read(116, 4), read(69, 1)) == (1992, 1)
        assert packets.action(port, 254) == 0
        assert (read(116, 4), read(69, 1)) == (2056, 0)
        # a gain is lost with the power, a limit is not; a factory reset takes both
        for servo in (1, 2):
            write(64, 1, 0, servo)
        write(84, 2, 99)
        write(48, 4, 3000)
        assert packets.reboot(port, 1) == (0, 0) and packets.clearMultiTurn(port, 1) == (0, 0)
        assert (read(84, 2), read(48, 4)) == (800, 3000)
        assert packets.factoryReset(port, 1, 2) == (0, 0) and read(48, 4) == 4095
        write(7, 1, 9, servo=2)
        write(8, 1, 1, servo=9)
        assert packets.ping(port, 9)[1] != 0, "it hears its new rate only"
        assert port.setBaudRate(57_600)
        assert packets.ping(port, 9)[:2] == (1030, 0) and packets.ping(port, 1)[1] != 0
        port.closePort()


def test_model_numbers_are_those_of_the_vendors_drivers():
    # read in Robotis' ROS driver; 1110 is an XH540, not the XH430-W350
    stated = {1000: "XH430-W350", 1110: "XH540-W150", 1240: "XC330-M288", 1220: "XC330-T288"}
    assert {number: MODELS[number] for number in stated} == stated
