"""How a sweep is carried out: its bus, its plan, what is shown meanwhile, and rounds of it.

`--load` is one servo on a bench, with a bus and a plan of its own. `--until` records and fits in
rounds, each a recording of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import connect
from pupper_sysid.cli.live_views import Wanted, live_views
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, sha256
from pupper_sysid.hardware.address import EMULATED
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad
from pupper_sysid.sysid.sweep.bench import bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import POLL_RATE_HZ, Plan, plan

if TYPE_CHECKING:
    from pupper_sysid.sysid.fit.results import JointCalibrationResult
    from pupper_sysid.sysid.plan.proposal import SweepPlan
    from pupper_sysid.sysid.plan.until import JointOutcome, Outcome
    from pupper_sysid.sysid.recordings.recording import Recording
    from pupper_sysid.sysid.sweep.recorder import Observe, Progress

BENCH_MAP = "bench_sts3215"
BENCH_RATE_HZ = 100.0
"""One servo answers within a few milliseconds."""
BENCH_LIMITS = GuardLimits(
    speed_rad_s=6.0, acceleration_rad_s2=400.0, gentle_rad_s=0.6, park_within_s=6.0
)
"""Of a swinging mass: slower than a leg, and the way back takes its time."""
Record = Callable[[Path, dict[str, Any], bool], list[Path]]
"""Records a request, or with True the rest of it, to a file; returns the files written."""


@contextmanager
def shown(
    bus: GuardedBus, chosen: Plan, wanted: Wanted, live: bool, waits: bool
) -> Iterator[tuple[Progress, Observe]]:
    """What shows the progress, and each tick where live views are on."""
    watchers: list[Observe] = []

    def observe(number: int, sent: Sent, reading: BusSample, missed: int) -> None:
        for watch in watchers:
            watch(number, sent, reading, missed)

    with ExitStack() as open_things:
        if wanted:
            views = open_things.enter_context(live_views(bus, wanted, waits))
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


def say_how_to_resume(path: Path) -> None:
    """Print the command that continues a recording."""
    resuming = terminal.command("pupper-sysid", "sweep", "--resume", path)
    terminal.err.print(f"The recording up to here is in {path}; continue it with\n  {resuming}")


def say_what_stays(bus: ServoBus) -> None:
    """Warn of registers that could not be set back."""
    if isinstance(bus, GuardedBus):
        for joint, own in bus.registers.found.items():
            for name, value in own.items():
                terminal.warn(
                    f"{joint}: its register {name} could not be set back to {value}. Switch the "
                    f"servo's power off and on; if `scan` still shows another value, write {value} "
                    "yourself."
                )


def open_bus_of(request: dict[str, Any]) -> ServoBus:
    """The bus that a request names."""
    if request.get("load"):
        return open_bench(request)
    if request["bus"] == EMULATED:
        return open_emulated(request)
    return connect(request["bus"], request["joint_map"], request["joints"])


def plan_of(request: dict[str, Any], bus: ServoBus) -> Plan:
    """The plan that a request describes, within the limits of the bus."""
    joints = request["joints"]
    if request["playback"]:
        from pupper_sysid.sysid.sweep.resume import playback

        chosen = playback(Path(request["playback"]), joints)
        return replace(chosen, trials=chosen.trials * request.get("loops", 1))
    pose = bus.metadata["rest_pose_rad"]
    free = bus.limits.margin(np.array([pose[name] for name in bus.joint_names]))
    margin = dict(zip(bus.joint_names, map(float, free), strict=True))
    speed_limit = bus.metadata["speed_limit_rad_s"]
    if request.get("load"):
        return plan_of_bench(request, bus)
    if request.get("plan"):
        from pupper_sysid.sysid.plan.plan_file import executable, load_plan

        path = Path(request["plan"])
        return executable(load_plan(path), path, joints, margin, pose, speed_limit)
    return plan(
        request["kind"], joints, request["frequencies_hz"], request["amplitude_rad"],
        request["duration_s"], request["loop_period_s"], speed_limit,
        bus.metadata.get("poll_rate_hz", POLL_RATE_HZ), margin, pose,
    )  # fmt: skip


def in_virtual_time(request: dict[str, Any]) -> bool:
    """Whether time passes only for the emulated robot, so that nothing is late."""
    return request["bus"] == EMULATED and not request["real_time"]


@contextmanager
def priority_of(request: dict[str, Any]) -> Iterator[str]:
    """Real-time priority during the block, where time is real; yields it in words."""
    if in_virtual_time(request):
        yield "none: virtual time"
        return
    with real_time_priority() as priority:
        terminal.err.print(f"Control loop at {priority}.")
        yield priority


def guard_warnings(path: Path) -> list[str]:
    """Sentences on commands that the guard changed."""
    from pupper_sysid.sysid.sweep.resume import footer

    counts = footer(path).get("guard", {})
    sentences = {
        "clipped": "were outside the joints' limits and were held at them.",
        "slowed": "were delayed by the guard's speed and acceleration limits; the recording holds "
        "the commands that were sent.",
        "unsent": "could not be sent; the servos kept the last set-point.",
    }
    return [f"{counts[k]} commands {text}" for k, text in sentences.items() if counts.get(k)]


# ----- one servo on a bench


def load_of(request: dict[str, Any]) -> PendulumLoad | None:
    """The load that a request names."""
    return parse_load(request["load"]) if request.get("load") else None


def loads_of(request: dict[str, Any]) -> dict[str, Any]:
    """The entry `loads` of the recording's header; empty without a load."""
    load = load_of(request)
    return {"loads": {j: load.model_dump() for j in request["joints"]}} if load else {}


def open_emulated(request: dict[str, Any]) -> ServoBus:
    """The emulated robot: that of the joint map, or a Mini Pupper 2."""
    from pupper_sysid.sim.emulator.bus import EmulatedBus
    from pupper_sysid.sim.emulator.pendulum import draw_of_map, has_registers
    from pupper_sysid.sim.emulator.robot import draw_robot

    rng = np.random.default_rng(request["seed"])
    own = load_joint_map(request["joint_map"]) if request["joint_map"] else None
    robot = f"an emulated one with the servos of {own.file.name}" if own else "the emulated one"
    how = ", in real time" if request["real_time"] else ""
    terminal.err.print(f"No robot: using {robot}{how}.")
    registers = request.get("registers") or {}
    if registers and not (own and has_registers(own)):
        raise InputError(
            "--registers: the servos of this robot have none that act. Give a --joint-map whose "
            "`servo` is STS3215."
        )
    drawn, plant = draw_of_map(rng, own, registers) if own else (draw_robot(rng), None)
    if request.get("plan"):  # the same robot, but not once more the same noise
        noise = int(sha256(Path(request["plan"]))[:12], 16)
        rng = np.random.default_rng([request["seed"], noise])
    return EmulatedBus(drawn, rng, bool(request["real_time"]), plant)


def open_bench(request: dict[str, Any]) -> ServoBus:
    """The bus of a bench, guarded with its limits."""
    if request["bus"] != EMULATED:
        return connect(request["bus"], request["joint_map"], request["joints"], BENCH_LIMITS)
    from pupper_sysid.sim.emulator.bus import EmulatedBus
    from pupper_sysid.sim.emulator.pendulum import Pendulum, PendulumBench, draw_bench

    rng = np.random.default_rng(request["seed"])
    load = load_of(request)
    terminal.err.print(f"No servo: using an emulated STS3215 on a bench, load {request['load']}.")
    robot = draw_bench(
        rng,
        Pendulum(**(load.model_dump() if load else {})),
        joint_map=load_joint_map(request["joint_map"] or BENCH_MAP),
    )
    bus = EmulatedBus(robot, rng, bool(request["real_time"]), PendulumBench(robot))
    return GuardedBus(bus, BENCH_LIMITS)


def plan_of_bench(request: dict[str, Any], bus: ServoBus) -> Plan:
    """The plan that a request describes, within the limits of the bus."""
    (joint,), load = request["joints"], load_of(request)
    pose = dict(bus.metadata["rest_pose_rad"])
    if load:
        pose[joint] = load.hanging_rad
    free = bus.limits.margin(np.array([pose[name] for name in bus.joint_names]))
    return bench_plan(
        joint, load, request["gains"], request["kind"],
        frequencies_hz=request["frequencies_hz"], amplitude_rad=request["amplitude_rad"],
        duration_s=request["duration_s"], loop_period_s=request["loop_period_s"],
        start_rad=pose[joint], margin_rad=float(free[bus.joint_names.index(joint)]),
    )  # fmt: skip


# ----- rounds of recording and fitting


def run_rounds(
    record: Record,
    path: Path,
    request: dict[str, Any],
    *,
    resume: bool,
    whole: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Record the first sweep, or what is left of the last round, and go on to the goal.

    `path` is the first recording, or the one that is continued (`resume`), which may be `whole`
    already; `request` is its. `force` replaces the rounds of an earlier sweep.
    """
    started = time.perf_counter()
    from pupper_sysid.sysid.doctor.checks import each_joint
    from pupper_sysid.sysid.fit.joint_fit import fit_joint
    from pupper_sysid.sysid.plan.plan_file import save_plan
    from pupper_sysid.sysid.plan.until import parse_goal, record_until
    from pupper_sysid.sysid.sweep.resume import footer, header_of

    series = request["until"]
    first = path.with_name(series["first"])
    if resume:
        paths = _recorded(first)
        if paths[-1] != path:
            path = paths[-1]
            whole, request = bool(footer(path)), dict(header_of(path)["sweep"])
    else:
        paths = [path]
        if force:  # rounds of an earlier sweep of this name are not this one's
            for old in _recorded(first)[1:]:
                old.unlink()
    written = list(paths)
    if not whole:
        written += record(path, request, resume)[1:]

    def record_next(plan: SweepPlan, number: int) -> Path:
        file = _of_round(first, number)
        refuse_overwrite(file)
        plan_file = file.with_suffix(".plan.yaml")
        save_plan(plan, plan_file, force=True)  # of a round that never began, if it is there
        again = request | {
            "plan": str(plan_file), "joints": plan.joints, "loop_period_s": plan.loop_period_s,
            "until": series | {"number": number},
        }  # fmt: skip
        written.extend([*record(file, again, False), plan_file])
        return file

    def fit(
        recordings: Sequence[Recording], joints: list[str]
    ) -> dict[str, JointCalibrationResult]:
        with terminal.progress("fitting", len(joints)) as advance:
            return each_joint(
                partial(fit_joint, seed=request["seed"]), recordings, joints, 2, advance
            )

    try:
        outcome = record_until(
            parse_goal(series["goal"]), paths, series["joints"], fit, record_next,
            most_seconds=series["most_seconds"], seed=request["seed"],
            report=lambda found: _say_progress(found, series["goal"]),
        )  # fmt: skip
    except KeyboardInterrupt:
        say_how_to_resume(first)
        raise
    if as_json:
        elapsed = time.perf_counter() - started
        terminal.print_json(outcome.to_dict() | {"written": written, "elapsed_s": elapsed})
    else:
        _print_outcome(outcome, written, series["goal"])


def _of_round(first: Path, number: int) -> Path:
    return first if number == 1 else first.with_name(f"{first.stem}_{number}.csv")


def _recorded(first: Path) -> list[Path]:
    """Files of the rounds that were begun."""
    if not first.exists():
        raise InputError(f"{first}, the first recording of this sweep, is missing. Put it back.")
    found, number = [first], 2
    while (path := _of_round(first, number)).exists():
        found.append(path)
        number += 1
    return found


def _say_progress(found: dict[str, JointOutcome], goal: str) -> None:
    """One line per joint on stderr."""
    from pupper_sysid.sysid.plan.until import half_width

    for joint, state in found.items():
        dead = state.dead_time_s
        terminal.err.print(
            f"{joint}: after {state.recorded_s:.0f} s the dead time is "
            f"{terminal.ms(dead.value)} ms ± {terminal.ms(half_width(dead))} ({goal}): "
            f"{state.why or 'reached'}."
        )


def _print_outcome(outcome: Outcome, written: list[Path], goal: str) -> None:
    shown = terminal.table(
        f"Until {goal}", "joint", "rounds", "seconds", "dead time ms", "90 % interval", "goal"
    )
    for joint, state in outcome.joints.items():
        dead = state.dead_time_s
        shown.add_row(
            joint, str(state.rounds), terminal.number(state.recorded_s, 0),
            terminal.ms(dead.value), f"{terminal.ms(dead.low)} … {terminal.ms(dead.high)}",
            "reached" if state.reached else "not reached",
        )  # fmt: skip
    terminal.out.print(shown)
    for joint, state in outcome.joints.items():
        if state.why:
            terminal.warn(f"{joint}: the goal was not reached: {state.why}.")
    for name in written:
        terminal.out.print(f"  {name}")
    following = ("calibrate", *outcome.recordings, "--out", "calibrated.yaml")
    terminal.out.print(f"Next:\n  {terminal.command('pupper-sysid', *following)}")
