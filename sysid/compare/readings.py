"""Predict what a bus would have shown of a servo model: the age of readings, and their offset.

A servo model predicts positions; a recording holds readings, which are old on a polled bus and
shifted by an offset. `reading_rules` finds, per joint, when the readings were measured:

* `live`: at their read;
* `own dates`: the recording shows its poll lattice, which dates each reading;
* `expected`: it does not (a slow loop hides the poll), but a calibration of the same bus knows
  period and loss of the poll. The phase is unknown, so the prediction is the mean over the ages
  that a reading may have: uniform within a period, and a period more for each lost poll;
* `as logged`: nothing is known of the poll; the age of the readings counts as an error.

The offset is a property of the recording (its zero, or its joint map's), not of the servo: for
every model alike it is the median of reading minus predicted reading (`offsets`). The rounding of
readings to counts of size q adds q/√12 to the error, and nothing to the prediction, as long as
the error is larger than half a count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.results import Result
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.held_feedback import HeldFeedback
from pupper_sysid.sysid.servo_fit.data import Run, ServoData
from pupper_sysid.sysid.servo_fit.scores import Tracks, counted_ticks, predicted, stacked
from pupper_sysid.sysid.servo_fit.windows import Part, chosen, everything

_INSTANTS = 48  # of an expectation: 0.05 mrad from the integral for motions of 10 rad/s


@dataclass(frozen=True, kw_only=True)
class ReadingRule(Result):
    """When the readings of one joint were measured.

    Attributes
    ----------
    rule : {"live", "own dates", "expected", "as logged"}
    source : str
        Recording or calibration that the numbers are of.
    poll_period_s, loss, mean_age_s : float
        Of the bus; NaN where unknown.
    """

    rule: str
    source: str
    poll_period_s: float = math.nan
    loss: float = math.nan
    mean_age_s: float = math.nan


def in_words(rules: Mapping[str, ReadingRule]) -> list[str]:
    """How the readings of all joints are predicted, one sentence per rule and source."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for joint, rule in rules.items():
        grouped.setdefault((rule.rule, rule.source), []).append(joint)
    return [
        f"{', '.join(joints)}: {_sentence(*key, [rules[j] for j in joints])}."
        for key, joints in grouped.items()
    ]


def _sentence(rule: str, source: str, own: Sequence[ReadingRule]) -> str:
    parts = {"poll": ("poll_period_s", 1e3, 1, " ms"), "loss": ("loss", 1, 2, ""),
             "mean age": ("mean_age_s", 1e3, 1, " ms")}  # fmt: skip
    known = [
        f"{what} {_span(values, digits)}{unit}"
        for what, (key, scale, digits, unit) in parts.items()
        if (values := [scale * v for r in own if math.isfinite(v := getattr(r, key))])
    ]
    poll = ", ".join(known)
    return {
        "live": f"the readings of {source} are live and predicted at their read",
        "own dates": f"predicted at the dates of {source}'s own poll lattice ({poll})",
        "expected": (
            "the recording does not show its poll; predicted in the mean over the phase and the "
            f"losses of {source} ({poll})"
        ),
        "as logged": (
            "nothing is known of the poll, so the age of readings counts as an error; name a "
            "calibration of a sweep on the same bus among the models"
        ),
    }[rule]


def _span(values: Sequence[float], digits: int) -> str:
    """One number, or the smallest and the largest."""
    ends = list(dict.fromkeys(f"{x:.{digits}f}" for x in (min(values), max(values))))
    return "–".join(ends)


def reading_rules(
    data: ServoData, source: str, calibrations: Mapping[str, Calibration]
) -> dict[str, ReadingRule]:
    """The rule of each joint.

    Parameters
    ----------
    data : ServoData
    source : str
        Name of its recordings.
    calibrations : dict of str to Calibration
        By name; the first whose recording showed the poll of a joint is used for it.
    """
    return {joint: _rule(joint, data, source, calibrations) for joint in data.joints}


def _rule(
    joint: str, data: ServoData, source: str, calibrations: Mapping[str, Calibration]
) -> ReadingRule:
    lattice = data.lattices[joint]
    if lattice.kind == "every read":
        return ReadingRule(rule="live", source=source, poll_period_s=0.0, loss=0.0, mean_age_s=0.0)
    if lattice.kind == "lattice":
        return ReadingRule(
            rule="own dates", source=source, poll_period_s=lattice.poll_period_s,
            loss=lattice.loss, mean_age_s=lattice.mean_age_s,
        )  # fmt: skip
    for name, calibration in calibrations.items():
        if joint in calibration.joint_names:
            known = calibration.held_feedback(joint)
            if known.poll_period_s > 0:
                return ReadingRule(
                    rule="expected", source=name, poll_period_s=known.poll_period_s,
                    loss=known.loss, mean_age_s=known.mean_age_s,
                )  # fmt: skip
    return ReadingRule(rule="as logged", source=source)


def ages(poll_period_s: float, loss: float, count: int = _INSTANTS) -> NDArray[np.float64]:
    """Equally probable ages of a reading at a random phase of the poll [s], shape (count,).

    The age is uniform within a period, plus k periods with probability (1 - loss) lossᵏ; these are
    the middles of `count` quantiles, moved together so that their mean is that of `HeldFeedback`.

    Examples
    --------
    >>> ages(0.02, 0.0, 4).round(4).tolist()
    [0.0025, 0.0075, 0.0125, 0.0175]
    """
    chance = (np.arange(count) + 0.5) / count
    # 1 - lossᵏ: the age is at most k periods with this probability
    k = np.zeros(count) if loss <= 0 else np.floor(np.log1p(-chance) / math.log(loss))
    within = (chance - (1 - loss**k)) / ((1 - loss) * loss**k)
    found = poll_period_s * (k + within)
    return found * (HeldFeedback(poll_period_s, loss).mean_age_s / found.mean())


def with_ages(data: ServoData, rules: Mapping[str, ReadingRule]) -> ServoData:
    """The same data, the readings of `expected` joints at the ages that they may have."""

    def aged(run: Run, rule: ReadingRule) -> Run:
        if rule.rule != "expected":
            return run
        old = ages(rule.poll_period_s, rule.loss) / data.period_s
        return replace(run, reading_tick=np.maximum(run.row_tick[:, None] - old, 0.0))

    return replace(
        data, runs={j: tuple(aged(r, rules[j]) for r in runs) for j, runs in data.runs.items()}
    )


def as_rows(data: ServoData, joints: Sequence[str]) -> ServoData:
    """The same data for a model that was fitted to rows: it predicts readings, age and all."""

    def logged(run: Run) -> Run:
        return replace(run, reading_tick=run.row_tick[:, None], held_tick=run.row_tick)

    return replace(
        data,
        runs={
            j: tuple(map(logged, runs)) if j in joints else runs for j, runs in data.runs.items()
        },
    )


# ------------------------------------------------------------------------------- free runs


def run_with_offset(
    run: Callable[[NDArray[np.float64]], Tracks], data: ServoData, part: Part = everything
) -> tuple[Tracks, dict[str, float]]:
    """Free run of a model, shifted by the offset of each recording.

    Where a recording does not say where it began, the model begins at the first reading less the
    offset.

    Parameters
    ----------
    run : callable
        From where each run starts [rad], shape (runs, joints), to the model's tracks.
    data : ServoData
    part : Part
        Which readings the offset is estimated from.

    Returns
    -------
    tracks : Tracks
    offset_rad : dict of str to float
        By joint; the mean over recordings.
    """
    _, start, _ = stacked(data)
    unknown = np.zeros(start.shape)
    for n, joint in enumerate(data.joints):
        for e, own in enumerate(data.runs[joint]):
            unknown[e, n] = not own.rest_known
    offset = np.zeros(start.shape)
    tracks = run(start)
    found = offsets(tracks, data, part)
    for _ in range(2 if unknown.any() else 0):  # the offset moves the start, and a little itself
        for n, joint in enumerate(data.joints):
            for e, own in enumerate(data.runs[joint]):
                offset[e, n] = found[joint][own.recording]
        tracks = run(start - unknown * offset)
        found = offsets(tracks, data, part)
    shifted = {
        joint: [
            track + found[joint][own.recording]
            for track, own in zip(tracks[joint], data.runs[joint], strict=True)
        ]
        for joint in data.joints
    }
    return shifted, {j: float(np.mean(list(own.values()))) for j, own in found.items()}


def offsets(tracks: Tracks, data: ServoData, part: Part) -> dict[str, dict[int, float]]:
    """Median of reading minus predicted reading, by joint and recording [rad].

    Readings outside of `part` do not count; 0 where a recording has none of a joint.
    """
    found: dict[str, dict[int, float]] = {}
    for joint in data.joints:
        apart: dict[int, list[NDArray[np.float64]]] = {}
        for track, run in zip(tracks[joint], data.runs[joint], strict=True):
            value = predicted(track, run, counted_ticks(run, data.modes[joint]))
            apart.setdefault(run.recording, []).append(
                (run.position_rad - value)[chosen(run, part) & np.isfinite(value)]
            )
        found[joint] = {
            recording: float(np.median(every)) if (every := np.concatenate(parts)).size else 0.0
            for recording, parts in apart.items()
        }
    return found


def calibrated_run(
    calibration: Calibration, data: ServoData
) -> Callable[[NDArray[np.float64]], Tracks]:
    """Free run of a calibration's servos, as `calibrate` runs them.

    That is in its physics steps, under the commands as the bus sent them, each at its own time;
    the positions are looked up several times per tick.
    """
    model = calibration.delayed_pd(data.joints, TIME_STEP_S)
    shape = stacked(data)[1].shape
    arrived = {
        (e, n): received(run, data.period_s)
        for n, joint in enumerate(data.joints)
        for e, run in enumerate(data.runs[joint])
    }
    steps = max(map(len, arrived.values()))
    commands = np.zeros((steps, *shape))
    for (e, n), own in arrived.items():
        commands[: len(own), e, n], commands[len(own) :, e, n] = own, own[-1]

    def run(start: NDArray[np.float64]) -> Tracks:
        model.reset(start)
        positions = np.concatenate([start[None], model.rollout(commands)])
        return {
            joint: [
                on_ticks(positions[:, e, n], own, data.period_s)
                for e, own in enumerate(data.runs[joint])
            ]
            for n, joint in enumerate(data.joints)
        }

    return run


def received(run: Run, period_s: float) -> NDArray[np.float64]:
    """Commands of a run as the bus sent them, averaged over physics steps, to beyond its last tick.

    Parameters
    ----------
    run : Run
    period_s : float
        Between ticks.
    """
    trial = run.trial_data(np.ones(len(run.tick), bool))
    tail = math.ceil(period_s / TIME_STEP_S) + 1
    return np.pad(trial.command + trial.rest_rad, (0, tail), mode="edge")


def on_ticks(positions: NDArray[np.float64], run: Run, period_s: float) -> NDArray[np.float64]:
    """Positions at physics steps as a track: several times per tick, at the run's own times.

    Parameters
    ----------
    positions : ndarray, shape (steps + 1,)
        From the run's first command on, beyond its last tick.
    run : Run
    period_s : float
        Between ticks; the last one has no other.
    """
    per_tick = max(1, math.ceil(period_s / TIME_STEP_S))
    send = run.trial.send_time_s - run.trial.send_time_s[0]
    edges = np.append(send, send[-1] + period_s)
    ticks = np.arange(per_tick * len(send) + 1) / per_tick
    step = np.interp(ticks, np.arange(len(edges)), edges) / TIME_STEP_S
    return np.interp(step, np.arange(len(positions)), positions)


def shown(tracks: Tracks, data: ServoData) -> Tracks:
    """Tracks as a bus shows them, once per tick, where readings are predicted in the mean."""

    def smooth(track: NDArray[np.float64], run: Run) -> NDArray[np.float64]:
        if run.reading_tick.shape[1] == 1:
            return track
        old = (run.row_tick[:, None] - run.reading_tick).max(axis=0)
        at = np.maximum(np.arange(len(run.command_rad) + 1.0)[:, None] - old, 0.0)
        return predicted(track, run, at)

    return {
        joint: [smooth(t, r) for t, r in zip(tracks[joint], runs, strict=True)]
        for joint, runs in data.runs.items()
    }


def age_spread_rad(tracks: Tracks, data: ServoData) -> dict[str, float]:
    """Error that a perfect model would have, because the age of each reading is unknown [rad].

    The root mean square over rows of the spread of positions over the instants at which a reading
    may have been measured; 0 where the instants are known.
    """
    found = {}
    for joint, runs in data.runs.items():
        variance = []
        for track, run in zip(tracks[joint], runs, strict=True):
            if run.reading_tick.shape[1] == 1:
                variance.append(np.zeros(len(run.reading_tick)))
                continue
            mean = predicted(track, run, run.reading_tick)
            square = predicted(track**2, run, run.reading_tick)
            variance.append(np.maximum(square - mean**2, 0.0))
        every = np.concatenate(variance)
        found[joint] = float(np.sqrt(np.nanmean(every))) if len(every) else math.nan
    return found
