"""`calibrate`: fit the ladder to recordings and write the calibration file."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from cli import terminal
from common.files import refuse_overwrite
from servo_models.calibration import Calibration
from sysid.calibrate import JointCalibrationResult, calibrate
from sysid.calibration_file import (
    STALL_TORQUE_NM,
    STALL_TORQUE_SOURCE,
    preset_parameters,
    to_calibration,
)
from sysid.report_data import calibrate_json


@dataclass(frozen=True)
class Calibrate:
    """Fit a servo model per joint and write it as YAML, with intervals and caveats.

    Example: pupper-sysid calibrate recordings/sweep.csv --out calibrated.yaml
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    out: Path = Path("calibrated.yaml")
    """Calibration file to write."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    stall_torque: float = STALL_TORQUE_NM
    """Torque the servo stalls at [N·m]: sets the scale of all torques and of the armature."""
    force: bool = False
    """Replace the calibration file if it exists."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def run(self) -> None:
        """Calibrate, print, write."""
        started = time.perf_counter()
        terminal.need_positive("--stall-torque", self.stall_torque)
        refuse_overwrite(self.out, self.force)  # before the work, not after it
        recordings = terminal.load_all(self.recordings)
        joints = terminal.pick_joints(recordings, self.joints)
        with terminal.progress("calibrating", len(joints)) as advance:
            results = calibrate(
                recordings, joints, self.seed, preset_parameters(), progress=advance
            )
        given = self.stall_torque != STALL_TORQUE_NM
        source = "given with --stall-torque" if given else STALL_TORQUE_SOURCE
        made = to_calibration(results, recordings, self.seed, self.stall_torque, source)
        made.save(self.out, force=self.force)
        elapsed = time.perf_counter() - started
        if self.json:
            terminal.print_json(calibrate_json(results, made, elapsed))
        else:
            self._print(results, made, elapsed)

    def _print(
        self, results: dict[str, JointCalibrationResult], made: Calibration, elapsed: float
    ) -> None:
        shown = terminal.table(
            "DelayedPD per joint", "joint", "delay ms", "steps @500 Hz", "Kp", "Kd", "friction",
            "armature", "speed rad/s", "error mrad", "unseen Hz mrad", "paper mrad",
        )  # fmt: skip
        for name, r in results.items():
            a, s = made.joint(name).actuator, r.rungs["delayed_pd"].scores
            paper = r.presets.get("paper")
            shown.add_row(
                name, terminal.ms(a.delay_s.value), "{}–{}".format(*r.delay_steps),
                terminal.number(a.stiffness_nm_per_rad.value),
                terminal.number(a.damping_nm_s_per_rad.value, 3),
                terminal.number(a.friction_loss_nm.value, 3),
                f"{a.armature_kg_m2.value:.1e}",
                terminal.number(a.velocity_limit_rad_s.value), terminal.ms(s.fresh),
                terminal.ms(s.leave_one_out), terminal.ms(paper.fresh if paper else None),
            )  # fmt: skip
        terminal.out.print(shown)
        terminal.out.print(
            f"\nTorques assume a stall torque of {self.stall_torque:g} N·m; free-air recordings "
            "give only their ratios. Errors are free-run, on fresh readings.",
            soft_wrap=True,
        )
        for r in results.values():
            terminal.warn(r.warnings)
        terminal.err.print(
            f"Wrote {self.out} in {elapsed:.1f} s. Next: pupper-sysid report", soft_wrap=True
        )
