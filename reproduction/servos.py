"""The published claims about servos, judged by recordings of a robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.compare.compare import FITTED, PUBLISHED, Comparison, four_way
from pupper_sysid.sysid.doctor.examination import JointExamination, examine
from pupper_sysid.sysid.fit.calibrate import lag
from pupper_sysid.sysid.lag.lag_budget import LagBudget
from pupper_sysid.sysid.recordings.recording import Recording
from reproduction.evidence import Claim, Finding, NotTestable, claim, holds, span


@dataclass
class ServoEvidence:
    """Measurements of a robot's recordings."""

    lag: dict[str, LagBudget] = field(default_factory=dict)
    """Per joint, from sweeps."""
    health: dict[str, JointExamination] = field(default_factory=dict)
    """Of the joints of sweeps."""
    sweep: Recording | None = None
    """The sweep with most rows."""
    servos: Comparison | None = None
    """From a playback or walk."""
    played: Recording | None = None
    """That playback or walk: the recording with most joints that is no sweep."""


def gather(
    recordings: Sequence[Recording], seed: int, progress: Callable[[str], None] = lambda what: None
) -> ServoEvidence:
    """Lag and staleness from sweeps, servo models from the recording with most joints."""
    evidence = ServoEvidence()
    rng = np.random.default_rng(seed)
    tones = [bool(np.isfinite(r.table["frequency_hz"]).any()) for r in recordings]
    sweeps = [r for r, tone in zip(recordings, tones, strict=True) if tone]
    others = [r for r, tone in zip(recordings, tones, strict=True) if not tone]
    for recording in sweeps:
        evidence.health |= {
            f"{recording.name} {name}": one
            for name, one in examine(recording, seed=rng).joints.items()
        }
    if sweeps:
        progress("lag of the sweeps")
        evidence.lag = dict(lag(sweeps, seed=seed, workers=2))
        evidence.sweep = max(sweeps, key=lambda r: len(r.table))
    if others:
        evidence.played = max(others, key=lambda r: (len(r.joints), len(r.table)))
        progress(f"servo models on {evidence.played.name}")
        evidence.servos = four_way(evidence.played, evidence.played.joints, seed)
    return evidence


def judge(evidence: ServoEvidence) -> list[Claim]:
    """All claims about servos."""
    return [one(evidence) for one in _CLAIMS]


@claim(
    "A1", "Transport delay is a constant 76 ms from 1 to 6 Hz", "76 ms, same at all rates",
    "Sweeps: lag of all rows, of fresh rows, and of the servo (`pupper-sysid delay`).",
)  # fmt: skip
def constant_lag(evidence: ServoEvidence) -> Finding:
    budgets = list(_sweeps(evidence).values())
    raw, fresh, servo = (
        1e3 * np.mean([getattr(b, k).value for b in budgets])
        for k in ("raw_lag_s", "fresh_lag_s", "lag_s")
    )
    by_rate = [1e3 * f.lag_s.value for b in budgets for f in b.by_frequency]
    dead = 1e3 * np.mean([b.dead_time_s.value for b in budgets if b.dead_time_s])
    ours = (
        f"{raw:.0f} ms in all rows, {fresh:.0f} ms in fresh ones, {servo:.0f} ms the servo's own "
        f"({dead:.0f} ms of it dead time); {min(by_rate):.0f} to {max(by_rate):.0f} ms by frequency"
    )
    low, high = min(b.lag_s.low for b in budgets), max(b.lag_s.high for b in budgets)
    bounds = {"servo": Interval(float(servo), 1e3 * low, 1e3 * high)}
    stale = float(1 - servo / raw)
    return Finding(
        ours, bounds, holds(stale <= 0.15, True),
        f"It holds as a sum; {100 * stale:.0f} % of it is bus and stale feedback.",
    )  # fmt: skip


@claim(
    "A2", "Tracking degrades above 3 Hz", "visible loss of amplitude above 3 Hz",
    "Sweeps: gain per tone, of all rows and of fresh ones.",
)  # fmt: skip
def above_three_hertz(evidence: ServoEvidence) -> Finding:
    tones = [f for d in evidence.lag.values() for f in d.by_frequency]
    high = [f for f in tones if f.frequency_hz > 3.0]
    if not high:
        raise NotTestable("Give sweeps above 3 Hz with --recordings.")
    low = [f.gain for f in tones if f.frequency_hz <= 3.0]
    before, after = float(np.mean(low)), float(np.mean([f.gain for f in high]))
    raw = float(np.mean([f.raw_gain for f in high]))
    lost = 1 - after / before
    return Finding(
        f"gain {before:.2f} up to 3 Hz, {after:.2f} above (all rows, as the paper: {raw:.2f})",
        None, holds(lost >= 0.3, lost >= 0.05),
        f"Lost: {100 * lost:.0f} %; 30 % would hold, 5 % partly.",
    )  # fmt: skip


@claim(
    "A3", "Readings are noisy", "σ 0.101 rad in position, 3.17 rad/s in velocity",
    "Sweeps: noise of fresh readings about their tone; share of rows that repeat an old value.",
)  # fmt: skip
def reading_noise(evidence: ServoEvidence) -> Finding:
    noise = float(np.mean([d.noise_rad for d in _sweeps(evidence).values()]))
    fresh = float(np.mean([h.fresh_fraction for h in evidence.health.values()]))
    return Finding(
        f"σ {1e3 * noise:.1f} mrad in fresh readings; {100 * (1 - fresh):.0f} % of rows are old",
        None, holds(noise >= 0.03),
        "It is staleness, not noise: √2 · 0.101 · 25 Hz gives their velocity, too.",
    )  # fmt: skip


@claim(
    "S1", "A servo network is far better than a PD", "PD 0.1 to 1.8 rad, MLP 0.003 to 0.03 rad",
    "Playback, last loop held out, free run from commands alone, per joint.",
)  # fmt: skip
def servo_error(evidence: ServoEvidence) -> Finding:
    published, fitted, mlp = (
        1e3 * _by_joint(evidence, name) for name in (PUBLISHED, FITTED, "MLP")
    )
    return Finding(
        f"published PD {span(published, 0)}, a fitted PD {span(fitted, 0)}, "
        f"MLP {span(mlp, 0)} mrad",
        None, holds(bool(np.mean(fitted) > 3 * np.mean(mlp))),
        "Holds if a fitted PD is 3 times worse.",
    )  # fmt: skip


@claim(
    "S2", "In free run the LSTM servo drifts", "RMSE LSTM 0.070, MLP 0.028 rad",
    "As S1, mean of the joints, 90 % intervals over stretches of time.",
)  # fmt: skip
def free_run(evidence: ServoEvidence) -> Finding:
    spans = {k: _servos(evidence).models[k].rmse_free_run_rad for k in ("LSTM", "MLP")}
    mean = {k: 1e3 * i.value for k, i in spans.items()}
    return Finding(
        f"LSTM {mean['LSTM']:.1f}, MLP {mean['MLP']:.1f} mrad",
        {k: Interval(*(1e3 * x for x in (i.value, i.low, i.high))) for k, i in spans.items()},
        holds(mean["LSTM"] > 1.5 * mean["MLP"]),
        "Ours is driven by commands only; holds if it is 1.5 times worse.",
    )  # fmt: skip


@claim(
    "S3", "One step ahead the LSTM servo is better", "LSTM better in one step",
    "As S1, one step ahead of the last reading; beside it persistence (the last reading).",
)  # fmt: skip
def one_step(evidence: ServoEvidence) -> Finding:
    servos = _servos(evidence)
    ahead = {k: 1e3 * servos.models[k].mean.rmse_one_step_rad for k in ("LSTM", "MLP")}
    still = 1e3 * float(np.nanmean(list(servos.persistence_rmse_rad.values())))
    return Finding(
        f"LSTM {ahead['LSTM']:.1f}, MLP {ahead['MLP']:.1f}, persistence {still:.1f} mrad", None,
        holds(ahead["LSTM"] < 0.95 * ahead["MLP"]), "Holds if 5 % better.",
    )  # fmt: skip


@claim(
    "S4", "390 samples per joint are enough", "390 samples in 3 loops",
    "As S1: MLP against the robot's repeatability.",
)  # fmt: skip
def enough_data(evidence: ServoEvidence) -> Finding:
    mlp = 1e3 * float(np.mean(_by_joint(evidence, "MLP")))
    known = [v for v in _servos(evidence).repeatability_rad.values() if np.isfinite(v)]
    if not known:
        raise NotTestable("Give a playback that sends the same commands more than once.")
    floor = 1e3 * float(np.mean(known))
    rows = len(evidence.played.table) // len(evidence.played.joints) if evidence.played else 0
    return Finding(
        f"{rows} rows per joint: MLP {mlp:.1f} mrad, repeatability {floor:.1f}", None,
        holds(mlp <= 1.1 * floor, True), "More data: the data curve of the servo report.",
    )  # fmt: skip


def _sweeps(evidence: ServoEvidence) -> dict[str, LagBudget]:
    if not evidence.lag:
        raise NotTestable("Give sweeps with --recordings.")
    return evidence.lag


def _servos(evidence: ServoEvidence) -> Comparison:
    if evidence.servos is None:
        raise NotTestable("Give a playback or walk with --recordings.")
    return evidence.servos


def _by_joint(evidence: ServoEvidence, model: str) -> np.ndarray:
    """Free-run error of each joint [rad]."""
    joints = _servos(evidence).models[model].joints
    return np.array([s.rmse_free_run_rad for s in joints.values()])


_CLAIMS = (
    constant_lag, above_three_hertz, reading_noise, servo_error, free_run, one_step, enough_data,
)  # fmt: skip
