"""The published four-way comparison of servo models, on unseen readings.

The published DelayedPD, one fitted here, an MLP and an LSTM, each from commands alone (free run)
and one step ahead from the last reading, beside a linear filter and persistence. The
published one scored its networks on a loop whose commands they had been trained on; here, too, the
last loop is the test if a recording has loops, and else its last third.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.compare import Comparison, calibrated
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR

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
        If the recording cannot support a fit.
    """
    split = _split(recording)
    fits: dict[str, ServoFit] = {
        arch: fit_servo(recording, joints, arch, split=split, seed=seed, progress=progress)
        for arch in ("lstm", "mlp")
    }
    mlp = fits["mlp"]
    published = calibrated(load_calibration("paper"), mlp.data.joints, mlp.time_step_s)
    track = scores.tracks(published, mlp.data)
    assert split.test is not None
    errors = scores.errors(published, track, mlp.data, split.test)
    return Comparison(
        models={
            PUBLISHED: scores.ModelScores.of(errors, seed),
            FITTED: mlp.scored["delayed-pd"],
            LINEAR: mlp.scored["linear"],
        }
        | {arch.upper(): fit.scored[arch] for arch, fit in fits.items()},
        persistence_rmse_rad={j: s.persistence_rmse_rad for j, s in mlp.joints.items()},
        repeatability_rad={j: s.repeatability_rad for j, s in mlp.joints.items()},
        time_step_s=mlp.time_step_s,
        notes=mlp.notes,
        data=mlp.data,
        tracks={PUBLISHED: track} | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        bands={},
    )


def _split(recording: Recording) -> Split:
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        return Split.by_trials(numbers[:-1], numbers[-1:])
    end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
    return Split.by_time(end, end)
