"""The published four-way comparison of servo models, on readings none of them has seen.

The published DelayedPD, one fitted here, an MLP and an LSTM, each from commands alone (free run)
and one step ahead from the last reading, beside a linear filter and a servo that stays put. The
published one scored its networks on a loop whose commands they had been trained on; here, too, the
last loop is the test if a recording has loops, and else its last third.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pupper_sysid.sysid.identify.calibration_file import load_calibration
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.compare import LINEAR, Comparison, calibrated
from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split, fit_servo

PUBLISHED, FITTED = "DelayedPD, published", "DelayedPD, fitted here"
_TRAIN_SHARE = 2 / 3


def four_way(
    recording: Recording,
    joints: Sequence[str],
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Fit and compare.

    Parameters
    ----------
    recording : Recording
    joints : sequence of str
    seed : int
    progress : callable, optional
        Called with what is being done and the share of it that is done.

    Raises
    ------
    InputError
        If the recording cannot support a fit; the sentence says why.
    """
    split = _split(recording)
    fits: dict[str, ServoFit] = {
        arch: fit_servo([recording], joints, arch, "default", split, "auto", seed, progress)
        for arch in ("lstm", "mlp")
    }
    mlp = fits["mlp"]
    published = calibrated(load_calibration("paper"), mlp.data.joints, mlp.data.period_s)
    track = scores.tracks(published, mlp.data)
    assert split.test is not None
    return Comparison(
        mlp.data,
        {PUBLISHED: track} | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        {
            PUBLISHED: scores.errors(published, track, mlp.data, split.test),
            FITTED: mlp.scored["delayed-pd"].errors,
            LINEAR: mlp.scored["linear"].errors,
        }
        | {arch.upper(): fit.scored[arch].errors for arch, fit in fits.items()},
        {},
        mlp.persistence,
        mlp.repeatability,
        mlp.notes,
    )


def _split(recording: Recording) -> Split:
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        last = numbers[-1]
        return Split(
            f"trained on all trials but {last}, tested on it",
            lambda number, elapsed, group: number != last,
            lambda number, elapsed, group: number == last,
        )
    end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
    return Split(
        f"trained on the first {end:.1f} s, tested after it",
        lambda number, elapsed, group: elapsed < end,
        lambda number, elapsed, group: elapsed >= end,
    )
