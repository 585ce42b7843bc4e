"""`emulate`: an emulated robot behind the real protocols, whose limp joints keys move by hand."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import termios
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import yaml

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import parse_servo_registers
from pupper_sysid.cli.terminal import terminal_without
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import write_text
from pupper_sysid.common.reading.dialect import whole_number
from pupper_sysid.hardware.address import SOCKET
from pupper_sysid.hardware.feetech import BAUD_RATES, FAMILY, STS3215
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from, load_joint_map
from pupper_sysid.hardware.lock import announced
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.serial_servos.series import Family, Series
from pupper_sysid.sim.emulator import pendulum
from pupper_sysid.sim.emulator.bench import BusFaults, ServoBench
from pupper_sysid.sim.emulator.esp32 import ImuProxy, ProxyEmulator, ProxySocket
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.robot import EmulatedRobot, RobotSpec, draw_robot
from pupper_sysid.sim.emulator.serial_line import LineEmulator, SerialPty
from pupper_sysid.sysid.sweep.bench import parse_load

_MOST_BACKLASH_DEG = 20.0
_KEYS = (
    "Keys move limp joints, in this window: a and d by 0.05 rad, A and D by 0.4 rad, 0 back to "
    "where they went limp; n chooses the next joint (all at first)."
)
_STEPS_RAD = {"a": -0.05, "d": 0.05, "A": -0.4, "D": 0.4}


@dataclass(frozen=True)
class Common:
    """Options of both emulators."""

    seed: int = 0
    """Seed of the robot: its servos, its lost polls, its noise."""
    faults: str = ""
    """Faults to inject, as kind=probability per answer: lost=0.02,late=0.01,corrupted=0.01. Kinds:
    lost, late, truncated, corrupted, duplicated, foreign, wrong-length, error-bits, frozen, reboot,
    brown-out, unplugged, second-writer."""
    walking: bool = False
    """The robot stands on the ground and walks where its servos carry it; otherwise its legs hang
    in free air."""
    by_hand: bool = False
    """Keys in this window move joints while they are limp, to rehearse calibrate-joints."""
    truth: Path | None = None
    """Write the true parameters of the robot to this YAML file."""
    force: bool = False
    """Replace the file of --truth."""


@dataclass(frozen=True)
class Esp32(Common):
    """The Mini Pupper 2's proxy: a socket, with the real one's quirks, in real time.

    Example: pupper-sysid emulate esp32 --socket /tmp/pupper.socket
    """

    socket: Path = SOCKET
    """Where to listen."""

    def run(self) -> None:
        """Serve until Ctrl-C."""
        rng = np.random.default_rng(self.seed)
        bench = _bench(self, draw_robot(rng), load_joint_map("mini_pupper_2"), rng)
        emulator = ProxyEmulator(bench, rng, BusFaults.parse(self.faults, rng))
        with closing(ProxySocket(emulator, self.socket)) as server:
            name = "esp32" if self.socket == SOCKET else f"esp32:{self.socket}"
            what = "Emulated Mini Pupper 2" + (", standing," if self.walking else "")
            what += f" at {self.socket}."
            _serve(self, server, bench, what, _commands(self, name))


@dataclass(frozen=True)
class SerialLine(Common):
    """Options of the serial lines."""

    load: str | None = None
    """A bench instead of a robot: one servo that swings a pendulum, such as pendulum:0.1kg@0.10m,
    or bare (none)."""
    registers: str = ""
    """Registers that differ from the factory's, of all servos or of one id: p=16,5:mode=1. The
    servos act on them; Feetech's gains, ramps and torque limits only STS3215 that do not walk."""
    joint_map: str | None = None
    """Joint map of another robot, such as `init-robot` writes; its joints are in free air."""
    ids: str = "all"
    """Which of them are there: 1-12, 4,5,6, or all."""
    baud: int | None = None
    """Their baud rate; default 1000000 (SCS0009: 500000)."""
    link: Path | None = None
    """A stable name for the device; survives being unplugged."""
    echo: bool = False
    """The adapter sends the host's own bytes back."""
    double_id: int | None = None
    """Two servos have this id, and destroy each other's answers."""
    supply: float | None = None
    """Supply of the servos [V]; by default what they are made for."""
    adapter_ms: float = 0.0
    """Latency timer of the USB adapter [ms]: 16 for an FTDI as its driver sets it."""

    def refuse_outside(self, rates: tuple[int, ...]) -> None:
        """Refuse numbers that cannot be."""
        refuse_outside("--adapter-ms", self.adapter_ms, 0, 100, "ms")
        refuse_outside("--supply", self.supply, 0, 25, "V")
        if self.baud is not None and self.baud not in rates:
            raise InputError(f"--baud {self.baud}: choose {', '.join(map(str, rates))}.")

    def on_bench(
        self, rng: np.random.Generator, spec: pendulum.BenchSpec, layout: JointMap
    ) -> ServoBench:
        """Servos whose registers act on the motion, in free air or with the load."""
        load = parse_load(self.load) if self.load else None
        robot = pendulum.draw_bench(
            rng, pendulum.Pendulum(**(load.model_dump() if load else {})), spec, layout
        )
        plant = pendulum.PendulumBench(robot)
        bench = ServoBench(robot, layout, rng.spawn(1)[0], keep_log=False, plant=plant)
        bench.supply_v = spec.supply_v
        return bench

    def line(
        self, emulator_class: type[LineEmulator], series: Series, bench: ServoBench,
        rng: np.random.Generator, usual_baud: int,
    ) -> LineEmulator:  # fmt: skip
        """The servos of a bench on a line, with the faults that were chosen."""
        if self.supply is not None:
            bench.supply_v = self.supply
        return emulator_class(
            bench, series, rng, _parse_ids(self.ids, bench.map.ids),
            usual_baud if self.baud is None else self.baud,
            BusFaults.parse(self.faults, rng), self.echo,
            parse_servo_registers(self.registers, series),
            () if self.double_id is None else (self.double_id,),
        )  # fmt: skip

    def place(self) -> Path:
        """Name of the device."""
        return self.link or Path(tempfile.mkdtemp()) / "servos"


@dataclass(frozen=True)
class Feetech(SerialLine):
    """A line of Feetech servos: a serial device, in real time, at the pace of its baud rate.

    Example: pupper-sysid emulate feetech --model sts3215 --ids 1-12
    """

    model: str | None = None
    """Which servos: sts3215, scs0009, or any that init-robot knows with the joint map of it; by
    default those of the joint map, or sts3215."""
    backlash: float = 0.0
    """With --load: play of its gears [degrees]."""
    imu_socket: Path | None = None
    """Serve the robot's IMU here, as the Mini Pupper 2's proxy does: a serial line has none."""

    def run(self) -> None:
        """Serve until Ctrl-C."""
        rng = np.random.default_rng(self.seed)
        layout = load_joint_map(self.joint_map) if self.joint_map else None
        series = _series_of(FAMILY, self.model, layout, STS3215)
        preset = FAMILY.presets.get(series.name)
        if layout is None and preset is None:
            raise InputError(
                f"--model {self.model}: add --joint-map; `pupper-sysid init-robot --servo "
                f"{series.name.lower()} --joints pan=1,tilt=2` makes one."
            )
        if self.load:
            preset = pendulum.BENCH_MAP
            if series != STS3215 or self.walking:
                raise InputError(
                    "--load is a bench with one STS3215: leave out --model, --walking."
                )
        elif self.backlash:
            raise InputError("--backlash is of a bench: add --load (or --load none).")
        layout = layout or load_joint_map(str(preset))
        registers = parse_servo_registers(self.registers, series)
        moves = any(pendulum.FEETECH_REGISTERS.keys() & names for names in registers.values())
        loaded_servos = bool(
            self.load
            or (pendulum.has_registers(layout) and (self.joint_map or moves) and not self.walking)
        )
        if moves and not loaded_servos:
            raise InputError(
                "--registers: gains, ramps and torque limits of these servos do not act. Add "
                "--load (or --load none), or choose STS3215 that do not walk."
            )
        if self.joint_map and self.walking:
            raise InputError("--walking: only the Mini Pupper walks here; leave out --joint-map.")
        self.refuse_outside(BAUD_RATES)
        refuse_outside("--backlash", self.backlash, 0, _MOST_BACKLASH_DEG, "degrees")
        if loaded_servos:
            acting = tuple(
                (k, v) for k, v in registers[None].items() if k in pendulum.FEETECH_REGISTERS
            )
            spec = pendulum.BenchSpec(backlash_rad=math.radians(self.backlash), registers=acting)
            bench = self.on_bench(rng, spec, layout)
        else:
            # read directly, a servo answers with its present position: no polls, none lost
            spec = RobotSpec(poll_period_s=0.0, loss=0.0, quantum_rad=0.0)
            robot = draw_robot(rng, spec, layout if self.joint_map else None)
            bench = _bench(self, robot, layout, rng)
        usual_baud = 500_000 if series.big_endian else 1_000_000
        emulator = self.line(FeetechEmulator, series, bench, rng, usual_baud)
        with _imu_beside(bench, self.imu_socket, rng):
            imu = f"; IMU at {self.imu_socket}." if self.imu_socket else "."
            # without a map only a line of all its servos counts as a Mini Pupper
            part = len(emulator.servos) < len(layout.ids)
            named = self.joint_map or (preset if part and not self.load else None)
            _serve_line(self, emulator, bench, imu, named)


@dataclass(frozen=True)
class Dynamixel(SerialLine):
    """A line of Dynamixel servos (protocol 2.0): a serial device, in real time.

    Without --joint-map one servo on a bench, whose joint map is written beside the device.
    Example: pupper-sysid emulate dynamixel --model xm430-w350
    """

    model: str | None = None
    """Which servos: xl330-m288, xl430-w250, xm430-w350, xm430-w210, mx-28; by default those of the
    joint map, or xl330-m288."""

    def run(self) -> None:
        """Serve until Ctrl-C."""
        from pupper_sysid.hardware import dynamixel as table
        from pupper_sysid.sim.emulator.dynamixel import DynamixelEmulator

        if self.walking:
            raise InputError("--walking: the Mini Pupper that walks has no Dynamixel servos.")
        self.refuse_outside(table.BAUD_RATES)
        rng = np.random.default_rng(self.seed)
        place, map_path = self.place(), self.joint_map
        layout = load_joint_map(map_path) if map_path else None
        series = _series_of(table.FAMILY, self.model, layout, table.SERIES[1200])
        if map_path is None:
            map_path = f"{place}.joints.yaml"
            map_file = load_joint_map(pendulum.BENCH_MAP).file.model_dump(by_alias=True)
            name = f"one {series.name} on a bench"
            source = f"{name}: 360 degrees over 4096 counts; limits: 2.6 rad to both sides"
            map_file |= {"servo": series.name, "name": name, "source": source}
            joint_map_from(map_file, map_path).save(Path(map_path), force=True)
        layout = layout or load_joint_map(map_path)
        spec = pendulum.dynamixel_bench(series.name)
        bench = self.on_bench(rng, spec, layout)
        emulator = self.line(DynamixelEmulator, series, bench, rng, 1_000_000)
        _serve_line(replace(self, link=place), emulator, bench, ".", map_path)


def _series_of(family: Family, model: str | None, layout: JointMap | None, usual: Series) -> Series:
    """Series that is emulated: the one chosen, or that of the joint map."""
    of_map = layout.file.servo if layout else None
    known = {s.name.lower(): s for s in (*family.series.values(), *family.profiles.values())}
    name = (model or of_map or usual.name).lower()
    if name not in known or (of_map and name != of_map.lower()):
        remark = f"; the joint map is of {of_map}" if of_map else ""
        raise InputError(f"--model {name}: choose one of {', '.join(known)}{remark}.")
    return known[name]


Emulate = (
    Annotated[Esp32, tyro.conf.subcommand("esp32")]
    | Annotated[Feetech, tyro.conf.subcommand("feetech")]
    | Annotated[Dynamixel, tyro.conf.subcommand("dynamixel")]
)


def _bench(
    options: Common, robot: EmulatedRobot, layout: JointMap, rng: np.random.Generator
) -> ServoBench:
    """The servos of a robot in free air or on the ground."""
    if options.walking and options.by_hand:
        raise InputError("--by-hand swings legs in free air: leave out --walking.")
    servos, imu = rng.spawn(2)
    plant = None
    if options.walking:
        from pupper_sysid.sim.walking.robot import WalkingRobot

        plant = WalkingRobot(robot, imu)
    return ServoBench(robot, layout, servos, keep_log=False, plant=plant)


@contextmanager
def _imu_beside(bench: ServoBench, path: Path | None, rng: np.random.Generator) -> Iterator[None]:
    """Within the block, the IMU of the same robot on another socket, if there is a path."""
    if path is None:
        yield
        return
    # a proxy polls its servos, although this one does not return them
    polled = replace(bench.robot, spec=RobotSpec())
    polled_bench = ServoBench(
        polled, load_joint_map("mini_pupper_2"), rng.spawn(1)[0], keep_log=False, plant=bench.plant
    )
    with closing(ProxySocket(ImuProxy(polled_bench, rng.spawn(1)[0]), path)) as server:
        thread = threading.Thread(target=server.serve, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.stop()
            thread.join()


def _serve_line(
    options: SerialLine, emulator: LineEmulator, bench: ServoBench, also: str, map_path: str | None
) -> None:
    """Serve a line of servos until Ctrl-C."""
    with closing(SerialPty(emulator, options.place(), options.adapter_ms / 1e3)) as server:
        what = f"{len(emulator.servos)} emulated {emulator.series.name} at {server.device}, "
        what += f"{emulator.baud} baud{also}"
        bus = f"{emulator.family.name}:{server.device}"
        if not options.load:
            _serve(options, server, bench, what, _commands(options, bus, map_path))
            return
        map_option = f" --joint-map {map_path}" if map_path else ""
        kind = " --gains 8,16,32" if emulator.family.name == "feetech" else ""
        kind = kind if parse_load(options.load) else " --kind reversal"
        sweep = f"  pupper-sysid sweep --load {options.load}{kind}{map_option} --bus {bus}\n"
        _serve(options, server, bench, f"{what} Load: {options.load}.", sweep)


def _commands(options: Common, name: str, map_path: str | None = None) -> str:
    """What to type elsewhere while a robot is served at this bus."""
    which, bus = ("", f"{name} --joint-map {map_path}") if map_path else (" --joints LF", name)
    # a sweep is for legs in free air
    sweep = "" if options.walking else f"  pupper-sysid sweep --freqs 1-10{which} --bus {bus}\n"
    return f"{sweep}  pupper-sysid monitor --bus {bus}\n"


def _serve(
    options: Common, server: ProxySocket | SerialPty, bench: ServoBench, what: str, commands: str
) -> None:
    """Serve until Ctrl-C, with keys that move joints if they are wanted."""
    place = server.path if isinstance(server, ProxySocket) else server.device
    with announced(place), keys_move(bench) if options.by_hand else nullcontext():
        if options.truth:
            text = yaml.safe_dump(bench.truth(seed=options.seed), sort_keys=False)
            write_text(options.truth, text, options.force)
        terminal.out.print(what)
        terminal.out.print(f"In another terminal:\n{commands}Ctrl-C ends it.")
        with real_time_priority():  # bytes that come late would look like a slow servo
            server.serve()


def _parse_ids(text: str, known: tuple[int, ...]) -> list[int]:
    """Ids that `text` names: 1-12, 4,5,6, or all."""
    if text == "all":
        return sorted(known)
    ids = set[int]()
    for part in (piece.strip() for piece in text.split(",")):
        low, dash, high = part.partition("-")
        try:
            first, last = whole_number(low), whole_number(high if dash else low)
        except ValueError:
            raise InputError(f"--ids: '{part}' is no id. Write 1-12 or 4,5,6.") from None
        if not min(known) <= first <= last <= max(known):
            break
        ids.update(range(first, last + 1))
    else:
        if ids <= set(known):
            return sorted(ids)
    raise InputError(f"--ids {text}: the emulated robot has the ids {min(known)} to {max(known)}.")


class Hand:
    """Moves all joints of a bench, or one."""

    def __init__(self, bench: ServoBench):
        self._bench = bench
        self._names: Sequence[str] = bench.robot.joint_names
        self._chosen: int | None = None

    def press(self, key: str) -> str:
        """What to say of a key; empty if it has no meaning."""
        if key == "n":
            following = 0 if self._chosen is None else self._chosen + 1
            self._chosen = following if following < len(self._names) else None
            return f"{self._chosen_joint()}: chosen"
        if key not in _STEPS_RAD and key != "0":
            return ""
        indices = range(len(self._names)) if self._chosen is None else (self._chosen,)
        limp = [i for i in indices if not self._bench.is_on(i)]
        for i in limp:
            self._bench.move_by_hand(i, _STEPS_RAD.get(key))
        if not limp:
            return f"{self._chosen_joint()}: holds its position; only a limp joint moves by hand"
        return f"{self._chosen_joint()}: {self._bench.hand_rad[limp[0]]:+.2f} rad"

    def _chosen_joint(self) -> str:
        return "all joints" if self._chosen is None else self._names[self._chosen]


@contextmanager
def keys_move(bench: ServoBench) -> Iterator[None]:
    """Keys of the standard input move limp joints of `bench` during the block."""
    hand, fd = Hand(bench), sys.stdin.fileno()

    def listen() -> None:
        with suppress(OSError):  # the terminal is gone
            while typed := os.read(fd, 64):
                for key in typed.decode(errors="ignore"):
                    if notice := hand.press(key):
                        terminal.err.print(notice)

    raw = terminal_without(termios.ICANON | termios.ECHO, fd) if os.isatty(fd) else nullcontext()
    with raw:
        terminal.out.print(_KEYS)
        threading.Thread(target=listen, daemon=True).start()
        yield
