"""What recordings show, as text, page and files for others; and recordings from elsewhere."""

from __future__ import annotations

import filecmp
import webbrowser
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro
from rich.text import Text

from pupper_sysid.cli import terminal
from pupper_sysid.cli.live_views import refuse_files
from pupper_sysid.cli.terminal import Json, OfRecordings, Replace
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, resolved, write_bytes
from pupper_sysid.common.joints import JOINT_NAMES, with_joints
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sysid.report import tables

if TYPE_CHECKING:
    from pupper_sysid.common.interval import Interval


@dataclass(frozen=True)
class Doctor:
    """Check whether a recording is usable, and what is wrong with it.

    Example: pupper-sysid doctor recordings/sweep.csv
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to examine, pooled per joint; by default the newest in recordings/."""
    json: Json = False
    seed: int = 0
    """Seed of the shuffles behind the z-score."""

    def run(self) -> None:
        """Examine and print."""
        from pupper_sysid.sysid.doctor.examination import examine
        from pupper_sysid.sysid.doctor.findings import USE, Finding, shared

        recordings = terminal.load_all(self.recordings)
        result = examine(recordings, seed=self.seed)
        if self.json:
            return terminal.print_json(result)
        title = result.recording if len(recordings) < 4 else f"{len(recordings)} recordings"
        terminal.print_tables(tables.doctor_table([(title, result)], result, title))
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
        from pupper_sysid.sysid.fit.calibrate import lag

        recordings, joints = self.load()
        with terminal.progress("measuring", len(joints)) as advance:
            budgets = lag(recordings, joints, self.seed, workers=2, progress=advance)
        if self.json:
            return terminal.print_json(budgets)
        terminal.print_tables(tables.lag_table(budgets))
        terminal.out.print(
            "Only the dead time is the servo's own; the lag moves with gain, amplitude and load."
        )
        ranges = {name: [f"servo lag is the {b.lag_range}; its table by frequency has the lag of "
                         "a motion at each."] for name, b in budgets.items()
                  if b.lag_range.startswith("mean")}  # fmt: skip
        for text in with_joints(ranges):
            terminal.out.print(text)
        terminal.out.print()
        first = dict([next(iter(budgets.items()))])  # all joints are too wide
        terminal.print_tables(tables.frequency_table(budgets), tables.estimator_table(first))
        if len(budgets) > 1:
            terminal.out.print("The other joints' estimates are in --json, and in the report.")
        terminal.warn(*with_joints({name: b.warnings for name, b in budgets.items()}))


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
            return terminal.print_json(responses)
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
            return terminal.print_json(results)
        terminal.print_table(
            "Width between strokes up and down, 90 % intervals",
            "joint", "P gain", "hysteresis °", "lag ms", "strokes",
            rows=(
                (joint, terminal.number(row.p_gain, 0), _degrees(row.hysteresis_rad),
                 terminal.ms(row.lag_s.value, 0), row.strokes)
                for joint, test in results.items() for row in test.gains
            ),
        )  # fmt: skip
        for joint, test in results.items():
            for name, value in (("dead zone", test.dead_zone_rad), ("backlash", test.backlash_rad)):
                text = "not determined" if value is None else f"{_degrees(value)}°"
                terminal.out.print(f"{joint}: {name} {text}")
            for note in test.notes:
                terminal.out.print(f"  {note}")


def _degrees(value: Interval) -> str:
    best, low, high = np.degrees(astuple(value))
    return f"{best:.2f} ({low:.2f} to {high:.2f})"


@dataclass(frozen=True)
class Import:
    """Turn another project's log into a recording file, and say what was assumed.

    The layout is found by content: LeRobot dataset, SAGE folder, BAM or ktune JSON, MCAP, rosbag2,
    NumPy or torch arrays, parquet, or a table of text with any joint names and separators. Other
    commands read such logs directly; import them to name columns, units or joints, or to look at
    the rows.

    Example: pupper-sysid import arm.csv --time t_ms --command 'goal.{joint}' --position
    'present.{joint}' --unit deg --read-before-send
    """

    log: tyro.conf.Positional[Path]
    """File or folder."""
    out: Path | None = None
    """Recording to write; by default the log's name and .csv, in this folder; NAME_recording.csv
    where that is the log itself."""
    time: str | None = None
    """Column of the time, by name, or by number from 0 in a file without names."""
    command: str | None = None
    """Columns of commands, {joint} for the joint's name: action.{joint}; or several: 1,4,7. ROS:
    the topic."""
    position: str | None = None
    """Columns of positions: observation.state.{joint}. ROS: the topic."""
    trial: str | None = None
    """Column that numbers or names trials or episodes."""
    joints: str | None = None
    """Joints to read, with commas, by the log's names: a,b; by default all."""
    unit: str | None = None
    """Of angles: rad, deg, counts:4096 (of a turn; counts:4096:0 around 0), percent:3.5 (rad that
    −100 … 100 span) or scale:0.01 (rad per unit); deg,rad of commands and positions."""
    read_before_send: bool = False
    """A turn reads the position before it sends the command."""
    stamp: Literal["start", "middle", "end"] | None = None
    """Where in a turn (a command sent, a position read) its time stamp was taken."""
    command_time: str | None = None
    """Column of the times at which commands were sent; --time is then that of the readings."""
    send_after: str | None = None
    """Time from the reading to the command: 3ms; --send-after=-2ms for a command before it."""
    rate: float | None = None
    """Rows a second (Hz), for a log without times or with nominal ones."""
    readings: Literal["live", "polled"] | None = None
    """Whether a reading is the present position or that of the bus's last poll."""
    mapping: Path | None = None
    """YAML file with these options as keys, new names and units of joints; see docs/formats.md."""
    force: bool = False
    """Replace the recording if it exists."""
    json: Json = False

    def run(self) -> None:
        """Read, check, write."""
        from pupper_sysid.sysid.recordings.files import load, plain_stem
        from pupper_sysid.sysid.recordings.importers import options as importing

        name = plain_stem(resolved(self.log))
        out = self.out or Path(f"{name}.csv")
        if out.exists() and self.log.exists() and out.samefile(self.log):  # also by links
            if self.out:
                raise InputError(f"--out {out} is the log itself. Choose another name.")
            out = Path(f"{name}_recording.csv")
        refuse_overwrite(out, self.force)
        names = [] if self.joints is None else [part.strip() for part in self.joints.split(",")]
        if not all(names) or len(set(names)) < len(names):
            raise InputError(
                f"--joints '{self.joints}': write the log's names once each, with commas: a,b."
            )
        options = importing.LogOptions(
            self.time, self.command, self.position, self.trial,
            {name: name for name in names},
            self.unit, {}, self.read_before_send or None, self.stamp, self.command_time,
            self.send_after, self.rate, self.readings,
        )  # fmt: skip
        if self.mapping:
            options = importing.merged(options, importing.read_mapping(self.mapping))
        recording = load(self.log, options)
        recording.save(out, self.force)
        terminal.warn(*recording.warnings)
        layout = recording.metadata.get("imported_from", "recording of this project")
        if self.json:
            return terminal.print_json({
                "written": out, "imported_from": layout, "joints": recording.joints,
                "rows": len(recording.table), "loop_period_s": recording.loop_period_s,
                "warnings": recording.warnings,
            })  # fmt: skip
        by_joint = recording.table.groupby("joint")
        ranges = by_joint[["command_rad", "position_rad"]].agg(["min", "max"])
        counts, rows = by_joint.size(), []
        for joint in recording.joints:
            trials = recording.trials(joint)
            seconds = sum(float(t.send_time_s[-1] - t.send_time_s[0]) for t in trials)
            ends = ranges.loc[joint].to_numpy().reshape(2, 2)
            rows.append((joint, len(trials), counts[joint], terminal.number(seconds),
                         *(f"{low:.2f} … {high:.2f}" for low, high in ends)))  # fmt: skip
        terminal.print_table(
            f"{self.log}: {layout}", "joint", "trials", "rows", "s", "command rad", "position rad",
            rows=rows,
        )  # fmt: skip
        following = terminal.command("pupper-sysid", "doctor", out)
        terminal.err.print(f"Wrote {out}. Next: {following}")


@dataclass(frozen=True)
class View:
    """Write a recording as a file for Rerun (.rrd) or Foxglove (.mcap).

    Commands, readings and their ages per joint; with Rerun also the robot in three dimensions.
    Example: pupper-sysid view recordings/sweep.csv --rerun sweep.rrd
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recording to show; by default the newest in recordings/."""
    rerun: Path | None = None
    """File to write for Rerun, .rrd."""
    mcap: Path | None = None
    """File to write in ROS 2's messages for Foxglove, .mcap; `import` reads it back."""
    model: Path | None = None
    """MJCF or URDF of the robot that Rerun shows; by default it is the Mini Pupper where the joints
    are."""
    force: Replace = False

    def run(self) -> None:
        """Read and write."""
        from pupper_sysid.sysid.view import write_mcap, write_rerun

        if self.rerun is None and self.mcap is None:
            raise InputError("Nothing to write: give --rerun FILE.rrd, --mcap FILE.mcap or both.")
        if self.model is not None and self.rerun is None:
            raise InputError("--model: only a Rerun file shows the robot; add --rerun FILE.rrd.")
        refuse_files(self.force, rerun=self.rerun, mcap=self.mcap)
        recordings = terminal.load_all(self.recordings)
        if len(recordings) != 1:
            raise InputError(f"view: {len(recordings)} recordings were given; give one.")
        (recording,) = recordings
        if self.mcap is not None:
            write_mcap(recording, self.mcap, self.force)
        if self.rerun is not None:
            time_s, bodies = np.empty(0), []
            if self.model is not None or set(recording.joints) <= set(JOINT_NAMES):
                from pupper_sysid.policies.twin.drawing import robot_over_time

                time_s, bodies = robot_over_time(recording, self.model)
            write_rerun(recording, self.rerun, time_s, bodies, self.force)
        for path in filter(None, (self.rerun, self.mcap)):
            terminal.out.print(f"Wrote {path}")
        if self.rerun is not None:
            terminal.out.print(f"Next:\n  {terminal.command('rerun', self.rerun)}")


@dataclass(frozen=True)
class Report(OfRecordings):
    """Write one HTML page that opens anywhere, with its figures as PNG and SVG, its tables as CSV.

    Example: pupper-sysid report recordings/sweep.csv --out reports/sweep

    Example: pupper-sysid report --open
    """

    out: Path | None = None
    """Folder to write; by default reports/ and the first recording's name."""
    calibration: Path | None = None
    """Calibration made from these recordings: it is shown, and only joints under load are fitted
    again."""
    servo: tuple[str, ...] = ()
    """Servo models of fit-servo to show on these recordings, beside the calibration."""
    open: bool = False
    """Show it in the browser when it is written."""
    force: bool = False
    """Replace files of a report that is there already."""

    def run(self) -> None:
        """Examine, measure, calibrate, write."""
        # imported here: drawing and python-control take a second, which --help should not
        from pupper_sysid.sysid.report.report import PAGE, write_report

        recordings = terminal.load_all(self.recordings)
        folder = self.out or Path("reports") / recordings[0].name
        refuse_overwrite(folder / PAGE, self.force)
        calibration = load_calibration(self.calibration) if self.calibration else None
        with terminal.share_progress("report") as advance:
            written = write_report(
                recordings, folder, joints=self.joints, calibration=calibration, models=self.servo,
                seed=self.seed, workers=2, force=self.force, progress=advance,
            )  # fmt: skip
        if self.json:
            kinds = ("figures", "drawings", "tables")
            named = {name: getattr(written, name) for name in kinds}
            terminal.print_json({"report": written.path} | named)
        else:
            hint = "" if self.open else " Open it in a browser, or add --open."
            terminal.err.print(f"Wrote {written.path}.{hint}")
        if self.open and not webbrowser.open(resolved(written.path).as_uri()):
            terminal.warn(f"No browser could be started here; open {written.path} yourself.")


@dataclass(frozen=True)
class Samples:
    """Copy the samples into a folder: recordings with their truth, a calibration, policies, an arm.

    Those that are there already stay as they are; a changed one is replaced with --force only.

    README.md beside them says how each was made.

    Example: pupper-sysid samples

    Example: pupper-sysid delay samples/sweep.csv
    """

    out: tyro.conf.Positional[Path] = Path("samples")
    """Folder to write; made if missing."""
    force: Replace = False
    json: Json = False

    def run(self) -> None:
        """Copy the files, then name them."""
        from pupper_sysid.data import SAMPLES

        sources = [p for p in sorted(SAMPLES.rglob("*")) if p.is_file()]
        files = {self.out / p.relative_to(SAMPLES): p for p in sources}
        for target, source in files.items():  # before the first is written
            if not (target.is_file() and filecmp.cmp(source, target, shallow=False)):
                refuse_overwrite(target, self.force)
        for target, source in files.items():
            if not target.exists() or self.force:  # else it is the same
                write_bytes(target, source.read_bytes(), self.force)
        if self.json:
            return terminal.print_json({"files": list(files)})
        for target in files:
            terminal.out.print(f"  {target}")
        terminal.err.print(
            f"{len(files)} files in {self.out}. Next: "
            + terminal.command("pupper-sysid", "delay", self.out / "sweep.csv")
        )
