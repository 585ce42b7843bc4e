"""Which terms does an equation of motion need? pysindy's proposals, from the derivatives.

A smoothing spline through the re-timed fresh readings gives speed and acceleration, and
sequentially thresholded least squares (S. Brunton, J. Proctor, J. Kutz, "Discovering governing
equations from data by sparse identification of nonlinear dynamical systems", 2016) says which
physical terms carry the acceleration, at many thresholds, delays and saturation errors. Only the
structures are used, not the numbers: derivatives of sparse readings bias stiffness and delay, and
`sysid.sparse.equations` refines each structure by output error.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS
from pupper_sysid.sysid.fit.run import Run

Support = tuple[str, ...]
"""Names of the coefficients of one structure, in the order of `COEFFICIENTS`."""

PULLS = ("stiffness_per_s2", "saturated_stiffness_per_s2")
"""Terms that pull toward the command: without one of them it is no servo."""

LINEAR: Support = ("stiffness_per_s2", "damping_per_s")

_MOST_SUPPORTS = 8
_THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.45, 0.65)  # shares of the acceleration's RMS
_GRID_STEPS = 4  # 8 ms between regression points
_LONGEST_GAP_S = 0.15  # no spline across a stretch without readings
_LEAST_PER_PERIOD = 4.0  # fresh readings per period, below which a spline invents the motion


def propose(data: Sequence[Run], delayed_pd: Mapping[str, float]) -> list[Support]:
    """Structures that pysindy finds in the derivatives, those found most often first.

    Parameters
    ----------
    data : sequence of Run
    delayed_pd : mapping of str to float
        Values of the fitted `DelayedPD`: its delay, offset, and the error at which it saturates.

    Returns
    -------
    list of tuple of str
        At most `_MOST_SUPPORTS`, and among them the linear one, to compare with.
    """
    usable = [d for d in data if _dense(d)] or data
    splines = [s for d in usable for s in _motion(d, delayed_pd["offset_rad"])]
    votes: Counter[Support] = Counter()
    for shift in (-0.005, 0.0, 0.005):  # what is delay and what dynamics is known to a few ms
        delay = max(delayed_pd["dead_time_s"] + shift, 0.0) / TIME_STEP_S
        trials = []
        for trial, step, position, speed, acceleration in splines:
            middle = np.arange(len(trial.command)) + 0.5
            late = np.interp(step - delay, middle, trial.command, left=trial.rest_rad)
            trials.append((late - position, speed, acceleration))
        if not trials:
            break
        size = np.abs(np.concatenate([e for e, _, _ in trials]))
        saturation = delayed_pd["effort_rad_s2"] / delayed_pd["stiffness_per_s2"]
        for limit in (saturation, *np.quantile(size, (0.4, 0.7))):
            votes.update(_regress(trials, float(limit)))
    ranked = [support for support, _ in votes.most_common() if support != LINEAR]
    return [LINEAR, *ranked[: _MOST_SUPPORTS - 1]]


def ordered(names: set[str]) -> Support:
    """The coefficients in the order of `COEFFICIENTS`."""
    return tuple(name for name in COEFFICIENTS if name in names)


def _dense(trial: Run) -> bool:
    """Whether a spline through the readings can follow the trial's tone."""
    if not trial.frequency_hz > 0 or len(trial.sample_step) < 8:
        return not trial.frequency_hz > 0
    seconds = (trial.sample_step[-1] - trial.sample_step[0]) * TIME_STEP_S
    return len(trial.sample_step) >= _LEAST_PER_PERIOD * trial.frequency_hz * seconds


def _motion(trial: Run, offset_rad: float) -> list[tuple[Run, NDArray, NDArray, NDArray, NDArray]]:
    """The trial with steps, position, speed and acceleration of a spline through its readings."""
    step, first = np.unique(trial.sample_step, return_index=True)
    if len(step) < 8:
        return []
    spline = make_smoothing_spline(step * TIME_STEP_S, trial.sample_rad[first] - offset_rad)
    grid = np.arange(step[1], step[-2], _GRID_STEPS)  # the ends of a spline's curvature are guesses
    after = np.searchsorted(step, grid, "right")
    grid = grid[(step[after] - step[after - 1]) * TIME_STEP_S <= _LONGEST_GAP_S]
    time = grid * TIME_STEP_S
    if len(grid) < 16:
        return []
    return [(trial, grid, spline(time), spline(time, 1), spline(time, 2))]


def _regress(trials: Sequence[tuple[NDArray, NDArray, NDArray]], limit: float) -> set[Support]:
    """Structures that thresholded least squares leaves at all thresholds.

    Columns and acceleration are divided by their RMS, so that a threshold is the share of the
    acceleration that a term must carry.
    """
    terms: dict[str, Callable[[NDArray, NDArray], NDArray]] = {
        "stiffness_per_s2": lambda v, e: e,
        "saturated_stiffness_per_s2": lambda v, e: np.clip(e, -limit, limit),
        "damping_per_s": lambda v, e: -v,
        "drag_per_rad": lambda v, e: -v * np.abs(v),
        "friction_rad_s2": lambda v, e: -np.sign(v),
    }
    error, speed, acceleration = (np.concatenate(parts) for parts in zip(*trials, strict=True))
    scale = {n: max(float(np.sqrt(np.mean(f(speed, error) ** 2))), 1e-9) for n, f in terms.items()}
    unit = max(float(np.sqrt(np.mean(acceleration**2))), 1e-9)
    found = set()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import pysindy  # seconds, and scikit-learn with it: only who needs it waits

        for threshold in _THRESHOLDS:
            model = pysindy.SINDy(
                optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-3),
                feature_library=pysindy.CustomLibrary(
                    [_divided(f, scale[n]) for n, f in terms.items()]
                ),
            )
            model.fit(
                [v[:, None] for _, v, _ in trials],
                t=_GRID_STEPS * TIME_STEP_S,
                x_dot=[a[:, None] / unit for _, _, a in trials],
                u=[e[:, None] for e, _, _ in trials],
            )
            share = np.asarray(model.coefficients())[0]
            kept = {name for name, c in zip(terms, share, strict=True) if abs(c) > 0}
            if PULLS[1] in kept:
                kept.add("saturation_error_rad")
            if kept & set(PULLS):  # without a pull toward the command it is no servo
                found.add(ordered(kept))
    return found


def _divided(function: Callable[[NDArray, NDArray], NDArray], scale: float):
    # pysindy counts arguments: a lambda with defaults would be taken for one of four variables
    return lambda v, e: function(v, e) / scale
