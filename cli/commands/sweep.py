"""`sweep`: move the joints, write down what happens.

`--load` is one servo on a bench, with another bus and plan. `--until` records and fits in
rounds (`rounds`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import JOINTS_FILE, connect, joints_on, parse_registers
from pupper_sysid.cli.commands.plan import run_rounds, say_how_to_resume
from pupper_sysid.cli.live_views import LiveViews, ViewTargets
from pupper_sysid.cli.terminal import Json, Replace
from pupper_sysid.common.errors import BusError, InputError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite, sha256
from pupper_sysid.common.joints import select_joints
from pupper_sysid.hardware.address import EMULATED, bus_name
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus, header_entries
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus, guarded
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.sysid.recordings.servo_setup import ServoSetup
from pupper_sysid.sysid.sweep import bench, excitation
from pupper_sysid.sysid.sweep.bench import bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import LOOP_PERIOD_S, Plan

if TYPE_CHECKING:
    from pupper_sysid.sysid.sweep.recorder import Observe, Progress, Request

BENCH_MAP = "bench_sts3215"
BENCH_RATE_HZ = 100.0
"""One servo answers within a few milliseconds."""
BENCH_LIMITS = GuardLimits(
    speed_rad_s=6.0, acceleration_rad_s2=400.0, gentle_rad_s=0.6, park_within_s=6.0
)
"""Of a swinging mass: slower than a leg, and the way back takes its time."""
_CHANGED = {
    "clipped": "were outside the joints' limits and were held at them.",
    "slowed": "were delayed by the guard's speed and acceleration limits; the recording holds "
    "the commands that were sent.",
    "unsent": "could not be sent; the servos kept the last set-point.",
}
"""What the guard does to commands, by its count."""


@dataclass(frozen=True)
class Sweep:
    """Record the response of joints to a sweep of tones (or steps, a chirp, …).

    Example: pupper-sysid sweep --freqs 1-10 --joints LF
    """

    freqs: str | None = None
    """Frequencies [Hz]: 1-10, 1-10:0.5 or 1,2,4,6.5; by default 1-10, on a bench 0.5,1,2,4."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all; one after the other."""
    bus: str = EMULATED
    """emulated (no robot needed), esp32 (on the robot), feetech:DEVICE or dynamixel:DEVICE, e.g.
    feetech:/dev/ttyUSB0."""
    joint_map: str | None = None
    """Joint map: a file or a preset; by default joints.yaml if it is here, else the preset that
    fits the bus. With the emulated bus, the robot that is emulated."""
    kind: excitation.Kind | None = None
    """Shape of the motion; by default sine, or bench with --load: tones, chirp, prbs, steps and
    drops. drop and reversal (slow strokes, for backlash) are of a bench, too."""
    load: str | None = None
    """One servo on a bench, and what it swings: pendulum:0.1kg@0.10m (mass, distance from the axis;
    ,arm=0.02kg and ,hanging=0.1rad where they are not 0), or none. Without a joint map: an STS3215
    of id 1."""
    gains: str | None = None
    """With --load: P gains at which everything is recorded, such as 8,16,32. The servo's own is
    set back at the end."""
    playback: Path | None = None
    """Play the commands of this recording or command file instead."""
    loops: int = 1
    """How often to play them."""
    plan: Path | None = None
    """Execute this plan (of `pupper-sysid plan`): its joints, motions, durations and rate."""
    until: str | None = None
    """Fit and go on with planned trials until an interval is narrow: dead_time:2ms until half of
    the 90 % interval of every joint's dead time is at most 2 ms. Each round is a recording of its
    own beside the first, named _2, _3, …"""
    most_seconds: float = 180.0
    """With --until: longest recorded time of a joint [s], all rounds together."""
    amplitude: float | None = None
    """Largest excursion from the start pose [rad], by default 0.3; less where the speed limit asks
    for it. On a bench by default 0.5, strokes 0.25, lifts 1.4."""
    duration: float | None = None
    """Length of each trial [s]; by default 5 s or five periods, whichever is longer."""
    rate: float | None = None
    """Control loop [Hz]; by default 52.63, on a bench 100."""
    out: Path | None = None
    """File to write; by default recordings/<kind>_<date>_<time>.csv."""
    resume: Path | None = None
    """Continue this unfinished recording with its own plan; other options are ignored."""
    truth: bool = False
    """Also write the true parameters and positions of the emulated robot, beside the recording."""
    registers: str = ""
    """Registers of the emulated robot's STS3215 that differ from the factory's, e.g. p=16."""
    real_time: bool = False
    """Run the emulated robot in real time."""
    live: bool = False
    """Show commands, readings and lag of each joint in the terminal while they move; an emulated
    robot moves in real time then."""
    rerun: str | None = None
    """Show all joints and the robot in Rerun while they move: a .rrd file to write, `viewer` (of
    this machine), or a viewer's address, rerun+http://HOST:9876/proxy."""
    mcap: Path | None = None
    """Write all joints in ROS 2's messages for Foxglove while they move, .mcap."""
    force: Replace = False
    json: Json = False
    seed: int = 0
    """Seed of the emulated robot: its servos, its lost polls, its noise."""

    def run(self) -> None:
        """Plan, record, and name the next commands."""
        from pupper_sysid.sysid.recordings.files import FOLDER
        from pupper_sysid.sysid.sweep.recorder import request_of

        started = time.perf_counter()
        self._views.check()
        if self.resume:
            path, (request, done) = self.resume, request_of(self.resume)
        else:
            request, done = self._request(), False
            name = "playback" if self.playback else "plan" if self.plan else request.kind
            path = self.out or FOLDER / f"{name}_{time.strftime('%Y-%m-%d_%H%M%S')}.csv"
            if path.suffix != ".csv":
                raise InputError(f"--out {path}: a recording is a .csv file.")
            refuse_overwrite(path, self.force)
            if request.until:
                request.until.first = path.name
        for ending in (".truth.yaml", ".truth.csv") if self.truth else ():
            refuse_overwrite(path.with_suffix(ending), self.force)
        if self.truth and (self.resume or request.bus != EMULATED):
            raise InputError("--truth: only a new recording of the emulated robot has true values.")
        if request.until:
            if self._views:
                raise InputError(
                    "--until makes several recordings, and --rerun and --mcap show one. Leave "
                    "them out, and give the recordings to `pupper-sysid view`."
                )
            return run_rounds(
                lambda *recording: self._record(*recording)[1], path, request,
                resume=self.resume is not None, done=done, force=self.force, as_json=self.json,
            )  # fmt: skip
        chosen, written = self._record(path, request, self.resume is not None)
        self._print(request.joints, chosen, written, time.perf_counter() - started)

    def _record(self, path: Path, request: Request, resume: bool) -> tuple[Plan, list[Path]]:
        """Record a request, or the rest of it; returns what was executed, and the files written."""
        from pupper_sysid.sim.emulator.bus import EmulatedBus
        from pupper_sysid.sysid.sweep.recorder import footer, record, resume_point

        bus = guarded(_open_bus(request))
        try:
            chosen = _plan_of(request, bus)
            point = resume_point(path, chosen, request.loop_period_s) if resume else None
        except BaseException:
            bus.close()
            raise
        terminal.warn(*chosen.warnings)
        if point:
            terminal.err.print(
                f"Continuing {path} at trial {point.next_trial + 1} of {len(chosen.trials)}."
            )
        existed = path.exists()
        try:
            with (
                _priority_of(request) as priority,
                _shown(bus, chosen, self._views, self.live, request.in_virtual_time) as shows,
            ):
                about: dict[str, Any] = {"seed": request.seed, "sweep": request.model_dump()}
                about["priority"] = priority
                if load := request.pendulum:
                    about["loads"] = dict.fromkeys(request.joints, load.model_dump())
                record(
                    bus, chosen, path, loop_period_s=request.loop_period_s, metadata=about,
                    force=self.force, resume=point, progress=shows[0], observe=shows[1],
                )  # fmt: skip
        except (BusError, KeyboardInterrupt):
            _warn_of_unrestored(bus)
            if path.exists() and not existed and path.stat().st_size == 0:
                path.unlink()  # stopped before its header
            elif path.exists() and (point or not existed or self.force):
                say_how_to_resume(path)
            raise
        _warn_of_unrestored(bus)
        counts = footer(path).get("guard", {})
        changed = (f"{counts[k]} commands {text}" for k, text in _CHANGED.items() if counts.get(k))
        terminal.warn(*changed)
        written = [path]
        if self.truth and isinstance(bus.bus, EmulatedBus):
            written += bus.bus.write_truth(path.with_suffix(""), self.force)
        return chosen, written

    @property
    def _views(self) -> ViewTargets:
        return ViewTargets(self.rerun, self.mcap, self.force)

    def _request(self) -> Request:
        """Options that define the plan; the recording keeps them, so that it can be continued."""
        from pupper_sysid.sysid.sweep.recorder import Request, Series

        bus, on_bench = bus_name(self.bus), self.load is not None
        usual_rate = BENCH_RATE_HZ if on_bench else round(1 / LOOP_PERIOD_S, 2)
        rate = usual_rate if self.rate is None else self.rate
        refuse_outside("--rate", rate, *excitation.RATES_HZ, "Hz")
        refuse_outside("--most-seconds", self.most_seconds, *excitation.TRIAL_S, "s")
        refuse_outside("--duration", self.duration, *excitation.TRIAL_S, "s")
        refuse_outside("--loops", self.loops, 1, excitation.MOST_LOOPS)
        if self.real_time and bus != EMULATED:
            raise InputError("--real-time: a real bus always runs in real time; leave it out.")
        loop_period_s = 1.0 / rate
        self._refuse_bench_options()
        in_folder = JOINTS_FILE if bus != EMULATED and JOINTS_FILE.exists() else None
        joint_map = self.joint_map
        if on_bench and joint_map is None and in_folder is None:
            joint_map = BENCH_MAP
        if self.plan is None:
            chosen = joint_map or in_folder
            joints = joints_on(bus, load_joint_map(chosen) if chosen else None, self.joints)
        else:
            from pupper_sysid.sysid.plan.plan_file import load_plan

            if self.playback:
                raise InputError("--plan and --playback: give one of the two.")
            proposal = load_plan(self.plan)
            joints = select_joints(self.joints, proposal.joints)
            loop_period_s = proposal.loop_period_s
        if on_bench and len(joints) > 1:
            raise InputError(
                f"--load: a bench is one servo, and {len(joints)} were chosen; name it with "
                "--joints."
            )
        if self.freqs is None and on_bench:
            frequencies = list(bench.FREQUENCIES_HZ)
        else:
            frequencies = excitation.parse_frequencies("1-10" if self.freqs is None else self.freqs)
        amplitude = self.amplitude
        if amplitude is not None:
            excitation.check_amplitude(amplitude)
        elif not on_bench:  # motions on a bench have other excursions
            amplitude = 0.3
        until = None
        if self.until is not None:
            from pupper_sysid.sysid.plan.plan_file import parse_goal

            parse_goal(self.until)
            if self.playback:
                raise InputError("--until and --playback: give one of the two.")
            until = Series(
                goal=self.until, most_seconds=self.most_seconds, first="", joints=joints, number=1
            )
        if self.registers and (on_bench or bus != EMULATED):
            raise InputError(
                "--registers: sets those of an emulated robot. A real one's are recorded as they "
                "are; on a bench --gains sets the P gain."
            )
        watched = bus == EMULATED and self.live and terminal.err.is_terminal
        return Request(
            bus=bus, joint_map=joint_map, real_time=self.real_time or watched, seed=self.seed,
            loop_period_s=loop_period_s,
            kind=self.kind or (bench.BENCH if on_bench else "sine"), joints=joints,
            frequencies_hz=frequencies, amplitude_rad=amplitude, duration_s=self.duration,
            playback=str(self.playback) if self.playback else None, loops=self.loops,
            plan=str(self.plan) if self.plan else None, load=self.load,
            gains=[] if self.gains is None else bench.parse_gains(self.gains), until=until,
            registers=parse_registers(self.registers),
        )  # fmt: skip

    def _refuse_bench_options(self) -> None:
        """Gains, drops and strokes are for a bench, and a bench has no plan or playback."""
        if self.load is None:
            alone = "--gains" if self.gains else f"--kind {self.kind}"
            if self.gains or self.kind in bench.BENCH_KINDS:
                raise InputError(
                    f"{alone} is for one servo on a bench, not for a robot's legs: add --load "
                    "pendulum:0.1kg@0.10m, or --load none for a servo in free air."
                )
            return
        parse_load(self.load)
        option = next((n for n in ("plan", "playback", "until") if getattr(self, n)), None)
        if option:
            raise InputError(f"--load and --{option}: give one of the two.")

    def _print(self, joints: list[str], chosen: Plan, written: list[Path], elapsed: float) -> None:
        path = written[0]
        if self.json:
            return terminal.print_json({
                "recording": path, "written": written, "joints": joints,
                "trials": len(chosen.trials), "recorded_s": chosen.duration_s,
                "elapsed_s": elapsed, "warnings": chosen.warnings,
            })  # fmt: skip
        trials = _counted(len(chosen.trials), "trial")
        terminal.out.print(
            f"Recorded {trials} of {_counted(len(joints), 'joint')}, "
            f"{chosen.duration_s:.0f} s of motion, in {elapsed:.1f} s."
        )
        for name in written:
            terminal.out.print(f"  {name}")
        following: list[tuple[object, ...]] = [("backlash", path)]
        if self.kind != "reversal":
            following = [("delay", path), ("calibrate", path, "--out", "calibrated.yaml")]
        following.insert(0, ("doctor", path))
        terminal.out.print("Next:")
        for words in following:
            terminal.out.print(f"  {terminal.command('pupper-sysid', *words)}")


def _open_bus(request: Request) -> ServoBus:
    """The bus that a request names; that of a bench is guarded with its limits."""
    joint_map, load = request.joint_map, request.load
    if request.bus != EMULATED:
        limits = BENCH_LIMITS if load else None
        return connect(request.bus, joint_map, request.joints, limits)
    from pupper_sysid.sim.emulator import pendulum
    from pupper_sysid.sim.emulator.bus import EmulatedBus
    from pupper_sysid.sim.emulator.robot import draw_robot

    rng, real_time = np.random.default_rng(request.seed), request.real_time
    if load:
        terminal.err.print(f"No servo: using an emulated STS3215 on a bench, load {load}.")
        swung = request.pendulum
        robot = pendulum.draw_bench(
            rng, pendulum.Pendulum(**(swung.model_dump() if swung else {})),
            joint_map=load_joint_map(joint_map or BENCH_MAP),
        )  # fmt: skip
        bus = EmulatedBus(robot, rng, real_time, pendulum.PendulumBench(robot))
        return GuardedBus(bus, BENCH_LIMITS)
    map_ = load_joint_map(joint_map) if joint_map else None
    what = f"an emulated one with the servos of {map_.file.name}" if map_ else "the emulated one"
    terminal.err.print(f"No robot: using {what}{', in real time' * real_time}.")
    if request.registers and not (map_ and pendulum.has_registers(map_)):
        raise InputError(
            "--registers: the servos of this robot have none that act. Give a --joint-map whose "
            "`servo` is STS3215."
        )
    registers = request.registers
    drawn, plant = pendulum.draw_of_map(rng, map_, registers) if map_ else (draw_robot(rng), None)
    if request.plan:  # the same robot, with other noise
        noise = int(sha256(Path(request.plan))[:12], 16)
        rng = np.random.default_rng([request.seed, noise])
    return EmulatedBus(drawn, rng, real_time, plant)


def _plan_of(request: Request, bus: GuardedBus) -> Plan:
    """The plan that a request describes, within the limits of the bus and its guard."""
    joints, load = request.joints, request.pendulum
    if request.playback:
        from pupper_sysid.sysid.sweep.recorder import playback

        chosen = playback(Path(request.playback), joints)
        return replace(chosen, trials=chosen.trials * request.loops)
    pose = dict(bus.metadata["rest_pose_rad"])
    if load:
        pose[joints[0]] = load.hanging_rad
    free = bus.limits.margin(np.array([pose[name] for name in bus.joint_names]))
    margin = dict(zip(bus.joint_names, map(float, free), strict=True))
    stated = header_entries(bus).get("servos", {})
    setups = [ServoSetup(**stated[joint]) for joint in joints if joint in stated]
    speeds = [setup.set_point_speed_rad_s for setup in setups]
    stated_speed = bus.metadata["speed_limit_rad_s"]
    speed_limit = min([stated_speed, bus.guard.speed_rad_s, *filter(None, speeds)])
    ramps = [setup.set_point_acceleration_rad_s2 for setup in setups]
    ramp_limit = min([*filter(None, ramps), np.inf])
    if request.load:
        (joint,) = joints
        return bench_plan(
            joint, load, request.gains, request.kind,
            frequencies_hz=request.frequencies_hz, amplitude_rad=request.amplitude_rad,
            duration_s=request.duration_s, loop_period_s=request.loop_period_s,
            start_rad=pose[joint], margin_rad=margin[joint],
        )  # fmt: skip
    if request.plan:
        from pupper_sysid.sysid.plan.plan_file import executable, load_plan

        path = Path(request.plan)
        return executable(load_plan(path), path, joints, margin, pose, speed_limit, ramp_limit)
    assert request.amplitude_rad is not None
    return excitation.plan(
        request.kind, joints, request.frequencies_hz, request.amplitude_rad,
        request.duration_s, request.loop_period_s, speed_limit,
        bus.metadata.get("poll_rate_hz", excitation.POLL_RATE_HZ), margin, pose, ramp_limit,
    )  # fmt: skip


@contextmanager
def _shown(
    bus: GuardedBus, chosen: Plan, targets: ViewTargets, live: bool, waits: bool
) -> Iterator[tuple[Progress, Observe]]:
    """What shows the progress, and each tick where live views are on."""
    watchers: list[Observe] = []

    def observe(number: int, sent: Sent, reading: BusSample, missed: int) -> None:
        for watch in watchers:
            watch(number, sent, reading, missed)

    with ExitStack() as open_things:
        if targets:
            views = open_things.enter_context(LiveViews(bus, targets, waits))
            watchers.append(lambda number, sent, reading, _: views.tick(number, sent, reading))
        if live and terminal.err.is_terminal:
            from pupper_sysid.cli.oscilloscope import Oscilloscope

            scope = open_things.enter_context(Oscilloscope(bus.name, bus.joint_names))
            watchers.append(
                lambda _, sent, reading, missed: scope.tick(
                    bus.now(), sent.position_rad, reading, missed
                )
            )
            yield scope.stage, observe
            return
        if live:
            terminal.warn("--live needs a terminal to draw in; it was left out.")
        progress = terminal.seconds_progress("recording", chosen.duration_s)
        yield open_things.enter_context(progress), observe


@contextmanager
def _priority_of(request: Request) -> Iterator[str]:
    """Real-time priority during the block, where time is real; yields it in words."""
    if request.in_virtual_time:
        yield "none: virtual time"
        return
    with real_time_priority() as priority:
        terminal.err.print(f"Control loop at {priority}.")
        yield priority


def _warn_of_unrestored(bus: GuardedBus) -> None:
    """Warn of registers that could not be set back."""
    for joint, registers in bus.registers.originals.items():
        for name, value in registers.items():
            terminal.warn(
                f"{joint}: its register {name} could not be set back to {value}. Switch the "
                f"servo's power off and on; if `scan` still shows another value, write {value} "
                "yourself."
            )


def _counted(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"
