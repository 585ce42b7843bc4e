"""Commands that fit and compare servo models; of calibrations and servo models also for fleets."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.terminal import Joints, Json, OfRecordings, ms, number
from pupper_sysid.common.errors import InputError, PupperError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite, resolved
from pupper_sysid.common.joints import (
    JOINT_NAMES,
    STALL_TORQUE_NM,
    STALL_TORQUE_SOURCE,
    STALL_TORQUES_NM,
)
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of, words_of
from pupper_sysid.sysid.report.tables import comparison_tables
from pupper_sysid.sysid.sweep.excitation import TRIAL_S

if TYPE_CHECKING:
    from pupper_sysid.sysid.fit.calibrate import CalibrationResult
    from pupper_sysid.sysid.fleet import Product
    from pupper_sysid.sysid.servo_fit.fit import ServoFit, Split

Readings = Annotated[
    Literal["auto", "fresh", "all"],
    tyro.conf.arg(
        help="Which readings count: fresh ones at the time they were taken, all raw rows, or "
        "what suits the recording."
    ),
]

_JOBS = (1, 1024)  # robots of a fleet that are computed at the same time
_OF_CALIBRATIONS = {
    "lag_ms": ("lag ms", 1), "dead_time_ms": ("dead time ms", 1),
    "stiffness_per_s2": ("stiffness 1/s²", 0), "speed_rad_s": ("speed rad/s", 2),
    "loss": ("loss", 2),
}  # fmt: skip


@dataclass(frozen=True)
class Calibrate(OfRecordings):
    """Fit a servo model per joint and write it as YAML, with intervals and caveats.

    Example: pupper-sysid calibrate recordings/sweep.csv --out calibrated.yaml

    Example: pupper-sysid calibrate short.csv --from sts3215-12v --out mine.yaml

    Example: pupper-sysid calibrate robots/ --jobs 4
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/. A folder is a fleet: each
    recording in it is a robot of its own."""
    out: Path | None = None
    """Calibration file to write, calibrated.yaml by default; of a fleet the folder, by default the
    given one's name and _calibrated."""
    stall_torque: float | None = None
    """Torque the servo stalls at [N·m]: sets the scale of all torques and of the armature. By
    default of the recorded servo's data sheet, else that of --from; a recording with a known load
    needs none."""
    prior: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Calibration or servo card (`pupper-sysid servo list`) of another unit of the servo: its
    numbers are the prior, so that 20 s in free air are enough."""
    jobs: int = 2
    """Robots of a fleet that are calibrated at the same time."""
    cluster: str | None = None
    """Dask scheduler to calibrate a fleet on, such as tls://host:8786. It executes code, and who
    controls it can run programs on this computer: see docs/exports.md."""
    force: bool = False
    """Replace the calibration file if it exists."""

    def run(self) -> None:
        """Calibrate, print, write."""
        refuse_outside("--stall-torque", self.stall_torque, *STALL_TORQUES_NM, "N·m")
        from pupper_sysid.sysid.fit.calibrate import STAGES, calibrate

        if root := _fleet_of(self):
            return self._fleet(root)
        out = self.out or Path("calibrated.yaml")
        refuse_overwrite(out, self.force)  # before the work, not after it
        if out.suffix.lower() not in (".yaml", ".yml"):
            raise InputError(f"--out {out}: a calibration is a .yaml file. Choose another name.")
        started = time.perf_counter()
        recordings, joints = self.load()
        stages = dict.fromkeys(joints, len(STAGES))
        with terminal.progress("calibrating", sum(stages.values())) as advance:

            def staged(joint: str, stage: str) -> None:
                stages[joint] -= 1
                advance(f"{joint}, {stage}")

            def done(joint: str) -> None:  # joints under load have fewer stages
                for _ in range(stages.pop(joint)):
                    advance(joint)

            result = calibrate(
                recordings, joints, self.seed, self.stall_torque,
                workers=2, progress=done, staged=staged, prior=self.prior,
            )  # fmt: skip
        result.save(out, force=self.force)
        if self.json:
            return terminal.print_json(result)
        self._print(result)
        following = ("report", *self.recordings, "--calibration", out)
        terminal.err.print(
            f"Wrote {out} in {time.perf_counter() - started:.1f} s. Next: "
            + terminal.command("pupper-sysid", *following)
        )

    def _fleet(self, root: Path) -> None:
        """Many robots, one after the other or side by side."""
        from pupper_sysid.sysid.fleet import Calibrations

        if self.prior is not None:
            raise InputError("--from: a fleet is calibrated without a prior; leave it out.")
        if self.joints != "all":
            raise InputError("--joints: a fleet is calibrated with all its joints; leave it out.")
        each_robot(
            self, root, "calibrating", "calibrated", "a calibration", _OF_CALIBRATIONS,
            Calibrations(self.seed, self.stall_torque),
        )  # fmt: skip

    def _print(self, result: CalibrationResult) -> None:
        rows = []
        for name, r in result.items():
            joint, scores = result.calibration.joint(name), r.delayed_pd.scores
            a = joint.actuator
            brakes = a.back_emf_nm_s_per_rad.value > 0
            limit = a.back_emf_nm_s_per_rad if brakes else a.velocity_limit_rad_s
            damping = _number(a.damping_nm_s_per_rad, 3)
            total = a.ratios_to_armature.damping_and_back_emf
            if damping.endswith("?") and total is not None and total.identified != "no":
                damping = f"{number(a.armature_kg_m2.value * total.value, 3)}Σ"
            rows.append((
                name, _number(a.dead_time_s, 1, 1e3),
                f"{1e3 * r.dead_time_s.low:.0f}–{1e3 * r.dead_time_s.high:.0f}",
                number(joint.scores.residual_over_noise, 1),
                _number(a.stiffness_nm_per_rad, 1), damping, _number(a.friction_loss_nm, 3),
                f"{number(a.top_speed_rad_s)}{_unidentified(limit)}", "EMF" if brakes else "slew",
                ms(scores.rmse_fresh_rad), ms(scores.rmse_unseen_rad),
            ))  # fmt: skip
        terminal.print_table(
            "DelayedPD per joint", "joint", "dead time ms", "90 %", "fit", "Kp", "Kd", "fric. N·m",
            "speed rad/s", "limit", "error mrad", "unseen mrad", rows=rows,
        )  # fmt: skip
        scales = {name: result.calibration.joint(name).actuator.scale for name in result}
        assumed = {s.value_nm for s in scales.values() if s.anchor == "stall torque"}
        torques = "Torques are in N·m by the known load. "
        if assumed:
            listed = " and ".join(f"{t:.3g}" for t in sorted(assumed))
            torques = (
                f"Torques assume a stall torque of {listed} N·m; recordings without a "
                "known load give only their ratios. "
            )
        terminal.out.print(
            "\nfit: errors over the noise of the readings; about 1 where the model describes the "
            f"servo. {torques}? is not identified; Σ: damping and back-EMF together; "
            "limit: what limits the speed, the set-point's slew or back-EMF (EMF). Errors are "
            "free-run, on fresh readings."
        )
        for point, names in result.calibration.operating_points().items():
            terminal.out.print(f"{', '.join(names)}: {point}.")
        for r in result.values():
            terminal.warn(*r.warnings)
        of_pupper = [n for n, scale in scales.items() if scale.source == STALL_TORQUE_SOURCE]
        if strangers := [name for name in of_pupper if name not in JOINT_NAMES]:
            terminal.warn(
                f"{', '.join(strangers)}: {STALL_TORQUE_NM:g} N·m is the stall torque of the Mini "
                "Pupper's servo. Give --stall-torque from your servo's data sheet: all torques "
                "scale with it."
            )


def _unidentified(quantity: Quantity) -> str:
    return "?" if quantity.identified == "no" else ""


def _number(quantity: Quantity, decimals: int, factor: float = 1.0) -> str:
    return f"{number(factor * quantity.value, decimals)}{_unidentified(quantity)}"


_OF_SERVO_MODELS = {
    "free_run_mrad": ("free run mrad", 1), "linear_mrad": ("linear mrad", 1),
    "delayed_pd_mrad": ("delayed PD mrad", 1), "persistence_mrad": ("persistence mrad", 1),
}  # fmt: skip
_SCORES = {
    "rmse_free_run_rad": "free run", "rmse_held_rad": "held", "rmse_raw_rad": "raw",
    "rmse_one_step_rad": "one step", "linear_rmse_rad": "linear", "delayed_pd_rmse_rad": "PD",
    "persistence_rmse_rad": "persist.", "repeatability_rad": "repeats",
}  # fmt: skip


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
    readings: Readings = "auto"
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
        refuse_outside("--train-before", self.train_before, 0, TRIAL_S[1], "s")
        refuse_outside("--test-after", self.test_after, 0, TRIAL_S[1], "s")
        from pupper_sysid.servo_models.servo_file import CONTRACT
        from pupper_sysid.sysid.servo_fit.fit import fit_servo

        split = self._split()
        if root := _fleet_of(self):
            return self._fleet(root, split)
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
            about = {"elapsed_s": elapsed, "written": str(folder)}
            return terminal.print_json(fit.to_dict() | about)
        self._print(fit)
        terminal.warn(*fit.notes)
        terminal.err.print(
            f"Wrote {folder}/ in {elapsed:.0f} s. Next: "
            + terminal.command("pupper-sysid", "compare", *self.recordings, "--models", folder)
        )

    def _fleet(self, root: Path, split: Split) -> None:
        """Many robots, one after the other or side by side."""
        from pupper_sysid.sysid.fleet import ServoModels

        if self.joints != "all":
            raise InputError("--joints: a fleet is fitted with all its joints; leave it out.")
        each_robot(
            self, root, f"fitting {self.arch}", "servos", "a servo model", _OF_SERVO_MODELS,
            ServoModels(self.arch, self.preset, split, self.readings, self.seed),
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
        joints = dict(fit.joints) | ({"mean": fit.mean} if len(fit.joints) > 1 else {})
        table = terminal.table(
            f"{fit.arch}, {fit.split}; RMS error in mrad", "joint", *_SCORES.values(),
            rows=((name, *(ms(getattr(s, key)) for key in _SCORES)) for name, s in joints.items()),
        )  # fmt: skip
        if len(fit.joints) > 1:
            table.rows[-1].style = "bold"
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
            return terminal.print_json(results)
        for name, r in results.items():
            terminal.out.print(Text.assemble((name, "bold"), f": {r.equation}"))
            for line in r.explanation():
                terminal.out.print(f"  - {line}")
            terminal.out.print()
        terminal.print_table(
            "Free-run error, mrad", "joint", "equation, fresh", "all rows", "unseen Hz",
            "DelayedPD, fresh", "unseen Hz", "structures tried",
            rows=(
                (name, *map(ms, (
                    r.scores.rmse_fresh_rad, r.scores.rmse_held_rad, r.scores.rmse_unseen_rad,
                    r.delayed_pd.rmse_fresh_rad, r.delayed_pd.rmse_unseen_rad,
                )), len(r.candidates))
                for name, r in results.items()
            ),
        )  # fmt: skip
        terminal.out.print(
            "\nq: joint angle, u: command, e: error. Per unit of inertia; each reading is compared "
            "with the motion at the time it was measured, none is fed back."
        )
        for r in results.values():
            terminal.warn(*r.warnings)
        terminal.err.print(f"Took {time.perf_counter() - started:.1f} s.")


_UNITS = {"_rad_s": ("rad/s", 1.0, 2), "_rad": ("mrad", 1e3, 2), "_s": ("ms", 1e3, 2)}


@dataclass(frozen=True)
class Compare(OfRecordings):
    """Which model moves like the servo? Free run of each on the same recording, per joint.

    Every model predicts readings: with the age that the bus gives them, and the offset of this
    recording. A calibration of a sweep on the same bus gives the poll where a recording of another
    motion does not show it.

    Example: pupper-sysid compare recordings/playback.csv --models servo/ calibrated.yaml
    """

    models: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL [MODEL ...]")] = ()
    """Folders of fit-servo, calibration files, servo cards (names or files), or presets (paper,
    release)."""
    readings: Readings = "auto"
    plot: Path = Path("compare.png")
    """Picture to draw, PNG or SVG."""
    force: bool = False
    """Replace the picture if it exists."""

    def run(self) -> None:
        """Compare, print, draw."""
        from pupper_sysid.common.figure_style import refuse_picture, save
        from pupper_sysid.sysid.compare.compare import compare

        if not self.models:
            raise InputError(
                "Nothing to compare: name models, such as `--models servo/ calibrated.yaml`."
            )
        refuse_picture(self.plot, self.force)
        recordings, joints = self.load()
        models = [
            name
            for text in self.models
            for name in ([text] if Path(text).exists() else text.split(","))
        ]
        result = compare(recordings, models, joints, self.readings, self.seed)
        save(result.plot(), self.plot, self.force)
        if self.json:
            return terminal.print_json(result.to_dict() | {"written": str(self.plot)})
        terminal.print_tables(*comparison_tables(result))
        for sentence in result.reading_notes():
            terminal.out.print(sentence)
        terminal.warn(*result.notes)
        terminal.err.print(f"Wrote {self.plot}.")


@dataclass(frozen=True)
class CompareTruth:
    """Each calibrated number beside the true one of an emulated robot.

    `sweep --truth` writes the truth beside the recording, `emulate ... --truth FILE` that of a
    robot behind a real protocol. Where the interval holds it, the last column says yes; of many
    robots that should be nine in ten.

    Example: pupper-sysid compare-truth sweep.csv calibrated.yaml
    """

    recording: tyro.conf.Positional[Path]
    """Recording of an emulated robot."""
    calibration: tyro.conf.Positional[Path | None] = None
    """Calibration file; by default the recording is calibrated now."""
    truth: Path | None = None
    """File of the true parameters; by default the .truth.yaml beside the recording."""
    joints: Joints = "all"
    json: Json = False
    seed: int = 0
    """Seed of the calibration, where none is given."""

    def run(self) -> None:
        """Calibrate if need be, compare, print."""
        from pupper_sysid.sysid.compare.truth import read_truth, truth_table
        from pupper_sysid.sysid.fit.calibrate import calibrate

        truth = read_truth(self.recording, self.truth)  # before the work, not after it
        (recording,) = terminal.load_all([self.recording])
        joints = terminal.pick_joints([recording], self.joints)
        if self.calibration:
            fitted = load_calibration(self.calibration)
        else:
            with terminal.progress("calibrating", len(joints)) as advance:
                fitted = calibrate(
                    recording, joints, self.seed, workers=2, progress=advance
                ).calibration
        rows = truth_table(fitted, truth, recording, joints)
        if self.json:
            return terminal.print_json(rows)
        cells = []
        for row in rows:
            end = next((end for end in _UNITS if row.quantity.endswith(end)), "")
            places = 3 if abs(row.truth) < 1 else max(0, 3 - len(f"{abs(row.truth):.0f}"))
            unit, factor, digits = _UNITS.get(end, (unit_of(row.quantity), 1.0, places))
            value, low, high, true = (
                number(factor * x, digits)
                for x in (row.found.value, row.found.low, row.found.high, row.truth)
            )
            cells.append((
                row.joint, f"{words_of(row.quantity)}, {unit}".removesuffix(", 1"), value,
                f"{low}…{high}", true, row.identified,
                {True: "yes", False: "no", None: "–"}[row.held],
            ))  # fmt: skip
        terminal.print_table(
            "Found and true", "joint", "quantity", "found", "90 % interval", "truth", "identified",
            "held", rows=cells,
        )  # fmt: skip
        known_rows = [row for row in rows if row.held is not None and row.identified != "no"]
        held = sum(bool(row.held) for row in known_rows)
        terminal.out.print(
            f"\n{held} of {len(known_rows)} intervals of identified numbers hold the truth. "
            "stiffness, damping, friction loss, effort limit and back-EMF are ratios to the "
            "armature."
        )
        for definition in rows.definitions:
            terminal.out.print(f"Both sides of {definition}")
        terminal.warn(*rows.notes)


def _fleet_of(options: Any) -> Path | None:
    """Folder of the fleet that `--jobs` and `--cluster` are for, if the recordings are one."""
    from pupper_sysid.sysid.recordings.importers.recognise import is_fleet

    refuse_outside("--jobs", options.jobs, *_JOBS)
    if len(options.recordings) == 1 and is_fleet(options.recordings[0]):
        return options.recordings[0]
    if options.cluster is not None:
        raise InputError("--cluster is for a fleet: give the folder of its recordings.")
    return None


def each_robot(
    options: Any,
    root: Path,
    doing: str,
    ending: str,
    what: str,
    columns: Mapping[str, tuple[str, int]],
    product: Product,
) -> None:
    """Have a fleet's results made, and print its joints, outliers and failed recordings.

    The folder is by default that of the recordings and an `ending`. `what` names the result per
    robot; `columns` gives title and digits by column of the table. A recording that could not be
    used is a `PupperError` at the end: the exit code says so, too.
    """
    from pupper_sysid.sysid.fleet import TABLE, robots_in, run_fleet, trust

    started = time.perf_counter()
    folder = options.out or resolved(root).with_name(f"{resolved(root).name}_{ending}")
    if options.cluster is not None:
        terminal.warn(trust(options.cluster))
    with terminal.progress(doing, len(robots_in(root))) as advance:
        fleet = run_fleet(
            root, folder, product, options.jobs, options.cluster, options.force, advance
        )
    elapsed_s = time.perf_counter() - started
    if options.json:
        terminal.print_json(fleet.summary(folder, elapsed_s))
    else:
        known = fleet.table.query("problem == ''")
        terminal.print_table(
            "Fleet: median and middle 90 % of the robots", "joint", "robots",
            *(title for title, _ in columns.values()),
            rows=(
                (joint, len(rows), *(_spread(rows[key], n) for key, (_, n) in columns.items()))
                for joint, rows in known.groupby("joint", sort=False)
            ),
        )  # fmt: skip
        for _, row in known.query("outliers != ''").iterrows():
            terminal.out.print(
                f"{row['robot']} {row['joint']} is an outlier: "
                f"{', '.join(str(row['outliers']).split(';'))}."
            )
        for name, problem in sorted(fleet.problems.items()):
            terminal.warn(f"{name} was left out: {problem}")
        terminal.err.print(
            f"{len(fleet.made)} made, {len(fleet.kept)} kept, {len(fleet.failed)} failed in "
            f"{elapsed_s:.0f} s. Wrote {folder / TABLE} and {what} per robot beside it."
        )
    if fleet.failed:
        raise PupperError(
            f"{len(fleet.failed)} of {len(fleet.failed) + len(fleet.made) + len(fleet.kept)} "
            f"recordings could not be used: {', '.join(sorted(fleet.failed)[:5])}"
            f"{' …' if len(fleet.failed) > 5 else ''}. The others are done; {folder / TABLE} says "
            "why."
        )


def _spread(values: Any, digits: int) -> str:
    """Median and middle 90 % of a pandas column; a single value as it is."""
    if values.count() == 1:
        return number(values.median(), digits)
    return "{} ({} … {})".format(*(number(x, digits) for x in values.quantile([0.5, 0.05, 0.95])))
