"""Joint maps: begun from a robot's model, or measured on a limp robot that is moved by hand."""

from __future__ import annotations

import json
import time
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Group
from rich.live import Live
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import JOINTS_FILE, joints_on, say_remarks
from pupper_sysid.cli.terminal import Json, Keyboard, Replace
from pupper_sysid.common.errors import BusError, InputError
from pupper_sysid.common.files import refuse_overwrite, write_text
from pupper_sysid.common.reading.dialect import whole_number
from pupper_sysid.hardware import joint_calibration as jc
from pupper_sysid.hardware.address import EMULATED, bus_name, parse_address
from pupper_sysid.hardware.bus import ServoBus
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.safety.guard import open_bus
from pupper_sysid.sim.robot.robot_map import FAMILIES, joint_map_of, joint_map_of_servos

_PERIOD_S = 0.02
_MEAN_OVER_S = 0.5
_DRAW_EVERY_S = 0.1
_TORQUE_OFF_TRIES = 5


@dataclass(frozen=True)
class CalibrateJoints:
    """Measure each servo's middle, its range, and the scale of its counts.

    The robot goes limp and you move it by hand; nothing moves by itself, and the servos stay limp
    at the end. Example: pupper-sysid calibrate-joints --bus feetech:/dev/ttyUSB0
    """

    bus: str
    """esp32 (on the robot), feetech:DEVICE or dynamixel:DEVICE."""
    joint_map: str | None = None
    """Joint map to start from, a file or a preset: its ids, signs and limits_rad are kept. By
    default the preset that fits the bus."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all; the others keep the
    values of the starting map."""
    out: Path = Path("joints.yaml")
    """File to write; the other commands use joints.yaml by default."""
    scale_joint: str | None = None
    """Joint on which counts per radian are checked; by default the first."""
    scale_deg: float = 90.0
    """Angle that it is moved through for that [degrees]."""
    lerobot_calibration: Path | None = None
    """Also write LeRobot's calibration (.json), with the homing offsets that the servos have."""
    force: Replace = False

    def run(self) -> None:
        """Guide through the steps and write the map."""
        refuse_overwrite(self.out, self.force)
        if self.lerobot_calibration:
            refuse_overwrite(self.lerobot_calibration, self.force)
        if self.out.suffix not in (".yaml", ".yml"):
            raise InputError(f"--out {self.out}: a joint map is a .yaml file.")
        if not 5 <= self.scale_deg <= 300:
            raise InputError(
                f"--scale-deg {self.scale_deg:g}: give the angle in degrees, 5 to 300; the larger "
                "it is, the better."
            )
        if bus_name(self.bus) == EMULATED:
            raise InputError(
                "--bus emulated: it cannot be moved by hand. Start `pupper-sysid emulate feetech "
                "--by-hand` in another terminal and use the bus that it names."
            )
        address = parse_address(self.bus)
        start_map = load_joint_map(self.joint_map) if self.joint_map else None
        names = joints_on(self.bus, start_map, self.joints)
        if self.scale_joint and self.scale_joint not in names:
            raise InputError(
                f"--scale-joint {self.scale_joint}: it is not among the joints that are "
                f"calibrated ({', '.join(names)})."
            )
        chosen = None if self.joints == "all" else names
        with closing(
            open_bus(address, start_map.per_servo() if start_map else None, chosen)
        ) as bus:
            say_remarks(bus)
            start = start_map or load_joint_map(bus.metadata["joint_map"])
            # a line need not have all servos
            present = [n for n in names if n in bus.joint_names]
            silent = [n for n in names if n not in present]
            if silent:
                terminal.warn(f"{', '.join(silent)}: no answer; their part of the map is kept.")
            if self.scale_joint in silent:
                raise BusError(f"--scale-joint {self.scale_joint}: it does not answer.")
            self._calibrate(Guide(bus, start, present, Keyboard()), self.scale_joint or present[0])

    def _calibrate(self, guide: Guide, scale_joint: str) -> None:
        guide.go_limp()
        offsets = guide.offsets()
        limits = guide.limits()
        scale, use_it = guide.scale(scale_joint, self.scale_deg)
        measured = jc.Measured(offsets, limits, scale_joint, scale, use_it)
        new = jc.calibrated(guide.start.file, measured, time.strftime("%Y-%m-%d"))
        terminal.warn(*jc.doubts(new, offsets))
        guide.stay_limp()
        new.save(self.out, self.force)
        if self.lerobot_calibration:
            setups = getattr(guide.bus, "servo_setups", dict)()
            offsets_there = {
                name: setup.get("registers", {}).get("homing_offset", 0)
                for name, setup in setups.items()
            }
            lerobot = json.dumps(jc.lerobot_calibration(new, offsets_there), indent=4)
            write_text(self.lerobot_calibration, f"{lerobot}\n", self.force)
        entries = {name: new.file.joints[name] for name in offsets}
        terminal.print_table(
            f"{self.out}: {new.file.name}", "joint", "id", "offset", "limits", "counts/rad",
            rows=(
                (
                    name, e.id, f"{e.offset_counts:+d}",
                    "{}–{}".format(*e.limits_counts) + ("" if name in limits else " kept"),
                    terminal.number(e.counts_per_rad, 2),
                )
                for name, e in entries.items()
            ),
        )  # fmt: skip
        where = ("--bus", self.bus, "--joint-map", self.out)
        sweep = ("sweep", "--freqs", "1-10", "--joints", next(iter(offsets)), *where)
        terminal.out.print(
            f"Wrote {self.out}. The servos are limp.\nNext:\n"
            f"  {terminal.command('pupper-sysid', 'monitor', *where)}\n"
            f"  {terminal.command('pupper-sysid', *sweep)}"
        )


class Guide:
    """The steps of a calibration, one method each.

    The bus is only read, and its torque switched off; `joints` are those to calibrate, from the map
    `start`.
    """

    def __init__(self, bus: ServoBus, start: JointMap, joints: list[str], keyboard: Keyboard):
        self.bus, self.start, self._keyboard = bus, start, keyboard
        self.joints = tuple(joints)
        self._index = [bus.joint_names.index(name) for name in joints]
        self._counts = start.file.counts

    def go_limp(self) -> None:
        """Switch the torque off after a confirmation."""
        if self.start.frame == "proxy":
            terminal.err.print(
                "Counts here are the proxy's: the firmware has added its own stored calibration, "
                "and the offsets measured now are added on top of it."
            )
        self._keyboard.ask(
            "The robot will go limp. Lay it on its stand, hold what could fall, then press Enter."
        )
        self.stay_limp()
        terminal.err.print("All servos are limp; move them by hand, gently.")

    def stay_limp(self) -> None:
        """Switch the torque off, in several tries."""
        for _ in range(_TORQUE_OFF_TRIES):
            if self.bus.torque(False):
                return
        raise BusError(
            "not every servo confirmed that its torque is off, so nothing was written. Check the "
            "cable and the power, and do not force a joint that holds."
        )

    def offsets(self) -> dict[str, int]:
        """Step 1: the middle pose; offset of each joint."""
        pose = jc.middle_pose_in_words(self.start.file, self.joints)
        terminal.err.print(Text.assemble(("\nStep 1 of 3: the middle pose.\n", "bold"), pose))
        while True:
            self._keyboard.ask("Hold it still and press Enter.")
            mean, strayed = self._mean()
            moved = [
                f"{name} by {by:.0f}"
                for name, by in zip(self.joints, strayed, strict=True)
                if by > jc.STILL * self._counts
            ]
            if not moved or self._keep(
                f"Moved while being measured, in counts: {_list(moved)}. "
                "Enter to measure again, k to keep this"
            ):
                break
        return {
            name: round(float(count) - self._counts / 2)
            for name, count in zip(self.joints, mean, strict=True)
        }

    def limits(self) -> dict[str, tuple[int, int]]:
        """Step 2: the whole range; limits of the joints moved through it."""
        terminal.err.print(Text("\nStep 2 of 3: the whole range.", "bold"))
        travel = jc.Travel(len(self.joints), self._counts)
        while True:
            terminal.err.print(
                "Move every joint slowly to both of its ends, without force. Enter when all are "
                "done."
            )
            self._follow(travel)
            refused = travel.refusals(self.joints)
            if not refused:
                break
            for name, why in refused.items():
                terminal.err.print(Text.assemble((name, "yellow"), f" {why}."))
            if self._keep(
                "Enter to go on moving, k to keep the starting map's limits for "
                f"{'it' if len(refused) == 1 else 'these'}"
            ):
                break
            for name in refused:
                travel.forget(self.joints.index(name))
        cut = [n for n in travel.cut_off(self.joints) if n not in refused]
        if cut:
            terminal.warn(
                f"{_list(cut)}: the travel runs into the end of the encoder; an end is not seen."
            )
        return {name: travel.limits(k) for k, name in enumerate(self.joints) if name not in refused}

    def scale(self, joint: str, angle_deg: float) -> tuple[float | None, bool]:
        """Step 3: the measured scale (None if skipped), and whether to use it."""
        stated = self.start.file.joints[joint].counts_per_rad
        terminal.err.print(
            Text.assemble(
                ("\nStep 3 of 3: the scale.\n", "bold"),
                f"{joint} will be moved by {angle_deg:g} degrees, in one direction. Measure the "
                "angle at the horn, for example with a set square.",
            )
        )
        which = self.joints.index(joint)
        while True:
            first = f"Hold {joint} at the first position and press Enter, or s to skip this step"
            if self._choice(first, ("", "s")) == "s":
                return None, False
            before = self._mean()[0][which]
            self._keyboard.ask(
                f"Now move {joint} by {angle_deg:g} degrees, hold it and press Enter."
            )
            after = self._mean()[0][which]
            measured = float(abs(after - before) / np.radians(angle_deg))
            words = f"{abs(after - before):.0f} counts: {measured:.1f} counts per radian"
            if abs(after - before) < jc.SMALLEST_TRAVEL * self._counts:
                terminal.err.print(f"{words}. That is too little motion; try again.")
                continue
            if jc.scales_agree(measured, stated):
                terminal.err.print(
                    f"{words}, within {100 * jc.SCALE_AGREES:.0f} % of the map's {stated:.1f}, "
                    "which is kept."
                )
                return measured, False
            known = jc.known_scale_near(measured, self._counts)
            terminal.err.print(
                f"{words}; the starting map has {stated:.1f} "
                f"({100 * (measured / stated - 1):+.0f} %)."
                + (f" It agrees with {known}." if known else "")
            )
            if not jc.is_plausible_scale(measured, self._counts):
                range_deg = np.degrees(self._counts / measured)
                terminal.err.print(
                    f"The whole range would be {range_deg:.0f} degrees, which no such servo has, "
                    "so this scale is not offered. Check the joint and the angle."
                )
                continue
            answer = self._choice(
                "For all joints, use n the new scale, or m the map's; r to repeat", ("n", "m", "r")
            )
            if answer != "r":
                return measured, answer == "n"

    def _follow(self, travel: jc.Travel) -> None:
        """Add readings to `travel`, and show it, until Enter."""
        live = Live(console=terminal.err, auto_refresh=False) if terminal.err.is_terminal else None
        drawn_s, tick = -np.inf, self.bus.now()
        with self._keyboard.unseen(), live or nullcontext():
            while self._keyboard.line() is None:
                travel.add(self.bus.read().position_count[self._index])
                if live and self.bus.now() - drawn_s > _DRAW_EVERY_S:
                    drawn_s = self.bus.now()
                    live.update(self._table(travel), refresh=True)
                tick = max(tick + _PERIOD_S, self.bus.now())
                self.bus.sleep_until(tick)
            if live:
                live.update(self._table(travel), refresh=True)
        if not live:
            terminal.err.print(self._table(travel))

    def _table(self, travel: jc.Travel) -> Group:
        table = terminal.table("", "joint", "min", "now", "max", "travel", "°", "")
        refused = travel.refusals(self.joints)
        for k, name in enumerate(self.joints):
            low, now, high = (int(x[k]) for x in (travel.low, travel.now, travel.high))
            degrees = np.degrees((high - low) / self.start.file.joints[name].counts_per_rad)
            state = "wraps" if travel.wrapped[k] else "move it" if name in refused else "ok"
            state = "silent" if travel.silent[k] else state
            cells = ["–" if x < 0 else str(x) for x in (low, now, high, high - low)]
            table.add_row(name, *cells, f"{degrees:.0f}", state)
        return Group(table, Text("Enter when every joint has been at both ends.", style="bold"))

    def _mean(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean counts over half a second, and their motion meanwhile."""
        readings = []
        until = self.bus.now() + _MEAN_OVER_S
        while self.bus.now() < until:
            readings.append(self.bus.read().position_count[self._index])
            self.bus.sleep_until(self.bus.now() + _PERIOD_S)
        mean, strayed = jc.mean_counts(np.array(readings))
        silent = [n for n, c in zip(self.joints, mean, strict=True) if np.isnan(c)]
        if silent:
            raise BusError(
                f"{', '.join(silent)} did not answer for {_MEAN_OVER_S} s, so nothing was "
                "written. Check the cable and the power; the servos are limp."
            )
        return mean, strayed

    def _keep(self, question: str) -> bool:
        return self._choice(question, ("", "k")) == "k"

    def _choice(self, question: str, choices: tuple[str, ...]) -> str:
        while (answer := self._keyboard.ask(question + ".")) not in choices:
            known = ", ".join(key or "Enter" for key in choices)
            terminal.err.print(f"'{answer}' is none of {known}.")
        return answer


def _list(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


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
    json: Json = False

    def run(self) -> None:
        """Read the model, write the map, print the next commands."""
        lerobot = jc.read_lerobot(self.lerobot_calibration) if self.lerobot_calibration else None
        if self.model is not None and self.joints is None:
            robot = joint_map_of(self.model, self.servo, lerobot)
            usual = Path(f"{self.model.stem}.joints.yaml")
        elif self.model is None and self.joints is not None and lerobot is None:
            ids: dict[str, int] = {}
            for part in self.joints.split(","):
                name, equals, number = (piece.strip() for piece in part.strip().partition("="))
                if not (name and equals and number.isascii() and number.isdecimal()):
                    raise InputError(
                        f"--joints: '{part.strip()}' is not NAME=ID; write pan=1,tilt=2. "
                        "`pupper-sysid scan` lists the ids."
                    )
                if name in ids:
                    raise InputError(f"--joints: {name} is there twice.")
                ids[name] = whole_number(number)
            robot, usual = joint_map_of_servos(ids, self.servo), JOINTS_FILE
        else:
            raise InputError(
                "init-robot needs the robot's MJCF or URDF; or, without one, --joints with the "
                "servos' ids, such as pan=1,tilt=2 (--lerobot-calibration goes with a model)."
            )
        joint_map, left_out, target = robot.joint_map, robot.left_out, self.out or usual
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
            return terminal.print_json({
                "joint_map": target, "joints": joint_map.joint_names, "ids": joint_map.ids,
                "left_out": left_out, "following": robot.following, "doubts": robot.doubts,
                "margin_rad": margins, "sweeps": sweeps,
            })  # fmt: skip
        entries = {name: joint_map.file.joints[name] for name in margins}
        terminal.print_table(
            f"{target}, servos {self.servo}",
            "joint", "id", "centre rad", "limits rad", "margin rad",
            rows=(
                (name, e.id, f"{e.neutral_rad:.2f}", "{:.2f} … {:.2f}".format(*e.limits_rad),
                 f"{margins[name]:.2f}")
                for name, e in entries.items()
            ),
        )  # fmt: skip
        bus = f"{FAMILIES[self.servo.lower()].name}:/dev/ttyUSB0"
        quoted = terminal.command(target)
        if lerobot is None:
            origin = "Ids, signs and centres are guesses."
            measure = (
                "Then measure centres, ranges and scale:\n"
                f"  pupper-sysid calibrate-joints --joint-map {quoted} --out {quoted} --force "
                f"--bus {bus}\n"
            )
        else:
            origin = (
                "Ids, directions and ranges are those of LeRobot's calibration; a joint's zero is "
                "the pose in which LeRobot homed it."
            )
            measure = ""
        terminal.out.print(
            f"{origin} Ids and signs are for you to check: with the servos limp, move one joint "
            "after the other by hand to its positive side and watch\n"
            f"  pupper-sysid monitor --joint-map {quoted} --bus {bus}\n"
            f"If another row changes, correct the id in {target}; if the angle falls, the sign.\n"
            f"{measure}Sweep, first without the robot, then with --bus {bus}:\n"
            + "".join(f"  {line}\n" for line in sweeps)
            + "Then doctor, delay, calibrate, fit-servo and export, as for any recording."
        )
