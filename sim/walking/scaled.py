"""The walking task of a robot of another size, by Froude scaling.

Where g is the same, times and speeds of like motions grow with the root of the length, turn rates
fall with it, torques grow with weight times length. So lengths, speeds and rates of a task, found
on the Mini Pupper, are multiplied by the scale of `Body`, weights of rewards that have a unit
divided by it. What the robot's YAML gives stays as it is.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pupper_sysid.sim.robot.body import Body
from pupper_sysid.sim.robot.mini_pupper import MASS_KG
from pupper_sysid.sim.walking.config import Commands, Walking
from pupper_sysid.sim.walking.rewards.weights import Rewards

_LENGTHS = (
    "foot_paths_sigma", "clock_height", "clearance_height", "clearance_sigma", "least_clearance",
)  # fmt: skip
_SPEEDS = (
    "linear_sigma", "stride_linear_sigma", "fast_above", "gait_threshold", "moving_threshold",
)  # fmt: skip
_RATES = ("angular_sigma", "stride_angular_sigma", "clock_hz", "clock_pull_hz")
_TIMES = ("shortest_swing", "shortest_stance", "air_time_most", "gait_most")
_PER_SPEED = ("bounce", "foot_slip", "mechanical_power", "clearance_speed")


def for_robot(task: Walking, robot: str | Path, robot_config: str | Path | None) -> Walking:
    """A task of the Mini Pupper, for the robot in a MJCF and its YAML."""
    task = replace(
        task, robot=str(Path(robot).resolve()),
        robot_config=str(Path(robot_config).resolve()) if robot_config else "",
    )  # fmt: skip
    body = task.body
    length, mass = body.scale, body.mass_kg / MASS_KG
    speed, rate = float(body.command_scale[0]), float(body.command_scale[2])
    random, differ = task.randomisation, task.differences

    def times(values: tuple[float, ...], factor: float) -> tuple:
        return tuple(factor * v for v in values)

    return replace(
        task, commands=_commands(task.commands, body), rewards=_rewards(task.rewards, body),
        randomisation=replace(
            random, payload_kg=times(random.payload_kg, mass), push_m_s=speed * random.push_m_s,
            base_velocity_m_s=times(random.base_velocity_m_s, speed),
            base_rate_rad_s=times(random.base_rate_rad_s, rate),
            joint_rad_s=rate * random.joint_rad_s, on_the_move=0.0,
        ),
        trot=replace(
            task.trot, frequency_hz=rate * task.trot.frequency_hz, lift_m=length * task.trot.lift_m,
            crouch_m=0.0, spread_m=0.0, gain=1.0, back_gain=1.0, side_gain=1.0, turn_gain=1.0,
            turn_dead_band_rad_s=0.0,
        ),
        differences=replace(differ, centre_of_mass_m=times(differ.centre_of_mass_m, length)),
    )  # fmt: skip


def _commands(own: Commands, body: Body) -> Commands:
    found = {}
    for name, size in zip(
        ("forward_m_s", "sideways_m_s", "yaw_rad_s"), body.command_scale.tolist(), strict=True
    ):
        low, high = getattr(own, name)
        found[name] = body.commands.get(name, (size * low, size * high))
    speed, _, rate = body.command_scale.tolist()
    return replace(own, dead_band=(speed * own.dead_band[0], rate * own.dead_band[1]), **found)


def _rewards(own: Rewards, body: Body) -> Rewards:
    length, speed, _, rate = body.scale, *body.command_scale.tolist()
    time, torque = speed, body.mass_kg / MASS_KG * length
    factors = (
        dict.fromkeys(_LENGTHS, length) | dict.fromkeys(_SPEEDS, speed)
        | dict.fromkeys(_RATES, rate) | dict.fromkeys(_TIMES, time)
        | dict.fromkeys(_PER_SPEED, 1.0 / speed)
        | {
            # the default pose is the robot's own
            "crouch": 0.0, "spread": 0.0, "stance": 1.0 / length, "gait_sigma": time**2,
            "swing_height": 1.0 / (length**2 * speed), "joint_torques": 1.0 / torque,
            "joint_acceleration": time**2, "joint_velocity": time, "air_time": rate,
        }
    )  # fmt: skip
    return replace(own, **{name: getattr(own, name) * f for name, f in factors.items()})
