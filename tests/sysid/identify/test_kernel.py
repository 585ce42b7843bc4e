"""The compiled simulation is the models' own arithmetic (`CandidateModel.simulate`)."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.servo_models.delay_line import fractional_shift
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS
from pupper_sysid.sysid.identify.candidates.models import CANDIDATE_MODELS, candidate_model
from pupper_sysid.sysid.identify.candidates.simulation import (
    TrialData,
    free_run,
    look_up,
    moments_if_later,
    residuals,
)
from pupper_sysid.sysid.sparse.equations import equation_model

MODELS = [
    *CANDIDATE_MODELS,
    equation_model(tuple(COEFFICIENTS)),
    equation_model(("stiffness_per_s2", "damping_per_s")),
    equation_model(("saturated_stiffness_per_s2", "saturation_error_rad", "friction_rad_s2")),
]


def trial(frequency_hz: float, steps: int) -> TrialData:
    """A tone with readings at random times, the first and the last step among them."""
    rng = np.random.default_rng(steps)
    time = np.concatenate([[0.0], np.sort(rng.uniform(0, steps, 60)), [float(steps)]])
    command = 0.3 * np.sin(2 * np.pi * frequency_hz * TIME_STEP_S * np.arange(steps))
    empty = np.zeros(0)
    return TrialData(
        frequency_hz, 0.5, command, time, rng.uniform(-0.3, 0.3, len(time)), empty, empty, empty
    )


TRIALS = (trial(2.0, 700), trial(5.0, 430))


def candidates(model, count: int = 37) -> np.ndarray:
    """Parameter vectors from all over the box; a number that fills no whole group of lanes."""
    unit = np.random.default_rng(1).uniform(size=(count, len(model.parameters)))
    columns = []
    for p, u in zip(model.parameters, unit.T, strict=True):
        low, high = float(p.encode(p.low)), float(p.encode(p.high))
        columns.append(p.decode(low + u * (high - low)))
    return np.stack(columns, axis=1)


def reference(model, values: np.ndarray, trial: TrialData) -> np.ndarray:
    """Positions at step edges by NumPy, shape (steps + 1, candidates)."""
    steps = len(trial.command)
    history = np.concatenate([np.zeros(210), trial.command])[:, None]
    track = np.zeros((steps + 1, len(values)))
    track[1:] = fractional_shift(
        history, steps, values[:, 0] / TIME_STEP_S, np.zeros(len(values), int)
    )
    model.simulate(np.ascontiguousarray(values[:, 1:-1].T), track[1:])
    return track


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.name}-{len(m.parameters)}")
def test_every_model_moves_as_its_reference_does(model):
    values = candidates(model)
    expected = [reference(model, values, t) for t in TRIALS]
    found = np.stack([free_run(model, v, TRIALS[:1])[0] - v[-1] for v in values], axis=1)
    np.testing.assert_allclose(found, expected[0], atol=1e-12)

    error = [
        look_up(track, t.sample_step).T + values[:, -1:] - t.sample_rad
        for track, t in zip(expected, TRIALS, strict=True)
    ]
    np.testing.assert_allclose(
        residuals(model, values, TRIALS), np.concatenate(error, axis=1), atol=1e-12
    )


def test_the_fitted_delayed_pd_is_the_one_that_simulators_run():
    values = np.array([0.0273, 12000.0, 100.0, 150.0, 450.0, 6.5, 0.1])
    (track,) = free_run(candidate_model("delayed_pd"), values, TRIALS[:1])
    names = ("stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit")
    numbers = dict(zip(names, values[1:6], strict=True)) | {"armature": 1.0}
    model = DelayedPD(DelayedPDParameters(dead_time_s=values[0], **numbers))
    np.testing.assert_allclose(track[1:] - 0.1, model.rollout(TRIALS[0].command), atol=1e-12)


@pytest.mark.parametrize("model", MODELS[3:6], ids=lambda m: m.name)
def test_a_servo_that_moves_later_is_the_same_motion_looked_up_earlier(model):
    values, later, t = candidates(model), np.array([0.0, 2.0, 7.0]), TRIALS[0]
    track = reference(model, values, t)
    error = np.stack(
        [look_up(track, np.maximum(t.sample_step - d, 0)).T - t.sample_rad for d in later]
    )
    total, square = moments_if_later(model, values, t, later)
    np.testing.assert_allclose(total, error.sum(axis=-1), atol=1e-11)
    np.testing.assert_allclose(square, np.square(error).sum(axis=-1), atol=1e-11)
