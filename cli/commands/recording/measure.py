"""`doctor`, `delay`, `bode` and `backlash`: what recordings show without a model of the servo."""

from __future__ import annotations

from dataclasses import astuple, dataclass
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
        from pupper_sysid.sysid.report.tables import doctor_table

        recordings = terminal.load_all(self.recordings)
        result = examine(recordings, seed=self.seed)
        if self.json:
            terminal.print_json(result)
            return
        title = result.recording if len(recordings) < 4 else f"{len(recordings)} recordings"
        terminal.print_tables(doctor_table([(title, result)], result, title))
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
        from pupper_sysid.sysid.report.tables import estimator_table, frequency_table, lag_table

        recordings, joints = self.load()
        with terminal.progress("measuring", len(joints)) as advance:
            budgets = lag(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            terminal.print_json(budgets)
            return
        terminal.print_tables(lag_table(budgets))
        terminal.out.print(
            "Only the dead time is the servo's own; the lag moves with gain, amplitude and load."
        )
        ranges = {name: [f"servo lag is the {b.lag_range}; its table by frequency has the lag of "
                         "a motion at each."] for name, b in budgets.items()
                  if b.lag_range.startswith("mean")}  # fmt: skip
        for names, text in share_sentences(ranges):
            terminal.out.print(f"{names}: {text}")
        terminal.out.print()
        first = dict([next(iter(budgets.items()))])  # all joints are too wide
        terminal.print_tables(frequency_table(budgets), estimator_table(first))
        by_joint = {n: [w.removeprefix(f"{n}: ") for w in b.warnings] for n, b in budgets.items()}
        terminal.warn(*(f"{names}: {text}" for names, text in share_sentences(by_joint)))


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
        for joint, test in results.items():
            for row in test.gains:
                table.add_row(
                    joint, terminal.number(row.p_gain, 0), _degrees(row.hysteresis_rad),
                    terminal.ms(row.lag_s.value, 0), str(row.strokes),
                )  # fmt: skip
        terminal.out.print(table)
        for joint, test in results.items():
            for name, value in (("dead zone", test.dead_zone_rad), ("backlash", test.backlash_rad)):
                text = "not determined" if value is None else f"{_degrees(value)}°"
                terminal.out.print(f"{joint}: {name} {text}")
            for note in test.notes:
                terminal.out.print(f"  {note}")


def _degrees(value: Interval) -> str:
    best, low, high = np.degrees(astuple(value))
    return f"{best:.2f} ({low:.2f} to {high:.2f})"
