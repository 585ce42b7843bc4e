"""Reward terms of the walking task: each a small function of what happened in one control step.

A term takes a `Step` and its parameters and gives one number per environment; `Rewards` holds the
weight of each, per second (the sum is multiplied by the control period, as in Isaac Lab); 0 leaves
a term out. `PAPER` and `RELEASE` hold the weights of the paper's text and of the training
configuration its authors released; `DEFAULT` are this project's own.

Two errors of the published terms are not repeated: penalties act on the joints they name, and foot
terms use the foot, not the knee, whose frame the published robot model calls a foot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_HIPS = slice(0, 12, 3)
# feet in the order LF, RF, LB, RB: diagonal pairs move together, sides and ends alternate
DIAGONALS = ((0, 3), (1, 2))
"""Feet that a trot moves together, by index."""
_APART = ((0, 1), (3, 2), (0, 2), (1, 3))
_TURNS = np.array([1.0, -1.0, -1.0, 1.0])  # of the feet in the first half of the clock's cycle
_SLOW = (0.05, 0.15)  # m/s, rad/s


@dataclass(frozen=True)
class Step:
    """What happened in one control step, for all environments.

    Attributes
    ----------
    command : ndarray, shape (n, 3)
        Forward and sideways speed [m/s], turn rate [rad/s].
    linear_velocity, angular_velocity, gravity : ndarray, shape (n, 3)
        Of the trunk, in its own frame [m/s, rad/s, unit vector].
    position_relative, velocity, acceleration, torque : ndarray, shape (n, 12)
        Of the joints, from the default pose [rad, rad/s, rad/s², N·m].
    action, last_action, earlier_action : ndarray, shape (n, 12)
        Raw outputs of the policy: this, the one before, and the one before that.
    contact : ndarray of bool, shape (n, 4)
    air_s, contact_s : ndarray, shape (n, 4)
        Time that each foot has been in the air, on the ground; 0 if it is not.
    last_air_s, last_contact_s : ndarray, shape (n, 4)
        Duration of the last swing and stance.
    landed, lifted : ndarray of bool, shape (n, 4)
        Feet that came down, or left the ground, in this step.
    stride_velocity : ndarray, shape (n, 3)
        Forward and sideways speed and turn rate, averaged over about a stride [m/s, rad/s].
    foot_height_m, foot_speed_m_s : ndarray, shape (n, 4)
        Of the sole above the ground; of the foot along it.
    clock : ndarray, shape (n, 3)
        Cosine and sine of a trot's clock that follows the feet, and how well they keep to it, -1
        to 1; see `Strides`.
    """

    command: Array
    linear_velocity: Array
    angular_velocity: Array
    gravity: Array
    position_relative: Array
    velocity: Array
    acceleration: Array
    torque: Array
    action: Array
    last_action: Array
    earlier_action: Array
    contact: NDArray[np.bool_]
    air_s: Array
    contact_s: Array
    last_air_s: Array
    last_contact_s: Array
    landed: NDArray[np.bool_]
    lifted: NDArray[np.bool_]
    foot_height_m: Array
    foot_speed_m_s: Array
    stride_velocity: Array
    clock: Array

    def moving(self, threshold_m_s: float) -> NDArray[np.bool_]:
        """Whether a robot is commanded to move, or moves, shape (n,)."""
        commanded = np.abs(self.command).max(axis=1) > 0
        return commanded | (np.linalg.norm(self.linear_velocity[:, :2], axis=1) > threshold_m_s)


@dataclass(frozen=True)
class Rewards:
    """Weights [1/s] and parameters of all terms; a weight of 0 leaves the term out."""

    base_linear_velocity: float = 2.0
    """Follow the commanded speed at every instant."""
    base_angular_velocity: float = 3.0
    """Follow the commanded turn rate at every instant."""
    stride_linear_velocity: float = 2.0
    """Follow the commanded speed on average over about a stride."""
    stride_angular_velocity: float = 2.0
    """Follow the commanded turn rate on average over about a stride."""
    stride_linear_sigma: float = 0.05
    """σ of the mean speed's error [m/s]."""
    stride_angular_sigma: float = 0.2
    """σ of the mean turn rate's error [rad/s]."""
    tracking_shape: str = "exponential"
    """`gaussian`: exp(-error²/σ²); `exponential`: exp(-error/σ), as published."""
    linear_sigma: float = 0.1
    """σ of the speed error [m/s]."""
    angular_sigma: float = 0.3
    """σ of the turn rate's error [rad/s]."""
    fast_bonus: float = 0.0
    """Published: the speed term grows by this per m/s above `fast_above`."""
    fast_above: float = 0.15
    """Speed above which `fast_bonus` counts [m/s]."""
    progress: float = 0.0
    """How much nearer to the commanded speed the mean over a stride is than standing: pays from
    the first step on."""
    turn_progress: float = 0.0
    """The same of the turn rate."""
    progress_in_time: bool = False
    """Whether progress of either kind pays only as far as feet step with the clock."""
    alive: float = 0.5
    """Be upright."""
    unsupported: float = 0.0
    """Fewer than two feet on the ground."""
    short_swing: float = 0.0
    """Feet that come down after less than `shortest_swing`, by the share that was missing."""
    shortest_swing: float = 0.1
    """For `short_swing` [s]."""
    short_stance: float = 0.0
    """Feet that leave the ground after less than `shortest_stance`, by the share that was
    missing."""
    shortest_stance: float = 0.15
    """For `short_stance` [s]."""
    air_time: float = 0.0
    """Published: long swings and stances while moving, all feet down while standing."""
    air_time_most: float = 0.25
    """Longest swing that counts for `air_time` [s]."""
    clock: float = 0.0
    """Feet that are up when a trot's clock says so, less those that are when it does not, while
    commanded to move. The policy does not see the clock, which follows the feet."""
    clock_hz: float = 3.6
    """Steps of each foot per second by that clock."""
    clock_pull_hz: float = 0.5
    """How far from that rate it follows feet."""
    clock_duty: float = 0.6
    """Share of the time that a foot is to be down by that clock."""
    clock_height: float = 0.012
    """Height of a foot that counts as up [m]; lower ones count in proportion."""
    gait: float = 0.3
    """Diagonal feet together, the two pairs in turn (a trot)."""
    gait_threshold: float = 0.1
    """Like `moving_threshold`, for the gait [m/s]."""
    gait_sigma: float = 0.05
    """Its width [s²]."""
    gait_most: float = 0.15
    """Differences of times beyond this do not count more [s]."""
    foot_clearance: float = 0.0
    """Published: feet that move are at `clearance_height`."""
    clearance_height: float = 0.015
    """Height of a moving foot [m]."""
    clearance_sigma: float = 0.05
    """Its width [m]."""
    clearance_speed: float = 2.0
    """Inverse of the speed that counts as moving [s/m]."""
    swing_height: float = -400.0
    """Squared shortfall of a moving foot's height below `clearance_height`, by its speed [1/m³]."""
    action_smoothness: float = 0.0
    """Published: norm of the change of the action."""
    action_rate: float = -0.02
    """Squared change of the action."""
    action_jerk: float = -0.01
    """Squared change of the change of the action."""
    air_time_variance: float = 0.0
    """Published: feet that swing or stand for different times."""
    base_motion: float = -0.5
    """0.8 v_z² + 0.2 (|ω_x| + |ω_y|)."""
    base_orientation: float = -1.0
    """Tilt."""
    foot_slip: float = -1.0
    """Speed of feet on the ground."""
    joint_position: float = -0.1
    """Distance from the default pose."""
    standing_factor: float = 10.0
    """Factor on `joint_position` while standing."""
    moving_threshold: float = 0.15
    """Speed from which a robot counts as moving without a command to [m/s]."""
    hip_abduction: float = 0.0
    """Distance of the hips from the default pose."""
    joint_torques: float = -5e-3
    """Norm of the torques."""
    joint_acceleration: float = -2e-5
    """Norm of the accelerations."""
    joint_velocity: float = -1e-3
    """Norm of the velocities."""


DEFAULT = Rewards(
    tracking_shape="gaussian", linear_sigma=0.035, stride_linear_sigma=0.015, angular_sigma=0.16,
    stride_angular_sigma=0.06,
)  # fmt: skip
"""With widths of about an imitated trot's errors, where the slope of a Gaussian is largest."""

RELEASE = Rewards(
    base_linear_velocity=15.0, base_angular_velocity=10.0, tracking_shape="exponential",
    linear_sigma=0.1, angular_sigma=0.2, stride_linear_velocity=0.0,
    stride_angular_velocity=0.0, fast_bonus=0.5, fast_above=0.15, alive=0.0,
    air_time=5.0, air_time_most=0.25, gait=10.0, gait_sigma=0.08, gait_most=0.15,
    foot_clearance=1.0, clearance_height=0.03, clearance_sigma=0.05, clearance_speed=2.0,
    swing_height=0.0, action_smoothness=-2.0, action_rate=0.0, action_jerk=0.0,
    air_time_variance=-1.0, base_motion=-2.0, base_orientation=-5.0, foot_slip=-0.5,
    joint_position=-3.0, standing_factor=10.0, moving_threshold=0.15, hip_abduction=-2.5,
    joint_torques=-5e-4, joint_acceleration=-2.5e-4, joint_velocity=-1e-2,
)  # fmt: skip
"""Weights of the authors' released training configuration."""

PAPER = replace(RELEASE, action_smoothness=-1.0, joint_position=-0.7)
"""Weights that the paper's text names; the rest as released."""


def base_linear_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded speed, 0 to 1 (more with `fast_bonus`)."""
    error = np.linalg.norm(s.command[:, :2] - s.linear_velocity[:, :2], axis=1)
    speed = np.linalg.norm(s.command[:, :2], axis=1)
    bonus = np.maximum(1.0, 1.0 + p.fast_bonus * (speed - p.fast_above))
    return _tracking(error, p.linear_sigma, p) * bonus


def base_angular_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded turn rate, 0 to 1."""
    return _tracking(np.abs(s.command[:, 2] - s.angular_velocity[:, 2]), p.angular_sigma, p)


def stride_linear_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded speed on average over a stride, 0 to 1."""
    error = np.linalg.norm(s.command[:, :2] - s.stride_velocity[:, :2], axis=1)
    return _tracking(error, p.stride_linear_sigma, p)


def stride_angular_velocity(s: Step, p: Rewards) -> Array:
    """Tracking of the commanded turn rate on average over a stride, 0 to 1."""
    return _tracking(np.abs(s.command[:, 2] - s.stride_velocity[:, 2]), p.stride_angular_sigma, p)


def progress(s: Step, p: Rewards) -> Array:
    """Share of the commanded speed by which the mean over a stride is nearer than 0, -1 to 1."""
    return _nearer(s.command[:, :2], s.stride_velocity[:, :2], _SLOW[0]) * _stepping(s, p)


def turn_progress(s: Step, p: Rewards) -> Array:
    """The same of the turn rate."""
    return _nearer(s.command[:, 2:], s.stride_velocity[:, 2:], _SLOW[1]) * _stepping(s, p)


def _stepping(s: Step, p: Rewards) -> Array | float:
    return np.clip(s.clock[:, 2], 0.0, 1.0) if p.progress_in_time else 1.0


def _nearer(wanted: Array, velocity: Array, slow: float) -> Array:
    speed = np.linalg.norm(wanted, axis=1)
    gained = speed - np.linalg.norm(wanted - velocity, axis=1)
    # below `slow` the share of a small command would be that of the trunk's sway
    return np.where(speed > 0, np.clip(gained / np.hypot(speed, slow), -1.0, 1.0), 0.0)


def unsupported(s: Step, p: Rewards) -> Array:
    """0 with two or more feet on the ground, a half with one, 1 in flight."""
    return np.maximum(1.0 - 0.5 * s.contact.sum(axis=1), 0.0)


def short_swing(s: Step, p: Rewards) -> Array:
    """Share of `shortest_swing` that was missing, summed over feet that have just come down."""
    missing = np.maximum(1.0 - s.last_air_s / p.shortest_swing, 0.0)
    return (s.landed * missing).sum(axis=1)


def short_stance(s: Step, p: Rewards) -> Array:
    """Share of `shortest_stance` that was missing, summed over feet that have just left."""
    missing = np.maximum(1.0 - s.last_contact_s / p.shortest_stance, 0.0)
    return (s.lifted * missing).sum(axis=1)


def alive(s: Step, p: Rewards) -> Array:
    """1."""
    return np.ones(len(s.command))


def air_time(s: Step, p: Rewards) -> Array:
    """Sum over feet of the present swing or stance, up to `air_time_most` [s]."""
    most = p.air_time_most
    longest = np.maximum(s.air_s, s.contact_s)
    walking = np.where(longest < most, np.minimum(longest, most), 0.0)
    standing = np.clip(s.contact_s - s.air_s, -most, most)
    moving = s.moving(p.moving_threshold)[:, None]
    return np.where(moving, walking, standing).sum(axis=1)


def gait(s: Step, p: Rewards) -> Array:
    """Product over pairs of feet: 1 if they move together, or in turn, as in a trot."""
    most = p.gait_most**2
    product = np.ones(len(s.command))
    air, contact = s.air_s, s.contact_s
    for pairs, first, second in ((DIAGONALS, air, contact), (_APART, contact, air)):
        for a, b in pairs:
            gap = np.minimum((air[:, a] - first[:, b]) ** 2, most)
            gap = gap + np.minimum((contact[:, a] - second[:, b]) ** 2, most)
            product = product * np.exp(-gap / p.gait_sigma)
    return np.where(s.moving(p.gait_threshold), product, 0.0)


def clock(s: Step, p: Rewards) -> Array:
    """Heights of feet, as shares of `clock_height`, times how far the clock wants them up.

    That is 1 to -1 and less; the sum is 0 for a robot that stands, or is to.
    """
    up = s.clock[:, 1:2] * _TURNS - np.sin(np.pi * (p.clock_duty - 0.5))
    share = np.clip(s.foot_height_m / p.clock_height, 0.0, 1.0)
    return np.where(np.abs(s.command).max(axis=1) > 0, (up * share).sum(axis=1), 0.0)


def foot_clearance(s: Step, p: Rewards) -> Array:
    """Nearness of moving feet to `clearance_height`, 0 to 1."""
    moves = np.tanh(p.clearance_speed * s.foot_speed_m_s)
    error = ((s.foot_height_m - p.clearance_height) ** 2 * moves).sum(axis=1)
    return np.exp(-error / p.clearance_sigma)


def swing_height(s: Step, p: Rewards) -> Array:
    """Squared shortfall below `clearance_height` times the foot's speed, summed [m³/s]."""
    short = np.maximum(p.clearance_height - s.foot_height_m, 0.0)
    return (short**2 * s.foot_speed_m_s).sum(axis=1)


def action_smoothness(s: Step, p: Rewards) -> Array:
    """Norm of the change of the action."""
    return np.linalg.norm(s.action - s.last_action, axis=1)


def action_rate(s: Step, p: Rewards) -> Array:
    """Squared change of the action."""
    return ((s.action - s.last_action) ** 2).sum(axis=1)


def action_jerk(s: Step, p: Rewards) -> Array:
    """Squared change of the change of the action."""
    return ((s.action - 2 * s.last_action + s.earlier_action) ** 2).sum(axis=1)


def air_time_variance(s: Step, p: Rewards) -> Array:
    """Variance over feet of their last swings and stances, up to half a second [s²]."""
    swings, stances = np.minimum(s.last_air_s, 0.5), np.minimum(s.last_contact_s, 0.5)
    return swings.var(axis=1, ddof=1) + stances.var(axis=1, ddof=1)


def base_motion(s: Step, p: Rewards) -> Array:
    """Bouncing and rocking of the trunk."""
    rocking = np.abs(s.angular_velocity[:, :2]).sum(axis=1)
    return 0.8 * s.linear_velocity[:, 2] ** 2 + 0.2 * rocking


def base_orientation(s: Step, p: Rewards) -> Array:
    """Horizontal part of gravity in the trunk's frame: sine of the tilt."""
    return np.linalg.norm(s.gravity[:, :2], axis=1)


def foot_slip(s: Step, p: Rewards) -> Array:
    """Speed of the feet that are on the ground, summed [m/s]."""
    return (s.contact * s.foot_speed_m_s).sum(axis=1)


def joint_position(s: Step, p: Rewards) -> Array:
    """Norm of the distance from the default pose [rad], more while standing."""
    factor = np.where(s.moving(p.moving_threshold), 1.0, p.standing_factor)
    return np.linalg.norm(s.position_relative, axis=1) * factor


def hip_abduction(s: Step, p: Rewards) -> Array:
    """Norm of the hips' distance from the default pose [rad]."""
    return np.linalg.norm(s.position_relative[:, _HIPS], axis=1)


def joint_torques(s: Step, p: Rewards) -> Array:
    """Norm of the torques [N·m]."""
    return np.linalg.norm(s.torque, axis=1)


def joint_acceleration(s: Step, p: Rewards) -> Array:
    """Norm of the joint accelerations [rad/s²]."""
    return np.linalg.norm(s.acceleration, axis=1)


def joint_velocity(s: Step, p: Rewards) -> Array:
    """Norm of the joint velocities [rad/s]."""
    return np.linalg.norm(s.velocity, axis=1)


TERMS = {
    f.__name__: f
    for f in (
        base_linear_velocity, base_angular_velocity, stride_linear_velocity,
        stride_angular_velocity, progress, turn_progress, alive, unsupported, short_swing,
        short_stance, air_time, clock, gait, foot_clearance, swing_height, action_smoothness,
        action_rate, action_jerk, air_time_variance, base_motion, base_orientation, foot_slip,
        joint_position, hip_abduction, joint_torques, joint_acceleration, joint_velocity,
    )
}  # fmt: skip
"""All terms by the name of their weight."""


GUIDES = ("progress", "turn_progress", "clock", "gait")
"""Terms that lead to a first gait; a curriculum may fade them."""


def weighted(
    step: Step, rewards: Rewards, penalties: float = 1.0, guides: float = 1.0
) -> dict[str, Array]:
    """Every term that counts, times its weight.

    Parameters
    ----------
    step : Step
    rewards : Rewards
    penalties, guides : float
        Factors on negative weights and on those of `GUIDES`, for a curriculum.

    Returns
    -------
    dict of str to ndarray, shape (n,)
    """
    found = {}
    for name, term in TERMS.items():
        weight = getattr(rewards, name)
        factor = penalties if weight < 0 else guides if name in GUIDES else 1.0
        if weight:
            found[name] = weight * factor * term(step, rewards)
    return found


def narrowed(rewards: Rewards, linear: float, angular: float) -> Rewards:
    """The same with the widths of the tracking terms times a factor."""
    if linear == angular == 1.0:
        return rewards
    return replace(
        rewards,
        linear_sigma=linear * rewards.linear_sigma,
        stride_linear_sigma=linear * rewards.stride_linear_sigma,
        angular_sigma=angular * rewards.angular_sigma,
        stride_angular_sigma=angular * rewards.stride_angular_sigma,
    )


def _tracking(error: Array, sigma: float, p: Rewards) -> Array:
    if p.tracking_shape == "gaussian":
        return np.exp(-((error / sigma) ** 2))
    return np.exp(-error / sigma)
