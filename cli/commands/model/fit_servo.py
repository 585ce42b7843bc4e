"""`fit-servo` and `sindy`: a servo model per joint, scored on unseen data; a sparse equation."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.common import OfRecordings, each_robot
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.sysid.sweep.excitation import TRIAL_S

if TYPE_CHECKING:
    from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split
    from pupper_sysid.sysid.sparse import Equations

_SHOWN = {
    "free_run_mrad": ("free run mrad", 1),
    "linear_mrad": ("linear mrad", 1),
    "delayed_pd_mrad": ("delayed PD mrad", 1),
    "persistence_mrad": ("persistence mrad", 1),
}
_SCORES = (
    ("rmse_free_run_rad", "free run"),
    ("rmse_held_rad", "held"),
    ("rmse_raw_rad", "raw"),
    ("rmse_one_step_rad", "one step"),
    ("linear_rmse_rad", "linear"),
    ("delayed_pd_rmse_rad", "PD"),
    ("persistence_rmse_rad", "persist."),
    ("repeatability_rad", "repeats"),
)


@dataclass(frozen=True)
class FitServo(OfRecordings):
    """Fit a model per joint that predicts, from commands alone, where the servo is.

    Example: pupper-sysid fit-servo recordings/walk.csv --train-loops 0,1 --test-loops 2

    Example: pupper-sysid fit-servo robots/ --arch fir --jobs 4
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings at one rate, pooled per joint; by default the newest in recordings/. A folder is a
    fleet: each recording in it is a robot of its own."""
    arch: Literal["mlp", "lstm", "fir", "delayed-pd", "sindy"] = "mlp"
    """Kind of model: networks, the linear filter they build on, or a physical model."""
    preset: Literal["default", "paper"] = "default"
    """paper: an mlp or lstm trained as in the paper, one step ahead from measured positions."""
    out: Path | None = None
    """Folder to write the model to; by default servo/, or the next free servo-2/, servo-3/, …; of a
    fleet the folder of its models, by default the given one's name and _servos."""
    train_loops: str = ""
    """Trials (loops) to train on, such as 0,1; goes with --test-loops."""
    test_loops: str = ""
    """Trials (loops) to test on, such as 2."""
    train_before: float | None = None
    """Train on the first seconds of each trial; goes with --test-after."""
    test_after: float | None = None
    """Test on what comes after so many seconds of each trial."""
    leave_one_frequency_out: bool = False
    """Test on each tone (or loop) with a model that has not seen it; what is done by default."""
    readings: Literal["auto", "fresh", "all"] = "auto"
    """Which readings count: fresh ones at the time they were taken, all rows as logged, or what
    suits the recording."""
    jobs: int = 2
    """Robots of a fleet that are fitted at the same time."""
    cluster: str | None = None
    """Dask scheduler to fit a fleet on, such as tls://host:8786. It executes code, and who
    controls it can run programs on this computer: see docs/exports.md."""
    force: bool = False
    """Replace the model in --out."""
    seed: int = 0
    """Seed of the networks, of the physical models' starts and of the bootstrap."""

    def run(self) -> None:
        """Fit, score, save, print."""
        refuse_outside("--jobs", self.jobs, *terminal.JOBS)
        for option, value in (
            ("--train-before", self.train_before), ("--test-after", self.test_after),
        ):  # fmt: skip
            if value is not None:
                refuse_outside(option, value, 0, TRIAL_S[1], "s")
        from pupper_sysid.servo_models.servo_file import CONTRACT
        from pupper_sysid.sysid.recordings.importers.recognise import is_fleet
        from pupper_sysid.sysid.servo_fit.fit import fit_servo

        split = self._split()
        if len(self.recordings) == 1 and is_fleet(self.recordings[0]):
            self._fleet(self.recordings[0], split)
            return
        if self.cluster is not None:
            raise InputError("--cluster is for a fleet: give the folder of its recordings.")
        folder, number = self.out or Path("servo"), 2
        # the next name that is free: trying another model must not cost the last one
        while self.out is None and (folder / CONTRACT).exists():
            folder, number = Path(f"servo-{number}"), number + 1
        refuse_overwrite(folder / CONTRACT, self.force)
        started = time.perf_counter()
        recordings, joints = self.load()
        with terminal.share_progress(f"fitting {self.arch}") as advance:
            fit = fit_servo(
                recordings, joints, self.arch, self.preset, split, self.readings, self.seed,
                advance, keep_unfinished=False,
            )  # fmt: skip
        elapsed = time.perf_counter() - started
        fit.save(folder, self.force)
        if self.json:
            terminal.print_json(fit.to_dict() | {"elapsed_s": elapsed, "written": str(folder)})
            return
        self._print(fit)
        terminal.warn(*fit.notes)
        terminal.err.print(
            f"Wrote {folder}/ in {elapsed:.0f} s. Next: "
            + terminal.command("pupper-sysid", "compare", *self.recordings, "--models", folder)
        )

    def _fleet(self, root: Path, split: Split) -> None:
        """Many robots, one after the other or side by side."""
        from pupper_sysid.sysid.fleet import ServoSettings, fit_servo_fleet

        if self.joints != "all":
            raise InputError("--joints: a fleet is fitted with all its joints; leave it out.")
        settings = ServoSettings(self.arch, self.preset, split, self.readings, self.seed)
        each_robot(
            self, root, f"fitting {self.arch}", "servos", "a servo model", _SHOWN,
            lambda out, advance: fit_servo_fleet(
                root, out, settings, self.jobs, self.cluster, self.force, advance
            ),
        )  # fmt: skip

    def _split(self) -> Split:
        from pupper_sysid.sysid.servo_fit.fit import EACH_GROUP_IN_TURN, Split

        loops, times = (self.train_loops, self.test_loops), (self.train_before, self.test_after)
        ways = [any(loops), times != (None, None), self.leave_one_frequency_out]
        if sum(ways) > 1:
            raise InputError(
                "Choose one way to hold data out: --train-loops with --test-loops, --train-before "
                "with --test-after, or --leave-one-frequency-out."
            )
        if any(loops):
            if not all(loops):
                raise InputError("--train-loops and --test-loops go together, such as 0,1 and 2.")
            return Split.by_trials(
                terminal.whole_numbers("--train-loops", loops[0]),
                terminal.whole_numbers("--test-loops", loops[1]),
            )
        if times == (None, None):
            return EACH_GROUP_IN_TURN
        if self.train_before is None or self.test_after is None:
            raise InputError("--train-before and --test-after go together, such as 2 and 2.")
        return Split.by_time(self.train_before, self.test_after)

    def _print(self, fit: ServoFit) -> None:
        table = terminal.table(
            f"{fit.arch}, {fit.split}; RMS error in mrad", "joint", *(title for _, title in _SCORES)
        )
        for name, scores in fit.joints.items():
            table.add_row(name, *(terminal.ms(getattr(scores, key)) for key, _ in _SCORES))
        if len(fit.joints) > 1:
            means = (terminal.ms(getattr(fit.mean, key)) for key, _ in _SCORES)
            table.add_row("mean", *means, style="bold")
        terminal.out.print(table)
        terminal.out.print(
            "\nFree run: commands only, from the start of each run. DelayedPD (PD), the linear "
            "filter and the model were fitted to the same readings and scored on the same unseen "
            "ones."
        )
        terminal.out.print(Text(f"\n{fit.verdict}", "bold"))


@dataclass(frozen=True)
class Sindy(OfRecordings):
    """A short equation of motion per joint, with units (SINDy, refined by output error).

    Example: pupper-sysid sindy recordings/sweep.csv --joints LF_thigh
    """

    def run(self) -> None:
        """Find the equations and print them."""
        from pupper_sysid.sysid.sparse import sparse_equations

        started = time.perf_counter()
        recordings, joints = self.load()
        with terminal.progress("finding equations", len(joints)) as advance:
            results = sparse_equations(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            terminal.print_json(results)
            return
        self._print(results)
        terminal.err.print(f"Took {time.perf_counter() - started:.1f} s.")

    def _print(self, results: Equations) -> None:
        for name, r in results.items():
            terminal.out.print(Text.assemble((name, "bold"), f": {r.equation}"))
            for line in r.explanation():
                terminal.out.print(f"  - {line}")
            terminal.out.print()
        table = terminal.table(
            "Free-run error, mrad", "joint", "equation, fresh", "all rows", "unseen Hz",
            "DelayedPD, fresh", "unseen Hz", "structures tried",
        )  # fmt: skip
        for name, r in results.items():
            table.add_row(
                name, terminal.ms(r.scores.rmse_fresh_rad), terminal.ms(r.scores.rmse_held_rad),
                terminal.ms(r.scores.rmse_unseen_rad),
                terminal.ms(r.delayed_pd.rmse_fresh_rad),
                terminal.ms(r.delayed_pd.rmse_unseen_rad), str(len(r.candidates)),
            )  # fmt: skip
        terminal.out.print(table)
        terminal.out.print(
            "\nq: joint angle, u: command, e: error. Per unit of inertia; each reading is compared "
            "with the motion at the time it was measured, none is fed back."
        )
        for r in results.values():
            terminal.warn(*r.warnings)
