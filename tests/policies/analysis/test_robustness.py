"""Altered observations, and what a walking policy makes of them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pupper_sysid.policies.analysis import figures
from pupper_sysid.policies.analysis.autonomy import (
    Autonomy,
    RatePoint,
    frozen,
    orbits,
    push_response,
)
from pupper_sysid.policies.analysis.trial import (
    JOINTS,
    DelayPoint,
    ablation,
    applied,
    delay_curve,
    delayed,
    held,
    jittered,
    noisy,
    zeroed,
)
from pupper_sysid.policies.walks.rollouts import Rollout
from support.walks import recorded

STEPS, ROBOTS = 60, 3


def counting() -> np.ndarray:
    """Every number of step k is k."""
    seen = np.repeat(np.arange(STEPS, dtype=np.float32), ROBOTS * 60)
    return seen.reshape(STEPS, ROBOTS, 60)


def test_each_change_alters_the_joints_in_its_way_and_leaves_the_rest_alone():
    steps = np.arange(STEPS)
    late = applied(delayed(JOINTS, 8), counting())
    for robot, number in ((0, 12), (1, 47)):
        np.testing.assert_array_equal(late[:, robot, number], np.maximum(steps - 8, 0))
    stale = applied(held(JOINTS, 5), counting())
    np.testing.assert_array_equal(stale[:, 0, 20], 5 * (steps // 5))
    nothing = applied(zeroed(JOINTS), counting())
    assert not nothing[..., JOINTS].any()
    for changed in (late, stale, nothing):
        np.testing.assert_array_equal(changed[:, 0, 11], steps)
        np.testing.assert_array_equal(changed[:, 0, 48], steps)


def test_a_jittered_delay_never_goes_back_in_time_and_keeps_its_bounds():
    rng = np.random.default_rng(0)
    seen = applied(jittered(JOINTS, 4, rng), counting())[:, :, 12]
    lag = np.arange(STEPS)[:, None] - seen
    assert (np.diff(seen, axis=0) >= 0).all()
    assert lag.min() >= 0 and lag.max() <= 8
    assert len(np.unique(lag[10:])) > 3 and (lag[:, 0] != lag[:, 1]).any()


def test_noise_has_the_size_that_was_asked_for_per_number():
    sigma = np.linspace(0.1, 2.0, 36)
    change = noisy(JOINTS, sigma, np.random.default_rng(0))
    added = applied(change, np.zeros((4000, 1, 60), np.float32))
    np.testing.assert_allclose(added[:, 0, JOINTS].std(axis=0), sigma, rtol=0.06)
    assert not added[..., :12].any() and not added[..., 48:].any()


def test_a_delay_curve_has_its_three_modes_and_begins_with_the_plain_walk(walker):
    policy, trial = walker
    rows = delay_curve(policy, replace(trial, robots=1), extra_ms=(0,))
    assert [r.extra_delay_ms for r in rows] == [0, 0, 0]
    plain = {r.mode: r for r in rows}
    assert list(plain) == ["replay", "fixed", "jittered"]
    # shown what it saw, a policy does what it did
    assert plain["replay"].frequency_hz == pytest.approx(plain["fixed"].frequency_hz, rel=0.02)
    assert plain["fixed"].survival == plain["jittered"].survival == 1.0
    assert plain["fixed"].frequency_hz == pytest.approx(3.0, abs=0.15)


@pytest.mark.slow
def test_an_ablation_hurts_more_the_more_is_taken(walker, monkeypatch):
    policy, trial = walker
    monkeypatch.setattr("pupper_sysid.policies.analysis.trial.NOISE_SHARES", (0.05, 2.0))
    monkeypatch.setattr("pupper_sysid.policies.analysis.trial.HOLD_MS", (80,))
    rows = ablation(policy, trial, channels=("last_action",))
    noise = [r.correlation for r in rows if r.kind == "noise"]
    assert noise[0] > 0.9 and noise[-1] < noise[0] - 0.2
    assert {r.kind for r in rows} == {"noise", "zero", "hold"}


# ------------------------------------------------------------------ policies that do not walk


def fallen(rollout: Rollout, robots: list[int], after_s: float) -> Rollout:
    """The same walk, but these robots fell; what is recorded of them then is noise."""
    alive, seen = rollout.alive.copy(), rollout.observation.copy()
    at = round(after_s / rollout.step_s)
    alive[at:, robots] = False
    noise = np.random.default_rng(0).standard_normal(seen[at:, robots].shape)
    seen[at:, robots] = 5 * noise
    end = len(alive) if alive[-1].any() else at + 1  # a rollout ends when nobody is up
    parts = {
        f.name: getattr(rollout, f.name)[:end] for f in fields(rollout)
        if isinstance(getattr(rollout, f.name), np.ndarray) and f.name != "fell"
    }  # fmt: skip
    changed = {"alive": alive[:end], "observation": seen[:end], "fell": ~alive[-1]}
    return replace(rollout, **parts | changed)


@pytest.mark.slow
def test_replay_is_of_the_robots_that_walked_and_only_while_they_did(walker):
    policy, trial = walker
    plain = trial.walk(policy)
    half = recorded(fallen(plain, [0], 3.0))
    alone = recorded(replace_robots(plain, [1]))
    for measure in (
        lambda t: frozen(policy, t), lambda t: delay_curve(policy, t, (80,))[:1],
        lambda t: orbits(policy, t, (0.0, 160.0))["actions"].closure,
    ):  # fmt: skip
        for one, other in zip(measure(half), measure(alone), strict=True):
            one, other = (x if isinstance(x, float) else vars(x) for x in (one, other))
            assert one == pytest.approx(other, nan_ok=True, abs=1e-4)


def replace_robots(rollout: Rollout, robots: list[int]) -> Rollout:
    """The same walk of some of its robots."""
    parts = {
        f.name: getattr(rollout, f.name)[:, robots] for f in fields(rollout)
        if isinstance(getattr(rollout, f.name), np.ndarray) and f.name != "fell"
    }  # fmt: skip
    return replace(rollout, **parts, fell=rollout.fell[robots])


def test_where_all_fell_there_are_no_numbers_and_no_crash(walker):
    policy, trial = walker
    gone = recorded(fallen(replace(trial, seconds=2.5).walk(policy), [0, 1], 0.5))
    assert all(np.isnan(r.share) for r in frozen(policy, gone))
    assert all(np.isnan(r.frequency_hz) for r in delay_curve(policy, gone, (0, 80)))
    assert orbits(policy, gone, (0.0, 160.0)) == {} and push_response(policy, gone) == ()
    rows = ablation(policy, gone, ("last_action",))
    assert all(np.isnan(r.correlation) for r in rows)
    figures.ablation_figure({"fell": rows})
    figures.gait_figure(gone.walk(policy))
    figures.autonomy_figure(
        {"fell": Autonomy(frozen=frozen(policy, gone), push=(), rate_exponent=float("nan"),
                          rate=(RatePoint(rate_hz=50.0, cycles_per_step=float("nan")),))}
    )  # fmt: skip


def test_an_eighth_policy_is_drawn_as_well_and_what_no_walk_has_is_not():
    row = DelayPoint(
        mode="fixed", extra_delay_ms=0, survival=1.0, frequency_hz=3.0, amplitude_rad=0.1
    )
    figure = figures.delay_figure({f"policy {k}": [row] for k in range(9)})
    assert [len(axes.lines) for axes in figure.axes] == [9, 9, 9]
    still = replace(row, frequency_hz=np.nan, amplitude_rad=np.nan)
    assert len(figures.delay_figure({"policy": [still]}).axes) == 1
