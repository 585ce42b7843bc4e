"""Figures of walks: falls, tracking errors, speed, drift of the heading, and what the feet do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.rhythm import mean_of
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.walks.conditions import Condition, Moment
from pupper_sysid.policies.walks.rollouts import heading
from pupper_sysid.policies.walks.tracking import (
    ERRORS,
    STRIDE_ERRORS,
    counted,
    planar_velocity,
    stride_errors,
    tracking_errors,
)
from pupper_sysid.sim.walking.env import PupperEnv

Array = NDArray[np.float64]

START_S = 1.0
"""Time in which a robot starts to move, without which mean speeds are given [s]."""

_SHORTEST_SWING_S = 0.04  # shorter ones are flickering contacts


@dataclass(frozen=True)
class Walk:
    """Episodes of one or more robots under one condition; zeros after a robot's last step."""

    step_s: float
    fell: NDArray[np.bool_]
    """Shape (episodes,)."""
    command: Array
    """Forward and sideways speed [m/s], turn rate [rad/s]; shape (steps, episodes, 3)."""
    velocity: Array
    contact: NDArray[np.bool_]
    """Feet on the ground; shape (steps, episodes, 4)."""
    alive: NDArray[np.bool_]
    """Shape (steps, episodes)."""
    gravity: Array
    """The ground's normal, downwards, in the trunk's frame; shape (steps, episodes, 3)."""
    heading: Array
    """Continuous [rad], shape (steps, episodes)."""
    slip_m_s: Array
    """Speed of the feet on the ground, summed over those; shape (steps, episodes)."""
    swing_s: Array
    """Length of the swings that ended, summed; shape (steps, episodes)."""
    swings: NDArray[np.int_]
    """How many ended; shape (steps, episodes)."""

    @property
    def error(self) -> Array:
        """Mean absolute errors at every control step, shape (episodes, 3)."""
        return tracking_errors(self.velocity, self.command, self.alive, self.fell)

    @property
    def stride_error(self) -> Array:
        """Mean absolute errors of the mean velocity over a stride, shape (episodes, 3)."""
        with np.errstate(divide="ignore"):
            stride_s = 1.0 / self.stride_hz
        return stride_errors(
            self.velocity, self.command, self.alive, self.fell, stride_s, self.step_s
        )

    @property
    def commanded(self) -> Array:
        """Mean absolute command: the error of a robot that stands still, shape (episodes, 3)."""
        return tracking_errors(np.zeros_like(self.velocity), self.command, self.alive, self.fell)

    @property
    def stride_hz(self) -> Array:
        """Strides per second of each robot while it was up, shape (episodes,)."""
        feet = self.contact.shape[-1]
        up_s = self.step_s * np.maximum(self.alive.sum(axis=0), 1)
        return self.swings.sum(axis=0) / feet / up_s

    @property
    def mean_velocity(self) -> Array:
        """Mean velocity after the first second, with falls as standing; shape (episodes, 3)."""
        velocity, counts = counted(self.velocity, self.alive, self.fell)
        first = min(round(START_S / self.step_s), len(velocity) // 2)
        each = counts[first:, :, None]
        return (each * velocity[first:]).sum(axis=0) / np.maximum(each.sum(axis=0), 1)

    @property
    def drift_deg(self) -> Array:
        """Size of the change of heading over the episode; NaN of robots that did not finish it."""
        change = np.degrees(np.abs(self.heading[-1] - self.heading[0]))
        return np.where(self.alive[-1], change, np.nan)

    def first(self, episodes: int) -> Walk:
        """The same of the first episodes."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "step_s"}
        return Walk(
            step_s=self.step_s,
            **{k: v[:episodes] if k == "fell" else v[:, :episodes] for k, v in given.items()},
        )


@dataclass(frozen=True, kw_only=True)
class Intervals(Result):
    """90 % intervals over episodes.

    Of the share that fell by Clopper and Pearson, of all else by Student's t.
    """

    fall_rate: Interval
    mae_vx_m_s: Interval
    mae_vy_m_s: Interval
    mae_yaw_rad_s: Interval
    stride_mae_vx_m_s: Interval
    stride_mae_vy_m_s: Interval
    stride_mae_yaw_rad_s: Interval
    speed_share: Interval
    heading_drift_deg: Interval


@dataclass(frozen=True, kw_only=True)
class Figures(Result):
    """Figures of a number of episodes."""

    episodes: int
    fall_rate: float
    mae_vx_m_s: float
    """Of every control step, as the other two; see `policies.walks.tracking`."""
    mae_vy_m_s: float
    mae_yaw_rad_s: float
    stride_mae_vx_m_s: float
    """Of the mean velocity over a stride, as the other two."""
    stride_mae_vy_m_s: float
    stride_mae_yaw_rad_s: float
    speed_share: float
    """Mean speed along the command over the commanded one after the first second, 0 after a fall;
    NaN for random commands and for standing."""
    mean_velocity: tuple[float, ...]
    """Forward, sideways, turning, after the first second; 0 after a fall."""
    heading_drift_deg: float
    """Mean size of the change of heading over the episode, of robots that finished it; NaN where
    the command turns."""
    duty: tuple[float, ...]
    """Share of time that each foot stands."""
    stride_hz: float
    """Strides per second."""
    swing_s: float
    """Mean length of a swing."""
    foot_slip_m_s: float
    """Mean speed of feet on the ground."""
    intervals: Intervals


class Recorder:
    """What figures are made of, for the robots of one environment."""

    def __init__(self, env: PupperEnv, policy: Policy | None, conditions: Sequence[Condition]):
        self._env = env
        self._step_s = env.config.control_step_s
        self._fell = np.zeros(env.environments, bool)
        self._steps: list[dict[str, NDArray]] = []

    def keep(self, now: Moment) -> None:
        """Take the next control step."""
        facts = now.facts
        self._fell |= now.fell
        standing = facts.contact & now.alive[:, None]
        ended = standing & (facts.contact_s <= self._step_s + 1e-9)
        ended &= facts.last_air_s > _SHORTEST_SWING_S - 1e-9
        # before the first step a foot may have been elsewhere: its speed is not known
        slip = facts.foot_speed_m_s * standing if self._steps else np.zeros(standing.shape)
        self._steps.append(
            {
                "velocity": planar_velocity(facts), "contact": facts.contact, "alive": now.alive,
                "gravity": facts.gravity.astype(np.float32),
                "heading": heading(self._env.robots.qpos), "slip_m_s": slip.sum(axis=1),
                "swing_s": (facts.last_air_s * ended).sum(axis=1), "swings": ended.sum(axis=1),
            }
        )  # fmt: skip

    def of(self, condition: Condition, robots: slice, steps: int, commands: Array) -> Walk:
        """The walk of a condition's robots."""
        kept = self._steps[:steps]
        arrays = {name: np.stack([step[name][robots] for step in kept]) for name in kept[0]}
        arrays["heading"] = np.unwrap(arrays["heading"], axis=0)
        rest = len(commands) - steps
        padded = {
            name: np.concatenate([x, np.zeros((rest, *x.shape[1:]), x.dtype)])
            for name, x in arrays.items()
        }
        return Walk(self._step_s, self._fell[robots], commands, **padded)


def figures_of(found: Walk, command: tuple[float, float, float] | None = None) -> Figures:
    """Figures of a number of episodes; `command` is the fixed one, None for random ones."""
    alive = found.alive
    standing, swings = (found.contact & alive[..., None]).sum(), found.swings.sum()
    each = dict(zip(ERRORS, found.error.T, strict=True))
    each |= dict(zip(STRIDE_ERRORS, found.stride_error.T, strict=True))
    nothing = np.full(len(found.fell), np.nan)
    each["speed_share"] = nothing if command is None else _share(found, np.array(command))
    drifts = command is not None and command[2] == 0
    each["heading_drift_deg"] = found.drift_deg if drifts else nothing
    intervals = {name: mean_of(values) for name, values in each.items()}
    return Figures(
        episodes=len(found.fell),
        fall_rate=float(found.fell.mean()),
        **{name: interval.value for name, interval in intervals.items()},
        mean_velocity=tuple(found.mean_velocity.mean(axis=0).tolist()),
        duty=tuple(found.contact[alive].mean(axis=0).tolist()),
        stride_hz=float(found.stride_hz.mean()),
        swing_s=float(found.swing_s.sum() / swings) if swings else float("nan"),
        foot_slip_m_s=float(found.slip_m_s.sum() / max(standing, 1)),
        intervals=Intervals(
            fall_rate=share_interval(int(found.fell.sum()), len(found.fell)), **intervals
        ),
    )


def _share(found: Walk, command: Array) -> Array:
    """Speed of each robot along a command, over the commanded one; NaN of a command to stand."""
    size = float(command @ command)
    if not size:
        return np.full(len(found.fell), np.nan)
    return found.mean_velocity @ command / size


def share_interval(some: int, of: int) -> Interval:
    """Share with its interval by Clopper and Pearson."""
    tail = (1 - LEVEL) / 2
    low = float(beta.ppf(tail, some, of - some + 1)) if some else 0.0
    high = float(beta.ppf(1 - tail, some + 1, of - some)) if some < of else 1.0
    return Interval(some / of, low, high)
