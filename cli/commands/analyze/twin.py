"""`twin`: a recording's commands on the whole simulated robot, in the air and on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Drawn
from pupper_sysid.cli.terminal import ms, number
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from pupper_sysid.cli.commands.analyze.common import Found
    from pupper_sysid.policies.twin.gyro import Gyro
    from pupper_sysid.policies.twin.twin import Twin as Result

_WIDTH = 78
_PLACES = (("air", "in the air"), ("ground", "on the ground"))


@dataclass(frozen=True)
class Twin(Drawn):
    """Give a recording's commands to the whole simulated robot and compare it with the readings.

    Once in the air and once on the ground, with every actuator, joint by joint; the readings are
    predicted with their age and an offset per joint. Says where the robot was, if that shows.

    Example: pupper-analyze twin recordings/walk.csv --actuator calibrated.yaml --actuator paper
    """

    recording: tyro.conf.Positional[tuple[Path, ...]] = ()
    """The recording; by default the newest in recordings/."""
    actuator: tyro.conf.UseAppendAction[
        Annotated[tuple[str, ...], tyro.conf.arg(metavar="ACTUATOR")]
    ] = ()
    """Calibration, servo card, `paper`, `release` or `ideal`; once per actuator."""
    feedback: Path | None = None
    """Calibration of the same bus, whose poll is used where the recording does not show its own and
    no actuator has one."""
    model: Path | None = None
    """MJCF or URDF of the robot; by default it is the Mini Pupper."""
    imu: tuple[Path, ...] = ()
    """IMU logs of the robot on the ground (columns timestamp, gx, gy, gz), whose spectra are shown
    beside the simulated gyro's."""
    test_loops: str = ""
    """Trials (loops) to score on, such as 2, with the offsets of the others; by default all."""
    robots: int = 16
    """Simulated robots on the ground, which differ in friction and payload."""
    threads: int = 0
    """Of the physics; 0 for all cores."""

    def analyse(self) -> Found:
        """Simulate and compare."""
        from pupper_sysid.policies.twin.drawing import actuator_of, robot_for
        from pupper_sysid.policies.twin.gyro import read_imu, spectrum
        from pupper_sysid.policies.twin.twin import twin, twin_figure
        from pupper_sysid.servo_models.calibration.calibration import load_calibration

        if not self.actuator:
            raise InputError(
                "No actuator was named: give a calibration, such as `--actuator calibrated.yaml`."
            )
        recordings = terminal.load_all(self.recording)
        if len(recordings) != 1:
            raise InputError("One recording at a time: name one.")
        logs = {path.name: read_imu(path) for path in self.imu}
        robot = robot_for(recordings[0], self.model)
        actuators = {
            _short(name): actuator_of(name, robot, recordings[0]) for name in self.actuator
        }
        loops = terminal.whole_numbers("--test-loops", self.test_loops) if self.test_loops else []
        feedback = {self.feedback.name: load_calibration(self.feedback)} if self.feedback else {}
        with terminal.share_progress("simulating") as advance:
            found = twin(
                recordings[0], actuators, robot, feedback,
                test_loops=loops,
                copies=self.robots, seed=self.seed, threads=self.threads,
                progress=lambda share: advance("simulating", share),
            )  # fmt: skip
        seen = {name: spectrum(log.time_s, [log.rate_rad_s]) for name, log in logs.items()}
        if not self.json:
            _explain(found, seen)
        return (
            {**found.to_dict(), "imu": seen, "recording": recordings[0].name},
            twin_figure(found),
            _table(found),
        )


def _short(name: str) -> str:
    return Path(name).name or name


def _explain(found: Result, seen: dict[str, Gyro | None]) -> None:
    """Errors by joint, gyro, notes and the verdict, above the table."""
    best = found.models[found.best]
    own = {words: getattr(best, place) for place, words in _PLACES if getattr(best, place)}
    columns = [f"{what} {words}" for words in own for what in ("RMS", "mean")]
    joints = terminal.table(
        f"Errors of {found.best} by joint, mrad", "joint", *columns, "repeatability"
    )
    for joint in found.readings:
        errors = [
            e for c in own.values() for e in (c.joints[joint].rmse_rad, c.joints[joint].mae_rad)
        ]
        joints.add_row(joint, *map(ms, [*errors, found.repeatability_rad[joint]]))
    terminal.out.print(joints)
    if seen:
        terminal.out.print(_gyro_table(found, seen))
    terminal.warn(*found.notes)
    for line in wrap(found.verdict_in_words, _WIDTH):
        terminal.out.print(line)


def _gyro_table(found: Result, seen: dict[str, Gyro | None]) -> Table:
    table = terminal.table(
        "Gyro: deviation rad/s, peak Hz and its share of the variance", "", "x", "y", "z"
    )
    simulated = {f"simulated, {n}": m.ground.gyro for n, m in found.models.items() if m.ground}
    for name, gyro in (seen | simulated).items():
        if gyro is not None:
            axes = zip(gyro.deviation_rad_s, gyro.peak_hz, gyro.peak_share, strict=True)
            table.add_row(name, *(", ".join(map(number, axis)) for axis in axes))
    return table


def _table(found: Result) -> Table:
    table = terminal.table(
        f"Simulated {found.robot} against readings, mean of the joints, mrad ({found.scored})",
        "actuator", "", "RMS (90 %)", "mean abs.", "upright", "robot was",
    )  # fmt: skip
    for name, model in found.models.items():
        for place, words in _PLACES:
            own = getattr(model, place)
            if own is None:
                continue
            error = own.rmse_rad
            evidence = model.evidence.verdict if model.evidence and place == "ground" else ""
            table.add_row(
                name if place == "air" else "", words,
                f"{ms(error.value)} ({ms(error.low)}–{ms(error.high)})", ms(own.mean.mae_rad),
                f"{own.upright} of {own.copies}" if place == "ground" else "", evidence,
            )  # fmt: skip
    means = {"persistence": found.persistence_rmse_rad, "repeatability": found.repeatability_rad}
    for name, by_joint in means.items():
        values = [x for x in by_joint.values() if x == x]
        table.add_row(name, "", ms(sum(values) / len(values)) if values else "–", "", "", "")
    return table
