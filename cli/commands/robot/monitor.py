"""`monitor`: live traces of every servo; it only reads."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.buses import chosen_map, say_remarks
from pupper_sysid.cli.live_views import LiveViews, ViewTargets, live_views
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.hardware.address import EMULATED, bus_name, parse_address
from pupper_sysid.hardware.bus import BusSample, Sent, ServoBus, error_words
from pupper_sysid.hardware.safety.guard import open_bus
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot

if TYPE_CHECKING:
    from pupper_sysid.cli.oscilloscope import Oscilloscope

_RATES_HZ = (0.1, 1000.0)
_ONCE_S = 0.3  # voltage and temperature are not in every reply
_GOALS_EVERY_S = 1.0  # one request per servo, and only another program could change them
_PLAIN_EVERY_S = 1.0


@dataclass(frozen=True)
class Monitor:
    """Show every servo: goal position, position, load, voltage, temperature, errors.

    It only reads: no command is sent and no torque is switched. Ctrl-C ends it. In a terminal
    positions and goals are traces, else a table is printed each second. Angles are each
    servo's own, as in a sweep: a calf's is given as if its thigh were at its neutral.
    Example: pupper-sysid monitor --bus feetech:/dev/ttyUSB0
    """

    bus: str
    """esp32 (on the robot), feetech:DEVICE, dynamixel:DEVICE, or emulated."""
    joint_map: str | None = None
    """Joint map: a file or a preset; by default joints.yaml if it is here, else the preset that
    fits the bus."""
    rate: float = 20.0
    """Readings per second."""
    seconds: float | None = None
    """End after this long [s]; by default only with Ctrl-C."""
    rerun: str | None = None
    """Show all joints and the robot in Rerun, too: a .rrd file to write, `viewer` (of this
    machine), or a viewer's address, rerun+http://HOST:9876/proxy."""
    mcap: Path | None = None
    """Write all joints in ROS 2's messages for Foxglove, too, .mcap."""
    force: bool = False
    """Replace files that exist."""
    once: bool = False
    """Print one table and end."""
    json: bool = False
    """Print one JSON object and nothing else, and end."""

    def run(self) -> None:
        """Read and show until the end."""
        refuse_outside("--rate", self.rate, *_RATES_HZ, "Hz")
        if self.seconds is not None:
            terminal.need_positive("--seconds", self.seconds)
        targets = ViewTargets(self.rerun, self.mcap, self.force)
        if targets and (self.once or self.json):
            raise InputError(
                "--once and --json print one table, and --rerun and --mcap show what follows. "
                "Give one of the two."
            )
        targets.check()
        bus = _open(self.bus, self.joint_map)
        try:
            watched = Watched(bus)
            if self.once or self.json:
                self._watch(watched, _ONCE_S if self.seconds is None else self.seconds)
                if self.json:
                    terminal.print_json(
                        {
                            "bus": bus_name(self.bus), "joints": watched.rows(),
                            "joint_map": bus.metadata.get("joint_map"),
                            "coordinates": bus.metadata.get("coordinates"),
                        }
                    )  # fmt: skip
                else:
                    terminal.out.print(watched.table(bus_name(self.bus)))
                return
            with live_views(bus, targets) if targets else nullcontext() as views:
                self._show(watched, views)
        finally:
            bus.close()

    def _show(self, watched: Watched, views: LiveViews | None) -> None:
        """Traces in a terminal, else tables; and what other viewers show."""

        def show(draw: Callable[[], None]) -> None:
            if views:
                views.tick(0, *watched.tick())
            draw()

        until = np.inf if self.seconds is None else self.seconds
        if terminal.err.is_terminal:
            from pupper_sysid.cli.oscilloscope import Oscilloscope

            title = f"{bus_name(self.bus)}, only read"
            with Oscilloscope(title, watched.bus.joint_names, lag=False) as scope:
                self._watch(watched, until, lambda: show(lambda: watched.draw(scope)))
            return
        shown_s = -np.inf

        def table() -> None:
            nonlocal shown_s
            if watched.now_s - shown_s >= _PLAIN_EVERY_S:
                shown_s = watched.now_s
                terminal.out.print(watched.table(bus_name(self.bus)))

        self._watch(watched, until, lambda: show(table))

    def _watch(self, watched: Watched, seconds: float, show=lambda: None) -> None:
        bus = watched.bus
        until = bus.now() + seconds
        tick = bus.now()
        while True:
            watched.look()
            show()
            tick = max(tick + 1 / self.rate, bus.now())
            if tick > until:
                return
            bus.sleep_until(tick)


class Watched:
    """A bus that is only read, and the age of each joint's reading.

    A serial servo answers with its present position, so the age of a reading is the time since its
    last reply. The proxy and the emulated robot return stale readings without a time stamp: for
    those it is the time since the value last changed, which is long for a joint at rest.
    """

    def __init__(self, bus: ServoBus):
        self.bus = bus
        self.answers_now = bus.metadata.get("readings") == "live"
        joints = len(bus.joint_names)
        self.now_s = self._start_s = bus.now()
        self._seen_s = np.full(joints, np.nan)
        self._has_changed = np.zeros(joints, bool)
        self._position, self._goal = np.full((2, joints), np.nan)
        self._count = np.full(joints, -1)
        self._here = np.zeros(joints, bool)
        self._goal_s = -np.inf
        self._sample: BusSample | None = None
        self._voltage, self._temperature = np.full((2, joints), np.nan)

    def look(self) -> None:
        """Read once."""
        sample = self._sample = self.bus.read()
        answered = self._here = np.isfinite(sample.position_rad)
        changed = answered & (sample.position_rad != self._position) & np.isfinite(self._position)
        self._has_changed |= changed
        news = answered if self.answers_now else changed | (answered & np.isnan(self._seen_s))
        self._seen_s = np.where(news, sample.time_s, self._seen_s)
        self._position = np.where(answered, sample.position_rad, self._position)
        self._count = np.where(answered, sample.position_count, self._count)
        self._voltage = _latest(self._voltage, sample.voltage_v)
        self._temperature = _latest(self._temperature, sample.temperature_c)
        goals = getattr(self.bus, "goals", None)
        if goals and self.bus.now() - self._goal_s > _GOALS_EVERY_S:
            self._goal, self._goal_s = goals(), self.bus.now()
        self.now_s = self.bus.now()

    def tick(self) -> tuple[Sent, BusSample]:
        """The goals as they were last read, as if sent now, and the last reading."""
        assert self._sample is not None
        return Sent(self.now_s, self._goal), self._sample

    def draw(self, scope: Oscilloscope) -> None:
        """Show the last reading as traces, and what there is no trace for beside them."""
        sample = self._sample
        assert sample is not None
        latest = replace(sample, voltage_v=self._voltage, temperature_c=self._temperature)
        scope.tick(self.now_s, self._goal, latest)
        notes = []
        for k, row in enumerate(self.rows()):
            word = "age" if self.answers_now else "same"
            age = self._age(k, row["age_s" if self.answers_now else "unchanged_s"])
            count = "" if row["count"] is None else f"{row['count']} cts"
            notes.append(" ".join(filter(None, [row["errors"], word, age, count])))
        scope.notes(notes)

    def rows(self) -> list[dict[str, Any]]:
        """One dict per joint; None where the bus has no value."""
        sample = self._sample
        assert sample is not None
        rows = []
        for k, name in enumerate(self.bus.joint_names):
            status = None if sample.status is None or not self._here[k] else int(sample.status[k])
            since = _known(self.now_s - self._seen_s[k])
            rows.append(
                {
                    "joint": name,
                    "answers": bool(self._here[k]),
                    "goal_rad": _known(self._goal[k]),
                    "position_rad": _known(self._position[k]),
                    "count": int(self._count[k]) if np.isfinite(self._position[k]) else None,
                    "age_s": since if self.answers_now else None,
                    "unchanged_s": None if self.answers_now else since,
                    "load": None if sample.load is None else _known(sample.load[k]),
                    "voltage_v": _known(self._voltage[k]),
                    "temperature_c": _known(self._temperature[k]),
                    "errors": None if status is None else error_words(self.bus, status),
                }
            )
        return rows

    def table(self, bus_name: str) -> Group:
        """The table and the meaning of its columns."""
        table = terminal.table(
            bus_name, "joint", "goal", "rad", "count", "age" if self.answers_now else "unchanged",
            "load %", "volt", "°C", "errors",
        )  # fmt: skip
        for k, row in enumerate(self.rows()):
            errors = "–" if row["errors"] is None else row["errors"] or "none"
            load = None if row["load"] is None else 100 * row["load"]
            table.add_row(
                row["joint"], terminal.number(row["goal_rad"], 3),
                terminal.number(row["position_rad"], 3),
                "–" if row["count"] is None else str(row["count"]),
                self._age(k, row["age_s" if self.answers_now else "unchanged_s"]),
                terminal.number(load, 0),
                terminal.number(row["voltage_v"], 1), terminal.number(row["temperature_c"], 0),
                errors if row["answers"] else Text("silent", "red"),
            )  # fmt: skip
        if self.answers_now:
            note = "age: since the last valid reply. goal: the servo's Goal_Position."
        else:
            note = "unchanged: since the value last changed; the feedback age is unknown"
            proxy = self.bus.metadata["kind"] != "emulated"
            note += ", as are goals, temperatures and errors." if proxy else "."
        return Group(table, Text(note, style="dim"))

    def _age(self, joint: int, seconds: float | None) -> str:
        if seconds is None:
            return "–"
        if self.answers_now and seconds < 1:
            return f"{1e3 * seconds:.0f} ms"
        # its age before the first reading is unknown
        since_before = not self.answers_now and not self._has_changed[joint]
        return ("≥" if since_before else "") + f"{seconds:.1f} s"


def _open(bus: str, joint_map: str | None) -> ServoBus:
    """The bus to read, without guard and watchdog: nothing moves."""
    if bus_name(bus) == EMULATED:
        if joint_map:
            raise InputError("--joint-map: the emulated robot has its own; leave it out.")
        rng = np.random.default_rng(0)
        return EmulatedBus(draw_robot(rng), rng, real_time=True, keep_log=False)
    address = parse_address(bus)
    chosen = chosen_map(joint_map)
    opened = open_bus(address, chosen.per_servo() if chosen else None)
    say_remarks(opened)
    return opened


def _latest(before: NDArray[np.float64], now: NDArray[np.float64] | None) -> NDArray[np.float64]:
    return before if now is None else np.where(np.isfinite(now), now, before)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
