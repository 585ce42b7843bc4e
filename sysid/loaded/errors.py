"""Errors of a fit under load: noise and correlation of its residuals, errors of runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.loaded.runs import Run, at_steps, free_run, residuals
from pupper_sysid.sysid.loaded.search import Fit
from pupper_sysid.sysid.loaded.structures import Structure

_NOISE_RATIO = 1.5  # of the noise of a run to that of the others

_REMEMBERED_S = 0.5


def noise_of(
    structure: Structure, fit: Fit, runs: tuple[Run, ...], least: float
) -> tuple[float, ...]:
    """Size of the residuals of each run, none far from that of the others [rad]."""
    found = []
    for r in residuals(structure, structure.decode(fit.point)[None], runs):
        scale = 1.4826 * np.median(np.abs(r[0]))
        found.append(float(np.sqrt(np.mean(np.minimum(r[0] ** 2, (4 * scale) ** 2 + 1e-12)))))
    middle = max(float(np.median(found)), least)
    return tuple(float(np.clip(x, middle / _NOISE_RATIO, middle * _NOISE_RATIO)) for x in found)


def mean_errors(structure: Structure, fit: Fit, runs: Sequence[Run]) -> list[float]:
    """Mean absolute error of each run [rad]."""
    found = residuals(structure, structure.decode(fit.point)[None], runs)
    return [float(np.mean(np.abs(r))) for r in found]


def correlation(
    structure: Structure, fit: Fit, runs: Sequence[Run], noise: Sequence[float]
) -> float:
    """Readings per independent one: 1 + 2 Σ ρ(k), up to where the autocorrelation ρ vanishes.

    No further than half a second: what friction leaves for longer hardly moves with a parameter.
    """
    found = residuals(structure, structure.decode(fit.point)[None], runs)
    apart = float(np.median(np.concatenate([np.diff(r.sample_step) * r.step_s for r in runs])))
    longest = int(min(_REMEMBERED_S / max(apart, 1e-4), min(r.shape[1] for r in found) - 1))
    total, lagged = 0.0, np.zeros(longest)
    for r, s in zip(found, noise, strict=True):
        x = np.clip(r[0] / s, -4, 4)
        total += float(x @ x)
        for lag in range(1, longest + 1):
            lagged[lag - 1] += float(x[lag:] @ x[:-lag])
    rho = lagged / max(total, 1e-18)
    positive = np.cumprod(rho > 0.05)
    return float(max(1.0, 1.0 + 2.0 * np.sum(rho * positive)))


def typical_torque(structure: Structure, values: NDArray[np.float64], runs: Sequence[Run]) -> float:
    """Median torque of the motor while its torque is on."""
    servo = structure.servo(values)
    found = []
    for run, track in zip(runs, free_run(structure, values, runs), strict=True):
        speed = np.gradient(track, run.step_s)[:-1]
        command = run.held[0, run.rest :]
        duty = np.asarray(servo.duty_per_rad) * run.p_gain * (command - track[:-1])
        torque = np.asarray(servo.stall_torque) * np.clip(duty, -1, 1)
        torque = torque - np.asarray(servo.back_emf) * speed
        found.append(np.abs(torque)[run.held[1, run.rest :] > 0.5])
    return float(np.median(np.concatenate(found)))


def errors_of(
    structure: Structure,
    values: NDArray[np.float64],
    left_out: Sequence[Fit],
    runs: tuple[Run, ...],
    folds: dict[str, NDArray[np.bool_]],
) -> dict[str, float]:
    """RMS errors on fresh readings, on all rows held and raw, and on unseen runs [rad]."""
    fresh, held, raw, unseen = [], [], [], []
    for run, track in zip(runs, free_run(structure, values, runs), strict=True):
        fresh.append(at_steps(track, run.sample_step) - run.sample_rad)
        held.append(at_steps(track, run.held_step) - run.row_rad)
        raw.append(at_steps(track, run.row_step) - run.row_rad)
    for left, fit in zip(folds.values(), left_out, strict=True):
        out = [r for r, gone in zip(runs, left, strict=True) if gone]
        unseen += [r[0] for r in residuals(structure, structure.decode(fit.point)[None], out)]

    def rms(parts: list[NDArray]) -> float:
        every = np.concatenate([np.empty(0), *parts])
        every = every[np.isfinite(every)]
        return float(np.sqrt(np.mean(every**2))) if len(every) else float("nan")

    return {"fresh": rms(fresh), "held": rms(held), "raw": rms(raw), "unseen": rms(unseen)}
