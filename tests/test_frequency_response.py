"""Gain, phase, bandwidth and transfer functions, on servos whose transfer function is known."""

import json

import control
import numpy as np
import pytest
from scipy.signal import lfilter
from synthetic import LOOP_S, held_trial, tone_trials

from common.errors import InputError
from sysid.delay import Interval
from sysid.excitation import plan
from sysid.frequency_response import frequency_response, to_json
from sysid.multisine import multisine_responses
from sysid.poll_lattice import find_poll_lattice, readings
from sysid.recording import load
from sysid.transfer_function import TransferFunction, fit_transfer_function

FREQUENCIES = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
JOINT = "LF_hip"


def fopdt(frequency_hz, gain, delay_s, time_constant_s):
    s = 2j * np.pi * np.asarray(frequency_hz)
    return gain * np.exp(-delay_s * s) / (time_constant_s * s + 1)


def sopdt(frequency_hz, gain, delay_s, natural_rad_s, damping):
    s = 2j * np.pi * np.asarray(frequency_hz)
    rational = natural_rad_s**2 / (s**2 + 2 * damping * natural_rad_s * s + natural_rad_s**2)
    return gain * np.exp(-delay_s * s) * rational


def answered(response, rng, frequencies=FREQUENCIES, amplitude=0.2, **options):
    """Tones as a servo with `response` answers them, when the bus holds each for a loop."""
    trials = []
    for n, f in enumerate(frequencies):
        held = np.sinc(f * LOOP_S) * np.exp(-1j * np.pi * f * LOOP_S)
        phasor = amplitude * held * response(f)
        where = {"frequency_hz": f, "number": n, "start_s": 20.0 * n, "duration_s": max(4, 4 / f)}
        trials.append(
            held_trial(
                lambda t, f=f, p=phasor: (p * np.exp(2j * np.pi * f * t)).imag,
                lambda t, f=f: amplitude * np.sin(2 * np.pi * f * t),
                rng,
                **where,
                **options,
            )
        )
    return trials


def multisine_trial(rng, delay_s, time_constant_s, lines=(1.0, 2.0, 3.0, 4.3, 6.1), **options):
    """A multisine through the bus's hold, a delay and a first-order lag, stepped exactly."""
    made = plan("multisine", [JOINT], lines, amplitude_rad=0.3, loop_period_s=LOOP_S).trials[0]
    fine = np.arange(0.0, made.duration_s, 5e-4)
    send = np.arange(0.0, made.duration_s, LOOP_S)
    held = made.offset(send)[np.searchsorted(send, fine, side="right") - 1]
    pole = np.exp(-5e-4 / time_constant_s)
    motion = lfilter([0.0, 1 - pole], [1.0, -pole], held)
    return held_trial(
        lambda t: np.interp(t - delay_s, fine, motion), made.offset, rng,
        duration_s=made.duration_s, **options,
    )  # fmt: skip


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_fopdt_parameters_are_recovered_even_when_half_the_reads_are_lost(loss):
    truth = {"gain": 0.95, "delay_s": 0.025, "time_constant_s": 0.020}
    rng = np.random.default_rng(0)
    trials = answered(lambda f: fopdt(f, **truth), rng, loss=loss)
    fit = frequency_response(JOINT, trials, rng).fits[0]
    assert fit.name == "FOPDT" and fit.at_bound == ()
    assert fit.parameters["gain"].value == pytest.approx(0.95, abs=0.005)
    assert fit.delay_s == pytest.approx(0.025, abs=5e-4)
    assert fit.parameters["time_constant_s"].value == pytest.approx(0.020, abs=5e-4)


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_sopdt_parameters_are_recovered_even_when_half_the_reads_are_lost(loss):
    rng = np.random.default_rng(1)
    trials = answered(lambda f: sopdt(f, 1.0, 0.02, 60.0, 0.7), rng, loss=loss)
    fopdt_fit, fit = frequency_response(JOINT, trials, rng).fits
    value = {name: p.value for name, p in fit.parameters.items()}
    assert value["delay_s"] == pytest.approx(0.02, abs=1e-3)
    assert value["natural_frequency_rad_s"] == pytest.approx(60.0, rel=0.03)
    assert value["damping_ratio"] == pytest.approx(0.7, rel=0.03)
    assert fopdt_fit.chi2_per_dof > 10 * fit.chi2_per_dof


def test_the_delay_is_unbiased_over_recordings_that_lose_half_the_reads():
    errors = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        trials = answered(lambda f: fopdt(f, 1.0, 0.030, 0.015), rng, (1, 2, 4, 6, 8), loss=0.5)
        errors.append(frequency_response(JOINT, trials, rng).fits[0].delay_s - 0.030)
    assert abs(np.mean(errors)) < 0.5e-3


def test_a_delay_longer_than_a_period_comes_out_whole():
    # 160 ms is more than one period at 8 Hz and at 10 Hz
    rng = np.random.default_rng(2)
    trials = answered(lambda f: fopdt(f, 1.0, 0.16, 0.01), rng, (1, 2, 4, 6, 8, 10), loss=0.3)
    found = frequency_response(JOINT, trials, rng)
    assert found.fits[0].delay_s == pytest.approx(0.16, abs=1e-3)
    lag_s = 0.16 + np.arctan(2 * np.pi * 10 * 0.01) / (2 * np.pi * 10)
    assert found.phase_deg[-1] == pytest.approx(-360 * 10 * lag_s, abs=3)


def test_a_pure_delay_leaves_no_time_constant_to_find():
    rng = np.random.default_rng(3)
    fit = frequency_response(JOINT, tone_trials(0.04, rng), rng).fits[0]
    total = fit.delay_s + fit.parameters["time_constant_s"].value
    assert fit.parameters["time_constant_s"].low < 1e-3
    assert total == pytest.approx(0.04, abs=5e-4)


def test_a_second_order_fit_to_a_first_order_servo_says_that_its_damping_means_nothing():
    # a first-order lag is the limit of ever larger damping and natural frequency
    frequency = np.array(FREQUENCIES)
    truth = fopdt(frequency, 1.0, 0.025, 0.02)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2, len(frequency), 300))
    fit = fit_transfer_function(
        "SOPDT", frequency, truth, truth[:, None] + noise[0] + 1j * noise[1]
    )
    assert fit.at_bound == ("damping_ratio",)


def test_intervals_of_the_delay_have_the_width_that_the_covariance_implies():
    # one parameter at a time: with gain and τ known to be exact, Fisher's information of T from
    # white noise s on both parts of each tone is sum(|2πf H|²) / s²; the free fit is no tighter
    frequency, s = np.array(FREQUENCIES), 2e-3
    truth = fopdt(frequency, 1.0, 0.025, 0.02)
    noise = s * np.random.default_rng(1).standard_normal((2, len(frequency), 1000))
    fit = fit_transfer_function(
        "FOPDT", frequency, truth, truth[:, None] + noise[0] + 1j * noise[1]
    )
    slopes = [
        np.concatenate([d.real, d.imag])
        for d in (
            truth,
            -2j * np.pi * frequency * truth,
            -2j * np.pi * frequency * truth / (1 + 2j * np.pi * frequency * 0.02),
        )
    ]
    jacobian = np.stack(slopes, axis=1)
    sd = s * np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[1, 1])
    delay = fit.parameters["delay_s"]
    # 200 draws put a 5 % quantile within 11 % of its place
    assert (delay.high - delay.low) / 2 == pytest.approx(1.645 * sd, rel=0.3)


def test_bandwidth_of_a_first_order_lag_is_one_over_two_pi_tau():
    tau = 1 / (2 * np.pi * 5.0)
    rng = np.random.default_rng(4)
    trials = answered(lambda f: fopdt(f, 0.9, 0.01, tau), rng)
    bandwidth = frequency_response(JOINT, trials, rng).bandwidth_hz
    # the lowest tone stands for zero frequency: 1 + (f/5)² = 2 (1 + (0.5/5)²), 1 % above 5 Hz
    assert bandwidth is not None
    assert bandwidth.value == pytest.approx(5.0 * np.sqrt(1 + 2 * 0.1**2), rel=0.02)
    assert bandwidth.low <= bandwidth.value <= bandwidth.high < bandwidth.low + 0.5


def test_a_bandwidth_above_the_highest_tone_is_not_made_up():
    rng = np.random.default_rng(5)
    found = frequency_response(JOINT, tone_trials(0.04, rng), rng)
    assert found.bandwidth_hz is None
    assert found.bandwidth_text() == "above 4.0 Hz, the highest tone"
    assert to_json(found)["bandwidth_hz"] is None


def test_one_frequency_has_a_gain_but_neither_bandwidth_nor_transfer_function():
    rng = np.random.default_rng(6)
    found = frequency_response(JOINT, tone_trials(0.04, rng, (2.0,), duration_s=6.0), rng)
    assert found.gain == pytest.approx([1.0], abs=0.02)
    assert found.fits == () and "one frequency" in found.bandwidth_text()


def test_gain_is_true_on_fresh_readings_where_all_rows_show_attenuation():
    rng = np.random.default_rng(7)
    found = frequency_response(JOINT, tone_trials(0.04, rng, (1.0, 4.0, 8.0), 0.15), rng)
    assert found.gain == pytest.approx(np.ones(3), abs=0.03)
    assert abs(found.naive_response[2]) < 0.8


def test_amplitudes_are_kept_apart_for_the_describing_gain():
    # Coulomb friction eats a constant part of every amplitude: gain 1 - 0.02 / A
    rng = np.random.default_rng(8)
    trials = []
    for n, amplitude in enumerate((0.1, 0.2, 0.4)):
        trials += tone_trials(
            0.04, rng, (2.0,), amplitude, 1 - 0.02 / amplitude, duration_s=5.0, quantum_rad=0.001
        )
        trials[-1] = type(trials[-1])(**{**vars(trials[-1]), "number": n})
    found = frequency_response(JOINT, trials, rng)
    by_amplitude = np.argsort(found.amplitude_rad)
    # as the bus holds them, amplitudes are smaller by sinc(f loop)
    held = np.array([0.1, 0.2, 0.4]) * np.sinc(2.0 * LOOP_S)
    assert found.amplitude_rad[by_amplitude] == pytest.approx(held, rel=1e-3)
    assert found.gain[by_amplitude] == pytest.approx([0.8, 0.9, 0.95], abs=0.01)


def test_covariance_matches_the_scatter_over_repeated_recordings():
    found = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        trials = answered(
            lambda f: fopdt(f, 1.0, 0.03, 0.01), rng, (3.0,), noise_rad=0.02, loss=0.0,
            period_s=0.0, quantum_rad=0.0,
        )  # fmt: skip
        found.append(frequency_response(JOINT, trials, rng, find_poll_lattice(trials)))
    response = np.array([f.response[0] for f in found])
    scatter = np.var(response.real, ddof=1) + np.var(response.imag, ddof=1)
    stated = np.mean([np.trace(f.covariance[0]) for f in found])
    # white noise, N readings: variance of each part of the phasor is 2 s² / N. Readings in the
    # steady part of 4 s less 0.2 s: 200; the held amplitude is 0.2 sinc(3 · 0.019).
    expected = 2 * (2 * 0.02**2 / 200) / (0.2 * np.sinc(3 * LOOP_S)) ** 2
    assert stated == pytest.approx(expected, rel=0.5)
    # 48 squares scatter by 20 %; three times that
    assert scatter == pytest.approx(expected, rel=0.6)


def test_python_control_gets_the_measurement_and_the_rational_part():
    rng = np.random.default_rng(9)
    found = frequency_response(JOINT, answered(lambda f: fopdt(f, 1.0, 0.02, 0.02), rng), rng)
    frd = found.frd()
    assert isinstance(frd, control.FrequencyResponseData)
    np.testing.assert_allclose(frd(2j * np.pi * found.frequency_hz), found.response)
    for fit in found.fits:
        s = 2j * np.pi * 3.0
        whole = fit.rational()(s) * np.exp(-fit.delay_s * s)
        assert whole == pytest.approx(complex(fit.evaluate(np.array([3.0]))[0]))


def test_a_transfer_function_reads_as_a_formula():
    def exactly(value):
        return Interval(value, value, value)

    fit = TransferFunction(
        "FOPDT",
        {"gain": exactly(1.0), "delay_s": exactly(0.025), "time_constant_s": exactly(0.02)},
        1.0,
    )
    assert str(fit) == "1.000 exp(-0.0250 s) / (0.0200 s + 1)"


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_every_line_of_a_multisine_gives_its_response(loss):
    rng = np.random.default_rng(10)
    trial = multisine_trial(rng, 0.025, 0.02, loss=loss)
    found = frequency_response(JOINT, [trial], rng)
    assert found.frequency_hz == pytest.approx([1.0, 2.0, 3.0, 4.3, 6.1], abs=0.02)
    away = np.abs(found.response - fopdt(found.frequency_hz, 1.0, 0.025, 0.02))
    stated = np.sqrt(np.trace(found.covariance, axis1=1, axis2=2))
    assert np.all(stated < 0.01) and np.all(away < 4 * stated)
    assert found.fits[0].delay_s == pytest.approx(0.025, abs=1e-3)


def test_a_chirp_is_no_multisine_and_the_error_says_what_to_record():
    rng = np.random.default_rng(11)
    made = plan("chirp", [JOINT], (1.0, 8.0), amplitude_rad=0.1).trials[0]
    trial = held_trial(lambda t: made.offset(t - 0.05), made.offset, rng, duration_s=10.0)
    lattice = find_poll_lattice([trial])
    assert multisine_responses(trial, readings(trial, lattice), rng) == []
    with pytest.raises(InputError, match=r"LF_hip: .*sweep --freqs"):
        frequency_response(JOINT, [trial], rng)


def test_json_is_finite_and_complete():
    rng = np.random.default_rng(12)
    found = to_json(frequency_response(JOINT, tone_trials(0.04, rng), rng))
    json.dumps(found, allow_nan=False)
    assert [row["frequency_hz"] for row in found["by_frequency"]] == pytest.approx([1, 2, 3, 4])
    assert set(found["transfer_functions"]) == {"FOPDT", "SOPDT"}


def test_the_same_seed_gives_the_same_numbers():
    trials = tone_trials(0.04, np.random.default_rng(13))
    first, second = (
        to_json(frequency_response(JOINT, trials, np.random.default_rng(1))) for _ in range(2)
    )
    assert first == second


def test_the_real_servos_follow_at_4_hz_where_raw_rows_say_they_do_not(real_sweeps):
    for path in real_sweeps:
        recording = load(path)
        (joint,) = recording.joints
        found = frequency_response(joint, recording.trials(joint), np.random.default_rng(0))
        assert found.frequency_hz[-1] == pytest.approx(4.0, abs=0.05)
        assert 0.97 < found.gain[-1] < 1.06
        assert abs(found.naive_response[-1]) < 0.95
