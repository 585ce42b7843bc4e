"""Inputs of a fit under load: runs, supply voltage, parameter scales, and the runs to leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.poll_lattice import PollLattice
from pupper_sysid.sysid.loaded.runs import Run, prepare
from pupper_sysid.sysid.loaded.structures import Scales
from pupper_sysid.sysid.recordings.recording import Trial

_RUN_FOLDS = 4

_SEARCHED_S = 250.0
"""Duration of all runs together that the search uses; the final fit uses all."""

_RIPPLE = 0.7  # autocorrelation below which a logged voltage is ripple, not the supply


def prepared_runs(trials: Sequence[Trial], lattice: PollLattice, volts: float) -> tuple[Run, ...]:
    """Runs of the trials that have readings enough; `volts` is the reference voltage [V]."""
    found = (prepare(t, lattice, volts) for t in trials)
    return tuple(r for r in found if r is not None and len(r.sample_step) > 20)


def reference_voltage(trials: Sequence[Trial]) -> float:
    """Median of the logged or nominal voltages; NaN where torques cannot follow them."""
    found, ripple = [], []
    for t in trials:
        logged = t.voltage_v
        if logged is not None and np.isfinite(logged).sum() > 10:
            known = logged[np.isfinite(logged)]
            found.append(float(np.median(known)))
            if known.std() > 0:
                ripple.append(float(np.corrcoef(known[1:], known[:-1])[0, 1]))
        elif t.servo.supply_voltage_v is not None:
            found.append(t.servo.supply_voltage_v)
        else:
            return float("nan")
    # a voltage that jumps from reading to reading is the ripple of the pulse width
    if ripple and np.median(ripple) < _RIPPLE:
        return float("nan")
    return float(np.median(found))


def read_time_doubt(trials: Sequence[Trial]) -> float:
    """By how much readings may have been taken earlier or later than they are dated [s]."""
    return max(t.read_time_doubt_s for t in trials)


def scales_of(trials: Sequence[Trial], runs: Sequence[Run]) -> Scales:
    """Scales of the parameters: from the known load, or torques per inertia without one."""
    known = all(t.load is not None for t in trials) and any(r.load[0] > 0 for r in runs)
    gains = sorted(r.p_gain for r in runs)
    middle = gains[len(gains) // 2]
    off = any((r.held[1] < 1).any() for r in runs)
    ramps = [t.servo.set_point_acceleration_rad_s2 for t in trials]
    limits = [ramp for ramp in ramps if ramp is not None and np.isfinite(ramp)]
    ramp = float(np.median(limits)) if limits else float("nan")
    if not known:
        return Scales(100.0, 1.0, middle, False, off, True, ramp, bool(limits))
    inertia = max(float(r.load[0]) for r in runs)
    # without gravity the scale is a torque that would reach 10 rad/s within 0.1 s
    torque = max(max(float(r.load[1]) for r in runs), 100.0 * inertia)
    return Scales(torque, inertia, middle, True, off, False, ramp, bool(limits))


def shortened(runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """The runs with fewer readings at their ends, together no longer than the search needs."""
    total = sum((r.held.shape[1] - r.rest) * r.step_s for r in runs)
    if total <= _SEARCHED_S:
        return runs
    share = _SEARCHED_S / total
    return tuple(_until(r, share) for r in runs)


def _until(run: Run, share: float) -> Run:
    last = share * (run.held.shape[1] - run.rest)
    use = run.sample_step <= last
    return replace(run, sample_step=run.sample_step[use], sample_rad=run.sample_rad[use])


def folds_of(runs: Sequence[Run]) -> dict[str, NDArray[np.bool_]]:
    """Which runs are left out: all of a gain between others, and some of every gain and load."""
    labels = [r.label for r in runs]
    count = min(_RUN_FOLDS, len(runs))
    if len(runs) < 2:
        return {}
    names = list(dict.fromkeys(labels))
    turn = [labels[:n].count(x) + names.index(x) for n, x in enumerate(labels)]
    found = {
        f"part {k + 1} of {count}": np.array([t % count == k for t in turn]) for k in range(count)
    }
    gains = sorted({r.p_gain for r in runs})
    for gain in gains[1:-1][:2]:
        found[f"P {gain:g}"] = np.array([r.p_gain == gain for r in runs])
    return {name: left for name, left in found.items() if left.any() and not left.all()}
