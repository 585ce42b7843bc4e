"""Recordings of one joint: those that agree are left alone, one that differs is named."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.fit.choice import Fitted, goodness_of, undescribed
from pupper_sysid.sysid.fit.preparation import PreparedJoint, prepare_joint
from pupper_sysid.sysid.fit.repeats import (
    Apart,
    Repeats,
    compare_repeats,
    fit_apart,
    repeats_of,
)
from pupper_sysid.sysid.fit.run import Run, prepare
from pupper_sysid.sysid.fit.search import Problem, refine
from pupper_sysid.sysid.fit.structure import SIMULATED, candidate
from pupper_sysid.sysid.recordings.recording import Trial
from support.synthetic import tone_trials

SERVO = DelayedPDParameters(
    stiffness=3000.0, damping=60.0, friction_loss=30.0, armature=1.0, effort_limit=300.0,
    velocity_limit=6.0, dead_time_s=0.025,
)  # fmt: skip
NOISE_RAD = 1e-3


def trials(name: str, seed: int, bend_rad: float = 0.0, **changes: float) -> list[Trial]:
    """Live, noisy tones of the servo, or of one that differs by factors; a bent potentiometer."""
    rng, made = np.random.default_rng(seed), []
    servo = replace(SERVO, **{n: factor * getattr(SERVO, n) for n, factor in changes.items()})
    for trial in tone_trials(0.03, rng, (2.0, 4.0), duration_s=2.0, period_s=0.0):
        start = trial.send_time_s[0]
        steps = np.arange(0.0, 2.1, CONTINUOUS_S)
        row = np.clip(np.searchsorted(trial.send_time_s - start, steps, "right") - 1, 0, None)
        motion = DelayedPD(servo, CONTINUOUS_S).rollout(trial.command_rad[row])
        motion = motion + bend_rad * np.sin(20.0 * motion)
        seen = np.interp(trial.read_time_s - start, steps + CONTINUOUS_S, motion)
        seen += NOISE_RAD * rng.standard_normal(len(seen))
        made.append(replace(trial, position_rad=seen, readings="live", source=name))
    return made


def recorded(name: str, seed: int, **changes: float) -> list[Run]:
    """The same on the physics clock."""
    tones = trials(name, seed, **changes)
    lattice = find_poll_lattice(tones, np.random.default_rng(seed))
    return [prepare(trial, lattice).in_free_air() for trial in tones]


def pooled(*recordings: list[Trial]) -> tuple[PreparedJoint, Fitted]:
    """The recordings made ready, and the first fit."""
    every = [t for recording in recordings for t in recording]
    every = [replace(t, number=n) for n, t in enumerate(every)]
    ready = prepare_joint("knee", every, 0, free_air=True)
    return ready, Fitted(*ready.first[SIMULATED[0]])


def compared(*recordings: list) -> Repeats | None:
    structure = candidate(SIMULATED[0])
    runs = tuple(run for several in recordings for run in several)
    problem = Problem(structure, runs, (NOISE_RAD,) * len(runs))
    by_name = {
        "dead_time_s": 25e-3, "stiffness_per_s2": 3000.0, "damping_per_s": 60.0,
        "friction_rad_s2": 30.0, "effort_rad_s2": 300.0, "velocity_limit_rad_s": 6.0,
        "offset_rad": 0.0,
    }  # fmt: skip
    point = structure.encode(np.array([by_name[n] for n in structure.names]))
    best = refine(problem, point[None])
    return compare_repeats(fit_apart(problem, best.point, 3e-4, 0.0))


def test_one_recording_has_nothing_to_be_compared_with():
    assert compared(recorded("monday", 0)) is None


def test_recordings_of_one_servo_agree():
    repeats = compared(recorded("monday", 0), recorded("tuesday", 1), recorded("walk", 2))
    assert repeats is not None and repeats.differences == ()
    assert repeats.between[:-1].max() < 0.05  # a tenth would be seen


def test_what_recordings_vary_by_is_no_misfit_and_the_fit_is_their_mean():
    changes = {"stiffness": 1.06, "damping": 0.97, "velocity_limit": 0.96}
    ready, fitted = pooled(trials("monday", 0), trials("tuesday", 1, **changes))
    as_read = replace(ready, between_rad=())
    assert undescribed(goodness_of(as_read, fitted)) is not None
    assert undescribed(goodness_of(ready, fitted)) is None
    values = dict(zip(fitted.structure.names, fitted.values, strict=True))
    assert values["stiffness_per_s2"] == pytest.approx(3000.0 * 1.03, rel=0.02)
    assert values["damping_per_s"] == pytest.approx(60.0 * 0.985, rel=0.02)
    assert values["velocity_limit_rad_s"] == pytest.approx(6.0 * 0.98, rel=0.02)


def test_a_recording_that_is_not_described_by_its_own_fit_is_named_among_others_that_are():
    recordings = [trials("monday", 0), trials("tuesday", 1), trials("walk", 2, bend_rad=5e-3)]
    ready, fitted = pooled(*recordings)
    goodness = goodness_of(ready, fitted)
    assert undescribed(goodness) is not None
    assert all(motion.endswith(" of walk") for motion in goodness)


def test_readings_of_one_recording_are_left_as_they_are():
    ready, _ = pooled(trials("monday", 0))
    assert ready.alike is ready.runs


@pytest.mark.parametrize("recordings", [2, 3, 5])
@pytest.mark.parametrize("spread", [0.0, 0.01, 0.03, 0.1])
def test_intervals_hold_the_next_recording_however_widely_recordings_vary(recordings, spread):
    rng, structure, error = np.random.default_rng(1), candidate(SIMULATED[0]), 0.005
    kept, widths = [], []
    for _ in range(200):
        truths = spread * rng.standard_normal((recordings + 1, len(structure.names)))
        points = truths[:-1] + error * rng.standard_normal((recordings, len(structure.names)))
        repeats = repeats_of(points, np.full(points.shape, error**2), structure)
        pooled = error / np.sqrt(recordings) * rng.standard_normal((400, points.shape[1]))
        draws = points.mean(axis=0) + pooled + repeats.of_the_next(rng, 400)
        low, high = np.quantile(draws, [0.05, 0.95], axis=0)
        kept.append(((low <= truths[-1]) & (truths[-1] <= high))[:-1])  # without the offset
        widths.append((high - low)[:-1])
    assert np.mean(kept) >= 0.75  # a moment estimate: 0.65 of two recordings
    # 3.3 standard deviations of the next value, and what so few recordings leave open of them
    next_sd = np.hypot(spread * np.sqrt(1 + 1 / recordings), error)
    assert np.median(widths) < {2: 3, 3: 1.7, 5: 1.4}[recordings] * 3.29 * next_sd


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"stiffness": 0.8, "damping": 0.8}, "gains (stiffness and damping)"),
        ({"velocity_limit": 0.8}, "velocity_limit_rad_s"),
        ({"dead_time_s": 0.8}, "dead_time_s"),
    ],
)
def test_the_recording_that_differs_is_named_with_its_number_and_the_factor(changes, named):
    repeats = compared(
        recorded("monday", 0), recorded("tuesday", 1, **changes), recorded("walk", 2)
    )
    assert repeats is not None
    worst = repeats.differences[0]
    assert (worst.recording, worst.name) == ("tuesday", named)
    assert worst.factor.low - 0.03 <= 0.8 <= worst.factor.high + 0.03
    place = repeats.names.index("dead_time_s" if "dead" in named else
                                "stiffness_per_s2" if "gains" in named else named)  # fmt: skip
    assert repeats.between[place] > 0.05
    assert "tuesday differs from the other recordings" in worst.sentence("knee")


def parabolas(changes: dict[str, float], rng: np.random.Generator) -> dict[str, Apart]:
    """Two fits whose costs are parabolas with ridges of their own; the second has other numbers."""
    structure, fits = candidate(SIMULATED[0]), {}
    count = len(structure.names)
    shift = np.array([np.log(changes.get(name, 1.0)) for name in structure.names])
    for name in ("monday", "tuesday"):
        axes, _ = np.linalg.qr(rng.standard_normal((count, count)))
        sd = np.exp(rng.uniform(np.log(0.003), np.log(0.3), count))
        precision = (axes / sd**2) @ axes.T
        point = np.mean(structure.box, axis=0) + shift * (name == "tuesday")
        point = point + axes @ (sd * rng.standard_normal(count))
        part: Any = SimpleNamespace(structure=structure)
        part.costs = lambda x, p=point, h=precision: 0.5 * np.sum((x - p) @ h * (x - p), axis=1)
        fits[name] = Apart(part, point, precision, 1.0)
    return fits


def factors(changes: dict[str, float], pairs: int) -> list[Interval]:
    """Factors of the stiffness, where it is named."""
    rng, named = np.random.default_rng(6104), []
    while len(named) < pairs:
        repeats = compare_repeats(parabolas(changes, rng))
        assert repeats is not None
        named += [d.factor for d in repeats.differences if d.name == "stiffness_per_s2"]
    return named


def test_the_interval_of_a_factor_holds_it_where_the_recordings_have_ridges_of_their_own():
    named = factors({"stiffness_per_s2": 0.8}, 200)
    assert 0.85 <= np.mean([f.low <= 0.8 <= f.high for f in named]) <= 0.97


def test_the_interval_of_a_factor_is_wider_where_that_alone_does_not_explain_the_difference():
    several = {"stiffness_per_s2": 0.8, "friction_rad_s2": 1.2, "dead_time_s": 0.9}
    alone, beside = factors({"stiffness_per_s2": 0.8}, 100), factors(several, 100)
    width = [np.median([f.high / f.low - 1 for f in each]) for each in (alone, beside)]
    assert width[1] > 1.5 * width[0]
