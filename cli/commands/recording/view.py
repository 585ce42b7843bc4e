"""`view`: a recording as a file for Rerun or Foxglove."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.live_views import refuse_file
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES


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
        from pupper_sysid.sysid.view.mcap_file import write_mcap
        from pupper_sysid.sysid.view.rerun_file import write_rerun

        wanted = {"rerun": self.rerun, "mcap": self.mcap}
        if self.rerun is None and self.mcap is None:
            raise InputError("Nothing to write: give --rerun FILE.rrd, --mcap FILE.mcap or both.")
        if self.model is not None and self.rerun is None:
            raise InputError("--model: only a Rerun file shows the robot; add --rerun FILE.rrd.")
        for option, path in wanted.items():
            if path is not None:
                refuse_file(option, path, self.force)
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
        for path in wanted.values():
            if path is not None:
                terminal.out.print(f"Wrote {path}", soft_wrap=True)
        if self.rerun is not None:
            terminal.out.print(f"Next:\n  rerun {self.rerun}", soft_wrap=True)
