"""Recordings of random servos, in which nothing is wrong.

`good_recording` draws a servo from a wide world (dead time to 0.3 s, slow and weak ones, backlash,
sag, offset, coarse encoders, polled or live buses of 30 to 500 Hz, five kinds of excitation). The
faults are in `support.garbage`.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.sysid.recordings.recording import Recording

STEP_S = 0.002
JOINT = "LF_hip"
KINDS = ("tones", "chirp", "prbs", "teleoperation", "steps")


@dataclass(frozen=True)
class Setup:
    """A servo, its bus and its excitation.

    Attributes
    ----------
    servo : DelayedPDParameters
        Per inertia.
    rate_hz : float
    amplitude_rad, offset_rad, backlash_rad, sag_rad, quantum_rad, noise_rad : float
    poll_s, loss : float
        0 for a live bus.
    kind : str
        One of `KINDS`.
    frequencies_hz : tuple of float
        Of the tones.
    trial_s : float
    """

    servo: DelayedPDParameters
    rate_hz: float = 50.0
    amplitude_rad: float = 0.3
    offset_rad: float = 0.0
    backlash_rad: float = 0.0
    sag_rad: float = 0.0
    quantum_rad: float = 2 * np.pi / 4096
    noise_rad: float = 0.0
    poll_s: float = 0.0
    loss: float = 0.0
    kind: str = "tones"
    frequencies_hz: tuple[float, ...] = (1.0, 2.0, 4.0)
    trial_s: float = 3.0


USUAL_SERVO = DelayedPDParameters(
    stiffness=2500.0, damping=70.0, friction_loss=4.0, armature=1.0, effort_limit=400.0,
    velocity_limit=8.0, dead_time_s=0.025,
)  # fmt: skip


def random_setup(rng: np.random.Generator) -> Setup:
    """A servo whose recording is good, drawn widely."""
    stiffness = float(np.exp(rng.uniform(np.log(150), np.log(12000))))
    slow = rng.random() < 0.2
    dead = rng.uniform(0.1, 0.3) if slow else rng.uniform(0.002, 0.06)
    amplitude = float(np.exp(rng.uniform(np.log(0.08), np.log(0.6))))
    # it can start: the first error is worth several times its friction
    friction = stiffness * amplitude * rng.uniform(0.0, 0.15)
    servo = DelayedPDParameters(
        stiffness=stiffness, damping=2 * rng.uniform(0.35, 1.5) * np.sqrt(stiffness),
        friction_loss=friction, armature=1.0, effort_limit=rng.uniform(150, 1500) + 3 * friction,
        velocity_limit=rng.uniform(3, 20), dead_time_s=dead,
    )  # fmt: skip
    rate = float(np.exp(rng.uniform(np.log(30), np.log(500))))
    polled = rng.random() < 0.4
    quantum = float(rng.choice([0.0, 2 * np.pi / 4096, 0.0057]))
    top = min(rng.choice([4.0, 6.0, 10.0]), rate / 4)
    return Setup(
        servo, rate, amplitude,
        offset_rad=float(rng.choice([0.0, rng.uniform(-0.8, 0.8)])),
        backlash_rad=float(rng.choice([0.0, rng.uniform(0, 0.1) * amplitude])),
        sag_rad=float(rng.choice([0.0, rng.uniform(0, 0.15) * amplitude])),
        quantum_rad=quantum, noise_rad=float(rng.choice([0.0, 0.0005, 0.003])),
        poll_s=float(max(rng.uniform(0.01, 0.05), 1.3 / rate)) if polled else 0.0,
        loss=float(rng.uniform(0, 0.5)) if polled else 0.0,
        kind=str(rng.choice(KINDS, p=[0.5, 0.125, 0.125, 0.125, 0.125])),
        frequencies_hz=tuple(np.round(np.geomspace(rng.uniform(0.5, 1.2), top, 5), 2)),
    )  # fmt: skip


def good_recording(rng: np.random.Generator) -> Recording:
    """The recording of a random servo, in which nothing is wrong."""
    return record(random_setup(rng), rng)


def record(setup: Setup, rng: np.random.Generator) -> Recording:
    """The recording of one joint."""
    parts, start = [], 1.0
    many = setup.kind == "tones"
    for number, f in enumerate(setup.frequencies_hz if many else (np.nan,)):
        seconds = max(setup.trial_s, 3.5 / f) if many else 4 * setup.trial_s
        rows = _trial(setup, rng, f, seconds)
        rows = rows.assign(trial=number, frequency_hz=f)
        parts.append(rows.assign(send_time_s=rows.send_time_s + start,
                                 read_time_s=rows.read_time_s + start))  # fmt: skip
        start += seconds + 0.5
    return made(pd.concat(parts, ignore_index=True))


def made(table: pd.DataFrame, joint: str = JOINT, **metadata) -> Recording:
    """A recording of a table with or without a column `joint`, validated like a file's."""
    table = table if "joint" in table else table.assign(joint=joint)
    pose = {j: 0.0 for j in table["joint"].unique()}
    return Recording.from_frame(table, metadata={"start_pose_rad": pose} | metadata, name="made")


def _trial(setup: Setup, rng: np.random.Generator, f: float, seconds: float) -> pd.DataFrame:
    gaps = (1 + 0.02 * rng.standard_normal(int(1.3 * seconds * setup.rate_hz))) / setup.rate_hz
    every = np.cumsum(np.maximum(gaps, 0.3 / setup.rate_hz), dtype=np.float64)
    send = np.asarray(np.round(every[every < seconds], 6), np.float64)
    command = np.round(commanded(setup, send, f, rng), 7)
    motion = _motion(setup, send, command, seconds)
    read = send + min(0.002, 0.2 / setup.rate_hz)
    return pd.DataFrame({
        "send_time_s": send, "read_time_s": np.round(read, 6), "command_rad": command,
        "position_rad": _read(setup, motion, read, seconds, rng),
    })  # fmt: skip


def commanded(
    setup: Setup, time: NDArray[np.float64], f: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Command at each time, at rest for the first 0.2 s [rad]."""
    t, end = np.maximum(time - 0.2, 0.0), time[-1]
    if setup.kind == "tones":
        wave = np.sin(2 * np.pi * f * t)
    elif setup.kind == "chirp":
        wave = np.sin(2 * np.pi * (0.3 * t + (3.0 / end) * t**2))
    elif setup.kind == "prbs":
        level = rng.choice([-1.0, 1.0], int(end / 0.2) + 2)
        wave = level[(t / 0.2).astype(int)] * (time > 0.2)
    elif setup.kind == "steps":
        level = rng.uniform(-1, 1, int(end / 0.7) + 2)
        wave = level[(t / 0.7).astype(int)] * (time > 0.2)
    else:
        frequency, phase = rng.uniform(0.1, 1.5, 6), rng.uniform(0, 6, 6)
        wave = np.sin(2 * np.pi * np.outer(t, frequency) + phase).sum(axis=1) / 3
        wave = (wave - wave[0]) * np.minimum(t, 1.0)
    return setup.amplitude_rad * wave


def _motion(
    setup: Setup, send: NDArray[np.float64], command: NDArray[np.float64], seconds: float
) -> NDArray[np.float64]:
    """Position at each physics step [rad]."""
    time = np.arange(0.0, seconds + 0.1, STEP_S)
    row = np.searchsorted(send, time, "right") - 1
    held = np.where(row < 0, 0.0, command[np.maximum(row, 0)])
    servo = DelayedPD(setup.servo, STEP_S)
    servo.reset(np.array(0.0))
    motion = np.asarray(servo.rollout(held))
    if setup.backlash_rad:
        half, shown, at = setup.backlash_rad / 2, np.empty_like(motion), 0.0
        for k, x in enumerate(motion):
            at = min(max(at, x - half), x + half)
            shown[k] = at
        motion = shown
    return motion + setup.sag_rad * np.cos(motion) + setup.offset_rad


def _read(
    setup: Setup, motion: NDArray[np.float64], read: NDArray[np.float64], seconds: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:  # fmt: skip
    """What the bus answers at each read [rad]."""
    measured = read
    if setup.poll_s > 0:
        measured = np.arange(-0.5, seconds, setup.poll_s) + rng.uniform(0, setup.poll_s)
        keep = (rng.random(len(measured)) >= setup.loss) | (measured < -0.2)
        measured = measured[keep]
    value = np.interp(measured, STEP_S * np.arange(len(motion)), motion)
    value = value + setup.noise_rad * rng.standard_normal(len(value))
    if setup.quantum_rad:
        value = setup.quantum_rad * np.round(value / setup.quantum_rad)
    return value[np.maximum(np.searchsorted(measured, read, "right") - 1, 0)]
