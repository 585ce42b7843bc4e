"""Coverage of the 90 % intervals of poll period, loss and mean feedback age.

Random servos (those of `benchmarks/lattice_slips.py`) under four to six tones, behind the
emulator's own poll schedule: periods of 5–100 ms, losses of 0–0.6, jitter to 1.5 ms, a round whose
length wanders by up to 0.4 %, quantisation to 6 mrad, noise to 4 mrad; in one trial of ten the
phase slips. Loops are 1.1 to 4 times faster than the poll. No MuJoCo: a second per recording.

    .venv/bin/python benchmarks/poll_intervals.py --joints 200 --first 1000
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from lattice_slips import STEP_S, simulate

from pupper_sysid.sim.emulator.poll_schedule import PollSchedule
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.recordings.recording import Trial


def recording(seed: int) -> tuple[list[Trial], float, float]:
    """Trials of a random joint, its poll period [s] and loss."""
    rng = np.random.default_rng([20261124, seed])
    period = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
    loop = float(np.clip(period / np.exp(rng.uniform(np.log(1.1), np.log(4.0))), 0.002, 0.04))
    loss = float(rng.uniform(0, 0.6))
    quantum, noise = float(rng.choice([0.0, 0.0015, 0.0057])), rng.uniform(0, 0.004)
    servo = np.array([
        rng.uniform(0.005, 0.06), np.exp(rng.uniform(np.log(40), np.log(150))),
        rng.uniform(0.3, 1.0), np.exp(rng.uniform(np.log(20), np.log(300))),
        np.exp(rng.uniform(np.log(300), np.log(2000))), rng.uniform(5, 15),
        rng.choice([0.0, rng.uniform(0, 0.6)]), rng.choice([0.0, rng.uniform(0, 0.008)]),
    ])  # fmt: skip
    jitter = min(rng.uniform(0, 0.0015), 0.1 * period)
    schedule = PollSchedule(
        period, np.array([rng.uniform(0, period)]), loss, jitter, rng.uniform(0, 0.004), rng
    )
    trials, start = [], 1.0
    count = int(rng.integers(4, 7))
    slip = 0.0
    for n, frequency in enumerate(np.sort(rng.choice(np.arange(1.0, 11.0), count, replace=False))):
        seconds = rng.uniform(2.5, 4.0)
        amplitude = min(0.3, rng.uniform(4, 10) / (2 * np.pi * frequency))
        send = np.arange(0, seconds, loop)
        send = send + rng.uniform(0, 0.0003, len(send))
        command = amplitude * np.sin(2 * np.pi * frequency * send)
        steps = np.arange(0, seconds + 0.1, STEP_S)
        held = command[np.maximum(np.searchsorted(send, steps, "right") - 1, 0)]
        motion = simulate(held, servo, STEP_S)
        read = send + start + 0.0005
        jump = (rng.uniform(0.2, seconds), rng.uniform(0, period)) if rng.random() < 0.1 else None
        shown = np.empty(len(read))
        last, value = -np.inf, 0.0
        for k, at in enumerate(read):
            if jump and at - start > jump[0]:
                slip, jump = slip + jump[1], None
            measured = float(schedule.advance(at - slip)[0]) + slip
            if measured != last:
                last = measured
                value = np.interp(measured - start, steps, motion) + noise * rng.standard_normal()
                value = quantum * np.round(value / quantum) if quantum else value
            shown[k] = value
        trials.append(Trial("LF_hip", n, frequency, send + start, read, command, shown, None, 0.0))
        start += seconds + 0.9
    return trials, period, loss


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Coverage of the poll's intervals.")
    parser.add_argument("--joints", type=int, default=240)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    kinds: dict[str, int] = {}
    rows = []
    for seed in range(given.first, given.first + given.joints):
        trials, period, loss = recording(seed)
        found = find_poll_lattice(trials, np.random.default_rng(seed))
        kinds[found.kind] = kinds.get(found.kind, 0) + 1
        if found.kind != "lattice":
            continue
        truth = (period, loss, period * (0.5 + loss / (1 - loss)))
        intervals = (found.poll_period_interval, found.loss_interval, found.mean_age_interval)
        rows.append([(t, i.low, i.high, i.value) for t, i in zip(truth, intervals, strict=True)])
        if given.verbose:
            loop = np.median(np.diff(trials[0].read_time_s))
            print(seed, f"loop {1e3 * loop:.1f}", *(
                f"{'  ' if a <= t <= b else '!!'} {t:.4f} {v:.4f} [{a:.4f} {b:.4f}]"
                for t, a, b, v in rows[-1]
            ), f"z {found.z_score:.0f} slips {len(found.slips)}")  # fmt: skip
    table = np.array(rows)
    print("| | true value in the 90 % interval | median width | relative | median error |")
    print("|---|---|---|---|---|")
    for k, (name, scale) in enumerate((("poll period, ms", 1e3), ("loss", 1.0),
                                       ("mean age, ms", 1e3))):  # fmt: skip
        truth, low, high, value = table[:, k].T
        inside = (low <= truth) & (truth <= high)
        print(
            f"| {name} | {inside.sum()} of {len(inside)} ({100 * inside.mean():.0f} %) | "
            f"{scale * np.median(high - low):.3f} | "
            f"{100 * np.median((high - low) / value):.2f} % | "
            f"{scale * np.median(np.abs(value - truth)):.3f} |"
        )
    print("\n" + ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) + ".")
