"""How a sweep is carried out: its bus, its plan, what is shown meanwhile and at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import connect
from pupper_sysid.cli.commands.recording.bench import open_bench, open_emulated, plan_of_bench
from pupper_sysid.cli.live_views import Wanted, live_views
from pupper_sysid.hardware.address import EMULATED
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus
from pupper_sysid.hardware.loop import real_time_priority
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.sysid.sweep.excitation import POLL_RATE_HZ, Plan, plan

if TYPE_CHECKING:
    from pupper_sysid.sysid.sweep.recorder import Observe, Progress


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
            terminal.warn(["--live needs a terminal to draw in; it was left out."])
        progress = terminal.seconds_progress("recording", chosen.duration_s)
        yield open_things.enter_context(progress), observe


def say_how_to_resume(path: Path) -> None:
    """Print the command that continues a recording."""
    terminal.err.print(
        f"The recording up to here is in {path}; continue it with\n"
        f"  pupper-sysid sweep --resume {path}",
        soft_wrap=True,
    )


def say_what_stays(bus: ServoBus) -> None:
    """Warn of registers that could not be set back."""
    if isinstance(bus, GuardedBus):
        terminal.warn(
            f"{joint}: its register {name} could not be set back to {value}. Switch the servo's "
            f"power off and on; if `scan` still shows another value, write {value} yourself."
            for joint, own in bus.registers.found.items()
            for name, value in own.items()
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
