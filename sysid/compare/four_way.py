"""Compare servo models as the paper does: a published one, and three fitted here."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.sysid.compare.comparison import ComparedModel, Comparison
from pupper_sysid.sysid.compare.readings import (
    age_spread_rad,
    calibrated_run,
    reading_rules,
    run_with_offset,
    shown,
    with_ages,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.result import ServoFit
from pupper_sysid.sysid.servo_fit.scores import LINEAR

PUBLISHED, FITTED = "DelayedPD, published", "DelayedPD, fitted here"
_TRAIN_SHARE = 2 / 3  # of a recording without loops
_PARTS = {"lstm": (0.0, 0.7), "mlp": (0.7, 1.0)}  # of the time that both fits take


def four_way(
    recording: Recording,
    joints: Sequence[str],
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
    calibration: Calibration | None = None,
) -> Comparison:
    """Compare published DelayedPD, one fitted here, an MLP and an LSTM.

    Each runs free and one step ahead, on readings that none was fitted to: the last loop, or the
    last third of a recording without loops. (The published networks were scored on commands that
    they had been trained on.) The published model gets the offset of the readings that the others
    were fitted to, and predicts readings as `compare` does.

    Parameters
    ----------
    recording : Recording
    joints : sequence of str
    seed : int
    progress : callable, optional
        Called with what is being done and the share of it that is done.
    calibration : Calibration, optional
        Of the same bus; its poll is used where the recording does not show one.

    Raises
    ------
    InputError
        If the recording cannot support a fit.
    KeyboardInterrupt
        On Ctrl-C: of networks trained to different ends there is no comparison.
    """
    split = _split(recording)
    fits: dict[str, ServoFit] = {}
    for arch, part in _PARTS.items():
        say = _part_of(progress, part) if progress else None
        fits[arch] = fit_servo(
            recording, joints, arch, split=split, seed=seed, progress=say, keep_unfinished=False
        )
    mlp = fits["mlp"]
    assert split.train is not None and split.test is not None
    rules = reading_rules(
        mlp.data, recording.name, {"calibration": calibration} if calibration else {}
    )
    data = with_ages(mlp.data, rules)
    run = calibrated_run(load_calibration("paper"), data)
    track, offset = run_with_offset(run, data, split.train)
    errors = scores.errors(None, track, data, split.test)
    published = scores.ModelScores.of(errors, seed)
    fitted = {FITTED: mlp.scored["delayed-pd"], LINEAR: mlp.scored["linear"]}
    fitted |= {arch.upper(): fit.scored[arch] for arch, fit in fits.items()}
    return Comparison(
        models={PUBLISHED: ComparedModel.scored(published, offset, age_spread_rad(track, data))}
        | {name: ComparedModel.scored(own, {}, {}) for name, own in fitted.items()},
        readings=rules,
        persistence_rmse_rad={j: s.persistence_rmse_rad for j, s in mlp.joints.items()},
        repeatability_rad={j: s.repeatability_rad for j, s in mlp.joints.items()},
        time_step_s=mlp.time_step_s,
        notes=mlp.notes,
        data=mlp.data,
        tracks={PUBLISHED: shown(track, data)}
        | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        bands={},
    )


def _part_of(
    progress: Callable[[str, float], None], part: tuple[float, float]
) -> Callable[[str, float], None]:
    """Progress of one fit as a part of the whole; never backwards."""
    start, end = part
    furthest = start

    def say(what: str, share: float) -> None:
        nonlocal furthest
        furthest = max(furthest, start + share * (end - start))
        progress(what, furthest)

    return say


def _split(recording: Recording) -> Split:
    numbers = sorted(int(n) for n in recording.table["trial"].unique())
    if len(numbers) > 1:
        return Split.by_trials(numbers[:-1], numbers[-1:])
    end = _TRAIN_SHARE * float(np.ptp(recording.table["send_time_s"]))
    return Split.by_time(end, end)
