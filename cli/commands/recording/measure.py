"""`doctor`, `delay`, `bode` and `backlash`: what recordings show without a model of the servo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.common import OfRecordings
from pupper_sysid.common.joints import share_sentences

if TYPE_CHECKING:
    from pupper_sysid.common.interval import Interval


@dataclass(frozen=True)
class Doctor:
    """Check whether a recording is usable, and what is wrong with it.

    Example: pupper-sysid doctor recordings/sweep.csv
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to examine, pooled per joint; by default the newest in recordings/."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the shuffles behind the z-score."""

    def run(self) -> None:
        """Examine and print."""
        from pupper_sysid.sysid.doctor.examination import examine
        from pupper_sysid.sysid.doctor.findings import USE, Finding, shared

        recordings = terminal.load_all(self.recordings)
        result = examine(recordings, seed=self.seed)
        if self.json:
            terminal.print_json(result)
            return
        title = result.recording if len(recordings) < 4 else f"{len(recordings)} recordings"
        table = terminal.table(
            title, "joint", "verdict", "loop ms", "jitter ms", "fresh %", "poll ms",
            "loss", "step mrad", "offset mrad",
        )  # fmt: skip
        for name, j in result.items():
            table.add_row(
                name, j.verdict, terminal.ms(j.loop_period_s, 2), terminal.ms(j.jitter_s, 2),
                terminal.number(100 * j.fresh_fraction, 0), terminal.ms(j.poll_period_s, 2),
                terminal.number(j.loss), terminal.ms(j.quantum_rad, 3),
                terminal.ms(j.reading_minus_command_rad),
            )  # fmt: skip
        terminal.out.print(table)
        terminal.out.print()
        nothing = (Finding("nothing_wrong", USE),)
        for joints, text in shared({name: j.findings or nothing for name, j in result.items()}):
            terminal.out.print(Text.assemble((joints, "bold"), f": {text}"))
        for text in result.advice:
            terminal.out.print(f"\n{text}")


@dataclass(frozen=True)
class Delay(OfRecordings):
    """Measure each joint's lag, and split it into bus, sensor and servo.

    Example: pupper-sysid delay recordings/sweep.csv --joints LF_thigh
    """

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.fit.dead_time import lag

        recordings, joints = self.load()
        with terminal.progress("measuring", len(joints)) as advance:
            budgets = lag(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            terminal.print_json(budgets)
            return
        budget = terminal.table(
            "Lag budget, ms: raw = stale readings + command hold + servo lag", "joint", "raw",
            "stale", "hold", "servo", "90 %", "of it dead time", "90 %",
        )  # fmt: skip
        for name, b in budgets.items():
            dead = b.dead_time_s
            assert dead is not None
            budget.add_row(
                name, terminal.ms(b.raw_lag_s.value), terminal.ms(b.stale_lag_s),
                terminal.ms(b.command_hold_s), terminal.ms(b.lag_s.value), _ends(b.lag_s),
                terminal.ms(dead.value), _ends(dead),
            )  # fmt: skip
        terminal.out.print(budget)
        terminal.out.print(
            "Only the dead time is the servo's own; the lag moves with gain, amplitude and load."
        )
        ranges = {name: [f"servo lag is the {b.lag_range}; its table by frequency has the lag of "
                         "a motion at each."] for name, b in budgets.items()
                  if b.lag_range.startswith("mean")}  # fmt: skip
        for names, text in share_sentences(ranges):
            terminal.out.print(f"{names}: {text}")
        shown = terminal.table(
            "Per frequency, fresh readings", "joint", "Hz", "gain", "phase °", "lag ms",
            "90 %", "raw lag ms", "raw gain",
        )  # fmt: skip
        for name, b in budgets.items():
            for f in b.by_frequency:
                shown.add_row(
                    name, terminal.number(f.frequency_hz), terminal.number(f.gain),
                    terminal.number(f.phase_deg, 0), terminal.ms(f.lag_s.value), _ends(f.lag_s),
                    terminal.ms(f.raw_lag_s), terminal.number(f.raw_gain),
                )  # fmt: skip
        if shown.row_count:
            terminal.out.print()
            terminal.out.print(shown)
        first = next(iter(budgets.values()))
        shown = terminal.table(f"Estimators on {first.joint}", "estimator", "lag ms")
        for name, value in first.estimators_s.items():
            shown.add_row(name, terminal.ms(value))
        terminal.out.print()
        terminal.out.print(shown)
        by_joint = {n: [w.removeprefix(f"{n}: ") for w in b.warnings] for n, b in budgets.items()}
        terminal.warn(*(f"{names}: {text}" for names, text in share_sentences(by_joint)))


def _ends(interval: Interval) -> str:
    # without spaces, at which a narrow table would break it
    return f"{terminal.ms(interval.low)}…{terminal.ms(interval.high)}"


@dataclass(frozen=True)
class Bode(OfRecordings):
    """Frequency response per joint: gain, phase, bandwidth, fitted transfer function.

    Example: pupper-sysid bode recordings/sweep.csv --plot bode.png
    """

    plot: Path | None = None
    """Also draw the Bode plot into this PNG or SVG file."""
    force: bool = False
    """Replace the plot if it exists."""

    def run(self) -> None:
        """Measure, draw and print."""
        from pupper_sysid.sysid.lag.frequency_response import frequency_response

        if self.plot:
            from pupper_sysid.common.figure_style import refuse_picture

            refuse_picture(self.plot, self.force)
        responses = frequency_response(*self.load(), self.seed)
        if self.plot:
            from pupper_sysid.common.figure_style import save

            save(responses.plot(), self.plot, self.force)
        if self.json:
            terminal.print_json(responses)
            return
        for joint, response in responses.items():
            terminal.out.print(Text(joint, "bold"))
            terminal.out.print(str(response))
            terminal.warn(*response.warnings)
        if self.plot:
            terminal.err.print(f"Wrote {self.plot}.")


@dataclass(frozen=True)
class Backlash(OfRecordings):
    """Measure hysteresis, dead zone and backlash from slow strokes up and down.

    Record them with `sweep --load pendulum:0.1kg@0.10m --gains 8,16,32 --kind reversal`.

    Example: pupper-sysid backlash recordings/reversal.csv
    """

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.backlash import backlash

        results = backlash(*self.load(), self.seed)
        if self.json:
            terminal.print_json(results)
            return
        table = terminal.table(
            "Width between strokes up and down, 90 % intervals",
            "joint", "P gain", "hysteresis °", "lag ms", "strokes",
        )  # fmt: skip
        for joint, one in results.items():
            for row in one.gains:
                table.add_row(
                    joint, terminal.number(row.p_gain, 0), _degrees(row.hysteresis_rad),
                    terminal.ms(row.lag_s.value, 0), str(row.strokes),
                )  # fmt: skip
        terminal.out.print(table)
        for joint, one in results.items():
            for name, value in (("dead zone", one.dead_zone_rad), ("backlash", one.backlash_rad)):
                text = "not determined" if value is None else f"{_degrees(value)}°"
                terminal.out.print(f"{joint}: {name} {text}")
            for note in one.notes:
                terminal.out.print(f"  {note}")


def _degrees(value: Interval) -> str:
    """Value and interval in degrees."""
    best, low, high = np.degrees([value.value, value.low, value.high])
    return f"{best:.2f} ({low:.2f} to {high:.2f})"
