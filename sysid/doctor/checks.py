"""All checks of a joint's recording before anything is fitted to it, and what follows from them.

`findings` has them all; `refuse_unusable` ends a computation with the sentence of what makes every
number wrong, and `cautions` are the sentences that go with its result. The commands and functions
that compute from recordings call these two, so that all of them judge as `doctor` does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.doctor.bends import bend_findings
from pupper_sysid.sysid.doctor.causality import crossed
from pupper_sysid.sysid.doctor.clock import clock_findings, tone_findings
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, USE, Finding
from pupper_sysid.sysid.doctor.hypotheses import (
    encoder_findings,
    hypothesis_findings,
    stepwise_findings,
)
from pupper_sysid.sysid.doctor.servo_setup import register_findings
from pupper_sysid.sysid.doctor.signals import (
    frozen_findings,
    interpolation_findings,
    motion_findings,
    offset_findings,
    start_findings,
    unit_findings,
)
from pupper_sysid.sysid.feedback.quantisation import quantum
from pupper_sysid.sysid.feedback.rows import fresh_rows
from pupper_sysid.sysid.recordings.bad_readings import without_bad_readings
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.remembered import remembered

LEAST_ROWS = 3
"""Rows of a trial; fewer have no rate of change."""

_FEW_MISSING, _MANY_MISSING = 0.02, 0.5
_LEAST_FRESH = 16
_MANY_BAD = 0.05  # share of the readings
_CHECKS = (
    motion_findings, tone_findings, encoder_findings, unit_findings, bend_findings,
    frozen_findings, offset_findings, hypothesis_findings, start_findings, interpolation_findings,
    register_findings,
)  # fmt: skip
_SERVOS_ALONE = (frozen_findings, hypothesis_findings)  # a joint held by friction is explained


def long_enough(trials: Sequence[Trial]) -> list[Trial]:
    """The trials that have rows enough to be looked at, where their torque is on."""
    powered = [t.powered() for t in trials]
    return [t for t in powered if len(t.send_time_s) >= LEAST_ROWS]


@remembered(64)
def findings(recorded: Sequence[Trial]) -> list[Finding]:
    """Find what is wrong with one joint's trials.

    All that asks for care, or the first fault that makes every number wrong.

    Parameters
    ----------
    recorded : sequence of Trial
        All of one joint.
    """
    cleaned = [without_bad_readings(t) for t in recorded]
    trials = long_enough(cleaned)
    if not trials:
        return [Finding("too_short", REFUSE, {"rows": LEAST_ROWS})]
    found = [*_missing(recorded, len(recorded) - len(trials)), *clock_findings(trials)]
    found += _bad_readings(recorded, cleaned)
    step = -1.0
    for check in (*_CHECKS[:1], stepwise_findings, _few_fresh, *_CHECKS[1:]):
        if any(f.verdict == REFUSE for f in found):
            break
        if check in _SERVOS_ALONE and any(f.code == "held_by_friction" for f in found):
            continue
        step = quantum(trials) if step < 0 else step
        found += check(trials, step)
    return found


def refuse_unusable(trials_by_joint: Mapping[str, Sequence[Trial]]) -> None:
    """Refuse to compute from recordings whose verdict is "do not use".

    Parameters
    ----------
    trials_by_joint : dict of joint to sequence of Trial

    Raises
    ------
    InputError
        With the joint, the reason and the cure.
    """
    others = " Or leave the joint out of `joints`." if len(trials_by_joint) > 1 else ""
    for joint, trials in trials_by_joint.items():
        for fault in findings(trials):
            if fault.verdict == REFUSE:
                raise InputError(f"{joint}: {fault.text}{others}")
    for joint, fault in crossed({j: long_enough(t) for j, t in trials_by_joint.items()}).items():
        raise InputError(f"{joint}: {fault.text}{others}")


def cautions(joint: str, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Warnings that go with every number computed from these trials of `joint`."""
    return tuple(f"{joint}: {f.text}" for f in findings(trials) if f.verdict != USE)


def _few_fresh(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Too few new readings to measure anything."""
    fresh = sum(len(fresh_rows(t)) for t in trials)
    if fresh >= _LEAST_FRESH:
        return []
    return [Finding("few_fresh", REFUSE, {"readings": fresh})]


def _missing(recorded: Sequence[Trial], short: int) -> list[Finding]:
    position = np.concatenate([t.position_rad for t in recorded])
    share = float(np.mean(~np.isfinite(position))) if len(position) else 1.0
    found = []
    if not len(position) or share > _MANY_MISSING:
        found.append(Finding("most_missing", REFUSE, {"percent": 100 * share}))
    elif share > _FEW_MISSING:
        found.append(Finding("some_missing", CARE, {"percent": 100 * share}))
    if short:
        found.append(Finding("short_trials", CARE, {"trials": short, "rows": LEAST_ROWS}))
    return found


def _bad_readings(recorded: Sequence[Trial], cleaned: Sequence[Trial]) -> list[Finding]:
    """Single readings that are left out, with the first of them."""
    bad = [
        (t.read_time_s[k] - recorded[0].send_time_s[0], t.position_rad[k])
        for t, c in zip(recorded, cleaned, strict=True)
        for k in np.flatnonzero(np.isfinite(t.position_rad) & ~np.isfinite(c.position_rad))
    ]
    if not bad:
        return []
    share = len(bad) / sum(int(np.isfinite(t.position_rad).sum()) for t in recorded)
    many = share > _MANY_BAD
    values = {"readings": len(bad), "percent": 100 * share, "time_s": bad[0][0],
              "value_rad": bad[0][1]}  # fmt: skip
    return [Finding("many_bad_readings" if many else "bad_readings", REFUSE if many else CARE,
                    values)]  # fmt: skip
