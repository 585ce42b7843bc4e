"""What servo models are fitted to: runs, readings at fractional ticks, windows, linear filters."""

import numpy as np
import pytest

from pupper_sysid.sysid.servo_fit.data import ServoData, look_up, servo_data
from pupper_sysid.sysid.servo_fit.windows import (
    chosen,
    fit_linear,
    grouped,
    learns_from,
    merged_groups,
    samples,
    taps,
    training_sets,
)
from support.refusals import assert_each_refused
from support.servo_recordings import JOINT, P, everything, ramp, recording, sine, trial

# ------------------------------------------------------------------------------- runs


def test_loops_without_a_pause_are_one_run_with_the_true_commands():
    loops = [trial(n, n * 10 * P, ramp(10, n), ramp(10, n)) for n in range(3)]
    data = servo_data([recording(*loops, rest=-0.3)], [JOINT], "all")
    (run,) = data.runs[JOINT]
    np.testing.assert_array_equal(run.command_rad, np.concatenate([ramp(10, n) for n in range(3)]))
    np.testing.assert_array_equal(run.number, np.repeat([0, 1, 2], 10))
    np.testing.assert_array_equal(run.group, np.repeat([0, 1, 2], 10))
    assert data.groups == ("loop 0", "loop 1", "loop 2")
    assert run.initial_rad == -0.3
    assert data.period_s == pytest.approx(P)
    of_third = run.readings.rows == 24
    assert run.tick[of_third] == pytest.approx(24.25)
    assert run.position_rad[of_third] == pytest.approx(2.04)
    assert run.reading_elapsed_s[of_third] == pytest.approx(4 * P + 0.005)
    assert chosen(run, lambda number, elapsed, group: number == 1).sum() == 10


def test_a_pause_starts_a_new_run_from_rest_or_where_that_is_unknown_from_the_first_reading():
    first, second = trial(0, 0.0, ramp(10), ramp(10)), trial(1, 5.0, ramp(8, 1), ramp(8, 1))
    data = servo_data([recording(first, second, rest=0.2)], [JOINT], "all")
    one, two = data.runs[JOINT]
    assert (len(one.command_rad), len(two.command_rad)) == (10, 8)
    assert two.initial_rad == 0.2 and two.command_rad[0] == 1.0
    rows = trial(0, 0.0, ramp(10), ramp(10, 0.4))
    (run,) = servo_data([recording(rows, rest=None)], [JOINT], "all").runs[JOINT]
    assert run.initial_rad == 0.4


def test_a_missing_tick_splits_a_run_that_then_starts_from_the_last_command():
    rows = trial(0, 0.0, ramp(20), ramp(20)).drop(index=[7])
    one, two = servo_data([recording(rows)], [JOINT], "all").runs[JOINT]
    np.testing.assert_allclose(one.command_rad, ramp(7))
    np.testing.assert_allclose(two.command_rad, ramp(12, 0.08))
    assert two.initial_rad == pytest.approx(0.06)
    assert two.elapsed_s[0] == pytest.approx(8 * P)  # its trial began before the gap
    assert two.reading_elapsed_s[0] == pytest.approx(8 * P + 0.005)
    assert two.tick[0] == pytest.approx(0.25)


# ------------------------------------------------------------------------------- readings


def test_a_held_reading_was_taken_between_the_reads_around_its_change():
    held = np.repeat([0.0, 0.1, 0.2, 0.3], 3)  # new at rows 3, 6, 9; too few to find a lattice
    (run,) = servo_data([recording(trial(0, 0.0, ramp(12), held))], [JOINT], "fresh").runs[JOINT]
    np.testing.assert_array_equal(run.readings.rows, [3, 6, 9])
    np.testing.assert_allclose(run.tick, np.array([3, 6, 9]) + 0.25 - 0.5)
    np.testing.assert_allclose(run.position_rad, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(run.held_tick, np.repeat([np.nan, 2.75, 5.75, 8.75], 3))


def test_missing_readings_never_count():
    position = ramp(30)
    position[[0, 4, 5, 20]] = np.nan
    for mode in ("all", "fresh"):
        data = servo_data([recording(trial(0, 0.0, ramp(30), position))], [JOINT], mode)
        (run,) = data.runs[JOINT]
        assert np.isfinite(run.position_rad).all() and len(run.tick) >= 25
        assert not set(run.readings.rows) & {0, 4, 5, 20}


def test_readings_held_more_than_a_fifth_of_the_time_count_only_when_fresh():
    for every, mode in ((4, "fresh"), (6, "all")):
        position = sine(400)
        held = position[every - 1 :: every]
        position[every - 1 :: every] = position[every - 2 :: every][: len(held)]
        data = servo_data([recording(trial(0, 0.0, sine(400), position))], [JOINT])
        assert data.modes[JOINT] == mode, every
    # a missing reading does not make the next one fresh
    position = sine(401)
    position[2::3] = position[:-2:3]  # each value is seen twice …
    position[1::3] = np.nan  # … with a failed read in between
    data = servo_data([recording(trial(0, 0.0, sine(401), position))], [JOINT])
    assert data.modes[JOINT] == "fresh"


def test_a_trial_cut_short_after_two_rows_does_not_stop_the_others():
    whole, short = trial(0, 0.0, sine(60), sine(60)), trial(1, 9.0, sine(2), sine(2))
    data = servo_data([recording(whole, short)], [JOINT])
    assert [len(r.command_rad) for r in data.runs[JOINT]] == [60, 2]


def test_recordings_that_give_no_servo_data_are_refused():
    slow = recording(trial(0, 0.0, ramp(20), ramp(20), period_s=0.04))
    fast = recording(trial(0, 0.0, ramp(20), ramp(20)))
    dead = recording(trial(0, 0.0, ramp(20), np.full(20, np.nan)))
    cases = [
        (([fast, slow], [JOINT]), "20.0 ms"), (([fast, slow], [JOINT]), "40.0 ms"),
        (([dead], [JOINT]), JOINT), (([dead], ["RB_calf"]), "RB_calf"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda case: servo_data(*case))


def test_tones_are_groups_across_recordings_and_loops_are_not():
    tones = [
        recording(
            trial(0, 0.0, ramp(9), late + ramp(9), frequency_hz=2.0),
            trial(1, 9.0, ramp(9), late + ramp(9), frequency_hz=3.5),
            name=name,
        )
        for name, late in (("a", 0.0), ("b", 1e-3))
    ]
    data = servo_data(tones, [JOINT], "all")
    assert data.groups == ("2 Hz", "3.5 Hz")
    assert [int(r.group[0]) for r in data.runs[JOINT]] == [0, 1, 0, 1]
    loops = [
        recording(trial(0, 0.0, ramp(9), late + ramp(9)), name=name)
        for name, late in (("a", 0.0), ("b", 1e-3))
    ]
    assert servo_data(loops, [JOINT], "all").groups == ("a, loop 0", "b, loop 0")


# ------------------------------------------------------------------------------- look_up


def test_look_up_is_exact_for_polynomials_up_to_the_second_degree_and_good_for_tones():
    at, track = (
        np.random.default_rng(1).uniform(1, 17, 200),
        np.random.default_rng(2).normal(size=12),
    )
    for degree in (0, 1, 2):
        expected = (at - 8.0) ** degree
        np.testing.assert_allclose(look_up((np.arange(20) - 8.0) ** degree, at), expected)
    np.testing.assert_allclose(look_up(track, np.arange(12.0)), track)
    assert np.isnan(look_up(track, np.array([np.nan]))).all()
    turn, at = 2 * np.pi * 4 * 0.019, np.linspace(2, 97, 2000)  # of 4 Hz
    assert 0.3 * turn**2 / 8 > 8e-3  # the error of straight lines
    found = look_up(0.3 * np.sin(turn * np.arange(100)), at)
    assert np.abs(found - 0.3 * np.sin(turn * at)).max() < 1e-3


# ------------------------------------------------------------------------------- windows


def identifiable(read_after_s: float) -> tuple[ServoData, list[np.ndarray]]:
    """Two runs: commands are 1000 · run + tick, readings 1000 · run + row + 0.5."""
    commands = [1000.0 * n + np.arange(rows) for n, rows in enumerate((100, 60))]
    trials = [
        trial(n, 10.0 * n, c, c + 0.5, read_after_s=read_after_s) for n, c in enumerate(commands)
    ]
    return servo_data([recording(*trials, rest=-7.0)], [JOINT], "all"), commands


@pytest.mark.parametrize("read_after_s", [0.0, 0.013])
def test_windows_show_each_reading_the_commands_before_it_and_none_of_another_run(read_after_s):
    data, commands = identifiable(read_after_s)
    found = samples(data, everything, past=6)
    norm = {k: v[0] for k, v in found.normalisation.items()}
    history = found.at_readings(4)[0] * norm["command_scale"] + norm["command_center"]
    target = found.target[0] * norm["position_scale"] + norm["position_center"]
    t = read_after_s / P
    # Catmull-Rom, written out
    weight = 0.5 * np.array(
        [-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]
    )
    seen = set()
    for window, n in np.argwhere(found.used[0]):
        run, row = divmod(round(float(target[window, n]) - 0.5), 1000)
        seen.add((run, row))
        for tap in range(4):
            # at tick k the newest command is k - 1
            at = row + np.arange(-1, 3) - 1 - tap
            own = commands[run][np.clip(at, 0, len(commands[run]) - 1)]
            expected = weight @ np.where(at < 0, -7.0, own)
            assert history[window, n, tap] == pytest.approx(expected, abs=2e-3)
    assert seen == {(run, row) for run, c in enumerate(commands) for row in range(len(c))}


def test_padding_and_other_parts_never_count():
    other = "RF_hip"
    long = trial(0, 0.0, sine(300), sine(300))
    short = trial(0, 0.0, sine(60), sine(60), joint=other)
    data = servo_data([recording(long, short)], [JOINT, other], "all")
    found = samples(data, everything, past=6)
    np.testing.assert_array_equal(found.used.sum((1, 2)), [300, 60])
    assert (found.group[~found.used] == -1).all()
    early = samples(data, lambda number, elapsed, group: elapsed < 1.0, past=6)
    np.testing.assert_array_equal(early.used.sum((1, 2)), [50, 50])  # 1 s in ticks of 20 ms


def test_stretches_leave_half_a_second_after_each_boundary_out():
    data = servo_data([recording(trial(0, 0.0, sine(300), sine(300)))], [JOINT], "all")
    cut, _ = grouped(data, everything)
    guard = np.full(25, -1)  # 0.5 s in ticks of 20 ms
    expected = [np.zeros(100), guard, np.ones(75), guard, np.full(75, 2)]
    np.testing.assert_array_equal(cut.runs[JOINT][0].group, np.concatenate(expected))
    assert cut.groups == ("stretch 1", "stretch 2", "stretch 3")
    found = samples(cut, everything, past=6)
    assert learns_from(found, frozenset()).sum() == 300
    assert learns_from(found, frozenset({0})).sum() == 150
    merged = merged_groups(cut, most=2)  # rows without a group stay without one
    np.testing.assert_array_equal(merged.runs[JOINT][0].group == -1, cut.runs[JOINT][0].group == -1)


def test_merged_groups_are_few_and_keep_neighbouring_tones_apart():
    tones = [
        trial(n, 10.0 * n, ramp(9), ramp(9), frequency_hz=f)
        for n, f in enumerate([7, 1, 12, 3, 9, 2, 11, 5, 8, 4, 10, 6])
    ]
    data = servo_data([recording(*tones)], [JOINT], "all")
    merged = merged_groups(data)
    assert len(merged.groups) == 5
    fold = {r.trial.frequency_hz: int(r.group[0]) for r in merged.runs[JOINT]}
    assert all(fold[f] != fold[f + 1] for f in range(1, 12))
    for f, n in fold.items():
        assert f"{f:g} Hz" in merged.groups[n].split(", ")
    assert merged_groups(merged) is merged


def test_too_few_readings_and_commands_that_do_not_move_are_refused():
    few, still = (
        servo_data([recording(trial(0, 0.0, command, sine(len(command))))], [JOINT], "all")
        for command in (sine(9), np.zeros(50))
    )
    none = lambda number, elapsed, group: number > 5  # noqa: E731
    cases = [
        ((few, everything), f"{JOINT}: only 9 readings"), ((still, none), "only 0 readings"),
        ((still, everything), f"{JOINT}: its commands hardly change"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda case: samples(*case, past=6))


def test_training_sets_leave_out_nothing_each_group_and_each_pair():
    alone = [frozenset(), frozenset({0}), frozenset({3}), frozenset({5})]
    pairs = [frozenset({0, 3}), frozenset({0, 5}), frozenset({3, 5})]
    assert training_sets([0, 3, 5], nested=False) == alone
    assert training_sets([0, 3, 5], nested=True) == alone + pairs


# ------------------------------------------------------------------------------- linear filter

TRUE_FIR = 0.1 * np.exp(-np.arange(taps(P)) / 4)
TRUE_BIAS = 0.05


def filtered(command: np.ndarray, fir: np.ndarray = TRUE_FIR) -> np.ndarray:
    """Position at each tick: bias + the filter of the commands before it, from rest at 0."""
    return TRUE_BIAS + np.convolve(np.concatenate([[0.0], command]), fir)[: len(command)]


def noise_servo(seed: int, disturb=lambda position, rng: position, loops: int = 3):
    """Loops of white commands, answered by the true filter, read on the tick."""
    rng = np.random.default_rng(seed)
    command = 0.3 * rng.normal(size=400 * loops)
    position = disturb(filtered(command), rng)
    rows = [slice(400 * n, 400 * n + 400) for n in range(loops)]
    parts = [
        trial(n, 400 * n * P, command[r], position[r], read_after_s=0.0) for n, r in enumerate(rows)
    ]
    return samples(servo_data([recording(*parts)], [JOINT], "all"), everything, past=taps(P))


def physical(data, fits) -> tuple[np.ndarray, float]:
    """The filter [rad/rad] and what it says at commands of 0 [rad]."""
    n = {k: v[0] for k, v in data.normalisation.items()}
    fir = fits.fir[0, 0] * n["position_scale"] / n["command_scale"]
    bias = n["position_center"] + n["position_scale"] * fits.bias[0, 0]
    return fir, bias - fir.sum() * n["command_center"]


def test_the_filter_of_noise_free_data_is_found_exactly():
    data = noise_servo(0)
    fits = fit_linear(data, [frozenset()], P, ridge=1e-12)
    fir, bias = physical(data, fits)
    np.testing.assert_allclose(fir, TRUE_FIR, atol=1e-6)
    assert bias == pytest.approx(TRUE_BIAS, abs=1e-6)
    assert np.abs(fits.residual[data.used]).max() < 1e-5


def test_a_burst_of_outliers_does_not_tilt_the_filter():
    noise = 0.002

    def burst(position, rng):
        disturbed = position + noise * rng.normal(size=len(position))
        disturbed[500:560] += 50 * noise  # a fall: 5 % of the readings
        return disturbed

    data = noise_servo(1, burst)
    fir, bias = physical(data, fit_linear(data, [frozenset()], P, ridge=1e-9))
    # least squares would move the bias by 5 % of 50 noise, Huber by about 5 % of 1.5 noise
    assert abs(bias - TRUE_BIAS) < 0.25 * noise
    # and each coefficient by 50 sqrt(0.05 / n) / 0.3 noise; its own error is 1 / (0.3 sqrt(n))
    error = np.sqrt(np.mean((fir - TRUE_FIR) ** 2))
    assert error < 1.5 * noise / (0.3 * np.sqrt(1200))


def test_a_fit_left_with_no_readings_predicts_the_mean():
    data = noise_servo(3, loops=2)
    fits = fit_linear(data, training_sets([0, 1], nested=True), P, ridge=1e-3)
    assert not fits.fir[:, -1].any()
    assert not fits.bias[:, -1].any()
    assert all(np.isfinite(v).all() for v in vars(fits).values())


def test_old_commands_must_earn_their_place():
    data = noise_servo(4)
    strong = fit_linear(data, [frozenset()], P, ridge=1.0)
    fir, _ = physical(data, strong)
    shrunk = fir / TRUE_FIR
    # shrinkage of a coefficient faded by f, at a ridge r: f² / (f² + r), nearly so for white input
    fade = np.exp(-2 * np.arange(taps(P)) * P / 0.1)
    np.testing.assert_allclose(shrunk[:6], fade[:6] / (fade[:6] + 1.0), rtol=0.15)
