"""The robot's proxy: layouts of its datagrams, faults that only it has, its emulator's quirks."""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator, ProxySocket
from support.damage import damaged
from support.servo_servers import ScriptedProxy, StillBench, on_a_socket
from support.stopwatch import wait_until

IDS = [4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9]
"""Servo ids in the order of the joints (facts/hardware.md D1)."""


def still_proxy() -> ProxyEmulator:
    return ProxyEmulator(StillBench("mini_pupper_2"), np.random.default_rng(0))


@contextmanager
def bus_of(proxy: ProxyEmulator, path: Path) -> Iterator[Esp32Bus]:
    with on_a_socket(proxy, path):
        bus = Esp32Bus(path)
        yield bus
        bus.close()


def counts_reply(counts) -> bytes:
    return bytes([26, 2]) + b"".join(int(c).to_bytes(2, "little") for c in counts)


def answers(request: bytes) -> bytes:
    """A proxy whose servos stand at 501 to 512, with loads of 1 to 12 thousandths."""
    return {
        1: b"\x02\x01",
        2: counts_reply(range(501, 513)),
        3: bytes([26, 3]) + b"".join(bytes([k, 0]) for k in range(1, 13)),
        5: bytes.fromhex("0a 05 00 00 ec 40 00 00 00 3f"),
    }[request[1]]


def test_readings_are_those_of_their_joint_and_a_count_on_which_no_two_answers_agree_is_missing(
    patient_proxy,
):
    third = iter(range(100, 10_000))

    def torn(request: bytes) -> bytes:
        counts = [*range(501, 512), next(third) % 900] if request[1] == 2 else []
        return counts_reply(counts) if counts else answers(request)

    with bus_of(ScriptedProxy(torn), patient_proxy) as bus:
        sample = bus.read()
    count = dict(zip(IDS, sample.position_count.tolist(), strict=True))
    assert count == {i: 500 + i for i in range(1, 12)} | {12: -1}
    assert sample.load is not None and sample.load == pytest.approx(1e-3 * np.array(IDS))
    assert sample.voltage_v is not None and sample.voltage_v.tolist() == [7.375] * 12
    # a left hip turns against its counts, 550 / pi counts to the radian
    assert sample.position_rad[0] == pytest.approx((512 - 504) * np.pi / 550)


# ---- layouts ----


def test_datagrams_are_laid_out_as_documented_and_little_endian():
    """Set-point: 38 bytes, torque then counts by id; questions 2; replies 26, 26 and 10 bytes."""
    packed = esp32.set_position(np.array([True, False] * 6), np.arange(12) + 256)
    assert packed[:2].hex() == "2601" and len(packed) == 38
    assert packed[2:14] == bytes([1, 0] * 6)
    assert packed[14:].hex() == "".join(f"{k:02x}01" for k in range(12))
    assert [esp32.request(op).hex() for op in (2, 3, 4, 5)] == ["0202", "0203", "0204", "0205"]
    counts = esp32.parse_counts(bytes.fromhex("1a02" + "0102" * 12))
    assert counts is not None and counts.tolist() == [0x0201] * 12
    load = esp32.parse_load(bytes.fromhex("1a03" + "18fc" * 6 + "e803" * 6))
    assert load is not None and load.tolist() == [-1.0] * 6 + [1.0] * 6
    # volts as IEEE 754 single: 7.375, the largest that passes, then NaN, infinity and -1
    volts = ("0000ec40", "00003041", "0000c07f", "0000807f", "000080bf")
    supply = [esp32.parse_supply(bytes.fromhex("0a05" + v + "0000003f")) for v in volts]
    assert supply == [7.375, 11.0, None, None, None]


@pytest.mark.parametrize("count", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_damaged_datagrams_raise_nothing(count):
    rng, proxy, counted = np.random.default_rng(0), still_proxy(), 0
    replies = [answers(bytes([2, opcode])) for opcode in (1, 2, 3, 5)]
    requests = [esp32.request(opcode) for opcode in (2, 3, 4, 5)]
    for k in range(count):
        reply = damaged(rng, replies)
        counts = esp32.parse_counts(reply)
        assert counts is None or len(counts) == 12
        counted += counts is not None
        for parse in (esp32.parse_load, esp32.parse_imu, esp32.parse_supply):
            values = parse(reply)
            assert values is None or np.abs(np.nan_to_num(values)).max() <= 2048
        assert proxy.answer(damaged(rng, requests), b"\x02\x01", 1e-3 * k)
    assert counted > count / 100


def test_the_byte_that_stores_a_calibration_is_never_packed_and_only_whole_counts_are():
    tries = [np.full(12, value) for value in range(-1, 257)]
    tries += [np.full(12, 99, kind) for kind in ("u1", "i8", "f4", "f8", "O")]
    tries += [np.full(12, np.nan), np.full(12, np.inf), np.ones(12, bool)]
    tries += [np.array(["99"] * 12), np.eye(12, dtype=int)[0] * 99]
    for count in (0, 99, 256 * 99 % 1024, 355, 1023):
        for on in tries:
            packed = esp32.set_position(on, np.full(12, count))
            assert len(packed) == 38 and set(packed[2:14]) <= {0, 1}
    assert esp32.SAVE_CALIBRATION == 99
    for counts in (np.full(12, -1), np.full(12, 1024), np.full(11, 512)):
        with pytest.raises(ValueError, match="set_position"):
            esp32.set_position(np.ones(12, bool), counts)


# ---- the bus ----


def test_no_write_or_torque_of_the_bus_sends_the_byte_that_stores_a_calibration(patient_proxy):
    proxy = ScriptedProxy(answers)
    rng = np.random.default_rng(3)
    with bus_of(proxy, patient_proxy) as bus:
        for scale in (0.1, 1.0, 10.0, 99.0, 1e9):
            bus.write(scale * rng.standard_normal(12))
            bus.torque(bool(rng.random() < 0.5))
    sent = [r for r in proxy.requests if r[1] == 1]
    assert len(sent) >= 10
    assert all(len(r) == 38 and set(r[2:14]) <= {0, 1} for r in sent)
    words = np.array([np.frombuffer(r[14:], "<u2") for r in sent])
    assert words.max() <= 1023


def test_an_unanswered_question_does_not_make_the_servos_jump_when_they_go_on(patient_proxy):
    lost: list[bytes | None] = [None]

    def answer(request: bytes) -> bytes | None:
        return lost.pop() if request[1] == 2 and lost else answers(request)

    proxy = ScriptedProxy(answer)
    with bus_of(proxy, patient_proxy) as bus:
        assert bus.torque(True)
    on = next(r for r in proxy.requests if r[1] == 1)
    assert np.frombuffer(on[14:], "<u2").tolist() == list(range(501, 513))


def test_nothing_is_sent_while_a_servo_does_not_say_where_it_is(patient_proxy):
    def without_the_last(request: bytes) -> bytes:
        return counts_reply([*range(501, 512), 0]) if request[1] == 2 else answers(request)

    proxy = ScriptedProxy(without_the_last)
    with bus_of(proxy, patient_proxy) as bus:
        assert not bus.torque(True)
    assert all(r[1] != 1 for r in proxy.requests)


@pytest.mark.wall_clock
def test_a_hung_server_costs_a_bounded_time_and_everything_is_missing(proxy_path):
    hung = False
    proxy = ScriptedProxy(lambda request: None if hung else answers(request))
    with bus_of(proxy, proxy_path) as bus:
        hung = True
        took = []
        for _ in range(5):
            start = time.perf_counter()
            sample = bus.read()
            sent = bus.write(np.array([0.0, 0.785, -1.57] * 4))
            took.append(time.perf_counter() - start)
            assert np.isnan(sample.position_rad).all() and np.isnan(sent.time_s)
        hung = False
        assert wait_until(lambda: bool(np.isfinite(bus.read().position_rad).all()))
    # position, load, supply, goals: one time-out each
    assert min(took) < 4 * esp32.TIMEOUT_S + 0.05  # the others on a busy machine


@pytest.mark.wall_clock
def test_an_answer_that_belongs_to_an_earlier_question_is_not_taken(proxy_path, monkeypatch):
    monkeypatch.setattr(esp32, "TIMEOUT_S", 0.05)

    class Late(ScriptedProxy):
        slow = False

        def apply_fault(self, kind, reply):
            return [(0.1, reply)] if self.slow else [(0.0, reply)]

    proxy = Late(answers)
    with bus_of(proxy, proxy_path) as bus:
        proxy.slow = True
        assert np.isnan(bus.read().position_rad).all()
        proxy.slow = False
        time.sleep(0.15)
        proxy.answers = lambda r: counts_reply([700] * 12) if r[1] == 2 else answers(r)
        assert wait_until(lambda: bus.read().position_count.tolist() == [700] * 12)


def test_the_emulator_refuses_a_path_where_a_proxy_lives_or_another_file_stands(
    proxy_path, tmp_path
):
    with on_a_socket(still_proxy(), proxy_path), pytest.raises(InputError, match="already running"):
        ProxySocket(still_proxy(), proxy_path)
    assert not proxy_path.exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="exists and is no socket"):
        ProxySocket(still_proxy(), tmp_path / "file")


# ---- quirks of the real proxy that the emulator has ----


def connect(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.settimeout(3.0)
    client.connect(str(path))
    return client


def test_an_unknown_request_is_answered_with_the_previous_reply(proxy_path):
    with on_a_socket(still_proxy(), proxy_path), connect(proxy_path) as client:
        client.send(bytes.fromhex("0205"))
        power = client.recv(64)
        for unknown in ("0209", "0303", "02", "26010101", "0b02" + "00" * 9):
            client.send(bytes.fromhex(unknown))
            assert client.recv(64) == power and len(power) == 10
