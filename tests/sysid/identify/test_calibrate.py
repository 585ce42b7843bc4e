"""Calibration recovers a servo, says what it does not know, and beats the published setting."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S, DelayedPD, DelayedPDParameters
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice, readings
from pupper_sysid.sysid.identify.calibrate import _calibrate_joint, _dead_time, _Task, calibrate
from pupper_sysid.sysid.identify.calibration_file import preset_parameters, to_calibration
from pupper_sysid.sysid.identify.models import LADDER, rung
from pupper_sysid.sysid.identify.output_error import Problem, fit, positions, prepare
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Truncation
from support.synthetic import LOOP_S, tone_trials

TRUE = DelayedPDParameters(
    stiffness=12000.0, damping=100.0, friction_loss=150.0, armature=1.0, effort_limit=450.0,
    velocity_limit=6.5, dead_time_s=0.025,
)  # fmt: skip


def servo_trials(rng, frequencies=(1.0, 2.0, 3.0, 4.0)):
    """Held, lossy, quantised readings of a servo with the parameters TRUE."""
    trials = []
    for trial in tone_trials(0.04, rng, frequencies, duration_s=3.0):
        start = trial.send_time_s[0]
        steps = np.arange(0.0, 3.0, TIME_STEP_S)
        row = np.clip(np.searchsorted(trial.send_time_s - start, steps, "right") - 1, 0, None)
        motion = DelayedPD(TRUE).rollout(trial.command_rad[row])
        polls = np.arange(rng.uniform(0, 0.02685), 3.0, 0.02685)
        polls = np.concatenate([[-1.0], polls[rng.random(len(polls)) >= 0.42]])
        seen = polls[np.searchsorted(polls, trial.read_time_s - start, "right") - 1]
        position = np.interp(seen, steps + TIME_STEP_S, motion, left=0.0)
        trials.append(replace(trial, position_rad=np.round(position / 0.0057) * 0.0057))
    return tuple(trials)


@pytest.fixture(scope="module")
def result():
    trials = servo_trials(np.random.default_rng(1))
    return _calibrate_joint(_Task("LF_hip", trials, 0, {}))


def test_delayed_pd_is_recovered_from_lossy_readings(result):
    pd = result.rungs["delayed_pd"]
    assert result.chosen == "delayed_pd"
    assert pd.values["dead_time_s"] == pytest.approx(0.025, abs=2e-3)
    assert pd.values["velocity_limit_rad_s"] == pytest.approx(6.5, rel=0.05)
    # the command's lag through a stiff PD is damping / stiffness
    ratio = pd.values["damping_per_s"] / pd.values["stiffness_per_s2"]
    assert ratio == pytest.approx(100 / 12000, abs=2.5e-3)


def test_the_truth_is_inside_the_dead_time_interval(result):
    assert result.dead_time.low <= 0.025 <= result.dead_time.high
    low, high = result.delay_steps
    assert low <= 12.5 <= high and high - low <= 8


def test_the_interval_of_a_fast_servo_ends_at_zero():
    trials = tone_trials(0.002, np.random.default_rng(2), (1.0, 3.0), period_s=0.0)
    found = _dead_time(_Task("LF_hip", tuple(trials), 0, {})).dead_time
    assert found.low == 0.0 < found.high


def test_the_fit_is_as_good_as_the_readings_allow(result):
    scores = result.rungs["delayed_pd"].scores
    # a count of 5.7 mrad and polls dated to about 0.5 ms at up to 6.5 rad/s
    assert scores.fresh < 6e-3 and scores.held < 8e-3
    assert scores.naive > 5 * scores.fresh  # stale rows: the model is right and looks wrong
    assert scores.fresh < result.rungs["pure_delay"].scores.fresh


def test_simpler_rungs_are_worse_on_tones_they_have_not_seen(result):
    errors = [result.rungs[r.name].scores.leave_one_out for r in LADDER]
    assert errors[0] > errors[2] > errors[4]


def test_friction_and_speed_limit_only_add_to_delay_and_linear_dynamics(result):
    linear = 0.025 + 100 / 12000  # low-frequency lag of the PD without them
    assert linear < result.budget.lag.value < linear + 0.015


def test_ratios_are_identified_and_torques_only_by_the_anchor(result, tmp_path):
    small, large = (to_calibration({"LF_hip": result}, [], 0, torque) for torque in (0.2, 0.4))
    a, b = small.joint("LF_hip").actuator, large.joint("LF_hip").actuator
    assert b.armature_kg_m2.value == pytest.approx(2 * a.armature_kg_m2.value)
    assert a.armature_kg_m2.identified == "ratio only" and a.effort_limit_nm.identified == "no"
    assert a.ratios_to_armature == b.ratios_to_armature
    # either moves alike: the scale cannot be seen in free air
    command = 0.3 * np.sin(np.arange(500) * 0.02)
    tracks = [c.delayed_pd().rollout(command[:, None]) for c in (small, large)]
    np.testing.assert_allclose(tracks[0], tracks[1], atol=1e-12)


def test_a_speed_limit_that_was_never_reached_is_not_claimed():
    rng = np.random.default_rng(2)
    slow = servo_trials(rng, (0.5, 1.0, 1.5))  # 2.8 rad/s at most
    found = _calibrate_joint(_Task("LF_hip", slow, 0, {}))
    assert "velocity_limit_rad_s" in found.rungs["delayed_pd"].undecided
    assert any("speed limit was not excited" in w for w in found.warnings)


def test_results_repeat_under_a_seed():
    trials = servo_trials(np.random.default_rng(3), (1.0, 3.0))
    first, again = (_calibrate_joint(_Task("LF_hip", trials, 5, {})) for _ in range(2))
    assert first.rungs == again.rungs and first.dead_time == again.dead_time


def test_the_fit_simulates_what_delayed_pd_simulates():
    trial = servo_trials(np.random.default_rng(4), (2.0,))[0]
    data = prepare(trial, readings(trial, find_poll_lattice([trial], np.random.default_rng(0))))
    values = np.array([0.0273, 12000.0, 100.0, 150.0, 450.0, 6.5, 0.0])
    track = positions(rung("delayed_pd"), [(values[None], [data])])[0][1:, 0, 0]
    model = DelayedPD(replace(TRUE, dead_time_s=0.0273))
    np.testing.assert_allclose(track, model.rollout(data.command), atol=1e-12)


def test_commands_are_averaged_over_physics_steps_and_truncated_by_count():
    trial = tone_trials(0.04, np.random.default_rng(5), (1.0,))[0]
    read = readings(trial, find_poll_lattice([trial], np.random.default_rng(0)))
    data = prepare(replace(trial, truncation=Truncation(0.0057, "up")), read)
    plain = prepare(trial, read)
    inside = slice(100, 1500)
    difference = data.command[inside] - plain.command[inside]
    assert difference.min() >= -1e-9 and difference.max() <= 0.0057 + 1e-9
    # a command row lasts 9.5 steps: held values appear, in between only their averages
    assert len(np.unique(np.round(data.command / 0.0057, 6) % 1)) < len(data.command) / 5
    assert LOOP_S / TIME_STEP_S == pytest.approx(9.5)


def test_a_frozen_parameter_stays_where_it_was_put():
    trials = servo_trials(np.random.default_rng(6), (1.0, 2.0))
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    data = tuple(prepare(t, readings(t, lattice)) for t in trials)
    model = rung("sopdt")
    start = np.array([[p.nominal for p in model.parameters]])
    (found,) = fit(model, [Problem(data, (True, True), 0.01, {"dead_time_s": 0.033})], start, 10)
    assert found.values[0] == pytest.approx(0.033)
    assert found.covariance[0, 0] == 0


@pytest.fixture(scope="module")
def real(real_sweeps):
    return calibrate([load(p) for p in real_sweeps], seed=0, presets=preset_parameters())


@pytest.mark.parametrize(
    ("joint", "lag", "held", "unseen"),
    [("LF_hip", 40.4, 14.5e-3, 19e-3), ("LF_thigh", 42.4, 18.5e-3, 22.5e-3)],
)
def test_the_real_sweeps_reach_the_best_published_figures(real, joint, lag, held, unseen):
    found = real[joint]
    pd = found.rungs["delayed_pd"].scores
    lattice = found.budget.lattice
    assert 1e3 * lattice.period_s == pytest.approx(26.85, abs=0.15)
    assert lattice.loss == pytest.approx(0.42, abs=0.05)
    assert found.quantum_rad == pytest.approx(5.712e-3, abs=1e-6)
    assert 1e3 * found.budget.lag.value == pytest.approx(lag, abs=1.5)
    assert 1e3 * (found.budget.lag.high - found.budget.lag.low) / 2 <= 1.5
    assert 0.013 <= found.dead_time.low < found.dead_time.high <= 0.032
    assert 0.97 <= found.budget.by_frequency[-1].gain <= 1.06
    assert pd.held <= held
    assert found.rungs[found.chosen].scores.leave_one_out <= unseen


def test_the_paper_setting_is_ten_times_further_off(real):
    ours = np.mean([r.rungs["delayed_pd"].scores.held ** 2 for r in real.values()])
    paper = np.mean([r.presets["paper"].held ** 2 for r in real.values()])
    assert np.sqrt(paper / ours) >= 10


def test_models_fitted_to_1_2_3_hz_predict_4_hz(real):
    left_out = [
        r.rungs[r.chosen].scores.leave_one_out_by_frequency[4.0] ** 2 for r in real.values()
    ]
    assert np.sqrt(np.mean(left_out)) <= 28e-3
