"""`init-robot`: a joint map and a plan to sweep another robot, from its own model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from pupper_sysid.cli import terminal

_AMPLITUDE_RAD, _SMALLEST_RAD = 0.3, 0.05


@dataclass(frozen=True)
class InitRobot:
    """Make a joint map of another robot with hobby servos, and plan its sweeps.

    Example: pupper-sysid init-robot my_robot.xml --servo sts3215
    """

    model: tyro.conf.Positional[Path]
    """The robot's MJCF or URDF."""
    servo: Literal[
        "sts3215", "scs0009", "hd-1910", "xl330-m288", "xl430-w250", "xm430-w350",
        "xm430-w210", "mx-28",
    ] = "sts3215"  # fmt: skip
    """Which servos it has."""
    lerobot_calibration: Path | None = None
    """LeRobot's calibration of this arm (.json): its ids, directions, homing offsets and ranges are
    taken instead of guesses."""
    out: Path | None = None
    """Joint map to write; by default the model's name and .joints.yaml, in this folder."""
    force: bool = False
    """Replace the file if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Read the model, write the map, print the next commands."""
        from pupper_sysid.hardware.lerobot_calibration import read_lerobot
        from pupper_sysid.sim.robot.robot_map import joint_map_of

        lerobot = read_lerobot(self.lerobot_calibration) if self.lerobot_calibration else None
        robot = joint_map_of(self.model, self.servo, lerobot)
        found, left_out = robot.joint_map, robot.left_out
        target = self.out or Path(f"{self.model.stem}.joints.yaml")
        found.save(target, self.force)
        servos = found.per_servo()
        margin = servos.position_limits().margin(servos.rest_pose())
        plan = _plan(found.joint_names, margin)
        sweeps = [
            f"pupper-sysid sweep --joint-map {target} --joints {','.join(names)} --freqs 1-6 "
            f"--amplitude {amplitude:g}"
            for amplitude, names in plan
        ]
        if left_out:
            terminal.warn(
                [
                    f"no actuator of {self.model} drives these, left out: {', '.join(left_out)}."
                    " If they have servos, give them actuators there, or take all actuators out."
                ]
            )
        terminal.warn(robot.doubts)
        if robot.following:
            pairs = ", ".join(f"{name} (follows {of})" for name, of in robot.following.items())
            terminal.warn([f"no servo of their own, left out: {pairs}."])
        narrow = [n for n, r in zip(found.joint_names, margin, strict=True) if r < _SMALLEST_RAD]
        if narrow:
            terminal.warn(
                [
                    f"{', '.join(narrow)}: less than {_SMALLEST_RAD:g} rad of margin, too little "
                    f"for a sweep. Are the limits in {self.model} in another unit? MJCF counts in "
                    'degrees, unless it says <compiler angle="radian"/>; URDF in radians.'
                ]
            )
        if self.json:
            terminal.print_json(
                {
                    "joint_map": str(target),
                    "joints": list(found.joint_names),
                    "ids": list(found.ids),
                    "left_out": left_out,
                    "following": robot.following,
                    "doubts": robot.doubts,
                    "margin_rad": dict(zip(found.joint_names, map(float, margin), strict=True)),
                    "sweeps": sweeps,
                }
            )
            return
        table = terminal.table(f"{target}", "joint", "id", "centre rad", "limits rad", "margin rad")
        for k, name in enumerate(found.joint_names):
            entry = found.file.joints[name]
            low, high = entry.limits_rad
            table.add_row(
                name, str(entry.id), f"{entry.neutral_rad:.2f}", f"{low:.2f} … {high:.2f}",
                f"{margin[k]:.2f}",
            )  # fmt: skip
        terminal.out.print(table)
        feetech = self.servo.startswith(("sts", "scs", "hd"))
        bus = f"{'feetech' if feetech else 'dynamixel'}:/dev/ttyUSB0"
        terminal.out.print(
            "Ids, signs and centres are guesses. Ids and signs are for you to check: with the "
            "servos limp, move one joint after the other by hand to its positive side and watch\n"
            f"  pupper-sysid monitor --joint-map {target} --bus {bus}\n"
            f"If another row changes, correct the id in {target}; if the angle falls, the sign.\n"
            "Then measure centres, ranges and scale:\n"
            f"  pupper-sysid calibrate-joints --joint-map {target} --out {target} --force "
            f"--bus {bus}\n"
            f"Sweep, first without the robot, then with --bus {bus}:\n"
            + "".join(f"  {line}\n" for line in sweeps)
            + "Then doctor, delay, calibrate, fit-servo and export, as for any recording.",
            soft_wrap=True,
        )


def _plan(names: tuple[str, ...], margin: np.ndarray) -> list[tuple[float, list[str]]]:
    """Amplitudes that leave a fifth of each joint's margin, and the joints of each."""
    groups: dict[float, list[str]] = {}
    for name, free in zip(names, margin, strict=True):
        amplitude = max(min(_AMPLITUDE_RAD, np.floor(80 * free) / 100), _SMALLEST_RAD)
        groups.setdefault(float(amplitude), []).append(name)
    return sorted(groups.items(), reverse=True)
