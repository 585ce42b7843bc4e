"""`doctor`, `delay` and `bode`: what a recording says before any model is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.lag.lag_budget import LagBudget


@dataclass(frozen=True)
class Doctor:
    """Is this log usable, and what is wrong with it?

    Example: pupper-sysid doctor recordings/sweep.csv
    """

    recording: tyro.conf.Positional[Path | None] = None
    """Recording to examine; by default the newest in recordings/."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the shuffles behind the z-score."""

    def run(self) -> None:
        """Examine and print."""
        import numpy as np

        from pupper_sysid.sysid.doctor import examination as doctor

        (recording,) = terminal.load_all([self.recording] if self.recording else [])
        found = doctor.examine(recording, np.random.default_rng(self.seed))
        if self.json:
            terminal.print_json(doctor.to_json(found))
            return
        shown = terminal.table(
            recording.name, "joint", "verdict", "loop ms", "jitter ms", "fresh %", "poll ms",
            "loss", "count mrad", "offset mrad",
        )  # fmt: skip
        for name, j in found.joints.items():
            shown.add_row(
                name, j.verdict, terminal.number(j.loop_period_ms),
                terminal.number(j.jitter_ms), terminal.number(100 * j.fresh_fraction, 0),
                terminal.number(j.poll_period_ms), terminal.number(j.loss),
                terminal.ms(j.quantum_rad, 3), terminal.ms(j.offset_rad),
            )  # fmt: skip
        terminal.out.print(shown)
        for name, j in found.joints.items():
            terminal.out.print(Text.assemble("\n", (name, "bold"), f": {j.verdict}"))
            for reason in j.reasons:
                terminal.out.print(f"  - {reason}", soft_wrap=True)


@dataclass(frozen=True)
class Delay:
    """How late is each joint, and is it the bus, the sensor or the servo?

    Example: pupper-sysid delay recordings/sweep.csv --joints LF_thigh
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the model's global start."""

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.identify import calibrate as calibration
        from pupper_sysid.sysid.report.json_objects import delay_json

        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        with terminal.progress("measuring", len(joints)) as advance:
            found = calibration.dead_times(recordings, joints, self.seed, progress=advance)
        if self.json:
            terminal.print_json(delay_json(found))
            return
        budget = terminal.table(
            "Lag budget, ms: naive = feedback age + command hold + servo lag", "joint", "naive",
            "feedback age", "command hold", "servo lag", "90 % interval", "of it dead time",
            "90 % interval",
        )  # fmt: skip
        for name, f in found.items():
            b, dead = f.budget, f.dead_time
            budget.add_row(
                name, terminal.ms(b.naive.value), terminal.ms(b.feedback_age_s),
                terminal.ms(b.command_hold_s), terminal.ms(b.lag.value),
                f"{terminal.ms(b.lag.low)} … {terminal.ms(b.lag.high)}",
                terminal.ms(dead.value), f"{terminal.ms(dead.low)} … {terminal.ms(dead.high)}",
            )  # fmt: skip
        terminal.out.print(budget)
        self._print_frequencies([f.budget for f in found.values()])
        first = next(iter(found.values())).budget
        shown = terminal.table(f"Estimators on {first.joint}", "estimator", "lag ms")
        for name, value in first.estimators.items():
            shown.add_row(name, terminal.ms(value))
        terminal.out.print()
        terminal.out.print(shown)
        for f in found.values():
            terminal.warn(f.budget.warnings)

    def _print_frequencies(self, budgets: list[LagBudget]) -> None:
        shown = terminal.table(
            "Per frequency, fresh readings", "joint", "Hz", "gain", "phase °", "lag ms",
            "90 % interval", "naive lag ms", "naive gain",
        )  # fmt: skip
        for b in budgets:
            for f in b.by_frequency:
                shown.add_row(
                    b.joint, terminal.number(f.frequency_hz), terminal.number(f.gain),
                    terminal.number(f.phase_deg, 0), terminal.ms(f.lag.value),
                    f"{terminal.ms(f.lag.low)} … {terminal.ms(f.lag.high)}",
                    terminal.ms(f.naive_lag_s), terminal.number(f.naive_gain),
                )  # fmt: skip
        if shown.row_count:
            terminal.out.print()
            terminal.out.print(shown)


@dataclass(frozen=True)
class Bode:
    """Frequency response per joint: gain, phase, bandwidth, fitted transfer function.

    Example: pupper-sysid bode recordings/sweep.csv --plot bode.png
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    plot: Path | None = None
    """Also draw the Bode plot into this PNG or SVG file."""
    force: bool = False
    """Replace the plot if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap."""

    def run(self) -> None:
        """Measure and print."""
        from pupper_sysid.sysid.identify import calibrate as calibration
        from pupper_sysid.sysid.lag import frequency_response

        if self.plot:
            from pupper_sysid.common.figure_style import refuse_picture

            refuse_picture(self.plot, self.force)
        recordings = terminal.load_all(self.recordings)
        found = {}
        for joint in terminal.pick_joints(recordings, self.joints):
            trials = calibration.joint_trials(recordings, joint)
            rng = calibration.joint_rng(self.seed, joint)
            found[joint] = frequency_response.frequency_response(joint, trials, rng)
        if self.plot:
            from pupper_sysid.common.figure_style import save
            from pupper_sysid.sysid.report.figures import bode_figure

            save(bode_figure(found), self.plot, self.force)
        if self.json:
            terminal.print_json(
                {"joints": {j: frequency_response.to_json(r) for j, r in found.items()}}
            )
            return
        for joint, response in found.items():
            terminal.out.print(Text(joint, "bold"))
            terminal.out.print(response.summary(), soft_wrap=True)
        if self.plot:
            terminal.err.print(f"Wrote {self.plot}.", soft_wrap=True)
