"""Weights and parameters of the walking task's reward terms, and the published sets.

`PAPER` and `RELEASE` hold the weights of the paper's text and of the training configuration its
authors released; `DEFAULT` are those of this project. A weight is per second: the sum is multiplied
by the control period, as in Isaac Lab.
"""

from __future__ import annotations

from dataclasses import dataclass, replace


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
    """`gaussian`: exp(-error²/σ²); `exponential`: exp(-error/σ), as published; `linear`:
    1 - error/σ, and -1 from 2 σ on, which pulls equally at errors of every size up to there."""
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
    foot_paths: float = 0.0
    """Feet pass under the trunk, swing back and rise as a trot's clock and the command say. A
    policy does not see the clock, which follows the feet; a teacher does."""
    foot_paths_sigma: float = 0.012
    """Its width: root of the summed squares of four feet's distances [m]."""
    stance: float = 0.0
    """Distance of the feet, all together, from `crouch` and `spread`. With it a policy begins by
    standing so: noise of actions moves feet by parts of a millimetre, from where 20 mm are far."""
    crouch: float = 0.02
    """How much lower than in the default pose the trunk is to be carried, for `stance` [m]."""
    spread: float = 0.007
    """How much farther to their sides than in the default pose feet are to be, likewise [m]."""
    clock_hz: float = 3.6
    """Steps of each foot per second by that clock."""
    clock_pull_hz: float = 0.2
    """How far from that rate it follows feet."""
    clock_duty: float = 0.72
    """Share of the time that a foot is to be down by that clock."""
    clock_height: float = 0.006
    """How far a foot is to rise by that clock, which so takes it as up [m]; lower ones count in
    proportion."""
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
    low_swing: float = 0.0
    """Feet that come down after a swing whose highest point was below `least_clearance`, by the
    share that was missing."""
    least_clearance: float = 0.008
    """For `low_swing`: about a tenth of the standing height [m]."""
    torque_saturation: float = 0.0
    """Share of the time in which servos are at their torque limit, the mean of all."""
    torque_share: float = 0.0
    """Square of torque over its limit, the mean of all servos."""
    mechanical_power: float = 0.0
    """Positive mechanical power over the robot's weight, a speed [m/s]: cost of transport times
    speed."""
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
    bounce: float = 0.0
    """Speed at which the trunk rises or falls."""
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


CLOCK = ("clock_hz", "clock_pull_hz", "clock_height")
"""Names of the parameters that decide the phase of the trot's clock."""

DEFAULT = Rewards(
    base_linear_velocity=3.0, tracking_shape="gaussian", linear_sigma=0.035,
    stride_linear_sigma=0.015, angular_sigma=0.16, stride_angular_sigma=0.06,
    low_swing=-8.0, torque_saturation=-3.0, torque_share=-3.0, mechanical_power=-1.0,
)  # fmt: skip
"""With widths of about an imitated trot's errors, where the slope of a Gaussian is largest. Each of
the last four costs a trot that clears three quarters of `least_clearance`, with servos at their
limit for a quarter of the time and a power of its weight times 1 m/s, about a tenth of what exact
tracking pays: all are relative to limits and weight, so that they hold for other servos."""

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
