"""`calibrate`: fit servo models to recordings and write the calibration file."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.common import OfRecordings, each_robot
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite
from pupper_sysid.common.joints import (
    JOINT_NAMES,
    STALL_TORQUE_NM,
    STALL_TORQUE_SOURCE,
    STALL_TORQUES_NM,
)

if TYPE_CHECKING:
    from pupper_sysid.servo_models.calibration.parts import Actuator
    from pupper_sysid.servo_models.calibration.quantity import Quantity
    from pupper_sysid.sysid.fit.calibrate import CalibrationResult

_SHOWN = {
    "lag_ms": ("lag ms", 1),
    "dead_time_ms": ("dead time ms", 1),
    "stiffness_per_s2": ("stiffness 1/s²", 0),
    "speed_rad_s": ("speed rad/s", 2),
    "loss": ("loss", 2),
}


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
        if self.stall_torque is not None:
            refuse_outside("--stall-torque", self.stall_torque, *STALL_TORQUES_NM, "N·m")
        refuse_outside("--jobs", self.jobs, *terminal.JOBS)
        from pupper_sysid.sysid.fit.calibrate import STAGES, calibrate
        from pupper_sysid.sysid.recordings.importers.recognise import is_fleet

        if len(self.recordings) == 1 and is_fleet(self.recordings[0]):
            self._fleet(self.recordings[0])
            return
        if self.cluster is not None:
            raise InputError("--cluster is for a fleet: give the folder of its recordings.")
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
            terminal.print_json(result)
        else:
            self._print(result)
            elapsed = time.perf_counter() - started
            following = terminal.command(
                "pupper-sysid", "report", *self.recordings, "--calibration", out
            )
            terminal.err.print(f"Wrote {out} in {elapsed:.1f} s. Next: {following}")

    def _fleet(self, root: Path) -> None:
        """Many robots, one after the other or side by side."""
        from pupper_sysid.sysid.fleet import Settings, calibrate_fleet

        if self.prior is not None:
            raise InputError("--from: a fleet is calibrated without a prior; leave it out.")
        if self.joints != "all":
            raise InputError("--joints: a fleet is calibrated with all its joints; leave it out.")
        settings = Settings(self.seed, self.stall_torque)
        each_robot(
            self, root, "calibrating", "calibrated", "a calibration", _SHOWN,
            lambda out, advance: calibrate_fleet(
                root, out, settings, self.jobs, self.cluster, self.force, advance
            ),
        )  # fmt: skip

    def _print(self, result: CalibrationResult) -> None:
        table = terminal.table(
            "DelayedPD per joint", "joint", "dead time ms", "90 %", "fit", "Kp", "Kd", "fric. N·m",
            "speed rad/s", "limit", "error mrad", "unseen mrad",
        )  # fmt: skip
        for name, r in result.items():
            a, s = result.calibration.joint(name).actuator, r.delayed_pd.scores
            brakes = a.back_emf_nm_s_per_rad.value > 0
            limit = a.back_emf_nm_s_per_rad if brakes else a.velocity_limit_rad_s
            table.add_row(
                name,
                _number(a.dead_time_s, 1, 1e3),
                f"{1e3 * r.dead_time_s.low:.0f}–{1e3 * r.dead_time_s.high:.0f}",
                terminal.number(result.calibration.joint(name).scores.residual_over_noise, 1),
                _number(a.stiffness_nm_per_rad, 1), _damping(a),
                _number(a.friction_loss_nm, 3),
                f"{terminal.number(a.top_speed_rad_s)}{_mark(limit)}",
                "EMF" if brakes else "slew",
                terminal.ms(s.rmse_fresh_rad), terminal.ms(s.rmse_unseen_rad),
            )  # fmt: skip
        terminal.out.print(table)
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


def _mark(quantity: Quantity) -> str:
    return "?" if quantity.identified == "no" else ""


def _damping(actuator: Actuator) -> str:
    """The damping, or its sum with the back-EMF where only that is known."""
    damping = actuator.damping_nm_s_per_rad
    braking = actuator.ratios_to_armature.damping_and_back_emf
    if damping.identified == "no" and braking is not None and braking.identified != "no":
        return f"{terminal.number(actuator.armature_kg_m2.value * braking.value, 3)}Σ"
    return _number(damping, 3)


def _number(quantity: Quantity, decimals: int, factor: float = 1.0) -> str:
    return f"{terminal.number(factor * quantity.value, decimals)}{_mark(quantity)}"
