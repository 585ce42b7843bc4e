"""Compare servo models on runs under load, each with its own P gain and load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.results import internal
from pupper_sysid.servo_models.calibration.calibration import (
    Calibration,
)
from pupper_sysid.sysid.compare import under_load
from pupper_sysid.sysid.compare.comparison import (
    OFFSET_RULE,
    ComparedModel,
    Comparison,
)
from pupper_sysid.sysid.compare.readings import (
    ReadingRule,
)
from pupper_sysid.sysid.feedback.poll_lattice import PollLattice, find_poll_lattice
from pupper_sysid.sysid.recordings.joints import (
    joint_rng,
)
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.scores import ModelScores

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class RunComparison(Comparison):
    """Servo models on runs under load, each with its own gain and load.

    Attributes
    ----------
    runs : dict of str to list of BenchRun
        By joint.
    run_tracks : dict of str to (dict of str to list of ndarray)
        By model, then joint: predicted readings at the steps of each run.
    """

    runs: dict[str, list[under_load.BenchRun]] = internal()
    run_tracks: dict[str, dict[str, list[NDArray[np.float64]]]] = internal()

    def reading_notes(self) -> list[str]:
        """How readings were predicted, and which offsets were taken out."""
        known = [j for j, own in self.runs.items() if all(b.offset_known for b in own)]
        said = [f"{', '.join(known)}: no offset is taken out, the load is known."] if known else []
        return [*said, *([OFFSET_RULE] if len(known) < len(self.runs) else [])]

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the models in free run beside commands and readings, a panel per run."""
        return under_load.figure(self.runs, self.run_tracks, joints)


def refuse_missing_joints(calibration: Calibration, name: str, joints: Sequence[str]) -> None:
    """Refuse to compare on joints that a calibration does not have."""
    missing = [j for j in joints if not _has(calibration, j)]
    if missing:
        common = [j for j in joints if j not in missing]
        advice = f" Compare on {', '.join(common)} only (`joints`)." if common else ""
        raise InputError(
            f"{name} has no joint {', '.join(missing)}; it has "
            f"{', '.join(calibration.joints)}.{advice}"
        )


def _has(calibration: Calibration, joint: str) -> bool:
    try:
        calibration.joint(joint)  # a servo card has every joint
    except InputError:
        return False
    return True


def compare_runs(
    recordings: Sequence[Recording],
    calibrations: Mapping[str, Calibration],
    joints: Sequence[str],
    seed: int,
    lattices: Mapping[str, PollLattice] | None,
) -> RunComparison:
    """`compare` where trials differ in gain, load or torque."""
    notes = []
    inputs = {r.sha256: r.name for r in recordings}
    for name, calibration in calibrations.items():
        refuse_missing_joints(calibration, name, joints)
        fitted = [inputs[f.sha256] for f in calibration.inputs if f.sha256 in inputs]
        if fitted:
            which = ", ".join(fitted) if len(fitted) < 4 else f"{len(fitted)} of these recordings"
            notes.append(f"{name} was fitted to {which}: its errors here are too small.")
    runs: dict[str, list[under_load.BenchRun]] = {}
    rules: dict[str, ReadingRule] = {}
    for joint in joints:
        trials = [t for r in recordings for t in r.trials(joint)]
        lattice = (lattices or {}).get(joint) or find_poll_lattice(
            tuple(trials), joint_rng(seed, joint)
        )
        runs[joint] = under_load.bench_runs(recordings, joint, seed, lattice)
        kind = {"every read": "live", "lattice": "own dates"}.get(lattice.kind, "as logged")
        source = ", ".join(r.name for r in recordings)
        rules[joint] = ReadingRule(rule=kind, source=source)
    made: dict[str, ComparedModel] = {}
    tracks: dict[str, dict[str, list[NDArray[np.float64]]]] = {}
    for name, calibration in calibrations.items():
        tracks[name], found, offset = {}, {}, {}
        for joint, own in runs.items():
            volts = under_load.reference_voltage(calibration, joint)
            own = under_load.at_voltage(own, volts)
            track, offset[joint] = under_load.predict(calibration, joint, own)
            tracks[name][joint] = track
            error = under_load.errors(own, track)
            nothing = np.zeros(len(error["fresh"]))
            found[joint] = scores.Errors(
                error["fresh"], under_load.one_step(own, track), nothing, under_load.blocks(own),
                error["held"], error["raw"],
            )  # fmt: skip
        spread = dict.fromkeys(joints, 0.0)
        made[name] = ComparedModel.scored(ModelScores.of(found, seed), offset, spread)
    notes += under_load.notes(calibrations, runs)
    nan = float("nan")
    period = float(np.median([r.loop_period_s for r in recordings]))
    return RunComparison(
        models=made,
        readings=rules,
        persistence_rmse_rad={j: under_load.persistence(own) for j, own in runs.items()},
        repeatability_rad=dict.fromkeys(joints, nan),
        time_step_s=period,
        notes=tuple(notes),
        data=ServoData(tuple(joints), period, {}, (), {}, {}),
        tracks={},
        bands={},
        runs=runs,
        run_tracks=tracks,
    )
