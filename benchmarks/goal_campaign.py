"""Hostile sequences of goals through guard, bus and protocol: what do the servos get?

    .venv/bin/python benchmarks/goal_campaign.py --each 5 --seed 0

Twenty kinds of goals that no sane driver sends, each several times with random numbers of its own,
go through the guard to emulated servos behind each real protocol. Checked is what the servos
receive: whether a goal is outside the joints' limits (torque-on apart, which holds a joint where it
is found), whether the first one after torque-on jumps,
whether one after a pause of more than 0.1 s moves by more than 0.16 rad (8 rad/s over one tick of
20 ms), and by how much a joint gains on 8 rad/s over any stretch of the sequence. A sequence that
the guard ends is not gone on with.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from emulators import KINDS, hurry, served
from numpy.typing import NDArray

from pupper_sysid.common.errors import PupperError
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.safety.guard import GuardedBus

Goal = NDArray[np.float64]
POSE = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])
GOALS, JOINTS = 40, len(JOINT_NAMES)
SPEED_RAD_S, FIRST_RAD, PAUSE_S, AFTER_PAUSE_RAD = 8.0, 0.15, 0.1, 0.16
STRETCH_S = 0.1
"""Travel that a late tick may add to 8 rad/s [s]: ticks of 60 ms, one and a half of them."""


def _often(draw: Callable[[np.random.Generator, int], object], tick_s: float = 0.01):
    """A sequence of goals at a steady rate."""

    def sequence(rng: np.random.Generator) -> Iterator[tuple[object, float]]:
        for k in range(GOALS):
            yield draw(rng, k), tick_s

    return sequence


def _paused(draw: Callable[[np.random.Generator, int], object], pause_s: Callable):
    """A sequence of goals with pauses in between."""

    def sequence(rng: np.random.Generator) -> Iterator[tuple[object, float]]:
        for k in range(GOALS // 2):
            yield draw(rng, k), float(pause_s(rng, k))

    return sequence


def far(rng: np.random.Generator, k: int) -> Goal:
    """Anywhere, also far outside."""
    return rng.uniform(-7, 7, JOINTS)


def sides(rng: np.random.Generator, k: int) -> Goal:
    """From one end to the other."""
    return np.full(JOINTS, 3.0 if k % 2 else -3.0)


def one_joint(rng: np.random.Generator, k: int) -> Goal:
    """One joint to an end, the others at rest."""
    goal = POSE.copy()
    goal[rng.integers(JOINTS)] += rng.choice([-2.0, 2.0])
    return goal


def corners(rng: np.random.Generator, k: int) -> Goal:
    """Thigh and calf, which share a push rod, in opposite corners."""
    goal = POSE.copy()
    goal[1::3], goal[2::3] = rng.choice([-2.0, 2.0], 4), rng.choice([-3.0, 3.0], 4)
    return goal


def _with(value: float) -> Callable[[np.random.Generator, int], Goal]:
    """Now and then this number at one joint."""

    def draw(rng: np.random.Generator, k: int) -> Goal:
        goal = POSE + rng.uniform(-0.2, 0.2, JOINTS)
        if k % 3 == 2:
            goal[rng.integers(JOINTS)] = value
        return goal

    return draw


def creep(rng: np.random.Generator, k: int) -> Goal:
    """Outwards by a little more each time."""
    return POSE + 0.08 * k


def chirp(rng: np.random.Generator, k: int) -> Goal:
    """A swing that becomes faster."""
    return POSE + 0.5 * np.sin(0.02 * k * k)


MISSHAPEN = (np.zeros(11), np.zeros(13), np.zeros((12, 2)), np.float64(0.3), [], np.zeros((0, 12)))
SEQUENCES = {
    "anywhere, 100 Hz": _often(far),
    "anywhere, no pause at all": _often(far, 0.0),
    "anywhere, 16 Hz": _often(far, 0.06),
    "end to end, 100 Hz": _often(sides),
    "end to end, no pause at all": _often(sides, 0.0),
    "end to end after pauses of 0.15 s": _paused(sides, lambda rng, k: 0.15),
    "end to end after pauses of 99 ms": _paused(sides, lambda rng, k: 0.099),
    "anywhere after random pauses": _paused(far, lambda rng, k: rng.exponential(0.05)),
    "bursts of eight, then 0.2 s": _paused(far, lambda rng, k: 0.2 if k % 8 == 7 else 0.0),
    "a slow rate, then bursts": _paused(sides, lambda rng, k: 0.06 if k < 10 else 0.001),
    "one joint to an end": _often(one_joint),
    "thigh and calf in opposite corners": _often(corners),
    "creeping outwards": _often(creep),
    "a swing that becomes faster": _often(chirp),
    "not a number": _often(_with(np.nan)),
    "infinite": _often(_with(np.inf)),
    "1e300": _often(_with(1e300)),
    "-1e18": _often(_with(-1e18)),
    "too few, too many, none": _often(lambda rng, k: MISSHAPEN[k % len(MISSHAPEN)]),
    "torque off and on in between": _often(far),
}
SWITCHED = "torque off and on in between"


@dataclass
class Tally:
    """What the servos got of one kind of sequence."""

    runs: int = 0
    goals: int = 0
    refused: int = 0
    outside: int = 0
    jumped: int = 0
    first_rad: float = 0.0
    paused_rad: float = 0.0
    gained_rad: float = 0.0
    others: int = 0
    """Exceptions that are not the project's own."""


def run(bus: GuardedBus, bench, kind: str, rng: np.random.Generator, tally: Tally) -> None:
    """Send one sequence, and check what arrived."""
    tally.runs += 1
    begin, held = len(bench.commands), set()
    found = bus.read().position_rad

    def switch_on() -> None:
        before = len(bench.commands)
        bus.torque(True)
        held.update(range(before - begin, len(bench.commands) - begin))

    try:
        for _ in range(50):
            if np.isfinite(found).all():
                break
            time.sleep(0.02)
            found = bus.read().position_rad
        switch_on()
        for number, (goal, pause_s) in enumerate(SEQUENCES[kind](rng)):
            try:
                if number == 0:  # a first goal that is far is refused, and ends the sequence
                    bus.write(found if rng.random() < 0.8 else found + rng.uniform(-1, 1, JOINTS))
                if kind == SWITCHED and number % 10 == 9:
                    bus.torque(False)
                    time.sleep(0.02)
                    switch_on()
                bus.write(goal)  # type: ignore[arg-type]
            except PupperError as error:
                tally.refused += 1
                if not _goes_on(error):
                    break
            if number % 4 == 0:
                bus.read()
            bus.sleep_until(bus.now() + pause_s)
    except PupperError:
        tally.refused += 1
    except Exception as error:
        tally.others += 1
        print(f"{kind}: {error!r}", file=sys.stderr)
    finally:
        bus.limp()
        bus.limp()
    check(bus, bench, bench.commands[begin:], found, held, kind == SWITCHED, tally)


def opened(where: str) -> GuardedBus:
    """The bus, once all servos have answered it on a busy machine."""
    while True:
        bus = GuardedBus(open_bus(parse_address(where)))
        if len(bus.joint_names) == JOINTS:
            return bus
        bus.close()


def _goes_on(error: PupperError) -> bool:
    """Whether a driver may go on after this refusal."""
    return type(error).__name__ == "BusError"


def check(
    bus: GuardedBus,
    bench,
    commands: list,
    found: Goal,
    held: set[int],
    switched: bool,
    tally: Tally,
) -> None:
    """Compare what the servos received with what they may.

    `held` are the goals of torque-on, which holds a joint where it is; `switched`: it was switched
    off and on in between.
    """
    tally.goals += len(commands)
    scale, quantum = bench.map.counts_per_rad(), 2 / bench.map.counts_per_rad().min()
    for k in range(JOINTS):
        own = [(t, c, n not in held) for n, (t, index, c) in enumerate(commands) if index == k]
        if not own:
            continue
        times, counts, sent = (np.array(values, float) for values in zip(*own, strict=True))
        row = np.tile(bench.map.rest_pose(), (len(own), 1))
        row[:, k] = bench.map.to_angles(np.tile(counts[:, None], (1, JOINTS)))[:, k]
        here = found[k] if np.isfinite(found[k]) else row[0, k]
        low, high = bus.limits.low_rad[k] - quantum, bus.limits.high_rad[k] + quantum
        tally.outside += int((((row[:, k] < low) | (row[:, k] > high)) & (sent > 0)).sum())
        angle = counts / scale[k]
        moved, dt = np.abs(np.diff(angle)), np.diff(times)
        tally.first_rad = max(tally.first_rad, abs(row[0, k] - here))
        # a torque that was off in between begins anew where the joint is
        paused = moved[(dt > PAUSE_S + 0.01) & (not switched)]
        tally.paused_rad = max(tally.paused_rad, paused.max(initial=0.0))
        late = np.abs(angle[:, None] - angle) - SPEED_RAD_S * np.abs(times[:, None] - times)
        tally.gained_rad = max(tally.gained_rad, float(late.max()))
        tally.jumped += int((paused > AFTER_PAUSE_RAD + quantum).sum())
        tally.jumped += int(late.max() > SPEED_RAD_S * STRETCH_S + quantum)
        tally.jumped += int(abs(row[0, k] - here) > FIRST_RAD + quantum)


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description="Hostile sequences of goals.")
    parser.add_argument("--each", type=int, default=5, help="sequences of each kind on each bus")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| bus | sequence | runs | goals received | refused | outside limits | jumps "
          "| first rad: worst | after a pause rad: worst | gained on 8 rad/s rad: worst "
          "| other errors |")  # fmt: skip
    print("|" + "---|" * 11)
    wrong = runs = 0
    for kind in KINDS:
        for number, name in enumerate(SEQUENCES):
            tally = Tally()
            for repeat in range(options.each):
                rng = np.random.default_rng([options.seed, number, repeat])
                # another robot each time: a limp leg may have swung out of its limits
                with served(kind, int(rng.integers(1 << 30))) as (server, where, _):
                    hurry()
                    bus = opened(where)
                    try:
                        run(bus, server.emulator.bench, name, rng, tally)
                    finally:
                        bus.close()
            wrong += tally.outside + tally.jumped + tally.others
            runs += tally.runs
            print(
                f"| {kind} | {name} | {tally.runs} | {tally.goals} | {tally.refused} "
                f"| {tally.outside} | {tally.jumped} | {tally.first_rad:.3f} "
                f"| {tally.paused_rad:.3f} | {tally.gained_rad:.3f} | {tally.others} |",
                flush=True,
            )
    load = " ".join(f"{x:.1f}" for x in os.getloadavg())
    print(f"\n{runs} sequences: {wrong} goals that should not have passed, or errors of another "
          f"kind. Load of the machine: {load}.")  # fmt: skip
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
