"""Frequency response of an observer at any frequencies, as `observer_match` measures it."""

import numpy as np

from pupper_sysid.policies.deploy.matches import _drive, _phasors, _sines


def response(observer, frequencies_hz, amplitude_rad: float, period_s: float) -> np.ndarray:
    """Swing of each joint over that of its target, shape (frequencies, 12), without readings."""
    frequencies = np.asarray(frequencies_hz, float)
    targets = _sines(frequencies, amplitude_rad, period_s)
    positions = _drive(observer, targets, np.full_like(targets, np.nan))
    return _phasors(positions, frequencies, period_s) / amplitude_rad
