"""`import` and `view`: another project's log as a recording, a recording for other viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.live_views import refuse_files
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import refuse_overwrite, resolved
from pupper_sysid.common.joints import JOINT_NAMES


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
    json: bool = False
    """Print one JSON object and nothing else."""

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
        options = importing.LogOptions(
            self.time, self.command, self.position, self.trial,
            {} if self.joints is None else _names(self.joints),
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
            terminal.print_json(
                {
                    "written": out, "imported_from": layout, "joints": recording.joints,
                    "rows": len(recording.table), "loop_period_s": recording.loop_period_s,
                    "warnings": recording.warnings,
                }
            )  # fmt: skip
            return
        table = terminal.table(f"{self.log}: {layout}", "joint", "trials", "rows", "s",
                               "command rad", "position rad")  # fmt: skip
        by_joint = recording.table.groupby("joint")
        ranges = by_joint[["command_rad", "position_rad"]].agg(["min", "max"])
        counts = by_joint.size()
        for joint in recording.joints:
            trials = recording.trials(joint)
            table.add_row(
                joint, str(len(trials)), str(counts[joint]),
                terminal.number(sum(float(t.send_time_s[-1] - t.send_time_s[0]) for t in trials)),
                *(f"{low:.2f} … {high:.2f}"
                  for low, high in ranges.loc[joint].to_numpy().reshape(2, 2)),
            )  # fmt: skip
        terminal.out.print(table)
        following = terminal.command("pupper-sysid", "doctor", out)
        terminal.err.print(f"Wrote {out}. Next: {following}")


def _names(text: str) -> dict[str, str]:
    """Joints to read, which keep their names."""
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise InputError(f"--joints '{text}': write the log's names once each, with commas: a,b.")
    return {name: name for name in names}


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
    force: bool = False
    """Replace files that exist."""

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
