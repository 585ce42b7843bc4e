"""`servo`: published DelayedPD, fitted DelayedPD, LSTM and MLP on the same unseen readings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Analysis
from pupper_sysid.cli.terminal import need_positive
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.analyze.common import Found


@dataclass(frozen=True)
class Servo(Analysis):
    """Compare servo models on a recording, or on a walk of an emulated robot.

    These are the published DelayedPD, a fitted DelayedPD, an LSTM and an MLP.
    Give one recording or one policy. --command, --seconds and --actuator are for a policy's walk.

    Example: pupper-analyze servo recordings/playback.csv
    """

    command: tuple[float, float, float] = (0.15, 0.0, 0.0)
    """Forward and sideways speed [m/s], turn rate [rad/s]."""
    seconds: float = 10.0
    """Duration of a policy's walk."""

    def analyse(self) -> Found:
        """Fit and compare the models."""
        import numpy as np

        from pupper_sysid.sysid.compare.comparison import four_way

        need_positive("--seconds", self.seconds)
        if len(self.policies) != 1:
            raise InputError("Servo models are compared on one recording or policy at a time.")
        (path,) = self.policies
        if path.is_dir():
            path = self._walked(path)
        (recording,) = terminal.load_all([path])
        with terminal.share_progress("fitting") as advance:
            compared = four_way(recording, recording.joints, self.seed, advance)
        table = terminal.table(
            "RMS error on unseen readings, mrad, mean of the joints", "model", "one step",
            "free run", "90 % interval",
        )  # fmt: skip
        for name, one in compared.models.items():
            errors = (one.mean.rmse_one_step_rad, one.mean.rmse_free_run_rad)
            low, high = one.rmse_free_run_rad.low, one.rmse_free_run_rad.high
            table.add_row(
                name, *map(terminal.ms, errors), f"{terminal.ms(low)} … {terminal.ms(high)}"
            )
        still = float(np.nanmean(list(compared.persistence_rmse_rad.values())))
        table.add_row("persistence", terminal.ms(still), "", "")
        return {**compared.to_dict(), "recording": path}, compared.plot(), table

    def _walked(self, folder: Path) -> Path:
        """A recording of the servos of an emulated robot that a policy walks."""
        from pupper_sysid.cli.policy_choice import chosen_actuator, policy_at, run_folder
        from pupper_sysid.policies.deploy.emulated_walk import walk_once
        from pupper_sysid.policies.deploy.stacks import STACKS
        from pupper_sysid.sysid.recordings.files import RecordingWriter

        policy, run = policy_at(folder)
        actuator = chosen_actuator(folder, policy, run, self.actuator)
        path = self.out / f"{run_folder(folder).name}-walk.csv"
        about = {"bus": {"kind": "emulated walking robot", "coordinates": "servo"}}
        with RecordingWriter(path, about | {"policy": str(folder)}, self.force) as rows:
            outcome, _ = walk_once(
                policy, STACKS["closed-loop"], self.command, self.seconds, self.seed, actuator,
                rows=rows,
            )  # fmt: skip
            rows.close({"stop_reason": outcome.stop_reason})
        return path
