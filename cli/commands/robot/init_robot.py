"""`init-robot`: a joint map and a plan to sweep another robot, from its model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import JOINTS_FILE
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import whole_number

_AMPLITUDE_RAD, _SMALLEST_RAD = 0.3, 0.05


@dataclass(frozen=True)
class InitRobot:
    """Make a joint map of another robot with hobby servos, and plan its sweeps.

    Example: pupper-sysid init-robot my_robot.xml --servo sts3215

    Example: pupper-sysid init-robot --servo xl330-m288 --joints pan=1,tilt=2
    """

    model: tyro.conf.Positional[Path | None] = None
    """The robot's MJCF or URDF."""
    joints: str | None = None
    """Instead of a model file, names of joints and their servos' ids: pan=1,tilt=2."""
    servo: str = "sts3215"
    """Which servos it has: sts3215, scs0009, hd-1910, xl330-m288, xm430-w350, mx-28 or another name
    that scan prints; sts, hls or scs for Feetech servos that it only numbers."""
    lerobot_calibration: Path | None = None
    """LeRobot's calibration of this arm (.json): its ids, directions, homing offsets and ranges are
    taken instead of guesses."""
    out: Path | None = None
    """Joint map to write; by default the model's name and .joints.yaml, in this folder; without a
    model joints.yaml, which the other commands use by default."""
    force: bool = False
    """Replace the file if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Read the model, write the map, print the next commands."""
        from pupper_sysid.hardware.joint_calibration import read_lerobot
        from pupper_sysid.sim.robot.robot_map import FAMILIES, joint_map_of, joint_map_of_servos

        lerobot = read_lerobot(self.lerobot_calibration) if self.lerobot_calibration else None
        if self.model is not None and self.joints is None:
            robot = joint_map_of(self.model, self.servo, lerobot)
            usual = Path(f"{self.model.stem}.joints.yaml")
        elif self.model is None and self.joints is not None and lerobot is None:
            robot, usual = joint_map_of_servos(_parse_ids(self.joints), self.servo), JOINTS_FILE
        else:
            raise InputError(
                "init-robot needs the robot's MJCF or URDF; or, without one, --joints with the "
                "servos' ids, such as pan=1,tilt=2 (--lerobot-calibration goes with a model)."
            )
        joint_map, left_out = robot.joint_map, robot.left_out
        target = self.out or usual
        joint_map.save(target, self.force)
        servos = joint_map.per_servo()
        margin = servos.position_limits().margin(servos.rest_pose())
        margins = dict(zip(joint_map.joint_names, margin, strict=True))
        joints: dict[float, list[str]] = {}  # by amplitudes that leave a fifth of their margin
        for name, free in margins.items():
            amplitude = max(min(_AMPLITUDE_RAD, np.floor(80 * free) / 100), _SMALLEST_RAD)
            joints.setdefault(float(amplitude), []).append(name)
        sweeps = [
            terminal.command(
                "pupper-sysid", "sweep", "--joint-map", target, "--joints", ",".join(names),
                "--freqs", "1-6", "--amplitude", f"{amplitude:g}",
            )
            for amplitude, names in sorted(joints.items(), reverse=True)
        ]  # fmt: skip
        if left_out:
            terminal.warn(
                f"no actuator of {self.model} drives these, left out: {', '.join(left_out)}."
                " If they have servos, give them actuators there, or take all actuators out."
            )
        terminal.warn(*robot.doubts)
        if robot.following:
            pairs = ", ".join(f"{name} (follows {of})" for name, of in robot.following.items())
            terminal.warn(f"no servo of their own, left out: {pairs}.")
        narrow = [name for name, free in margins.items() if free < _SMALLEST_RAD]
        if narrow:
            terminal.warn(
                f"{', '.join(narrow)}: less than {_SMALLEST_RAD:g} rad of margin, too little "
                f"for a sweep. Are the limits in {self.model} in another unit? MJCF counts in "
                'degrees, unless it says <compiler angle="radian"/>; URDF in radians.'
            )
        if self.json:
            terminal.print_json(
                {
                    "joint_map": target, "joints": joint_map.joint_names, "ids": joint_map.ids,
                    "left_out": left_out, "following": robot.following, "doubts": robot.doubts,
                    "margin_rad": margins,
                    "sweeps": sweeps,
                }
            )  # fmt: skip
            return
        headings = ("joint", "id", "centre rad", "limits rad", "margin rad")
        table = terminal.table(f"{target}, servos {self.servo}", *headings)
        for name, free in margins.items():
            entry = joint_map.file.joints[name]
            low, high = entry.limits_rad
            table.add_row(
                name, str(entry.id), f"{entry.neutral_rad:.2f}", f"{low:.2f} … {high:.2f}",
                f"{free:.2f}",
            )  # fmt: skip
        terminal.out.print(table)
        bus = f"{FAMILIES[self.servo.lower()].name}:/dev/ttyUSB0"
        quoted = terminal.command(target)
        terminal.out.print(
            "Ids, signs and centres are guesses. Ids and signs are for you to check: with the "
            "servos limp, move one joint after the other by hand to its positive side and watch\n"
            f"  pupper-sysid monitor --joint-map {quoted} --bus {bus}\n"
            f"If another row changes, correct the id in {target}; if the angle falls, the sign.\n"
            "Then measure centres, ranges and scale:\n"
            f"  pupper-sysid calibrate-joints --joint-map {quoted} --out {quoted} --force "
            f"--bus {bus}\n"
            f"Sweep, first without the robot, then with --bus {bus}:\n"
            + "".join(f"  {line}\n" for line in sweeps)
            + "Then doctor, delay, calibrate, fit-servo and export, as for any recording."
        )


def _parse_ids(text: str) -> dict[str, int]:
    """Servo id of each joint: pan=1,tilt=2."""
    ids: dict[str, int] = {}
    for part in (piece.strip() for piece in text.split(",")):
        name, equals, number = (piece.strip() for piece in part.partition("="))
        if not (name and equals and number.isascii() and number.isdecimal()):
            raise InputError(
                f"--joints: '{part}' is not NAME=ID; write pan=1,tilt=2. `pupper-sysid scan` lists "
                "the ids."
            )
        if name in ids:
            raise InputError(f"--joints: {name} is there twice.")
        ids[name] = whole_number(number)
    return ids
