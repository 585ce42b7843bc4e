"""Sine fits, a transfer function by SciPy, simulated by python-control: a careful afternoon."""

import control
import numpy as np
from exchange import Fitted, serve
from scipy.fft import rfft, rfftfreq
from scipy.optimize import curve_fit, least_squares

CONTINUOUS = 0.0001  # s: no steps worth the name


def phasor(time, signal, frequency):
    basis = np.stack([np.cos(2 * np.pi * frequency * time), np.sin(2 * np.pi * frequency * time),
                      np.ones_like(time)], axis=1)  # fmt: skip
    cosine, sine, _ = np.linalg.lstsq(basis, signal, rcond=None)[0]
    return cosine - 1j * sine


def tone_of(trial):
    command = trial.command_rad - np.mean(trial.command_rad)
    spectrum = np.abs(rfft(command))
    coarse = rfftfreq(len(command), np.mean(np.diff(trial.command_time_s)))[np.argmax(spectrum)]
    wave = lambda t, a, f, p, c: a * np.sin(2 * np.pi * f * t + p) + c  # noqa: E731
    start = [np.ptp(command) / 2, coarse, 0.0, 0.0]
    return abs(curve_fit(wave, trial.command_time_s, command, start)[0][1])


def fit(trials):
    frequency = np.array([tone_of(t) for t in trials])
    response = np.array([
        phasor(t.time_s, t.position_rad, f) / phasor(t.command_time_s, t.command_rad, f)
        for t, f in zip(trials, frequency, strict=True)
    ])  # fmt: skip
    s = 2j * np.pi * frequency

    def model(p):
        gain, natural, damping, delay = p
        return (
            gain * natural**2 / (s**2 + 2 * damping * natural * s + natural**2) * np.exp(-delay * s)
        )

    def residual(p):
        error = model(p) - response
        return np.concatenate([error.real, error.imag])

    low, high = [0.5, 8.0, 0.1, 0.0], [1.5, 600.0, 4.0, 0.2]
    best = least_squares(
        residual, [1.0, 60.0, 0.8, 0.05], x_scale=[1, 60, 1, 0.05], bounds=(low, high)
    )
    gain, natural, damping, delay = best.x
    free = max(len(best.fun) - len(best.x), 1)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * (best.fun @ best.fun) / free
    half = 1.645 * np.sqrt(covariance[3, 3])
    offset = np.mean([np.mean(t.position_rad) - np.mean(t.command_rad) for t in trials])
    system = control.tf([gain * natural**2], [1, 2 * damping * natural, natural**2])

    def predict(trial):
        moved = trial.command_rad - trial.rest_rad
        command = np.interp(trial.grid_s - delay, trial.command_time_s, moved, left=0.0)
        return (
            trial.rest_rad + offset + control.forced_response(system, trial.grid_s, command).outputs
        )

    return Fitted(predict, float(delay), CONTINUOUS, (float(delay - half), float(delay + half)))


serve(fit)
