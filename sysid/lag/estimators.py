"""The usual estimators of a lag, for comparison with the lag budget's.

* integer cross-correlation, which resolves whole loop periods only;
* sub-sample cross-correlation, bounded to one period of the tone;
* sine phase per trial, and the phase slope over all tones, on all rows and on fresh rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.lag.phase_slope import responses, slope, tone_lags
from pupper_sysid.sysid.lag.step_response import LONGEST_S
from pupper_sysid.sysid.lag.time_shift import row_shift
from pupper_sysid.sysid.lag.tone import ToneResponse
from pupper_sysid.sysid.recordings.recording import Trial


def estimators(
    trials: Sequence[Trial], read: Sequence[Readings], tones: Sequence[ToneResponse], lag_s: float
) -> dict[str, float]:
    """All estimators side by side, each the mean over trials [s].

    Parameters
    ----------
    trials : sequence of Trial
    read : sequence of Readings
        Of each trial.
    tones : sequence of ToneResponse
        Empty if there are none.
    lag_s : float
        The lag budget's own, to stand beside them.
    """
    pairs = list(zip(trials, read, strict=True))
    found = {
        "integer cross-correlation, all rows": [_integer(t, None) for t in trials],
        "integer cross-correlation, fresh rows": [_integer(t, r.rows) for t, r in pairs],
        "sub-sample cross-correlation, all rows": [
            row_shift(t, t.read_time_s, t.position_rad, 0.0, _longest(t)) for t in trials
        ],
        "sub-sample cross-correlation, fresh rows": [
            row_shift(t, r.time_s, r.position_rad, 0.0, _longest(t)) for t, r in pairs
        ],
    }
    frequency = np.array([t.frequency_hz for t in tones])
    for pair, name in (("raw_rows", "all rows"), ("fresh_rows", "fresh rows")):
        lags = list(tone_lags(responses(tones, pair)[0], frequency)) if tones else []
        found[f"sine phase, {name}"] = lags
    result = {
        k: float(np.nanmean(v)) if np.isfinite(v).any() else float("nan") for k, v in found.items()
    }
    if tones:
        result["phase slope, all rows"] = slope(tones, "raw_rows").value
        result["phase slope, fresh rows"] = slope(tones, "fresh_rows").value
        result["hold-aware (default)"] = lag_s
    return result


def _longest(trial: Trial) -> float:
    return min(LONGEST_S, 1.0 / trial.frequency_hz if trial.frequency_hz > 0 else LONGEST_S)


def _integer(trial: Trial, rows: NDArray | None) -> float:
    """Lag in whole loop periods at which raw correlation peaks [s]."""
    c = trial.command_rad - trial.command_rad.mean()
    loop = float(np.median(np.diff(trial.send_time_s)))
    shifts = np.arange(0, max(2, min(int(_longest(trial) / loop), len(c) // 2)))
    rows = np.flatnonzero(np.isfinite(trial.position_rad)) if rows is None else rows
    rows = rows[rows >= shifts[-1]]
    if len(rows) < 8:
        return float("nan")
    y = trial.position_rad[rows] - trial.position_rad[rows].mean()
    return float(shifts[int(np.argmax([np.sum(y * c[rows - s]) for s in shifts]))] * loop)
