"""Trials of a loaded bench: one servo swings a pendulum, at several P gains.

    plan = bench_plan("bench", parse_load("pendulum:0.1kg@0.10m"), gains=[8, 16, 32], ...)

With a load of known mass and length a servo's torque, inertia and friction become numbers in N·m.
At each gain: tones, a chirp, a pseudo-random sequence and steps about the hanging position, and
drops. A drop lifts the mass slowly (minimum jerk, never a step), switches the torque off and
records how it swings: gravity, friction and armature without the motor. The recorder waits until
the mass is at rest before it switches the torque on again.

`reversal` is a test of its own (`sysid.backlash`): slow strokes at several speeds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad
from pupper_sysid.sysid.sweep.excitation import (
    FASTEST_OF_MINIMUM_JERK,
    LEAD_IN_S,
    Plan,
    TrialPlan,
    after,
    check_amplitude,
    lift,
    plan,
    strokes,
)

BENCH, DROP, REVERSAL = "bench", "drop", "reversal"
BENCH_KINDS = (BENCH, DROP, REVERSAL)
"""Kinds of motion that only a bench has; `bench` is all but `reversal`."""

FREQUENCIES_HZ = (0.5, 1.0, 2.0, 4.0)
CHIRP_HZ = (0.3, 6.0)
AMPLITUDE_RAD = 0.5
SPEED_LIMIT_RAD_S = 5.0
"""Highest speed of a command: less than of a free servo, since a mass hangs on it."""
REACH_RAD = 1.6  # farthest from the hanging position that a mass is moved, by default
LIFT_RAD = 1.4
LIFT_RAD_S = 0.8  # highest speed of a lift
STROKE_RAD = 0.25
STROKE_SPEEDS_RAD_S = (0.04, 0.08, 0.12)
STROKES = 3  # strokes up and down at each speed
NEAREST_START_RAD = 1.0  # a pendulum that is found farther from its hanging position is not hanging

_HOLD_S, _DROP_S = 0.5, 3.0
_GAINS = (1, 254)
_NOMINAL_NM, _NOMINAL_PER_P = 1.8, 0.34  # STS3215 at 7.4 V: stall torque; N·m/rad per unit of P
_HEAVIEST, _DEEPEST_SAG_RAD = 0.6, 0.2

_LOAD = re.compile(r"pendulum:([0-9.]+)kg@([0-9.]+)m((?:,[a-z]+=-?[0-9.]+(?:kg|rad))*)")
_MORE = {"arm": ("arm_mass_kg", "kg"), "hanging": ("hanging_rad", "rad")}


def parse_load(text: str) -> PendulumLoad | None:
    """The load that `text` names; None for `none`, a servo without a load.

    Parameters
    ----------
    text : str
        `pendulum:0.1kg@0.10m`, with `,arm=0.02kg` for the mass of the arm and `,hanging=0.1rad` if
        the mass does not hang straight down at 0.

    Examples
    --------
    >>> load = parse_load("pendulum:0.1kg@0.12m,arm=0.03kg")
    >>> round(load.gravity_nm, 4), round(load.inertia_kg_m2, 6)
    (0.1354, 0.001584)
    """
    if text == "none":
        return None
    match = _LOAD.fullmatch(text)
    values: dict[str, float] = {}
    try:
        if not match:
            raise ValueError
        for part in match[3].split(",")[1:]:
            key, _, value = part.partition("=")
            name, unit = _MORE[key]
            if not value.endswith(unit):
                raise ValueError
            values[name] = decimal(value.removesuffix(unit))
        hanging_rad = values.get("hanging_rad", 0.0)
        if abs(hanging_rad) > np.pi:
            raise InputError(
                f"`load`: hanging={hanging_rad:g}rad is more than half a turn from 0. Write "
                f"radians: {hanging_rad:g} degrees are {np.radians(hanging_rad):.2g}."
            )
        load = PendulumLoad(mass_kg=decimal(match[1]), length_m=decimal(match[2]), **values)
        if not load.gravity_nm > 0:
            raise ValueError
    except (ValueError, KeyError):
        raise InputError(
            f"`load`: '{text}' is no load. Write pendulum:0.1kg@0.10m (mass at the end of the arm, "
            "its distance from the axis), with ,arm=0.02kg for the arm's own mass and "
            ",hanging=0.1rad if it does not hang straight down at 0 rad; or none."
        ) from None
    return load


def parse_gains(text: str) -> list[int]:
    """P gains that `text` names, such as `8,16,32`."""
    words = [word.strip() for word in text.split(",")]
    gains = [int(word) if word.isascii() and word.isdecimal() else 0 for word in words]
    if any(not _GAINS[0] <= gain <= _GAINS[1] for gain in gains) or len(set(gains)) < len(gains):
        raise InputError(
            f"`gains`: '{text}' are no P gains; write values of the register, {_GAINS[0]} to "
            f"{_GAINS[1]}, each once, such as 8,16,32."
        )
    return gains


def bench_plan(
    joint: str,
    load: PendulumLoad | None,
    gains: Sequence[int] = (),
    kind: str = BENCH,
    *,
    frequencies_hz: Sequence[float] = FREQUENCIES_HZ,
    amplitude_rad: float | None = None,
    duration_s: float | None = None,
    loop_period_s: float,
    start_rad: float,
    margin_rad: float,
) -> Plan:
    """The trials of a bench, gain by gain; empty `gains` leave the servo's own.

    A `load` of None is a servo in free air: no drops. `kind` is one of `BENCH_KINDS` or of
    `sysid.sweep.excitation.plan`; a chirp has frequencies of its own. The amplitude is by default
    `AMPLITUDE_RAD`, or `STROKE_RAD` for `reversal` and `LIFT_RAD` for lifts. The mass hangs (or the
    joint rests) at `start_rad`, with `margin_rad` of travel to both sides.
    """
    if amplitude_rad is not None:
        check_amplitude(amplitude_rad)
    warnings = _weigh(load, gains)
    reach = min(margin_rad, REACH_RAD)
    kinds = [kind] if kind != BENCH else ["sine", "chirp", "prbs", "steps", *([DROP] * bool(load))]
    if kind == DROP and load is None:
        raise InputError("`kind=drop`: without a load nothing drops; give one, or another kind.")
    one_gain: list[TrialPlan] = []
    for each in kinds:
        if each == DROP:
            height = LIFT_RAD if amplitude_rad is None or kind != DROP else amplitude_rad
            height = min(height, LIFT_RAD, reach)
            rise = FASTEST_OF_MINIMUM_JERK * abs(height) / LIFT_RAD_S
            release = LEAD_IN_S + rise + _HOLD_S  # lift, hold, and let go
            one_gain += [
                TrialPlan(
                    (joint,), np.nan, release + _DROP_S,
                    after(LEAD_IN_S, lift(side * height, rise)), release_s=release,
                )
                for side in (1, -1)
            ]  # fmt: skip
        elif each == REVERSAL:
            size = min(STROKE_RAD if amplitude_rad is None else amplitude_rad, reach)
            offset, time = strokes(size, STROKE_SPEEDS_RAD_S, STROKES)
            one_gain.append(TrialPlan((joint,), np.nan, LEAD_IN_S + time, after(LEAD_IN_S, offset)))
        else:
            some = plan(
                each, [joint], CHIRP_HZ if each == "chirp" and kind == BENCH else frequencies_hz,
                AMPLITUDE_RAD if amplitude_rad is None else amplitude_rad, duration_s,
                loop_period_s, SPEED_LIMIT_RAD_S, 0.0, {joint: reach}, {joint: start_rad},
            )  # fmt: skip
            one_gain += some.trials
            warnings += some.warnings
    trials = [replace(t, p_gain=float(g)) for g in gains or [np.nan] for t in one_gain]
    warnings = list(dict.fromkeys(warnings))
    description = {
        "kind": kind, "gains": list(gains), "load": load.model_dump() if load else None,
        "amplitude_rad": amplitude_rad, "frequencies_hz": list(frequencies_hz),
        "duration_s": duration_s, "lead_in_s": LEAD_IN_S, "speed_limit_rad_s": SPEED_LIMIT_RAD_S,
        "warnings": warnings,
    }  # fmt: skip
    near = NEAREST_START_RAD if load else float("inf")
    return Plan(tuple(trials), {joint: start_rad}, description, tuple(warnings), near)


def _weigh(load: PendulumLoad | None, gains: Sequence[int]) -> list[str]:
    """Warnings on a load; one that no servo of this class holds is refused."""
    if load is None:
        return []
    if load.gravity_nm > _HEAVIEST * _NOMINAL_NM:
        raise InputError(
            f"`load`: its weight asks for {load.gravity_nm:.2f} N·m, more than "
            f"{100 * _HEAVIEST:.0f} % of an STS3215's stall torque at 7.4 V ({_NOMINAL_NM} N·m): "
            "it would overheat. Take a lighter mass or a shorter arm."
        )
    sags = {g: load.gravity_nm / (_NOMINAL_PER_P * g) for g in gains}
    return [
        f"P gain {g}: an STS3215 would sag by {sag:.2f} rad under this load; the guard stops at "
        "0.35 rad. Take a higher gain or a lighter mass."
        for g, sag in sags.items()
        if sag > _DEEPEST_SAG_RAD
    ]
