"""`pupper-deploy`: run a policy on a robot, or on an emulated one, behind the same bus."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import tyro
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pupper_sysid.cli import policy_choice, terminal
from pupper_sysid.cli.buses import chosen_map
from pupper_sysid.cli.commands.sweep import Sweep
from pupper_sysid.cli.live_views import LiveViews, ViewTargets
from pupper_sysid.cli.program import end_politely, run_program
from pupper_sysid.cli.terminal import (
    err,
    need_positive,
    number,
    out,
    print_json,
    terminal_without,
    warn,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_path
from pupper_sysid.hardware.address import EMULATED, KINDS, SOCKET, bus_name, parse_address
from pupper_sysid.hardware.bus import BusSample, header_entries
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.imu import Imu
from pupper_sysid.hardware.joint_map import JointMap, load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus, open_guarded
from pupper_sysid.policies.deploy.stacks import STACKS, ObserverKind, Stack, StackName, suited

if TYPE_CHECKING:
    from pupper_sysid.policies.deploy.assembly import Assembly
    from pupper_sysid.policies.deploy.deployment import Commands, Tick
    from pupper_sysid.policies.network.policy_file import CommandRanges
    from pupper_sysid.sim.emulator.robot import EmulatedRobot
    from pupper_sysid.sim.robot.body import Body

DESCRIPTION = """Run a policy on a robot, or on an emulated one, behind the same bus.

The robot stands up, rests for a second, walks, and sits down; Ctrl-C ends the walk, a fault leaves
it limp. walks/<name>/walk.csv holds every input and output, and --replay repeats it bit for bit;
walks/<name>/recording.csv is a recording for `pupper-sysid fit-servo`.

Example: pupper-deploy runs/<name> --command 0.15 0 0 --seconds 20
"""

_SHOWN = {
    "stop_reason": "ended because",
    "fell": "fell",
    "mae_vx_m_s": "mean absolute error forward, m/s",
    "mae_vy_m_s": "the same sideways, m/s",
    "mae_yaw_rad_s": "the same in turning, rad/s",
    "mean_motion": "mean speed, m/s, m/s, rad/s",
    "rate_hz": "control loop, Hz",
    "deadline_misses": "missed deadlines",
    "step_ms": "time of a step of the policy, ms",
    "guard": "commands that the guard changed",
    "imu": "readings of the IMU",
    "log": "log",
}
"""What of the result the table shows, in words; the match of servos stands before the walk."""
PLAYBACK_LOOPS, PLAYBACK_HZ = 3, 50.0


@dataclass(frozen=True)
class Deploy:
    """A policy, a robot, and the settings between them."""

    policy: Annotated[Path | None, tyro.conf.Positional] = None
    """A run (`runs/<name>`) or a policy folder."""
    bus: str = EMULATED
    """`emulated` (no robot, as fast as it goes), `esp32`, `esp32:SOCKET`, `feetech:DEVICE` or
    `dynamixel:DEVICE`."""
    imu: Path | None = None
    """Socket of the proxy whose IMU to read, for a serial line, which has none."""
    joint_map: str | None = None
    """Joint map of the bus: a file of `calibrate-joints` or a preset."""
    stack: Literal["auto", "closed-loop", "lstm-servo", "mlp-observer"] = "auto"
    """Joint observation. `closed-loop`: the servos' readings; `lstm-servo`: a servo model's
    prediction; `mlp-observer`: that of a simulated PD; `auto`: as in the training."""
    servo: Path | None = None
    """Servo model's folder, for `lstm-servo`."""
    actuator: str | None = None
    """Calibration of this robot: an emulated one has its servos; on any, for `mlp-observer` and for
    a comparison with the policy's training before the start. By default that of the training, and
    for an emulated robot servos drawn from published measurements."""
    observer: ObserverKind | None = None
    """Instead of the stack's."""
    lowpass_hz: float | None = None
    """Instead of the stack's; 0 for none."""
    fade_in_s: float | None = None
    """Instead of the stack's."""
    scale_rad: float | None = None
    """Radians per unit of action, instead of the trained scale."""
    rate: float | None = None
    """Hz of the loop, instead of the policy's own; its time then runs faster or slower."""
    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]. Commands, also of --script and
    --keyboard, are clipped to what the policy was trained for."""
    script: Path | None = None
    """CSV of commands with the columns seconds,forward_m_s,left_m_s,turn_rad_s, one after the
    other, instead of --command."""
    keyboard: bool = False
    """Drive: w/s forward, a/d sideways, q/e turn, space stands, x ends."""
    seconds: float = 20.0
    """Duration of the walk."""
    live: bool = False
    """Show commands and readings of each joint in the terminal; an emulated robot walks in real
    time then."""
    rerun: str | None = None
    """Show all joints and the robot in Rerun as it walks: a .rrd file to write, `viewer` (of this
    machine), or a viewer's address, rerun+http://HOST:9876/proxy."""
    mcap: Path | None = None
    """Write all joints in ROS 2's messages for Foxglove as it walks, .mcap."""
    playback: Path | None = None
    """Instead of a policy: play the commands of this CSV three times and record the servos, for
    `pupper-sysid fit-servo`."""
    replay: Path | None = None
    """Instead of walking: repeat the log `walk.csv` through the policy and compare."""
    name: str | None = None
    """Of the folder in walks/; by default the policy's and the time."""
    seed: int = 0
    """Of the emulated robot."""
    json: bool = False
    """Print one JSON object."""
    force: bool = False
    """Replace an existing log."""

    @property
    def views(self) -> ViewTargets:
        """What other viewers show."""
        return ViewTargets(self.rerun, self.mcap, self.force)

    @property
    def in_real_time(self) -> bool:
        """Whether an emulated robot must walk as fast as a real one."""
        return self.bus != EMULATED or self.keyboard or (self.live and err.is_terminal)


def _run(options: Deploy) -> None:
    end_politely()
    options = replace(options, bus=bus_name(options.bus))
    need_positive("--seconds", options.seconds)
    if options.playback:
        Sweep(
            playback=options.playback, loops=PLAYBACK_LOOPS, joint_map=options.joint_map,
            bus=options.bus, seed=options.seed, json=options.json, force=options.force,
            rate=PLAYBACK_HZ if options.rate is None else options.rate,
            live=options.live, rerun=options.rerun, mcap=options.mcap,
        ).run()  # fmt: skip
        return
    Stack(**_changes(options))  # refuses what is out of range, before a policy is loaded
    if options.name is not None:
        refuse_path(options.name, "--name")
    if options.live and options.keyboard:
        raise InputError("--live and --keyboard: both draw in the terminal; give one of the two.")
    options.views.check()
    if options.replay and options.views:
        raise InputError("--replay moves nothing: give --rerun and --mcap to a walk.")
    if options.policy is None:
        raise InputError("No policy was named. Give a folder: pupper-deploy runs/<name>.")
    import torch

    torch.set_num_threads(1)
    from pupper_sysid.policies.deploy.assembly import assemble
    from pupper_sysid.policies.deploy.deployment import constant, script

    policy, run = policy_choice.policy_at(options.policy)
    body = policy_choice.body_at(options.policy, policy, run)
    name, stack = _stack(options, policy.contract)
    if options.replay:
        return _replay(options.replay, policy, body)
    trained = policy_choice.trained_commands(policy, run)
    if options.keyboard:
        commands: Commands = Driver(trained)
    elif options.script:
        commands = script(options.script, trained, err.print)
    else:
        commands = constant(options.command, trained, err.print)
    folder = Path("walks") / (options.name or time.strftime(f"{options.policy.name}-%H%M%S"))
    with ExitStack() as open_things:
        actuator = policy_choice.chosen_actuator(options.policy, policy, run, options.actuator)
        bus, imu, joint_map, truth = _open(options, open_things, body, actuator)
        of_training, known = policy_choice.trained_actuator(options.policy, policy, run)
        assembled = assemble(
            policy, stack, joint_map, actuator, options.servo, of_training if known else None, body
        )
        if stack.observer == "readings" and options.actuator is None:
            err.print(
                "The policy observes the servos' own readings. Give a calibration of this robot "
                "with --actuator to compare its servos with those of the training."
            )
        elif not known:
            warn(
                "the actuator with which the policy was trained is not here, so the observer "
                "was not compared with it."
            )
        else:
            policy_choice.show_match(assembled.match)
        match = assembled.servo_match if options.actuator else None
        if options.actuator:
            policy_choice.show_servos(match, policy.contract.servo is not None)
        header = assembled.header | header_entries(bus) | {
            "policy": str(options.policy), "stack_name": name, "seed": options.seed,
            "servo_match": match and match.to_dict(), "commands": trained.model_dump(mode="json"),
        }  # fmt: skip
        _walk(options, bus, imu, assembled, commands, header, folder, truth)


def _stack(options: Deploy, contract: Any) -> tuple[StackName, Stack]:
    """The stack, with the user's changes."""
    name = suited(contract) if options.stack == "auto" else options.stack
    stack = replace(STACKS[name], **_changes(options))
    trained_hz = 1 / contract.control_step_s
    if stack.rate_hz and abs(stack.rate_hz / trained_hz - 1) > 1e-6:
        warn(
            f"the policy was trained at {trained_hz:g} Hz and runs at {stack.rate_hz:g} Hz: its "
            f"gait is {stack.rate_hz / trained_hz:.2f} times as fast."
        )
    return name, stack


def _changes(options: Deploy) -> dict[str, Any]:
    """Settings that the user gives instead of the stack's."""
    named = {"observer", "lowpass_hz", "fade_in_s", "scale_rad"}
    changes = {name: getattr(options, name) for name in named} | {"rate_hz": options.rate}
    without = {"lowpass_hz": None} if options.lowpass_hz == 0 else {}
    return {name: value for name, value in changes.items() if value is not None} | without


def _open(
    options: Deploy, open_things: ExitStack, body: Body, actuator: str
) -> tuple[GuardedBus, Imu, JointMap, Any]:
    """Bus, IMU, joint map, and the emulated robot if it is one."""
    if options.bus == EMULATED:
        from pupper_sysid.sim.walking.robot import WalkingBus, body_joint_map

        rng = np.random.default_rng(options.seed)
        truth = _emulated(options, rng, body, actuator)
        inner = WalkingBus(truth, rng, real_time=options.in_real_time, body=body)
        bus = open_things.enter_context(closing(GuardedBus(inner)))
        return bus, inner, body_joint_map(body), inner.robot
    address = parse_address(options.bus)
    serial = KINDS[address.kind].is_serial
    if body.is_mini_pupper:
        preset = "sts3215" if serial else "mini_pupper_2"
        joint_map = chosen_map(options.joint_map) or load_joint_map(preset)
    else:
        joint_map = _map_of(options, body)
    if serial and options.imu is None:
        raise InputError(
            "A line of servos has no IMU, and a policy needs one. Give the proxy's socket with "
            "--imu."
        )
    bus = open_things.enter_context(closing(open_guarded(address, joint_map)))
    if isinstance(bus.bus, Imu):
        return bus, bus.bus, joint_map, None
    imu = open_things.enter_context(closing(Esp32Bus(options.imu or SOCKET)))
    return bus, imu, joint_map, None


def _map_of(options: Deploy, body: Body) -> JointMap:
    """The user's joint map of another robot, in the order of the policy's joints."""
    joint_map = chosen_map(options.joint_map)
    if joint_map is None:
        raise InputError(
            f"The policy walks {body.name}, and a real bus needs the joint map of that robot: the "
            f"servo's id, direction and limits of {', '.join(body.joints[:3])}, … Begin one with "
            "`pupper-sysid init-robot MJCF`, measure it with `pupper-sysid calibrate-joints`, and "
            "give it with --joint-map. Without a robot: --bus emulated."
        )
    if missing := [j for j in body.joints if j not in joint_map.joint_names]:
        raise InputError(
            f"The joint map {joint_map.file.name} has no {missing[0]}, which the policy of "
            f"{body.name} moves; it has {', '.join(joint_map.joint_names)}. Its joints must be "
            "called as in the robot's MJCF."
        )
    warn(
        f"the IMU's axes are taken for those of {body.name}'s trunk (x forward, y to the left, "
        "z up), and the joint map's angles for those of its MJCF."
    )
    return replace(joint_map, joint_names=body.joints)


def _emulated(options: Deploy, rng: np.random.Generator, body: Body, trained: str) -> EmulatedRobot:
    """An emulated robot with the user's servos.

    Without a calibration, a Mini Pupper has published servos, another robot those of the training.
    """
    from pupper_sysid.servo_models.cards.files import is_card
    from pupper_sysid.sim.emulator.robot import draw_robot
    from pupper_sysid.sim.walking.robot import calibrated_robot
    from pupper_sysid.sim.walking.servo_ranges import check_actuator, is_servo_model, servo_ranges

    if not body.is_mini_pupper:
        if is_servo_model(trained):
            raise InputError(
                f"{trained} is a learned model, which an emulated {body.name} cannot have. Give a "
                "calibration with --actuator."
            )
        whose = f"{trained}."
        if options.actuator is None:
            whose = f"the training, {Path(trained).name}. Give yours with --actuator."
        err.print(f"The emulated {body.name} has the servos of {whose}")
        servos = servo_ranges(trained, body=body)
        if not is_card(trained):
            policy_choice.warn_of_fallbacks([servos])
        return calibrated_robot(servos, rng, body)
    if options.actuator is None:
        return draw_robot(rng)
    check_actuator(options.actuator)
    if is_servo_model(options.actuator):
        err.print(
            f"{options.actuator} is a learned model, which the emulated robot cannot have: its "
            "servos are drawn from published measurements."
        )
        return draw_robot(rng)
    err.print(f"The emulated robot has the servos of {options.actuator}.")
    return calibrated_robot(servo_ranges(options.actuator), rng)


def _replay(path: Path, policy: Any, body: Body) -> None:
    """Repeat a log and compare."""
    from pupper_sysid.policies.deploy.assembly import reassemble
    from pupper_sysid.policies.deploy.walk_log import read_walk, replay

    walk = read_walk(path)
    differs = replay(walk, reassemble(policy, walk.header, path, body))
    ended = walk.ended or "it was cut short"
    if differs is not None:
        raise InputError(
            f"{path}: tick {differs} of {len(walk.senses)} gives another action than in the log. "
            "The policy and all settings are the same; the libraries or the processor are not."
        )
    out.print(f"{len(walk.senses)} ticks repeated, every action equal bit for bit ({ended}).")


def _walk(
    options: Deploy, bus: GuardedBus, imu: Imu, assembled: Assembly, commands: Commands,
    header: dict[str, Any], folder: Path, truth: Any,
) -> None:  # fmt: skip
    """Walk, log, and show the result."""
    from pupper_sysid.policies.deploy.assembly import ERRORS, WalkScore
    from pupper_sysid.policies.deploy.deployment import deploy
    from pupper_sysid.sysid.recordings.files import RecordingWriter

    score = WalkScore(bus, truth) if truth else None
    log, table = folder / "walk.csv", folder / "recording.csv"
    about = {"bus": header["bus"] | {"coordinates": "servo"}, "policy": header["policy"]}
    views = None
    with ExitStack() as open_things:
        priority = open_things.enter_context(real_time_priority())
        if options.bus != EMULATED:
            err.print(f"Running with {priority}.")
        watchers: list[Any] = [assembled.frozen_readings, *([score] if score else [])]
        if isinstance(commands, Driver):
            open_things.enter_context(commands.driving())
            watchers.append(commands.watching(bus.joint_names))
        if options.live and err.is_terminal:
            from pupper_sysid.cli.oscilloscope import Oscilloscope

            scope = open_things.enter_context(Oscilloscope(bus.name, bus.joint_names))
            watchers.append(
                lambda t: scope.tick(t.elapsed_s, t.sent, t.reading, t.missed_deadlines)
            )
        elif options.live:
            warn("--live needs a terminal to draw in; it was left out.")
        if options.views:
            waits = not options.in_real_time
            views = open_things.enter_context(LiveViews(bus, options.views, waits))
            watchers.append(partial(views.walk_tick, assembled.controller.to_servo))
        rows = open_things.enter_context(RecordingWriter(table, about, options.force))
        outcome = deploy(
            bus, imu, assembled.controller, commands, options.seconds, log, header, rows, watchers,
            options.force,
        )  # fmt: skip
        if views:
            views.say(f"Walk: {outcome.stop_reason}")
        rows.close({"stop_reason": outcome.stop_reason} | bus.report.footer())
    # only the true motion of an emulated robot is known
    motion: dict[str, Any] = score.summary() if score else dict.fromkeys(ERRORS)
    steps = outcome.steps
    result = {
        "rate_hz": 1 / outcome.loop.get("mean_period_s", float("nan")),
        "seconds": outcome.seconds, "deadline_misses": outcome.deadline_misses,
        "step_ms": {
            "p50": 1e3 * steps.quantile(0.5), "p99": 1e3 * steps.quantile(0.99),
            "max": 1e3 * steps.largest_s,
        },
        "fell": outcome.fell, **motion, "stop_reason": outcome.stop_reason, "guard": outcome.guard,
        "imu": {"clipped": outcome.clipped_imu_samples, "missing": outcome.missing_imu_samples},
        "servo_match": header["servo_match"], "commands": header["commands"], "log": str(log),
    }  # fmt: skip
    if options.json:
        return print_json(result)
    known = {label: result.get(key) for key, label in _SHOWN.items()}
    summary = terminal.table(
        f"{outcome.seconds:.1f} s on {bus.name}", "", "",
        rows=((k, terminal.cell(value, 3)) for k, value in known.items() if value is not None),
    )  # fmt: skip
    summary.show_header = False
    out.print(summary)
    repeat = terminal.command("pupper-deploy", options.policy, "--replay", log)
    err.print(f"Repeat it: {repeat}")


main = partial(run_program, Deploy, _run, "pupper-deploy", DESCRIPTION)


# ----- driving by keys

STEP = np.array([0.05, 0.04, 0.1])
"""Increment of one key press [m/s, m/s, rad/s]."""
KEYS = {
    "w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1),
}  # fmt: skip
CLIPPED = "   clipped to what it was trained for"
_HELP = "w/s forward  a/d sideways  q/e turn  space stands  x ends"
_SHOWN_EVERY_S = 0.2


class Driver:
    """Commands from the keyboard, no further than those `trained`, and a live table of the ticks.

    Use it as a context; it is a `policies.deploy.deployment.Commands`.
    """

    def __init__(self, trained: CommandRanges) -> None:
        self._trained, self._clipped = trained, False
        self._command = np.zeros(3)
        self._ended = False
        self._live = Live(console=terminal.err, auto_refresh=False)
        self._shown_s = -np.inf
        self._age = np.zeros(0)
        self._joints: Sequence[str] = ()
        self._seen: BusSample | None = None
        self._seen_s = 0.0

    def __call__(self, elapsed_s: float) -> np.ndarray | None:
        """Command at this moment, shape (3,); None once x was pressed."""
        while select.select([sys.stdin], [], [], 0)[0]:
            typed = os.read(sys.stdin.fileno(), 64).decode(errors="ignore").lower()
            if not typed:
                self._ended = True  # the terminal is gone
                break
            for key in typed:
                self._ended |= key == "x"
                if key == " ":
                    self._command, self._clipped = np.zeros(3), False
                elif key in KEYS:
                    axis, sign = KEYS[key]
                    command = self._command.copy()
                    # rounded: steps back to standing end at 0
                    command[axis] = np.round(command[axis] + sign * STEP[axis], 6)
                    self._command = self._trained.clip(command)
                    self._clipped = bool((self._command != command).any())
        return None if self._ended else self._command.copy()

    def watching(self, joints: Sequence[str]) -> Callable[[Tick], None]:
        """Watcher of a walk of these joints, for the table."""
        self._joints, self._age = joints, np.zeros(len(joints))
        return self.watch

    def watch(self, tick: Tick) -> None:
        """Show a tick, a few times a second."""
        if self._seen is not None:
            changed = tick.reading.position_rad != self._seen.position_rad
            self._age = np.where(changed, 0.0, self._age + tick.elapsed_s - self._seen_s)
        self._seen, self._seen_s = tick.reading, tick.elapsed_s
        if tick.elapsed_s - self._shown_s < _SHOWN_EVERY_S:
            return
        self._shown_s = tick.elapsed_s
        notice = CLIPPED if self._clipped else ""
        self._live.update(_table(tick, self._joints, self._age, notice), refresh=True)

    @contextmanager
    def driving(self) -> Iterator[Driver]:
        """Read keys one by one, without echo, during the block."""
        if not sys.stdin.isatty():
            raise InputError("--keyboard needs a terminal to type in; use --command or --script.")
        with terminal_without(termios.ICANON | termios.ECHO, sys.stdin.fileno()), self._live:
            yield self


def _table(tick: Tick, joints: Sequence[str], age_s: np.ndarray, notice: str) -> Table:
    forward, left, turn = tick.senses.command
    return terminal.table(
        f"{tick.elapsed_s:6.1f} s   {forward:+.2f} m/s forward  {left:+.2f} left  "
        f"{turn:+.2f} rad/s{notice}\n{_HELP}",
        "joint", "sent rad", "read rad", "unchanged ms", "load N·m", "margin rad",
        rows=(
            (
                joint, number(tick.sent[i], 3), number(float(tick.reading.position_rad[i]), 3),
                terminal.ms(age_s[i], 0), number(tick.senses.load[i], 2),
                Text(f"{margin:.2f}", "red") if margin < 0.02 else number(margin, 2),
            )
            for i, (joint, margin) in enumerate(zip(joints, tick.decision.margin, strict=True))
        ),
    )  # fmt: skip


if __name__ == "__main__":
    main()
