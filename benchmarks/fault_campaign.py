"""Inject thousands of faults into both protocols: is a wrong position ever recorded as good?

An emulated robot swings all its joints behind the real protocol while one kind of fault after the
other is injected, and at last all at once. Every reading that the bus calls good is compared with
what the emulator had honestly measured for that servo during the exchange; everything else must be
marked missing. For faults that last (unplugged, brown-out) the time from their end to the first
good reading of each joint is the recovery.

    .venv/bin/python benchmarks/fault_campaign.py

"frozen" servos answer correctly with a position that does not change, which no bus can detect; the
safety guard does (`tests/hardware/safety/test_guard.py`). Corrupted Feetech frames are bursts over
one or two bytes. Their checksum has 8 bits, so what passes it is bounded by the plausibility check
behind it, not excluded.
"""

from __future__ import annotations

import argparse
import bisect
import time
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from emulators import KINDS, served

from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.connect import open_bus
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.sim.emulator.faults import ANSWER_KINDS, STATE_KINDS, BusFaults

POSE = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])
RATES = {"brown-out": 0.004, "unplugged": 0.004, "frozen": 0.03, "error-bits": 0.03}
SLOW_HOST = "slow-host"
FIRST_S = 0.3


@dataclass
class Tally:
    """What came of one kind of fault."""

    faults: int = 0
    readings: int = 0
    missing: int = 0
    wrong: int = 0
    exceptions: int = 0
    recoveries_s: list[float] = field(default_factory=list)


class Phase:
    """One kind of fault on one bus, until enough of them have been injected."""

    def __init__(self, kind: str, rates: dict[str, float], enough: int, seed: int):
        self.kind, self.rates, self.enough, self.seed = kind, rates, enough, seed
        self.rng = np.random.default_rng([seed, 1])
        self.tally = Tally()

    def run(self, longest_s: float) -> Tally:
        """Swing, inject, compare."""
        tally = self.tally
        faults = BusFaults({}, np.random.default_rng([self.seed, 2]), lasts_s=0.05)
        with served(self.kind, self.seed, faults) as (server, where, _):
            bus = open_bus(parse_address(where))
            self._shift = server.now() - bus.now()
            index = {j: k for k, j in enumerate(bus.joint_names)}
            assert list(index) == list(JOINT_NAMES)
            self._ids = server.emulator.bench.map.ids
            time.sleep(FIRST_S)
            started, good_at = bus.now(), [[] for _ in JOINT_NAMES]
            slow = 0
            while bus.now() - started < longest_s:
                if bus.now() - started > FIRST_S:
                    server.emulator.faults = self._armed(server.emulator.faults)
                if sum(faults.counts.values()) + slow >= self.enough:
                    break
                if self.rates.get(SLOW_HOST) and self.rng.random() < self.rates[SLOW_HOST]:
                    time.sleep(float(self.rng.uniform(0.02, 0.08)))
                    slow += 1
                before = bus.now()
                try:
                    bus.write(POSE + 0.25 * np.sin(2 * np.pi * 1.3 * before + np.arange(12)))
                    asked = bus.now()
                    sample = bus.read()
                except Exception as error:
                    tally.exceptions += 1
                    print("exception:", repr(error))
                    continue
                self._compare(server.emulator, sample, asked, bus.now())
                for k in np.flatnonzero(np.isfinite(sample.position_rad)):
                    good_at[k].append(bus.now())
                bus.sleep_until(before + 0.012)
            ends = [end - self._shift for _, end in faults.ended]
            for at, following in pairwise([*ends, bus.now() - 0.3]):
                back = max(_first_after(g, at) for g in good_at)
                # struck again before it could recover, it is the next one's recovery
                if back < following - faults.lasts_s:
                    tally.recoveries_s.append(back - at)
            tally.faults = sum(faults.counts.values()) + slow
            bus.close()
        return tally

    def _armed(self, faults: BusFaults) -> BusFaults:
        if not faults.rates:
            faults.rates.update({k: r for k, r in self.rates.items() if k != SLOW_HOST})
            faults.__post_init__()
        return faults

    def _compare(self, emulator, sample: BusSample, asked: float, done: float) -> None:
        tally = self.tally
        first, last = asked + self._shift - 0.0005, done + self._shift + 0.0005
        truth = (
            _answers(emulator.readings, first, last)
            if self.kind == "feetech"
            else _blocks(emulator.history, first, last)
        )
        for k, servo in enumerate(self._ids):
            tally.readings += 1
            count = int(sample.position_count[k])
            if count < 0:
                assert np.isnan(sample.position_rad[k]), "missing, but not marked missing"
                tally.missing += 1
            elif count not in truth[servo]:
                tally.wrong += 1


def _answers(readings: list, first: float, last: float) -> dict[int, set[int]]:
    """Counts that each servo measured between two times."""
    found: dict[int, set[int]] = {i: set() for i in range(1, 13)}
    for at, servo, count in reversed(readings):
        if at < first:
            break
        if at <= last:
            found[servo].add(count)
    return found


def _blocks(history: list, first: float, last: float) -> dict[int, set[int]]:
    """Counts that stood in the proxy's block at any time between two times."""
    found: dict[int, set[int]] = {i: set() for i in range(1, 13)}
    start = max(bisect.bisect_right(history, first, key=lambda h: h[0]) - 1, 0)
    for at, block in history[start:]:
        if at > last:
            break
        for servo, count in enumerate(block, 1):
            found[servo].add(count)
    return found


def _first_after(times: list[float], at: float) -> float:
    k = bisect.bisect_left(times, at)
    return times[k] if k < len(times) else np.inf


def main() -> None:
    """Run it, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=500, help="faults of each kind on each bus")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| bus | fault | injected | readings | missing % | wrong but called good | exceptions "
          "| recovery ms: median | worst |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    total = Tally()
    for bus in KINDS:
        kinds = (*ANSWER_KINDS, *STATE_KINDS, SLOW_HOST, "all")
        for number, kind in enumerate(kinds):
            rates = {kind: RATES.get(kind, 0.05)}
            if kind == "all":
                rates = {k: 0.3 * RATES.get(k, 0.05) for k in (*ANSWER_KINDS, *STATE_KINDS)}
            lasting = kind in ("brown-out", "unplugged")
            enough = options.each // 2 if lasting else options.each
            tally = Phase(bus, rates, enough, options.seed + number).run(180.0)
            times = 1e3 * np.array(tally.recoveries_s)
            recovery = f"{np.median(times):.0f} | {times.max():.0f}" if len(times) else "– | –"
            print(
                f"| {bus} | {kind} | {tally.faults} | {tally.readings} "
                f"| {100 * tally.missing / tally.readings:.1f} | {tally.wrong} "
                f"| {tally.exceptions} | {recovery} |",
                flush=True,
            )
            total.faults += tally.faults
            total.readings += tally.readings
            total.wrong += tally.wrong
            total.exceptions += tally.exceptions
    print(
        f"\n{total.faults} faults, {total.readings} readings: {total.wrong} wrong ones called "
        f"good, {total.exceptions} exceptions."
    )


if __name__ == "__main__":
    with real_time_priority():
        main()
