"""Servos and trials for the tests of planning: known hypotheses, no fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pupper_sysid.sysid.identify.models import candidate_model
from pupper_sysid.sysid.identify.simulation import TrialData, free_run, look_up
from pupper_sysid.sysid.plan.candidates import Setup, recorded
from pupper_sysid.sysid.plan.information import (
    Hypothesis,
    Noise,
    pooled,
    prior_information,
    respond,
)
from pupper_sysid.sysid.plan.planner import Servo
from pupper_sysid.sysid.sweep.excitation import plan

NOISE = Noise(0.004, 0.001)
PD = (0.025, 12000.0, 100.0, 200.0, 430.0)


def tones(
    frequencies: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0), amplitude_rad: float = 0.3,
    loop_period_s: float = 0.019,
) -> list[TrialData]:  # fmt: skip
    """Trials of 5 s as a standard sweep has them."""
    made = plan("sine", ["LF_hip"], frequencies, amplitude_rad, 5.0, loop_period_s)
    return [recorded(trial, Setup(loop_period_s=loop_period_s)) for trial in made.trials]


def hypothesis(back_emf: bool = False) -> Hypothesis:
    """A usual servo whose speed is limited by set-point slew, or by back-EMF."""
    model = candidate_model("delayed_pd_back_emf" if back_emf else "delayed_pd")
    return Hypothesis(model, np.array([*PD, 8.0, 0.0]), prior_information(model))


def recorded_servo(trials: list[TrialData], structures: int = 1) -> Servo:
    """What these trials say about the usual servo, alone or beside a rival as good as it."""
    found = []
    for one in [hypothesis(), hypothesis(back_emf=True)][:structures]:
        said = pooled((t.frequency_hz, respond(one, t, NOISE, 0.6).information) for t in trials)
        found.append(replace(one, known=one.known + said))
    return Servo(tuple(found), NOISE, (0.0,) * structures)


def with_readings(
    one: Hypothesis, trial: TrialData, noise: Noise, rng: np.random.Generator
) -> TrialData:
    """The trial with readings of the servo, whose errors grow with its speed."""
    (track,) = free_run(one.model, one.values, [trial])
    speed = look_up(np.gradient(track) / trial.step_s, trial.sample_step)
    error = rng.standard_normal(len(speed)) / np.sqrt(noise.weights(speed))
    return replace(trial, sample_rad=look_up(track, trial.sample_step) + error)
