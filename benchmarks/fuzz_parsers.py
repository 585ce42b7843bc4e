"""Throw garbage at every parser, and let a second, simpler reading of the bytes judge what it took.

Good frames are flipped, cut, stretched, doubled and spliced, and mixed with noise. A parser must
not raise, must not hang, and must not accept what the judge does not find in the bytes or what is
out of range. The judges know the protocols' layouts and share no code with the parsers. Exits
with 1 if anything was wrong.

    .venv/bin/python benchmarks/fuzz_parsers.py --frames 1000000 --seed 0
"""

from __future__ import annotations

import argparse
import math
import random
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pupper_sysid.hardware.esp32 import datagrams
from pupper_sysid.hardware.feetech.frames import Frame, FrameReader
from pupper_sysid.hardware.feetech.registers import SCS0009, STS3215, Series
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sim.emulator.servos.bench import ServoBench

SERVOS = range(1, 13)
MEMORY = 80
LONGEST = 256
REAL_PHYSICS_SHARE = 20

Found = tuple[int, int, bytes]
"""Id, code, parameters: a frame as the judge sees it."""


@dataclass
class Tally:
    """What one parser did."""

    parser: str
    hang_s: float
    frames: int = 0
    accepted: int = 0
    exceptions: int = 0
    hangs: int = 0
    slowest_s: float = 0.0
    slowest_cpu_s: float = 0.0
    wrong: int = 0
    missed: int = 0

    def row(self) -> str:
        """As a line of the table."""
        return (
            f"| {self.parser} | {self.frames} | {self.accepted} | {self.exceptions} | "
            f"{self.hangs} | {1e3 * self.slowest_s:.2f} | {1e3 * self.slowest_cpu_s:.2f} | "
            f"{self.wrong} | {self.missed} |"
        )

    @property
    def clean(self) -> bool:
        """Whether nothing went wrong."""
        return not (self.exceptions or self.hangs or self.wrong or self.missed)


def mutated(rng: random.Random, good: Callable[[], bytes]) -> tuple[str, bytes]:
    """What arrives instead of a good frame, and how it came about."""
    kind = rng.choice(_MUTATIONS)
    frame = good()
    if kind == "flipped":
        spoiled = bytearray(frame)
        for _ in range(rng.choice((1, 1, 2, 5))):
            spoiled[rng.randrange(len(spoiled))] ^= 1 << rng.randrange(8)
        return kind, bytes(spoiled)
    if kind == "replaced":
        spoiled = bytearray(frame)
        spoiled[rng.randrange(len(spoiled))] = rng.choice((0, 1, 2, 254, 255, rng.randrange(256)))
        return kind, bytes(spoiled)
    if kind == "truncated":
        return kind, frame[: rng.randrange(len(frame))]
    if kind == "headless":
        return kind, frame[rng.randrange(1, len(frame) + 1) :]
    if kind == "inserted":
        at = rng.randrange(len(frame) + 1)
        return kind, frame[:at] + noise(rng, 4) + frame[at:]
    if kind == "doubled":
        return kind, frame + frame
    if kind == "spliced":
        other = good()
        return kind, frame[: rng.randrange(len(frame))] + other[rng.randrange(len(other)) :]
    if kind == "joined":
        return kind, frame[: rng.randrange(len(frame))] + good()
    if kind == "surrounded":
        return kind, noise(rng, 12) + frame + noise(rng, 12)
    if kind == "noise":
        return kind, noise(rng, 60)
    return kind, frame


_MUTATIONS = (
    "intact", "flipped", "flipped", "replaced", "truncated", "headless", "inserted", "doubled",
    "spliced", "joined", "surrounded", "noise",
)  # fmt: skip


def noise(rng: random.Random, longest: int) -> bytes:
    """Random bytes; half the time those that look like headers, ids and lengths."""
    size = rng.randrange(longest + 1)
    if rng.random() < 0.5:
        return rng.randbytes(size)
    return bytes(rng.choices((255, 255, 255, 0, 1, 2, 3, 4, 8, 12, 253, 254), k=size))


def placed_frames(stream: bytes) -> Iterator[tuple[int, int, Found]]:
    """Judge: every place in the bytes at which a whole frame stands, overlapping ones too."""
    at = stream.find(b"\xff\xff")
    while at >= 0:
        rest = stream[at + 2 : at + 2 + LONGEST]
        if len(rest) > 3 and rest[0] < 255 and 2 <= rest[1] <= len(rest) - 2:
            whole = rest[: rest[1] + 2]
            # the checksum makes the sum of everything behind the header 255
            if sum(whole) % 256 == 255:
                yield at, at + 2 + len(whole), (whole[0], whole[2], whole[3:-1])
        at = stream.find(b"\xff\xff", at + 1)


def fuzz_replies(tally: Tally, frames: int, rng: random.Random) -> None:
    """`FrameReader` as `FeetechLine` uses it: answers of those who were asked, as long as asked."""
    for _ in range(frames):
        size = rng.choice((0, 1, 2, 8, 9, 10, 11, 16))
        wanted = set(SERVOS) if rng.random() < 0.5 else {rng.randrange(1, 13)}
        error = rng.choice((0, 0, 0, 1, 32, 255))

        def good(size=size, wanted=wanted, error=error) -> bytes:
            stranger = rng.random() < 0.1
            frame_id = rng.randrange(254) if stranger else rng.choice(sorted(wanted))
            wrong = rng.random() < 0.1
            data = rng.randbytes(rng.randrange(20) if wrong else size)
            return Frame(frame_id, error, data).encode()

        kind, data = mutated(rng, good)
        taken: list[Frame] = []

        def parse(data=data, size=size, wanted=wanted, taken=taken) -> None:
            reader = FrameReader(lambda frame_id, length: frame_id in wanted and length == size + 2)
            # a serial port hands the bytes over in pieces
            cut = rng.randrange(len(data) + 1)
            taken += reader.feed(data[:cut])
            taken += reader.feed(data[cut:])

        if not _timed(tally, parse):
            continue
        there = Counter(found for _, _, found in placed_frames(data))
        tally.accepted += len(taken)
        for frame in taken:
            found = (frame.id, frame.code, frame.data)
            there[found] -= 1
            asked = frame.id in wanted and len(frame.data) == size
            tally.wrong += not asked or there[found] < 0
        if kind == "intact" and not taken:
            tally.missed += any(f[0] in wanted and len(f[2]) == size for f in there)


def fuzz_stream(tally: Tally, frames: int, rng: random.Random) -> None:
    """`FrameReader` as the emulator reads requests: one endless stream, every id and length."""
    reader, judge = FrameReader(), _StreamJudge()
    for _ in range(frames):
        _, data = mutated(rng, lambda: _feetech_request(rng))
        taken: list[Frame] = []
        if not _timed(tally, lambda data=data, taken=taken: taken.extend(reader.feed(data))):
            reader.reset()
            judge = _StreamJudge()
            continue
        judge.hear(data)
        tally.accepted += len(taken)
        tally.wrong += sum(not judge.has((f.id, f.code, f.data)) for f in taken)


def fuzz_feetech(
    tally: Tally, frames: int, rng: random.Random, series: Series, physics: bool = False
) -> None:
    """`FeetechEmulator.receive`: what it obeys, what it answers, which goals reach the servos."""
    now, emulator, judge = 0.0, _feetech_emulator(series, physics), _StreamJudge()
    for _ in range(frames):
        _, data = mutated(rng, lambda: _feetech_request(rng))
        now += rng.choice((1e-4, 2e-3))
        emulator.obeyed.clear()
        if not _timed(tally, partial(emulator.receive, data, now)):
            emulator, judge, now = _feetech_emulator(series, physics), _StreamJudge(), 0.0
            continue
        judge.hear(data)
        tally.accepted += len(emulator.obeyed)
        for frame, pieces, goals in emulator.obeyed:
            found = (frame.id, frame.code, frame.data)
            right = judge.has(found) and _rightly_answered(found, pieces, series)
            tally.wrong += not (right and _rightly_moved(found, goals))


def fuzz_datagram_parser(
    tally: Tally, frames: int, rng: random.Random, parse: Callable, judge: Callable
) -> None:
    """A parser of the proxy's replies against the plainest reading of the same bytes."""
    for _ in range(frames):
        kind, data = mutated(rng, lambda: _proxy_reply(rng))
        box: list = []
        if not _timed(tally, lambda data=data, box=box: box.append(parse(data))):
            continue
        expected = judge(data)
        if box[0] is None:
            tally.missed += kind == "intact" and expected is not None
            continue
        tally.accepted += 1
        tally.wrong += expected is None or not _same(box[0], expected)


def fuzz_proxy(tally: Tally, frames: int, rng: random.Random, physics: bool = False) -> None:
    """`ProxyEmulator.answer`: replies, and the goals that reach the servos."""
    now, previous, deaf_until, offsets = 0.0, b"", -math.inf, [0] * 12
    emulator, moves = _proxy_emulator(physics)
    for _ in range(frames):
        _, data = mutated(rng, lambda: _proxy_request(rng))
        data = data[:38]  # the real one's buffer ends there
        now += rng.choice((1e-3, 2e-2))
        moves.clear()
        box: list[bytes] = []
        before = previous

        def answer(emulator=emulator, data=data, before=before, now=now, box=box) -> None:
            box.append(emulator.answer(data, before, now))

        if not _timed(tally, answer):
            (emulator, moves), now, previous = _proxy_emulator(physics), 0.0, b""
            deaf_until, offsets = -math.inf, [0] * 12
            continue
        previous = box[0]
        setpoint = len(data) == 38 and data[:2] == b"\x26\x01"
        if setpoint and data[2] == 99:
            deaf_until = now + 4.0
            expected = [("torque", s, 0) for s in SERVOS]
            offsets = [
                sorted((-512, o + 512 - c, 511))[1]
                for o, c in zip(offsets, _words(data[14:]), strict=True)
            ]
        elif setpoint and now >= deaf_until:
            expected = list(_setpoint_effects(data, offsets))
        else:
            expected = []
        question = len(data) == 2 and data[0] == 2 and data[1] in (2, 3, 4, 5)
        tally.accepted += setpoint or question
        right = sorted(moves) == sorted(expected)
        if setpoint:
            right &= previous == b"\x02\x01"
        elif question:
            right &= len(previous) == {2: 26, 3: 26, 4: 26, 5: 10}[data[1]]
            right &= previous[:2] == bytes([len(previous), data[1]])
        else:
            right &= previous == before if before else len(previous) == 2
        tally.wrong += not right


def main() -> int:
    """Print one table; 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=1_000_000, help="per parser")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="parsers with this in their name")
    parser.add_argument("--hang-s", type=float, default=0.1, help="a frame that takes longer hangs")
    chosen = parser.parse_args()
    n, few = chosen.frames, max(chosen.frames // REAL_PHYSICS_SHARE, 1)
    parsers = {
        "parse_counts": (datagrams.parse_counts, _judge_counts),
        "parse_load": (datagrams.parse_load, _judge_load),
        "parse_power": (datagrams.parse_power, _judge_power),
    }
    jobs: dict[str, Callable[[Tally, random.Random], None]] = {
        "FrameReader, replies": lambda t, rng: fuzz_replies(t, n, rng),
        "FrameReader, requests": lambda t, rng: fuzz_stream(t, n, rng),
        "FeetechEmulator.receive, STS3215": lambda t, rng: fuzz_feetech(t, n, rng, STS3215),
        "FeetechEmulator.receive, SCS0009": lambda t, rng: fuzz_feetech(t, n, rng, SCS0009),
        "FeetechEmulator.receive, real physics": (
            lambda t, rng: fuzz_feetech(t, few, rng, STS3215, physics=True)
        ),
        **{
            f"esp32_datagrams.{name}": (
                lambda t, rng, pair=pair: fuzz_datagram_parser(t, n, rng, *pair)
            )
            for name, pair in parsers.items()
        },
        "ProxyEmulator.answer": lambda t, rng: fuzz_proxy(t, n, rng),
        "ProxyEmulator.answer, real physics": (
            lambda t, rng: fuzz_proxy(t, few, rng, physics=True)
        ),
    }
    print("| parser | frames | accepted | exceptions | hangs | slowest frame ms | slowest CPU ms | "
          "wrong accepts | intact frames missed |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    clean = True
    for name, job in jobs.items():
        if chosen.only not in name:
            continue
        tally = Tally(name, chosen.hang_s)
        job(tally, random.Random(f"{chosen.seed} {name}"))
        print(tally.row(), flush=True)
        clean &= tally.clean
    return 0 if clean else 1


def _timed(tally: Tally, call: Callable[[], object]) -> bool:
    """Call; whether it came back without an exception. The first ones are shown."""
    tally.frames += 1
    start, cpu = time.perf_counter(), time.thread_time()
    try:
        call()
    except Exception:
        tally.exceptions += 1
        if tally.exceptions <= 3:
            traceback.print_exc(file=sys.stderr)
        return False
    cpu, took = time.thread_time() - cpu, time.perf_counter() - start
    tally.slowest_s, tally.slowest_cpu_s = max(tally.slowest_s, took), max(tally.slowest_cpu_s, cpu)
    # no parser waits for anything, so what a busy machine takes for others does not count
    tally.hangs += cpu > tally.hang_s
    return True


class _StreamJudge:
    """The frames that stand in a stream and have not been taken yet."""

    def __init__(self):
        self._tail, self._start = b"", 0
        self._there: list[tuple[int, int, Found]] = []

    def hear(self, data: bytes) -> None:
        """Bytes that came."""
        known = self._start + len(self._tail)
        stream = self._tail + data
        for begin, end, found in placed_frames(stream):
            if self._start + end > known:
                self._there.append((self._start + begin, self._start + end, found))
        end = self._start + len(stream)
        self._tail = stream[-LONGEST:]
        self._start = end - len(self._tail)
        # no reader can hold back more than one frame
        self._there = [f for f in self._there if f[1] > end - len(data) - LONGEST]

    def has(self, found: Found) -> bool:
        """Whether it stands behind all that was taken; takes it."""
        for begin, end, frame in self._there:
            if frame == found:
                self._there = [f for f in self._there if f[0] >= end or f[0] < begin]
                return True
        return False


class _WatchedServos(ServoBench):
    """A bench that writes down what it is told; without physics it stands still."""

    def __init__(self, physics: bool, layout: str, series_spec: RobotSpec):
        rng = np.random.default_rng(0)
        super().__init__(
            draw_robot(rng, series_spec), load_joint_map(layout), rng, keep_log=False
        )  # fmt: skip
        self.physics, self.moves = physics, []
        self.id_of_index = {k: i for i, k in self.index_of_id.items()}

    def command(self, index: int, time_s: float, count: int) -> None:
        self.moves.append(("goal", self.id_of_index[index], int(count)))
        if self.physics:
            super().command(index, time_s, count)

    def torque(self, index: int, time_s: float, on: bool) -> None:
        self.moves.append(("torque", self.id_of_index[index], int(on)))
        if self.physics:
            super().torque(index, time_s, on)

    def count(self, index: int, time_s: float) -> int:
        return super().count(index, time_s) if self.physics else 500 + index

    def load(self, index: int) -> int:
        return super().load(index) if self.physics else 10 * index - 50


class _WatchedEmulator(FeetechEmulator):
    """Writes down each frame it obeys, with the answers and the goals that came of it."""

    obeyed: list[tuple[Frame, list[tuple[float, bytes]], list[tuple[str, int, int, int, int]]]]

    def _execute(self, frame: Frame, byte_s: float) -> list[tuple[float, bytes]]:
        assert isinstance(self.bench, _WatchedServos)
        self.bench.moves.clear()
        low = {i: self._limits(i) for i in self.servos} if frame.code in (3, 0x83) else {}
        pieces = super()._execute(frame, byte_s)
        high = {i: self._limits(i) for i in low}
        goals = [
            (what, i, value, min(low[i][0], high[i][0]), max(low[i][1], high[i][1]))
            for what, i, value in self.bench.moves
        ]
        self.obeyed.append((frame, pieces, goals))
        return pieces

    def _limits(self, servo: int) -> tuple[int, int]:
        order = "big" if self.series.big_endian else "little"
        memory = self.servos[servo].memory
        low, high = (int.from_bytes(memory[a : a + 2], order) for a in (9, 11))
        return min(low, high), max(low, high)


def _feetech_emulator(series: Series, physics: bool) -> _WatchedEmulator:
    layout = {"STS3215": "sts3215", "SCS0009": "mini_pupper_2_direct"}[series.name]
    spec = RobotSpec(poll_period_s=0.0, loss=0.0, quantum_rad=0.0)
    bench = _WatchedServos(physics, layout, spec)
    emulator = _WatchedEmulator(bench, series, np.random.default_rng(1))
    emulator.obeyed = []
    return emulator


def _proxy_emulator(physics: bool) -> tuple[ProxyEmulator, list[tuple[str, int, int]]]:
    bench = _WatchedServos(physics, "mini_pupper_2", RobotSpec())
    return ProxyEmulator(bench, np.random.default_rng(1)), bench.moves


def _feetech_request(rng: random.Random) -> bytes:
    """Any request a host may send, and some that none should."""
    servo, code = rng.randrange(1, 14), rng.choice((1, 2, 2, 3, 3, 4, 5, 6, 0x82, 0x83, 0x83, 7))
    address = rng.choice((0, 3, 9, 11, 40, 42, 42, 42, 44, 48, 56, 56, 60, 79, rng.randrange(256)))
    if code == 2:
        params = bytes([address, rng.choice((1, 2, 6, 8, 16, rng.randrange(256)))])
    elif code in (3, 4):
        params = bytes([address]) + rng.randbytes(rng.choice((0, 1, 2, 6)))
    elif code == 0x82:
        ids = rng.sample(range(1, 20), rng.randrange(13))
        params = bytes([address, rng.choice((2, 8, rng.randrange(256))), *ids])
    elif code == 0x83:
        size = rng.choice((1, 2, 2, 6))
        ids = rng.sample(range(1, 20), rng.randrange(13))
        params = bytes([address, size]) + b"".join(bytes([i]) + rng.randbytes(size) for i in ids)
    else:
        params = rng.randbytes(rng.choice((0, 0, 0, 3)))
    if code in (0x82, 0x83) or rng.random() < 0.05:
        servo = 254
    return Frame(servo, code, params).encode()


def _rightly_answered(found: Found, pieces: list[tuple[float, bytes]], series: Series) -> bool:
    """Judge: who may answer this request, and with how many bytes."""
    servo, code, params = found
    size, answering = 0, [servo]
    if code == 0x82 and series.name == "STS3215" and len(params) > 2:
        size, answering = _readable(params[0], params[1]), list(params[2:])
    elif servo == 254:
        answering = []
    elif code == 2 and len(params) == 2:
        size = _readable(params[0], params[1])
    elif not (code == 1 or (code == 3 and len(params) > 1)):
        answering = []
    answering = [i for i in answering if i in SERVOS]
    heard = [[f for _, _, f in placed_frames(piece)][:1] for _, piece in pieces]
    return [(f[0][0], f[0][1], len(f[0][2])) for f in heard if f] == [
        (i, 0, size) for i in answering
    ] and len(pieces) == len(answering)


def _readable(address: int, size: int) -> int:
    return max(min(size, MEMORY - address), 0)


def _rightly_moved(found: Found, goals: list[tuple[str, int, int, int, int]]) -> bool:
    """Judge: only writes to a servo's torque or goal may move it, and only within its limits."""
    servo, code, params = found
    writes: dict[int, set[int]] = {}
    if code == 3 and servo in SERVOS and len(params) > 1:
        writes[servo] = set(range(params[0], params[0] + len(params) - 1))
    elif code == 0x83 and len(params) > 2:
        step = params[1] + 1
        for k in range(2, len(params), step):
            writes.setdefault(params[k], set()).update(range(params[0], params[0] + params[1]))
    for what, i, value, low, high in goals:
        touched = writes.get(i, set())
        if not touched & ({42, 43, 40} if what == "torque" else {42, 43}):
            return False
        if what == "goal" and not low <= value <= high:
            return False
    return True


def _proxy_reply(rng: random.Random) -> bytes:
    opcode = rng.choice((1, 2, 2, 3, 3, 4, 5, 5))
    if opcode == 1:
        return b"\x02\x01"
    if opcode == 5:
        volts = rng.choice((7.4, 0.0, -1.0, 11.5, math.nan, math.inf, 1e-40))
        amperes = rng.choice((0.4, 0.0, -2.0, 20.0, math.nan))
        return b"\x0a\x05" + np.array([volts, amperes], "<f4").tobytes()
    words = rng.choices((0, 1, 512, 1000, 1023, 1024, 1030, 1031, 40_000, 64_506, 65_535), k=12)
    return bytes([26, opcode]) + np.array(words, "<u2").tobytes()


def _proxy_request(rng: random.Random) -> bytes:
    if rng.random() < 0.5:
        return bytes([2, rng.choice((2, 3, 4, 5, 6, rng.randrange(256)))])
    torque: list[int] = rng.choices((1, 1, 1, 0, 2, 255), k=12)
    counts = rng.choices((0, 1, 512, 1023, 1024, 65_535, rng.randrange(1024)), k=12)
    if rng.random() < 0.01:
        torque[0] = 99
        # small corrections, or soon every goal would lie beyond the ends
        counts = rng.choices(range(502, 523), k=12)
    return bytes([38, 1, *torque]) + np.array(counts, "<u2").tobytes()


def _setpoint_effects(data: bytes, offsets: list[int]) -> Iterator[tuple[str, int, int]]:
    """Judge: what a setpoint does, servo by servo, behind the stored calibration."""
    for servo, count, offset in zip(SERVOS, _words(data[14:]), offsets, strict=True):
        on = data[1 + servo]
        if on < 2:
            yield "torque", servo, on
        if on == 1:
            yield "goal", servo, sorted((0, count - offset, 1023))[1]


def _judge_words(data: bytes, opcode: int) -> list[int] | None:
    if data[:2] != bytes([26, opcode]) or len(data) != 26:
        return None
    return _words(data[2:])


def _words(data: bytes) -> list[int]:
    return [low + 256 * high for low, high in zip(data[::2], data[1::2], strict=True)]


def _judge_counts(data: bytes) -> Sequence[float] | None:
    words = _judge_words(data, 2)
    return words and [w if 1 <= w <= 1023 else -1 for w in words]


def _judge_load(data: bytes) -> Sequence[float] | None:
    words = _judge_words(data, 3)
    signed = words and [w - 65_536 if w > 32_767 else w for w in words]
    return signed and [w / 1000 if -1030 <= w <= 1030 else math.nan for w in signed]


def _judge_power(data: bytes) -> Sequence[float] | None:
    if data[:2] != b"\x0a\x05" or len(data) != 10:
        return None
    volts, amperes = (float(x) for x in np.frombuffer(data[2:], "<f4"))
    return [volts, amperes] if 0 <= volts <= 11 and -1 <= amperes <= 14 else None


def _same(parsed: datagrams.Power | Iterable[float], expected: Sequence[float]) -> bool:
    values = [parsed.voltage_v, parsed.current_a] if isinstance(parsed, datagrams.Power) else parsed
    return all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(values, expected, strict=True)
    )


if __name__ == "__main__":
    sys.exit(main())
