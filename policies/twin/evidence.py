"""Was the robot on the ground? What its readings say, beside its simulated motion there.

The simulated robot predicts readings twice, in the air (a) and on the ground (g). Two things differ
between the two, and each is evidence of its own:

* motion: within a joint, over time. The share of the difference g - a that is found in readings
  less a, by least squares over all joints, each weighted by the variance of its errors: 0 in the
  air, 1 on the ground; and the correlation of the two. Servos that are simulated wrongly leave
  errors, too. A wrong gain, damping, dead time or inertia looks like a and its derivatives, so what
  a constant, a, its speed and its acceleration explain of either is taken out before, joint by
  joint. Intervals resample stretches of time.
* load: between joints, over the whole recording. Legs that carry the robot sag. The share of the
  mean difference of each joint that is found in its offset, by least squares over joints, with
  Student's t. Zeros of joints are unknown, and are the errors of this line. Those that joints of
  one kind (all thighs) have in common can look like a load, so one unknown per kind, in the
  direction of its sags, stands beside the share: only how the sag differs between legs counts.

Torques of an actuator that was measured in free air are known to a factor only, and with them the
size of g - a: of a robot with strong servos the ground shows little. So both shares are taken
twice, with the torques as they are and `STRONGER` times as large. The verdict is that of motion:
"ground" if the interval of its correlation is above 0.08 in one of the two (in the air, wrong
servos alone reach 0.06: `benchmarks/twin_verdicts.py`), and "air" if in both its shares are within
±0.25 and its correlations below 0.06. That is no proof of the air: still stronger servos would hide
the ground. The load is reported beside it and decides nothing: an interval of 90 % lies above 0 in
one of twenty robots in the air.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.rhythm import t_quantile
from pupper_sysid.sysid.servo_fit.data import Run, ServoData
from pupper_sysid.sysid.servo_fit.scores import (
    Errors,
    counted_ticks,
    interval,
    predicted,
    steps_per_tick,
)
from pupper_sysid.sysid.servo_fit.windows import Part, chosen

Array = NDArray[np.float64]
Verdict = Literal["ground", "air", "cannot tell"]

STRONGER = 4.0
"""Factor of the torques in the second case."""

_CORRELATED, _UNCORRELATED, _NONE = 0.08, 0.06, 0.25
_FEWEST_FREE = 3  # degrees of freedom of a load share
_DRAWS = 1000
_WHY: dict[Verdict, str] = {
    "ground": "The robot was on the ground: its joints deviate as under the simulated load.",
    "air": (
        "The robot was in the air, unless its servos are more than "
        f"{STRONGER:g} times as strong as this actuator's: its joints show nothing of the load."
    ),
    "cannot tell": "The motion of the joints does not separate the ground from the air.",
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """The simulated robot at one scale of its torques, in the air and on the ground.

    Attributes
    ----------
    air, ground : dict of str to list of ndarray
        Tracks by joint and run, with offsets.
    errors : dict of str to Errors
        In the air, by joint.
    ground_errors : dict of str to Errors
    offsets : dict of str to (float, float)
        Reading minus prediction in the air and on the ground [rad], by joint.
    """

    air: Mapping[str, Sequence[Array]]
    ground: Mapping[str, Sequence[Array]]
    errors: Mapping[str, Errors]
    ground_errors: Mapping[str, Errors]
    offsets: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Motion(Result):
    """How much of the difference between ground and air the readings show over time.

    Attributes
    ----------
    share, correlation : Interval
    """

    share: Interval
    correlation: Interval


@dataclass(frozen=True, kw_only=True)
class Evidence(Result):
    """What readings say of where the robot was.

    Attributes
    ----------
    verdict : {"ground", "air", "cannot tell"}
    difference_rad : Interval
        Mean error on the ground less that in the air, with the torques as they are.
    motion : list of (Motion or None)
        With the torques as they are, and stronger; None where there is nothing to tell it from.
    load_share : list of (Interval or None)
    why : str
        The verdict's reason, in a sentence.
    """

    verdict: Verdict
    difference_rad: Interval
    motion: list[Motion | None]
    load_share: list[Interval | None]
    why: str


def evidence(cases: Sequence[Case], data: ServoData, part: Part, seed: int) -> Evidence:
    """What predictions of the same readings in the air and on the ground say.

    Parameters
    ----------
    cases : sequence of Case
        With the torques as they are, and stronger.
    data : ServoData
    part : Part
        Readings that count.
    seed : int
        Of the bootstrap.
    """
    motion = [_motion(case, data, part, seed) for case in cases]
    load = [_load_share(case.offsets) for case in cases]
    first = cases[0]
    verdict = _verdict(motion)
    return Evidence(
        verdict=verdict, motion=motion, load_share=load, why=_WHY[verdict],
        difference_rad=interval(dict(first.ground_errors), seed, dict(first.errors)),
    )  # fmt: skip


def _motion(case: Case, data: ServoData, part: Part, seed: int) -> Motion | None:
    blocks = sorted({b for e in case.errors.values() for b in e.block})
    place = {b: n for n, b in enumerate(blocks)}
    sums = np.zeros((3, len(blocks)))
    for joint, errors in case.errors.items():
        moved, left = _unexplained(case, joint, data, part)
        index, weight = [place[b] for b in errors.block], 1.0 / max(float(left.var()), 1e-12)
        for own, product in zip(sums, (left * moved, moved**2, left**2), strict=True):
            own += weight * np.bincount(index, product, len(blocks))
    if not sums[1].sum() > 1e-12 * len(blocks):
        return None
    draws = np.random.default_rng(seed).multinomial(
        len(blocks), np.full(len(blocks), 1 / len(blocks)), _DRAWS
    )
    together, ground, error = (np.append(draws @ own, own.sum()) for own in sums)
    ground = np.maximum(ground, 1e-300)
    share, correlation = together / ground, together / np.sqrt(ground * np.maximum(error, 1e-300))
    return Motion(
        share=Interval.of_draws(float(share[-1]), share[:-1]),
        correlation=Interval.of_draws(float(correlation[-1]), correlation[:-1]),
    )


def _unexplained(case: Case, joint: str, data: ServoData, part: Part) -> tuple[Array, Array]:
    """Ground less air and reading less air, without what a wrong servo explains, by reading."""
    rows = []
    for n, run in enumerate(data.runs[joint]):
        air, ground = case.air[joint][n], case.ground[joint][n]
        rate = steps_per_tick(air, run) / data.period_s
        speed = np.gradient(air) * rate
        when = counted_ticks(run, data.modes[joint])
        seen = np.stack([predicted(track, run, when) for track in
                         (air, speed, np.gradient(speed) * rate, ground)])  # fmt: skip
        rows.append(np.vstack([seen, run.position_rad])[:, _counts(run, part, seen[0])])
    air, speed, acceleration, ground, reading = np.concatenate(rows, axis=1)
    servo, _ = np.linalg.qr(np.stack([np.ones(len(air)), air, speed, acceleration], axis=1))
    moved, left = ground - air, reading - air
    return moved - servo @ (servo.T @ moved), left - servo @ (servo.T @ left)


def _counts(run: Run, part: Part, track: Array) -> NDArray[np.bool_]:
    """The readings that `scores.errors` counts."""
    return chosen(run, part) & np.isfinite(track - run.position_rad)


def _load_share(offsets: Mapping[str, tuple[float, float]]) -> Interval | None:
    in_air, on_ground = np.array(list(offsets.values())).T
    sag = in_air - on_ground
    kinds = np.array([joint.partition("_")[2] for joint in offsets])
    common = [np.where(kinds == kind, np.sign(sag), 0.0) for kind in sorted(set(kinds))]
    design = np.stack([sag, *common], axis=1)
    free = len(sag) - np.linalg.matrix_rank(design)
    if free < _FEWEST_FREE or np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    found = np.linalg.lstsq(design, in_air)[0]
    left = in_air - design @ found
    variance = np.linalg.inv(design.T @ design)[0, 0] * float(left @ left) / free
    half = t_quantile(int(free)) * float(np.sqrt(variance))
    return Interval(float(found[0]), float(found[0]) - half, float(found[0]) + half)


def _verdict(found: Sequence[Motion | None]) -> Verdict:
    if any(one is not None and one.correlation.low > _CORRELATED for one in found):
        return "ground"
    return "air" if all(one is not None and _nothing_in(one) for one in found) else "cannot tell"


def _nothing_in(one: Motion) -> bool:
    small = -_NONE < one.share.low and one.share.high < _NONE
    return small and one.correlation.high < _UNCORRELATED
