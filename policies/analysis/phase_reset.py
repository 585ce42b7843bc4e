"""Closed-loop tests of a rhythm's autonomy: what a push does to its phase, and another rate to it.

An oscillator that keeps its own time takes a push as a jump in phase, keeps the new phase, and goes
on as before; one that is driven from outside comes back to the phase it had. And a rhythm that a
network counts in its own steps gets faster when it is asked more often; one that the body sets
does not.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.policies.analysis.gait import SETTLE_S
from pupper_sysid.policies.analysis.rhythm import mean_of, sine_frequency
from pupper_sysid.policies.analysis.robustness import Trial, outcome, still
from pupper_sysid.policies.analysis.rollouts import Disturb, Rollout
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.walking.env import PupperEnv

Array = NDArray[np.float64]

PUSH_M_S = 0.2
"""Sideways speed that a push gives the trunk: the largest of the training."""
NUDGE_M_S = 0.01
"""For comparison: a push that changes nothing but the numbers."""
RATES_HZ = (25.0, 31.25, 50.0, 71.43, 100.0)
_PUSH_S = 4.0
_PUSHES = 4  # spread over one period
_EARLY_S, _LATE_S = (1.0, 3.0), (3.0, 5.0)  # after the push


def push_response(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """What is left of the phase shift that a push made.

    Each robot walks twice, once with a sideways push and once without; pushes come at times spread
    over a period. The shift is that between the sines of the two walks' actions.

    Returns
    -------
    list of dict
        `push_m_s`, `survival`, `shift_early`, `shift_late` (mean size of the phase shift [cycles],
        1–3 s and 3–5 s after the push), `kept` (slope of the late shifts on the early ones: 1 is
        kept, 0 comes back) and `phases`, `shifts` (of each robot and push, cycles). Empty if no
        robot walks to the end.
    """
    trial = replace(trial, seconds=_PUSH_S + _LATE_S[1] + 1.0)
    plain = trial.walk(policy)
    step_s = plain.step_s
    begin = round(_PUSH_S / step_s)
    settled = plain.action_rad[round(SETTLE_S / step_s) :]
    up = np.flatnonzero(plain.alive[-1]).tolist()
    robots = [i for i in up if not still(settled[:, i])]
    if not robots:
        return []
    rates = {i: sine_frequency(settled[:, i], step_s) for i in robots}
    period = 1 / float(np.median(list(rates.values())))
    found: list[dict[str, Any]] = []
    for speed in (NUDGE_M_S, PUSH_M_S):
        shifts, phases, survived = [], [], []
        for k in range(_PUSHES):
            at = begin + round(k * period / _PUSHES / step_s)
            pushed = trial.walk(policy, None, _pusher(at, speed))
            survived.append(pushed.alive[-1][robots].mean())
            both = [i for i in robots if pushed.alive[-1, i]]
            shifts += [
                [_shift(plain, pushed, at, w, i, rates[i]) for w in (_EARLY_S, _LATE_S)]
                for i in both
            ]
            phases += [_phase(plain, at, i, rates[i]) for i in both]
        early, late = np.array(shifts).reshape(-1, 2).T
        found.append(
            {"push_m_s": speed, "survival": float(np.mean(survived)),
             "shift_early": mean_of(np.abs(early)).value,
             "shift_late": mean_of(np.abs(late)).value,
             "kept": float(early @ late / (early @ early)) if early.any() else float("nan"),
             "phases": phases, "shifts": late.tolist()}
        )  # fmt: skip
    return found


def rate_response(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """The gait when the policy is asked more or less often than it was trained to be.

    Returns
    -------
    list of dict
        `rate_hz`, `cycles_per_step` and what `outcome` gives.
    """
    physics_s = trial.task.physics_step_s
    found = []
    for rate in RATES_HZ:
        step_s = round(1 / rate / physics_s) * physics_s
        walked = outcome(
            replace(trial, task=replace(trial.task, control_step_s=step_s)).walk(policy)
        )
        found.append(
            {"rate_hz": 1 / step_s, "cycles_per_step": walked["frequency_hz"] * step_s} | walked
        )
    return found


def rate_exponent(rows: list[dict[str, Any]]) -> float:
    """How the gait's frequency grows with the rate: 1 counted in steps, 0 in seconds."""
    known = [r for r in rows if np.isfinite(r["frequency_hz"]) and r["survival"] > 0.5]
    if len(known) < 2:
        return float("nan")
    rates, gaits = (np.log([r[k] for r in known]) for k in ("rate_hz", "frequency_hz"))
    return float(np.polyfit(rates, gaits, 1)[0])


def _pusher(at: int, speed: float) -> Disturb:
    """One push to the left of each robot's trunk."""

    def disturb(step: int, env: PupperEnv) -> None:
        if step != at:
            return
        robots = env.robots
        velocity = robots.qvel[:, :2].copy()
        w, x, y, z = robots.qpos[:, 3:7].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        velocity += speed * np.column_stack([-np.sin(heading), np.cos(heading)])
        robots.push(np.arange(env.environments), velocity)

    return disturb


def _shift(
    plain: Rollout,
    pushed: Rollout,
    at: int,
    window_s: tuple[float, float],
    robot: int,
    rate: float,
) -> float:
    """Phase of the pushed walk ahead of the other's [cycles], -0.5 to 0.5."""
    begin, end = (at + round(s / plain.step_s) for s in window_s)
    end = min(end, len(plain.action))  # the last pushes of a slow gait come late
    carrier = _carrier(rate, begin, end, plain.step_s)
    before, after = (r.action_rad[begin:end, robot] for r in (plain, pushed))
    one, other = (carrier @ (x - x.mean(axis=0)) for x in (before, after))
    return float(np.angle(np.vdot(one, other)) / (2 * np.pi))


def _phase(plain: Rollout, at: int, robot: int, rate: float) -> float:
    """Where in its cycle (of the LF thigh's action) a robot is pushed, 0 to 1."""
    begin = at - round(SETTLE_S / plain.step_s)
    thigh = plain.action_rad[begin:at, robot, 1]
    turned = np.angle(_carrier(rate, begin, at, plain.step_s) @ (thigh - thigh.mean()))
    return float((turned / (2 * np.pi) + rate * at * plain.step_s) % 1.0)


def _carrier(rate: float, begin: int, end: int, step_s: float) -> NDArray[np.complex128]:
    return np.exp(-2j * np.pi * rate * step_s * np.arange(begin, end))
