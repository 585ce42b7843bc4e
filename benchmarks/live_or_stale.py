"""Live, stale or cannot tell? Synthetic recordings of known truth, and the real ones.

Each synthetic joint is a `DelayedPD` of random stiffness, friction, torque and dead time under
tones, a chirp, a pseudo-random binary sequence, motion with pauses or teleoperation; its readings
are quantised (0–50 mrad), noisy or not, at 30–1,000 Hz, live or polled every 5–100 ms with losses
of 0–0.6. The verdict comes from `sysid.feedback.staleness`. Real recordings are those in
`$PUPPER_REAL_DATA`; the rows of a missing one are left out.

    .venv/bin/python benchmarks/live_or_stale.py --twins 300
"""

from __future__ import annotations

import argparse
import ast
import csv
import json
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.sysid.feedback.staleness import Staleness, staleness
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

STEP_S = 0.0005
REAL = Path(
    os.environ.get("PUPPER_REAL_DATA") or Path(__file__).resolve().parents[2] / "shared" / "real"
)
VERDICTS = ("live", "stale", "cannot tell")


@dataclass(frozen=True)
class Twin:
    """One synthetic recording: its trial and what is true of it."""

    trial: Trial
    truth: str
    rate_hz: float
    quantum_rad: float
    noise_rad: float
    poll_s: float
    loss: float
    command: str


def trial(time_s: ArrayLike, command_rad: ArrayLike, position_rad: ArrayLike) -> Trial:
    """Rows of one joint, read when its command was sent."""
    time, command, position = (np.asarray(a, float) for a in (time_s, command_rad, position_rad))
    return Trial("LF_hip", 0, np.nan, time, time, command, position, None, float(command[0]))


def commanded(kind: str, time: NDArray[np.float64], rng: np.random.Generator) -> NDArray:
    """Command at each time [rad]."""
    half, amplitude = time[-1] / 2, rng.uniform(0.05, 0.6)
    if kind == "tones":
        frequency = np.where(time < half, rng.uniform(0.5, 3), rng.uniform(2, 8))
        return amplitude * np.sin(2 * np.pi * frequency * time)
    if kind == "chirp":
        return amplitude * np.sin(2 * np.pi * (0.3 * time + rng.uniform(0.1, 0.3) * time**2))
    if kind == "prbs":
        level = rng.choice([-1.0, 1.0], int(time[-1] / 0.15) + 2)
        return amplitude * level[(time / 0.15).astype(int)]
    if kind == "pauses":
        wave = np.sin(2 * np.pi * rng.uniform(0.5, 3) * time)
        return amplitude * wave * (np.sin(0.4 * np.pi * time) > 0)
    frequency, phase = rng.uniform(0.1, 1.5, 6), rng.uniform(0, 6, 6)
    return amplitude / 3 * np.sin(2 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)


def twin(seed: int) -> Twin:
    """A random joint behind a random bus."""
    rng = np.random.default_rng([20261122, seed])
    rate = float(np.exp(rng.uniform(np.log(30), np.log(1000))))
    seconds = rng.uniform(4, 12)
    time = np.arange(0, seconds, STEP_S)
    kind = str(rng.choice(["tones", "chirp", "prbs", "pauses", "teleoperation"]))
    jitter = rng.choice([0.0, 0.02, 0.1])
    gaps = (1 + jitter * rng.standard_normal(int(1.2 * seconds * rate))) / rate
    read = np.cumsum(np.maximum(gaps, 0.2 / rate))
    read = read[read < seconds - 0.01]
    command = np.interp(read, time, commanded(kind, time, rng))
    held = command[np.maximum(np.searchsorted(read, time, "right") - 1, 0)]

    armature = 1e-3 * np.exp(rng.uniform(-0.7, 0.7))
    stiffness = np.exp(rng.uniform(np.log(200), np.log(15000)))  # per armature, as all of these
    servo = DelayedPD(
        DelayedPDParameters(
            dead_time_s=rng.uniform(0.001, 0.06), stiffness=armature * stiffness,
            damping=armature * rng.uniform(0.3, 2) * np.sqrt(stiffness),
            friction_loss=armature * np.exp(rng.uniform(np.log(2), np.log(400))),
            effort_limit=armature * rng.uniform(100, 1500), velocity_limit=rng.uniform(3, 30),
            armature=armature,
        ),
        STEP_S,
    )  # fmt: skip
    servo.reset(np.array(held[0]))
    motion = servo.rollout(held)

    quantum = float(rng.choice([0, 0.0015, 0.0057, 0.012, 0.05], p=[0.15, 0.4, 0.3, 0.1, 0.05]))
    noise = float(rng.choice([0, 0, 0, 0.0005, 0.002]))
    stale = bool(rng.random() < 0.5)
    poll = float(np.exp(rng.uniform(np.log(max(0.005, 1.3 / rate)), np.log(0.1))))
    loss = float(rng.choice([0.0, rng.uniform(0, 0.6)]))
    measured = read
    if stale:
        measured = rng.uniform(0, poll) + np.arange(0, seconds, poll)
        measured = measured[rng.random(len(measured)) >= loss]
    value = np.interp(measured, time, motion) + noise * rng.standard_normal(len(measured))
    value += rng.choice([0.0, rng.uniform(-1, 1)])
    value = quantum * np.round(value / quantum) if quantum else value
    shown = value[np.maximum(np.searchsorted(measured, read, "right") - 1, 0)]
    return Twin(
        trial(read, command, shown), "stale" if stale else "live", rate, quantum, noise,
        poll if stale else 0.0, loss if stale else 0.0, kind,
    )  # fmt: skip


def real_recordings() -> Iterator[tuple[str, str, Staleness]]:
    """Name of the set, what is right for it, and the verdict on each joint of each recording."""
    sweeps = [*sorted(REAL.glob("real_motor*.csv")), *REAL.glob("mini_pupper_full_band/*.csv")]
    walk = [p for p in [REAL / "playback_lstm_25hz.csv"] if p.exists()]
    for name, right, paths in (
        ("Mini Pupper 2, sweeps", "stale", sweeps),
        ("Mini Pupper 2, walk at 25 Hz", "stale", walk),
    ):
        for path in paths:
            recording = load(path)
            for joint in recording.joints:
                yield name, right, staleness(recording.trials(joint))
    for folder in sorted(REAL.glob("sage_so101/*/")):
        sent, read = (
            [(r["timestamp"], r["positions"]) for r in csv.DictReader((folder / name).open())]
            for name in ("control.csv", "state_motor.csv")
        )
        rows = min(len(sent), len(read))
        time = 1e-6 * np.array([float(t) for t, _ in read[:rows]])
        command, position = (
            np.array([ast.literal_eval(p) for _, p in s[:rows]]) for s in (sent, read)
        )
        for k in range(command.shape[1]):
            yield (
                "SO-101 (STS3215)", "live",
                staleness([trial(time, command[:, k], position[:, k])]),
            )  # fmt: skip
    for path in sorted(REAL.glob("bam_xl330/*.json")):
        table = json.loads(path.read_text())["entries"]
        # limp, or without a goal: there is no command
        driven = [e.get("torque_enable", True) and e["goal_position"] is not None for e in table]
        goal, position = ([e[k] for e in table] for k in ("goal_position", "position"))
        command = np.where(driven, goal, position)
        seen = np.where(driven, np.array(position), np.nan)
        verdict = staleness([trial([e["timestamp"] for e in table], command.astype(float), seen)])
        yield "XL330", "live", verdict
    for path in sorted(REAL.glob("ktune_robstride/*.json")):
        table = json.loads(path.read_text())["data"]
        time, command, position = (
            np.array([e[k] for e in table])
            for k in ("time_since_start", "commanded_position", "position")
        )
        verdict = staleness([trial(time, np.radians(command), np.radians(position))])
        yield "RobStride", "live", verdict


def line(name: str, truth: str, verdicts: Counter[str]) -> str:
    """A row of the table."""
    return "| " + " | ".join([name, truth, *(str(verdicts[v]) for v in VERDICTS)]) + " |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Live, stale or cannot tell?")
    parser.add_argument("--twins", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    given = parser.parse_args()
    print("| recordings | truth | live | stale | cannot tell |\n|---|---|---|---|---|")
    real: dict[tuple[str, str], Counter[str]] = {}
    for name, right, verdict in real_recordings():
        real.setdefault((name, right), Counter())[verdict.kind] += 1
    for (name, right), counted in real.items():
        print(line(name, right, counted))
    synthetic: dict[tuple[str, str], Counter[str]] = {}
    wrong = []
    for seed in range(given.first, given.first + given.twins):
        made = twin(seed)
        verdict = staleness([made.trial])
        band = next(b for b in (100, 300, 1001) if made.rate_hz < b)
        name = {100: "synthetic, 30–100 Hz", 300: "100–300 Hz", 1001: "300–1,000 Hz"}[band]
        synthetic.setdefault((name, made.truth), Counter())[verdict.kind] += 1
        if verdict.kind not in (made.truth, "cannot tell"):
            wrong.append((seed, made, verdict))
    for name in ("synthetic, 30–100 Hz", "100–300 Hz", "300–1,000 Hz"):
        for truth in ("live", "stale"):
            print(line(name, truth, synthetic.get((name, truth), Counter())))
    untold = sum(c["cannot tell"] for c in synthetic.values())
    print(
        f"\n{given.twins} synthetic recordings: {len(wrong)} wrong "
        f"({100 * len(wrong) / max(given.twins, 1):.1f} %), {untold} cannot be told "
        f"({100 * untold / max(given.twins, 1):.0f} %)."
    )
    for seed, made, verdict in wrong:
        print(
            f"- {made.truth} called {verdict.kind} (seed {seed}): {made.rate_hz:.0f} Hz, "
            f"{made.command}, quantisation {1e3 * made.quantum_rad:.1f} mrad, noise "
            f"{1e3 * made.noise_rad:.1f} mrad, poll {1e3 * made.poll_s:.1f} ms, loss "
            f"{made.loss:.2f}; {verdict.episodes_with_repeat} of {verdict.episodes} episodes."
        )
