"""Our line and bus have none of the SDK's faults (facts/hardware.md B5, one test per row)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import scservo_sdk
import serial
from scservo_sdk import scservo_def

from pupper_sysid.common.errors import BusError
from pupper_sysid.hardware.feetech import SCS0009, STS3215, FeetechBus, FeetechLine, Frame
from pupper_sysid.hardware.joint_map import JointMap
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.hardware.serial_servos.settings import memory_of
from pupper_sysid.sim.emulator.serial_line import LineEmulator
from support.servo_servers import (
    Scripted,
    StillBench,
    bench_of,
    map_of,
    on_a_port,
    still_servos,
)
from support.stopwatch import wait_until

POSITION = 56
PATIENT_S = 0.4


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """The servos share this process and a busy machine; tests of time put the true one back."""
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", PATIENT_S)


def position(line: FeetechLine, servo: int, series=STS3215) -> int | None:
    reply = line.read(servo, POSITION, 2)
    return series.decode("present_position", reply.frame.data, POSITION) if reply else None


@contextmanager
def line_of(servos: LineEmulator, patience_s: float | None = None) -> Iterator[FeetechLine]:
    with on_a_port(servos) as server:
        line = FeetechLine(server.device, 1_000_000)
        line.patience_s = patience_s or line.patience_s
        yield line
        line.close()


@contextmanager
def bus_of(servos: LineEmulator, *layout: JointMap) -> Iterator[FeetechBus]:
    with on_a_port(servos) as server:
        bus = FeetechBus(server.device, 1_000_000, *layout)
        yield bus
        bus.close()


def raw(servo: int, data: bytes, code: int = 0) -> bytes:
    return Frame(servo, code, data).encode()


# ---- one per row of table B5 ----


def test_b5_1_both_series_in_one_process_are_read_right():
    sts, scs = still_servos(STS3215), still_servos(SCS0009)
    bench_of(sts).counts[1], bench_of(scs).counts[1] = 900, 900
    before = scservo_def.SCS_GETEND()
    try:
        with on_a_port(sts) as little, on_a_port(scs) as big:
            one, other = FeetechLine(little.device, 1_000_000), FeetechLine(big.device, 1_000_000)
            for end in (0, 1):
                scservo_sdk.PacketHandler(end)  # whatever others set in the SDK's global
                assert position(one, 1, STS3215) == 900
                assert position(other, 1, SCS0009) == 900
            one.close()
            other.close()
    finally:
        scservo_def.SCS_SETEND(before)


@pytest.mark.wall_clock
def test_b5_2_a_missing_servo_costs_less_than_10_ms(monkeypatch):
    monkeypatch.undo()  # the product's own patience, not that of these tests

    def cost_s(line: FeetechLine) -> float:
        took = []
        for _ in range(15):
            start = time.perf_counter()
            assert line.read(2, POSITION, 2) is None
            took.append(time.perf_counter() - start)
        return min(took)  # a busy machine makes some last longer, none shorter

    with line_of(still_servos(ids=[1])) as line:
        assert cost_s(line) < 0.010
        line.patience_s = 0.034  # what the SDK adds to every exchange: the limit would show it
        assert cost_s(line) > 0.030


@pytest.mark.wall_clock
def test_b5_3_a_late_reply_is_not_the_answer_to_the_next_read():
    late = iter([0.2])

    def answer(request: Frame) -> list[tuple[float, bytes]]:
        delay = next(late, 0.0)
        return [(delay, raw(1, STS3215.encode("present_position", 900 if delay else 123)))]

    with line_of(Scripted(answer), 0.02) as line:
        assert position(line, 1) is None
        reply = raw(1, STS3215.encode("present_position", 900))
        assert wait_until(lambda: line._port.ser.in_waiting == len(reply))
        line.patience_s = 5.0
        assert position(line, 1) == 123


def test_b5_3_successive_readings_of_the_bus_ask_for_different_lengths():
    servos = still_servos(ids=[4])
    with bus_of(servos, map_of(4)) as bus:
        servos.heard = b""
        for _ in range(7):
            bus.read()
    requests = [servos.heard[k : k + 9] for k in range(0, len(servos.heard), 9)]
    # a sync read of one id: FF FF FE LEN 82 address size id CHK
    assert [r[6] for r in requests] == [6, 7, 8, 9, 10, 11, 6]


def test_b5_4_a_reply_of_another_length_or_of_another_servo_is_no_answer():
    replies = [raw(1, bytes([1] * size)) for size in (0, 1, 3, 8)] + [raw(7, b"\x01\x02")]
    unsent = list(replies)
    with line_of(Scripted(lambda request: [(0.0, unsent.pop(0))]), 0.05) as line:
        assert [line.read(1, POSITION, 2) for _ in replies] == [None] * len(replies)
        assert wait_until(lambda: not unsent)


@pytest.mark.wall_clock
def test_b5_3_late_replies_do_not_shift_the_registers_that_a_recording_keeps():
    """Every first reply comes during the second try, whose own reply comes during the next read."""
    memory = bytes(range(67))
    late = iter([0.12, 0.12] * 20)

    def answer(request: Frame) -> list[tuple[float, bytes]]:
        address, size = request.data
        return [(next(late), raw(1, memory[address : address + size]))]

    with line_of(Scripted(answer), 0.08) as line:
        for _ in range(3):
            assert memory_of(line, 1) in (None, memory)
        line.patience_s = 5.0
        assert memory_of(line, 1) == memory


def test_b5_5_a_silent_servo_in_a_sync_read_is_missing_and_hides_nobody():
    servos = still_servos(ids=[1, 2, 3])
    with line_of(servos) as line:
        assert set(line.sync_read([1, 2, 3], POSITION, 2)) == {1, 2, 3}
        del servos.servos[1]
        bench_of(servos).counts |= {2: 1111, 3: 2222}
        replies = line.sync_read([1, 2, 3], POSITION, 2)
    counts = {
        i: STS3215.decode("present_position", r.frame.data, POSITION) for i, r in replies.items()
    }
    assert counts == {2: 1111, 3: 2222}


def test_b5_6_after_an_error_in_the_port_the_next_calls_work(monkeypatch):
    with line_of(still_servos()) as line:
        first = line._port.ser

        def fails(data):
            raise serial.SerialException("write failed: unplugged")

        monkeypatch.setattr(first, "write", fails)
        assert line.read(1, POSITION, 2) is None
        assert not line._port.is_using
        assert wait_until(lambda: position(line, 1) == 2048)
        assert line._port.ser is not first


def test_b5_7_uneven_sync_write_data_is_refused_and_the_line_goes_on_working():
    with line_of(still_servos()) as line:
        with pytest.raises(ValueError, match=r"1, 2\] bytes; all must be as long"):
            line.sync_write(42, {1: b"\x00\x08", 2: b"\x08"})
        assert position(line, 1) == 2048


def test_b5_9_only_the_requested_baud_rate_is_ever_used_and_closing_twice_is_fine():
    servos = still_servos(baud=500_000)
    with on_a_port(servos) as server:
        line = FeetechLine(server.device, 500_000)
        assert line.answers_ping(1)
        line.close()
        line.close()
        assert not line.answers_ping(1)
    assert servos.bauds == {500_000}


@pytest.mark.parametrize("series", [STS3215, SCS0009])
def test_b5_10_an_echoing_adapter_is_recognised_and_its_echo_is_no_answer(series):
    servos = still_servos(series, ids=range(1, 13), echo=True)
    with bus_of(servos) as bus:
        assert bus.metadata["echo"] is True
        for count in (500, 510):
            bench_of(servos).counts = dict.fromkeys(range(1, 13), count)
            assert bus.write(bus.read().position_rad).time_s > 0
            assert bus.read().position_count.tolist() == [count] * 12
        assert bus.line.answers_ping(1)
        assert not bus.line.answers_ping(99)


def test_b5_11_an_error_byte_above_7f_is_read():
    answer = raw(1, STS3215.encode("present_position", 123), code=0xA1)
    with line_of(Scripted(lambda request: [(0.0, answer)])) as line:
        reply = line.read(1, POSITION, 2)
    assert reply and reply.frame.code == 0xA1


@pytest.mark.wall_clock
def test_b5_13_waiting_does_not_keep_the_processor_busy():
    with line_of(still_servos(ids=[1]), 0.5) as line:
        wall, cpu = time.perf_counter(), time.thread_time()
        assert line.read(2, POSITION, 2) is None
        wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
    assert wall > 0.45 and cpu < 0.3 * wall


# ---- the line beyond the table ----


def test_two_different_answers_of_one_servo_in_a_sync_read_are_none():
    def answer(request: Frame) -> list[tuple[float, bytes]]:
        return [(0.0, raw(1, b"\x01\x02") + raw(1, b"\x03\x04") + raw(2, b"\x05\x06"))]

    with line_of(Scripted(answer)) as line:
        replies = line.sync_read([1, 2], POSITION, 2)
    assert {i: r.frame.data for i, r in replies.items()} == {2: b"\x05\x06"}


def test_servos_that_cannot_be_driven_are_left_alone_and_the_refusal_says_which(monkeypatch):
    def model(*number: int, firmware: int = 3):
        servos = still_servos()
        servos.servos[2].memory[3:5] = bytes(number)
        servos.servos[2].memory[0] = firmware
        return servos

    for servos, joints, patience_s, words in (
        (still_servos(ids=[]), None, 0.003, "no servo answers at 1000000 baud (tried ids 1 to 12"),
        (still_servos(ids=[4]), ["LF_hip", "LF_thigh"], 0.1, "LF_thigh (id 5) does not answer"),
        (
            model(0x39, 5, firmware=8),
            None,
            0.4,
            "servo 2 has the model number 1337, which is not among",
        ),
        # protocol 1 has id and rate (1: a megabaud) where these have their model number
        (model(2, 1, firmware=12), None, 0.4, "servo 2 answers as a Dynamixel with protocol 1"),
        (model(5, 4), None, 0.4, "SCS0009, STS3215) share the line"),
    ):
        monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", patience_s)
        with on_a_port(servos) as server, pytest.raises(BusError) as refused:
            FeetechBus(server.device, 1_000_000, map_of(*range(1, 13)) if joints else None, joints)
        assert words in str(refused.value)
        assert bench_of(servos).goals == []


def test_a_rate_or_an_sdk_that_cannot_work_is_refused_with_the_way_out(monkeypatch, tmp_path):
    nothing = str(tmp_path / "nothing")
    with pytest.raises(BusError, match="76800 baud is not possible with this SDK. Use 1000000"):
        FeetechLine(nothing, 76_800)
    # another SDK of the same import name
    monkeypatch.delattr(scservo_sdk, "PacketHandler")
    with pytest.raises(BusError, match="pip uninstall ftservo-python-sdk"):
        FeetechLine(nothing, 1_000_000)


def test_torque_says_so_when_one_servo_did_not_confirm():
    servos = still_servos()
    with bus_of(servos) as bus:
        bus.line.patience_s = 0.1
        del servos.servos[5]
        assert not bus.torque(False)
    assert {i for i, _ in bench_of(servos).torques} == set(range(1, 13)) - {5}


def test_the_goals_that_stand_in_the_servos_can_be_read():
    servos = still_servos()
    with bus_of(servos) as bus:
        goal = bus.limits.clip(bus.read().position_rad + 0.05)
        bus.write(goal)
        stand = bus.goals()
    assert np.abs(stand - goal).max() <= 0.5001 * 2 * np.pi / 4096


def test_error_bits_come_with_the_reading_and_an_impossible_count_is_none_unless_told_twice():
    servos = still_servos(ids=[4])
    bench: StillBench = bench_of(servos)
    bench.counts[4] = 10
    with bus_of(servos, map_of(4)) as bus:
        assert bus.read().position_count.tolist() == [10]
        bench.counts[4] = 4090
        counts = [int(bus.read().position_count[0]) for _ in range(2)]
        servos.servos[4].error, servos.servos[4].faulty_until = 33, np.inf
        sample = bus.read()
    # 4080 counts are 6.3 rad, and no servo turns them within the milliseconds between two reads
    assert counts == [-1, 4090]
    assert sample.status is not None and sample.status.tolist() == [33]
    assert np.isfinite(sample.position_rad).all()
