"""Compare servo models as the paper does: a published one, and three fitted here."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.sysid.compare.comparison import ComparedModel, Comparison
from pupper_sysid.sysid.fit.predict import rule_of, track_of
from pupper_sysid.sysid.fit.run import at_steps
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.readings import FreeRun, run_with_offset
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
    data = mlp.data
    rules = {j: rule_of(j, data.lattices[j], recording.name) for j in data.joints}
    run = calibrated_run(load_calibration("paper"), data)
    track, offset = run_with_offset(run, data, split.train)
    errors = scores.errors(None, track, data, split.test)
    published = scores.ModelScores.of(errors, seed)
    fitted = {FITTED: mlp.scored["delayed-pd"], LINEAR: mlp.scored["linear"]}
    fitted |= {arch.upper(): fit.scored[arch] for arch, fit in fits.items()}
    return Comparison(
        models={PUBLISHED: ComparedModel.scored(published, offset, {})}
        | {name: ComparedModel.scored(own, {}, {}) for name, own in fitted.items()},
        readings=rules,
        persistence_rmse_rad={j: s.persistence_rmse_rad for j, s in mlp.joints.items()},
        repeatability_rad={j: s.repeatability_rad for j, s in mlp.joints.items()},
        time_step_s=mlp.time_step_s,
        notes=mlp.notes,
        data=mlp.data,
        tracks={PUBLISHED: track} | {arch.upper(): fit.tracks for arch, fit in fits.items()},
        bands={},
    )


def calibrated_run(calibration: Calibration, data: ServoData) -> FreeRun:
    """Free run of a calibration's servos on the runs of learned models, several times per tick."""

    def run(offset: NDArray[np.float64]) -> scores.Tracks:
        tracks: scores.Tracks = {}
        for n, joint in enumerate(data.joints):
            tracks[joint] = []
            for e, own in enumerate(data.runs[joint]):
                physics = own.on_physics(np.ones(len(own.tick), bool))
                track = track_of(calibration, joint, physics, offset[e, n]) - offset[e, n]
                per_tick = max(1, math.ceil(data.period_s / physics.step_s))
                send = own.trial.send_time_s - own.trial.send_time_s[0]
                edges = np.append(send, send[-1] + data.period_s)
                ticks = np.arange(per_tick * len(send) + 1) / per_tick
                step = np.interp(ticks, np.arange(len(edges)), edges) / physics.step_s
                tracks[joint].append(at_steps(track, step))
        return tracks

    return run


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
