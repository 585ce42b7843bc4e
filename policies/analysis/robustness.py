"""How a policy's walk stands up to late, noisy, missing and frozen observations.

Every test is done twice where the published one was done in replay only: in *replay* the policy is
shown altered recordings and nothing follows from what it does; in *closed loop* the robot in the
simulator has to live with it. Replay says how a network reacts, closed loop whether it walks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.analysis import perturbations
from pupper_sysid.policies.analysis.attractor import closure, collapse, principal_components
from pupper_sysid.policies.analysis.gait import SETTLE_S, amplitude, correlation, jitter, steady
from pupper_sysid.policies.analysis.perturbations import JOINTS
from pupper_sysid.policies.analysis.rhythm import frequency, mean_of
from pupper_sysid.policies.analysis.rollouts import Change, Disturb, Rollout, collect, replay
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.sim.robot.terrain import Terrain
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import OBSERVATION_PARTS as PARTS
from pupper_sysid.sim.walking.servo_ranges import ServoRanges

EXTRA_DELAYS_MS = (0, 40, 80, 160, 240, 320, 400)
NOISE_SHARES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
SCALES_RAD = (0.45, 0.6, 0.75)
"""Of the published deployments."""
HOLD_MS = (40, 80, 160, 320)
CHANNELS = {
    name: PARTS[name]
    for name in ("joint_position_relative", "joint_velocity", "joint_effort", "last_action")
} | {"all joints": JOINTS}
"""Parts of the observation that are ablated."""
_MOST_LAG = 5
_STILL_RAD = 1e-3  # less moves no servo by a count
_LAST_ACTION = PARTS["last_action"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trial:
    """Where, for how long and with how many robots a policy is tried."""

    task: Walking
    servos: ServoRanges
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    robots: int = 16
    seconds: float = 10.0
    seed: int = 0
    threads: int = 0
    _plain: list[tuple[Policy, Rollout]] = field(
        init=False, repr=False, compare=False, default_factory=list
    )

    def walk(
        self, policy: Policy, change: Change | None = None, disturb: Disturb | None = None
    ) -> Rollout:
        """One rollout, with altered observations or disturbed robots.

        One without either is made once per policy: most analyses begin with it.
        """
        plain = change is None and disturb is None
        known = next((r for p, r in self._plain if p is policy), None)
        if plain and known:
            return known
        found = collect(
            policy, self.task, self.servos, self.command, self.robots, self.seconds,
            self.seed, self.threads, change, disturb,
        )  # fmt: skip
        if plain:
            self._plain.append((policy, found))
        return found


def outcome(rollout: Rollout) -> dict[str, float]:
    """Survival, tracking and gait of a rollout; NaN where no robot walked long enough."""
    alive = rollout.alive
    error = np.abs(rollout.velocity - np.array(rollout.command))[alive].mean(axis=0)
    found = {
        "survival": float(alive[-1].mean()),
        "mae_vx_m_s": float(error[0]),
        "mae_vy_m_s": float(error[1]),
        "mae_yaw_rad_s": float(error[2]),
    }
    gaits = [
        (
            frequency(action, rollout.step_s).value,
            float(amplitude(action)[0].mean()),
            jitter(action),
        )
        for i, now in steady(rollout).items()
        if not still(action := rollout.action_rad[now, i])
    ]
    means = np.mean(np.array(gaits), axis=0).tolist() if gaits else [float("nan")] * 3
    return found | dict(zip(("frequency_hz", "amplitude_rad", "jitter_rad"), means, strict=True))


def delay_curve(
    policy: Policy, trial: Trial, extra_ms: Sequence[float] = EXTRA_DELAYS_MS
) -> list[dict[str, Any]]:
    """Against more delay: in replay as published, and closed loop, fixed and jittered.

    Fixed delay is the servos' own, on top of what the calibration says; jittered delay is of what
    the policy is told of its joints, since a servo cannot answer out of order.

    Returns
    -------
    list of dict
        `extra_delay_ms`, `mode` (`replay`, `fixed`, `jittered`), `survival` (NaN in replay),
        `frequency_hz`, `amplitude_rad`, `jitter_rad` and tracking errors.
    """
    step_ms = 1e3 * trial.task.control_step_s
    rng = np.random.default_rng(trial.seed)
    plain = trial.walk(policy)
    found: list[dict[str, Any]] = []
    for extra in extra_ms:
        steps = round(extra / step_ms)
        seen = perturbations.applied(perturbations.delayed(JOINTS, steps), plain.observation)
        actions, _ = replay(policy, seen)
        found.append(
            {"extra_delay_ms": extra, "mode": "replay", "survival": float("nan")}
            | _gait_of_actions(plain, actions)
        )
        later = replace(trial, servos=trial.servos.later(extra / 1e3))
        fixed = plain if extra == 0 else later.walk(policy)
        found.append({"extra_delay_ms": extra, "mode": "fixed"} | outcome(fixed))
        change = perturbations.jittered(JOINTS, steps, rng)
        moving = plain if extra == 0 else trial.walk(policy, change)
        found.append({"extra_delay_ms": extra, "mode": "jittered"} | outcome(moving))
    return found


def ablation(
    policy: Policy, trial: Trial, channels: Sequence[str] = tuple(CHANNELS)
) -> list[dict[str, Any]]:
    """Noise, zeros and staleness on what comes from the servos, by channel and jointly.

    Noise is in shares of a channel's own standard deviation while walking; `sigma` is that in the
    channel's unit (NaN where several units are mixed).

    Returns
    -------
    list of dict
        `channel`, `kind` (`noise`, `zero`, `hold`), `level` (share, 0, ms), `sigma`,
        `correlation` (replay, with the actions of the whole observation), `survival` and the rest
        of `outcome` (closed loop). All of it NaN for noise if no robot walked long enough to size
        it by.
    """
    rng = np.random.default_rng(trial.seed)
    plain = trial.walk(policy)
    walked = steady(plain)
    nothing = dict.fromkeys(outcome(plain), float("nan"))
    found: list[dict[str, Any]] = []
    for name in channels:
        part = CHANNELS[name]
        spread = np.full(part.stop - part.start, np.nan)
        if walked:
            shown = [plain.observation[now, i, part] for i, now in walked.items()]
            spread = np.concatenate(shown).std(axis=0)
        sigma = float(spread.mean()) if name != "all joints" else float("nan")
        cases: list[tuple[str, float, float, Callable[[], Change]]] = [
            ("noise", share, share * sigma, partial(perturbations.noisy, part, share * spread, rng))
            for share in NOISE_SHARES
        ]
        cases.append(("zero", 0.0, float("nan"), partial(perturbations.zeroed, part)))
        cases += [
            ("hold", ms, float("nan"), partial(perturbations.held, part, _steps(ms, plain.step_s)))
            for ms in HOLD_MS
        ]
        for kind, level, size, change in cases:
            row = {"channel": name, "kind": kind, "level": level, "sigma": size}
            if kind == "noise" and not walked:
                found.append(row | {"correlation": float("nan")} | nothing)
                continue
            closed_loop = outcome(trial.walk(policy, change()))
            actions, _ = replay(policy, perturbations.applied(change(), plain.observation))
            found.append(row | {"correlation": _agreement(plain, actions)} | closed_loop)
    return found


def terrain(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """Survival, tracking and gait on every kind of ground.

    Returns
    -------
    list of dict
        `ground` and what `outcome` gives.
    """
    return [
        {"ground": kind}
        | outcome(replace(trial, task=replace(trial.task, terrain=kind)).walk(policy))
        for kind in get_args(Terrain)
    ]


def scales(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """The walk with other scales of what is sent than that of the training, as deployed robots had.

    Returns
    -------
    list of dict
        `scale_rad` and what `outcome` gives.
    """
    return [
        {"scale_rad": scale}
        | outcome(replace(trial, task=replace(trial.task, action_scale=scale)).walk(policy))
        for scale in sorted({*SCALES_RAD, trial.task.action_scale})
    ]


def frozen(policy: Policy, trial: Trial) -> list[dict[str, Any]]:
    """Whether the rhythm goes on without its inputs.

    In replay, from two seconds on: everything frozen but the policy's own last action; everything
    frozen; only the last action frozen. A rhythm that goes on with all inputs frozen is made
    inside; one that needs its last action is made by the loop through the action; one that stops
    needs the joints.

    Returns
    -------
    list of dict
        `test`, `frequency_hz`, `amplitude_rad`, `jitter_rad` and `share` (of the amplitude with
        nothing frozen); NaN if no robot walked long enough, or moved.
    """
    plain = trial.walk(policy)
    start = round(SETTLE_S / plain.step_s)
    own = _LAST_ACTION
    before = _gait_of_actions(plain, plain.action)["amplitude_rad"]
    found: list[dict[str, Any]] = []
    tests = {
        "nothing frozen": (None, False),
        "senses frozen, its own last action": (slice(0, own.start), True),
        "senses and last action frozen": (slice(0, own.stop), False),
        "last action frozen, senses recorded": (own, False),
    }
    for name, (part, feeds_back) in tests.items():
        actions = _driven(policy, plain, part, feeds_back, start)
        gait = _gait_of_actions(plain, actions)
        share = gait["amplitude_rad"] / before if before > _STILL_RAD else float("nan")
        found.append({"test": name, "share": share} | gait)
    return found


def orbits(policy: Policy, trial: Trial, delays_ms: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Orbits of actions and hidden states in replay with late joints, on axes common to all delays.

    Returns
    -------
    dict of str to dict
        For `actions` [rad] and `hidden`: `states` and `orbits` (of the first robot that walked long
        enough, per delay; arrays of shape (steps, k)), `explained` and `explained_3` (shares of
        variance), `participation_ratio`, `closure` and `area_ratio` (to no delay) per delay, NaN
        where it stands still. Empty if no robot walked long enough and moved.
    """
    plain = trial.walk(policy)
    moving = {i: now for i, now in steady(plain).items() if not still(plain.action_rad[now, i])}
    if not moving:
        return {}
    robot, now = next(iter(moving.items()))
    acted, minds = [], []
    for delay in delays_ms:
        change = perturbations.delayed(JOINTS, round(delay / 1e3 / plain.step_s))
        actions, hidden = replay(policy, perturbations.applied(change, plain.observation))
        acted.append(plain.action_scale * actions[now, robot].astype(float))
        minds.append(hidden[now, robot].astype(float))
    rate = _rate(acted[0], plain.step_s)
    found = {}
    for name, conditions in (("actions", acted), ("hidden", minds)):
        axes = principal_components(conditions, 3)
        paths = [axes.orbit(c) for c in conditions]
        found[name] = {
            "states": conditions,
            "orbits": paths,
            "explained": axes.explained.tolist(),
            "explained_3": float(axes.explained[:3].sum()),
            "participation_ratio": float(axes.participation_ratio),
            "closure": [_or_nan(closure, path, plain.step_s, rate) for path in paths],
            "area_ratio": [_or_nan(_area, path[:, :2], paths[0][:, :2]) for path in paths],
        }
    return found


def _driven(
    policy: Policy, plain: Rollout, frozen: slice | None, own_action: bool, start: int
) -> Array:
    """Actions of a policy that is shown a recording with a part frozen from `start` on.

    With `own_action` its last action is what it really did last, else what the recording (or the
    frozen part) says. A recording that ends before has nothing to freeze.
    """
    player = copy(policy)
    seen = plain.observation
    player.reset(seen[0, :, _LAST_ACTION])
    last, actions = seen[0, :, _LAST_ACTION], []
    for step, observation in enumerate(seen):
        shown = observation.copy()
        if frozen is not None and step >= start:
            shown[:, frozen] = seen[start, :, frozen]
        if own_action:
            shown[:, _LAST_ACTION] = last
        last = player.act(shown)
        actions.append(last)
    return np.stack(actions)


def _gait_of_actions(plain: Rollout, actions: NDArray[np.floating]) -> dict[str, float]:
    """Frequency, amplitude and jitter of replayed actions, once settled.

    Means over the robots whose recording is of a walk, up to their fall; NaN if there is none (for
    the frequency: none that moves in the replay).
    """
    radians = plain.action_scale * actions.astype(float)
    walked = [radians[now, i] for i, now in steady(plain).items()]
    return {
        "frequency_hz": _mean([_rate(x, plain.step_s) for x in walked]),
        "amplitude_rad": _mean([float(amplitude(x)[0].mean()) for x in walked]),
        "jitter_rad": _mean([jitter(x) for x in walked]),
    }


def _mean(values: Sequence[float]) -> float:
    """Mean of the numbers among them, NaN if there are none."""
    return mean_of(np.array(values, float)).value


def _area(path: Array, reference: Array) -> float:
    return collapse(path, reference).area


def _or_nan(measure: Callable[..., float], *given: Any) -> float:
    """A measure of an orbit; NaN where it has none, because nothing moves any more."""
    try:
        return measure(*given)
    except InputError:
        return float("nan")


def _steps(ms: float, step_s: float) -> int:
    return max(round(ms / 1e3 / step_s), 1)


def still(signal: Array) -> bool:
    """Whether no joint moves, wherever each of them stands."""
    return bool(signal.std(axis=0).max() < _STILL_RAD)


def _rate(signal: Array, step_s: float) -> float:
    """Frequency of a signal; NaN if it stands still."""
    if still(signal):
        return float("nan")
    return frequency(signal, step_s).value


def _agreement(plain: Rollout, altered: NDArray[np.floating]) -> float:
    """Gait correlation of replayed actions with the walk's: mean over robots of that over joints.

    Of robots that walked long enough, and moved; NaN if there is none.
    """
    walked = {i: now for i, now in steady(plain).items() if not still(plain.action_rad[now, i])}
    return _mean(
        [correlation(plain.action[now, i], altered[now, i], _MOST_LAG).r
         for i, now in walked.items()]
    )  # fmt: skip
