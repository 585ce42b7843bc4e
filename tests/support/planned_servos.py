"""Servos, trials and fits for the tests of planning."""

from dataclasses import replace
from functools import cache

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.fit.results import JointCalibrationResult
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run
from pupper_sysid.sysid.fit.structure import candidate
from pupper_sysid.sysid.plan.planner import (
    Hypothesis,
    Noise,
    PlannedTrial,
    Servo,
    Setup,
    pooled,
    prior_information,
    recorded,
    respond,
)
from pupper_sysid.sysid.plan.proposal import SweepPlan
from pupper_sysid.sysid.recordings.importers.times import READ_AFTER_SEND_S
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.sweep.excitation import plan
from support.joint_results import result_of
from support.servo_parameters import MEASURED

NOISE = Noise(0.004, 0.001)
LIVE = PollLattice(kind="every read", readings="live", fresh_fraction=1.0)
SECONDS = 3.0
"""Recorded of each joint by `two_joints`."""

PD = (0.025, 12000.0, 100.0, 200.0, 430.0)


def small_plan() -> SweepPlan:
    """One tone of the hip."""
    trial = PlannedTrial(
        joint="LF_hip", kind="sine", frequency_hz=7.0, amplitude_rad=0.12, duration_s=3.0,
        purpose="dead time",
    )  # fmt: skip
    return SweepPlan(
        made_from=(), seed=3, loop_period_s=0.019, poll_rate_hz=37.2, speed_limit_rad_s=7.5,
        trials=(trial,), predictions=(), notes=(),
    )  # fmt: skip


def tones(
    frequencies: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0), amplitude_rad: float = 0.3,
    loop_period_s: float = 0.019,
) -> list[Run]:  # fmt: skip
    """Trials of 5 s as a standard sweep has them."""
    made = plan("sine", ["LF_hip"], frequencies, amplitude_rad, 5.0, loop_period_s)
    return [recorded(trial, Setup(loop_period_s=loop_period_s)) for trial in made.trials]


def hypothesis(back_emf: bool = False) -> Hypothesis:
    """A usual servo whose speed is limited by set-point slew, or by back-EMF."""
    model = candidate("delayed_pd_back_emf" if back_emf else "delayed_pd")
    return Hypothesis(model, np.array([*PD, 8.0, 0.0]), prior_information(model))


def recorded_servo(trials: list[Run], structures: int = 1) -> Servo:
    """What these trials say about the usual servo, alone or beside a rival as good as it."""
    found = []
    for one in [hypothesis(), hypothesis(back_emf=True)][:structures]:
        said = pooled((t.frequency_hz, respond(one, t, NOISE, 0.6).information) for t in trials)
        found.append(replace(one, known=one.known + said))
    return Servo(tuple(found), NOISE, (0.0,) * structures)


def with_readings(one: Hypothesis, trial: Run, noise: Noise, rng: np.random.Generator) -> Run:
    """The trial with readings of the servo, whose errors grow with its speed."""
    (track,) = free_run(one.model, one.values, [trial])
    speed = at_steps(np.gradient(track) / trial.step_s, trial.sample_step)
    error = rng.standard_normal(len(speed)) / np.sqrt(noise.weights(speed))
    return replace(trial, sample_rad=at_steps(track, trial.sample_step) + error)


@cache
def two_joints() -> Recording:
    """A recording of two joints at 2 and 5 Hz, read live."""
    time = np.arange(0.0, SECONDS / 2, 0.01)
    servo = DelayedPD(MEASURED)
    parts: dict[str, list] = {"time": [], "command": [], "position": [], "trial": [], "f": []}
    for number, frequency in enumerate((2.0, 5.0)):
        command = 0.2 * np.sin(2 * np.pi * frequency * time)
        servo.reset(0.0)
        held = np.repeat(command, 5)
        position = np.interp(time + 0.001, 0.002 * np.arange(1, len(held) + 1), servo.rollout(held))
        for key, column in (
            ("time", time + 10.0 * number), ("command", command),
            ("position", np.round(position / 0.0015) * 0.0015),
            ("trial", np.full(len(time), number)), ("f", np.full(len(time), frequency)),
        ):  # fmt: skip
            parts[key].append(column)
    whole = {k: np.concatenate(v) for k, v in parts.items()}
    joints = ("LF_hip", "LF_thigh")
    return Recording.from_arrays(
        whole["time"], dict.fromkeys(joints, whole["command"]),
        dict.fromkeys(joints, whole["position"]), trial=whole["trial"], frequency_hz=whole["f"],
        metadata={"readings": "live", "read_after_send_s": READ_AFTER_SEND_S},
    )  # fmt: skip


def fit_of_half_width(joint: str, half_width_ms: float) -> JointCalibrationResult:
    """Live readings of a servo whose dead time is 25 ms, known as well as that."""
    half, fit = 1e-3 * half_width_ms, result_of(joint)
    dead = Interval(0.025, 0.025 - half, 0.025 + half)
    candidates = {
        name: replace(c, parameters=c.parameters | {"dead_time_s": dead})
        for name, c in fit.candidate_models.items()
    }
    lag = replace(fit.lag, dead_time_s=dead, feedback=LIVE)
    return replace(fit, lag=lag, candidate_models=candidates)
