"""Synthetic recordings of random servos, drawn from a wider world than the estimators assume.

`servo` draws a servo with position loop, limited torque, Coulomb and Stribeck friction, back-EMF,
set-point slew, backlash; `swept` records it at its tones through a host loop, a bus that delays
commands at random, and readings that are live or polled. Everything is simulated in steps of
0.25 ms by a loop of its own (`_move`), not by the models that are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.servo_models.step_size import delay_at_step
from pupper_sysid.sysid.recordings.recording import Recording

STEP_S = 0.00025
JOINT = "LF_thigh"


@dataclass(frozen=True)
class Servo:
    """A servo per unit of inertia, and its bus; times in s, angles in rad."""

    dead_time_s: float
    """Mean, the mean of the jitter included."""
    stiffness: float
    damping: float
    friction: float
    effort: float
    velocity_limit: float = np.inf
    back_emf: float = 0.0
    stribeck: float = 0.0
    """Friction at rest beyond the sliding one, as a share of it."""
    backlash_rad: float = 0.0
    command_jitter_s: float = 0.0
    """Standard deviation and mean of an exponential latency of each command."""
    offset_rad: float = 0.0
    quantum_rad: float = 0.0
    noise_rad: float = 0.0
    poll_s: float = 0.0
    """0 for live readings."""
    loss: float = 0.0
    poll_jitter_s: float = 0.0

    @property
    def structure(self) -> str:
        """Candidate model that holds this servo, the smaller effects left out."""
        return "delayed_pd_back_emf" if self.back_emf else "delayed_pd"

    def truth(self, step_s: float = 0.002) -> dict[str, float]:
        """Values that a fit in steps of `step_s` should find, by parameter of the candidates."""
        p = DelayedPDParameters(
            self.stiffness, self.damping, self.friction, 1.0, self.effort, self.velocity_limit,
            self.dead_time_s, self.back_emf,
        )  # fmt: skip
        found = {
            "dead_time_s": float(delay_at_step(p, step_s, STEP_S)[0]),
            "stiffness_per_s2": self.stiffness, "damping_per_s": self.damping,
            "friction_rad_s2": self.friction, "effort_rad_s2": self.effort,
            "velocity_limit_rad_s": self.velocity_limit, "offset_rad": self.offset_rad,
        }  # fmt: skip
        if self.back_emf:
            found["no_load_speed_rad_s"] = self.effort / self.back_emf
        return found


def servo(rng: np.random.Generator, structure: str, polled: bool, wide: bool = True) -> Servo:
    """Draw a servo of a structure: "slew", "back-EMF" or "both".

    Parameters
    ----------
    rng : numpy.random.Generator
    structure : str
    polled : bool
        Readings from a bus that polls the servo; otherwise each row is a read.
    wide : bool
        Stribeck friction, backlash and jitter of commands besides.
    """

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    stiffness = between(2500, 25000)
    effort = between(200, 1500)
    speed = between(4, 14)
    return Servo(
        dead_time_s=float(rng.uniform(0.008, 0.060)),
        stiffness=stiffness, damping=float(rng.uniform(0.15, 0.9)) * 2 * np.sqrt(stiffness),
        friction=float(rng.uniform(0.05, 0.45)) * effort, effort=effort,
        velocity_limit=np.inf if structure == "back-EMF" else speed,
        back_emf=0.0 if structure == "slew" else effort / speed,
        stribeck=float(rng.choice([0, rng.uniform(0, 0.4)])) if wide else 0.0,
        backlash_rad=float(rng.choice([0, rng.uniform(0, 0.01)])) if wide else 0.0,
        command_jitter_s=float(rng.choice([0, rng.uniform(0, 0.004)])) if wide else 0.0,
        offset_rad=float(rng.normal(0, 0.01)),
        quantum_rad=float(rng.choice([np.pi / 550, 0.0051, 0.00153])),
        noise_rad=between(0.0008, 0.004),
        poll_s=float(rng.uniform(0.012, 0.040)) if polled else 0.0,
        loss=float(rng.uniform(0, 0.55)) if polled else 0.0,
        poll_jitter_s=float(rng.uniform(0, 0.001)) if polled else 0.0,
    )  # fmt: skip


@njit(cache=True)
def _move(command, h, kp, kd, friction, stribeck, effort, slew, emf, backlash):
    y, v, s, shown = command[0], 0.0, command[0], command[0]
    out = np.empty(len(command))
    for k in range(len(command)):
        s += min(max(command[k] - s, -slew * h), slew * h)
        force = min(max(kp * (s - y) - kd * v, -effort), effort) - emf * v
        most = friction * (1.0 + stribeck * np.exp(-((v / 0.3) ** 2)))
        force -= min(max(v / h + force, -most), most)
        v += force * h
        y += v * h
        shown = min(max(shown, y - 0.5 * backlash), y + 0.5 * backlash)
        out[k] = shown
    return out


def motion(own: Servo, sent: NDArray, command: NDArray, seconds: float, rng) -> NDArray[np.float64]:
    """Positions every `STEP_S` under commands sent at `sent` [s], each late at random."""
    least = max(own.dead_time_s - own.command_jitter_s, 0.0)
    arrives = sent + least + rng.exponential(1.0, len(sent)) * own.command_jitter_s
    arrives = np.maximum.accumulate(arrives)  # a later command never comes first
    time = STEP_S * np.arange(int(seconds / STEP_S))
    at = np.searchsorted(arrives, time, "right") - 1
    held = np.where(at < 0, command[0], command[np.maximum(at, 0)])
    return _move(
        held, STEP_S, own.stiffness, own.damping, own.friction, own.stribeck, own.effort,
        own.velocity_limit, own.back_emf, own.backlash_rad,
    )  # fmt: skip


def record(
    own: Servo, commands: list[tuple[float, NDArray, NDArray]], rng: np.random.Generator
) -> Recording:
    """A recording of trials, each a frequency [Hz], send times [s] and commands [rad]."""
    parts: dict[str, list[NDArray]] = {k: [] for k in ("time", "command", "position", "trial", "f")}
    start = 0.0
    for number, (frequency, sent, command) in enumerate(commands):
        seconds = sent[-1] + 0.1
        track = motion(own, sent, command, seconds, rng)
        read = sent + 0.001
        measured = read
        if own.poll_s:
            period = own.poll_s * (1 + 0.002 * rng.standard_normal())
            measured = rng.uniform(0, period) + np.arange(0, seconds, period)
            measured = measured[rng.random(len(measured)) >= own.loss]
            measured = np.maximum(
                measured + own.poll_jitter_s * rng.standard_normal(len(measured)), 0
            )
            measured = np.sort(measured)
        time = STEP_S * np.arange(1, len(track) + 1)
        value = np.interp(measured, time, track) + own.noise_rad * rng.standard_normal(
            len(measured)
        )
        value += own.offset_rad
        if own.quantum_rad:
            value = own.quantum_rad * np.round(value / own.quantum_rad)
        newest = np.searchsorted(measured, read, "right") - 1
        first = command[0] + own.offset_rad
        shown = np.where(newest < 0, first, value[np.maximum(newest, 0)])
        for key, column in (
            ("time", start + sent), ("command", command), ("position", shown),
            ("trial", np.full(len(sent), number)), ("f", np.full(len(sent), frequency)),
        ):  # fmt: skip
            parts[key].append(column)
        start += seconds + 1.0
    whole = {k: np.concatenate(v) for k, v in parts.items()}
    return Recording.from_arrays(
        whole["time"], {JOINT: whole["command"]}, {JOINT: whole["position"]},
        read_time_s=whole["time"] + 0.001, trial=whole["trial"], frequency_hz=whole["f"],
        name="twin",
    )  # fmt: skip


def swept(
    own: Servo, rng: np.random.Generator, tones=(1.0, 2.0, 4.0, 8.0), rate_hz: float = 50.0,
    amplitude_rad: float = 0.3, seconds: float = 3.0,
) -> Recording:  # fmt: skip
    """A sweep of tones, their amplitude reduced as `pupper-sysid sweep` does above 3 rad/s."""
    commands = []
    for f in tones:
        late = 1e-4 * rng.exponential(1.0, int(seconds * rate_hz))
        sent = np.arange(len(late)) / rate_hz + late
        a = min(amplitude_rad, 6.0 / (2 * np.pi * f))
        commands.append((f, sent, a * np.sin(2 * np.pi * f * sent)))
    return record(own, commands, rng)


def twin(seed: int, structure: str, polled: bool, wide: bool, **changes) -> tuple[Servo, Recording]:
    """A random servo and its sweep."""
    rng = np.random.default_rng([20261122, seed])
    own = replace(servo(rng, structure, polled, wide), **changes)
    rate = 50.0 if polled else float(rng.choice([30.0, 50.0, 100.0, 200.0]))
    return own, swept(own, rng, rate_hz=rate)
