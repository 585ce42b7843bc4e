"""The same recordings through pupper-sysid and through what people use now, in one run.

    benchmarks/peers/install.sh                        # once: environments of the peers
    .venv/bin/python benchmarks/peers/compare.py       # add --real FOLDER for a robot's recordings

Emulated robots of random servos, losses and counts are swept by the recorder, one joint each; their
servos' true motion and true dead time are known. Every method fits the whole recording, and again
without each of its tones. Its model's free run is then held against all rows where their value was
measured (held), against fresh readings of tones it has not seen (unseen), against rows as logged
(raw), and against the servo's true motion (true). All on one core, in turns.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import print_rows  # isort: skip

import numpy as np
import tyro
from exchange import STEP_S, dump
from exchange import Trial as PeerTrial
from numpy.typing import NDArray
from random_robots import SweptRobot, sweep_random_robot

from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sysid.doctor.checks import joint_trials
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run
from pupper_sysid.sysid.fit.scores import Scores, score
from pupper_sysid.sysid.fit.search import folds_of
from pupper_sysid.sysid.fit.structure import PREFERRED, candidate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording

HERE = Path(__file__).parent
if STEP_S != TIME_STEP_S:
    raise SystemExit("the peers' grid is not the calibration's any more: change exchange.STEP_S.")

RETIMED = "mujoco.sysid, times by pupper-sysid"
PEERS = {
    "cross-correlation, paper's gains": "naive.py",
    "mujoco.sysid 4.0.0": "mujoco_sysid.py",
    RETIMED: "mujoco_sysid.py",
}
OURS = "pupper-sysid calibrate"
ERRORS = ("held", "unseen", "raw", "true")


@dataclass(frozen=True)
class Case:
    """One joint's recording; `motion` (per trial, on step edges [rad]) if known."""

    name: str
    recording: Recording
    joint: str
    motion: list[NDArray] | None = None
    robot: SweptRobot | None = None


@dataclass(frozen=True)
class Outcome:
    """Errors of one method on one case, RMS [rad]."""

    method: str
    case: str
    raw: float
    held: float
    unseen: float
    true: float
    delay_error_s: float
    covered: bool | None
    width_s: float
    seconds: float


def outcome(
    method: str, case: Case, scores: Scores, tracks: list[NDArray], dead_time_s: float | None,
    ends_s: tuple[float, float] | None, step_s: float, seconds: float,
) -> Outcome:  # fmt: skip
    """What one method came to: its scores, its tracks and dead time against the truth."""
    true = case.robot.dead_time_s(step_s) if case.robot else np.nan
    return Outcome(
        method, case.name, scores.rmse_raw_rad, scores.rmse_held_rad,
        scores.rmse_leave_one_frequency_out_rad, off_truth(tracks, case),
        np.nan if dead_time_s is None else dead_time_s - true,
        bool(ends_s[0] <= true <= ends_s[1]) if ends_s and case.motion else None,
        ends_s[1] - ends_s[0] if ends_s else np.nan, seconds,
    )  # fmt: skip


def emulated(seed: int) -> Case:
    """A random robot, one of its joints swept at 1, 2, 4 and 8 Hz."""
    rng = np.random.default_rng([20261122, seed])
    loss, noise = float(rng.uniform(0.0, 0.5)), float(rng.uniform(0.002, 0.012))
    robot = sweep_random_robot(rng, "1,2,4,8", loss=loss, reading_noise_rad=noise)
    bus = robot.bus
    motion = []
    for trial in robot.recording.trials(robot.joint):
        steps = int(np.ceil((trial.read_time_s[-1] - trial.send_time_s[0]) / TIME_STEP_S)) + 3
        edges = trial.send_time_s[0] + TIME_STEP_S * np.arange(steps)
        motion.append(np.interp(edges, bus.time, bus.position))
    return Case(f"robot {seed}", robot.recording, robot.joint, motion, robot)


def ours(case: Case) -> tuple[Outcome, tuple[Run, ...]]:
    """Through `calibrate`, as the command does it."""
    began = time.perf_counter()
    result = calibrate([case.recording], [case.joint], workers=1)[case.joint]
    seconds = time.perf_counter() - began
    pd, dead = result.candidate_models[PREFERRED], result.dead_time_s
    structure = candidate(PREFERRED)
    values = np.array([pd.values[name] for name in structure.names])
    tracks = free_run(structure, values, result.runs)
    ends = (dead.low, dead.high)
    mine = outcome(OURS, case, pd.scores, tracks, dead.value, ends, TIME_STEP_S, seconds)
    return mine, result.runs


def off_truth(tracks: list[NDArray], case: Case) -> float:
    """RMS distance of a model's positions, shape (steps + 1,) per trial, to the true motion."""
    if case.motion is None:
        return float("nan")
    lengths = map(min, map(len, tracks), map(len, case.motion))
    pairs = zip(tracks, case.motion, lengths, strict=True)
    return rms(*(track[:n] - true[:n] for track, true, n in pairs))


def peer_trials(case: Case, data: tuple[Run, ...], retimed: bool) -> list[PeerTrial]:
    """The joint's trials as a peer gets them; `retimed`: fresh readings at the times we found."""
    trials = joint_trials([case.recording], case.joint)
    given = []
    for trial, one in zip(trials, data, strict=True):
        start, seen = trial.send_time_s[0], np.isfinite(trial.position_rad)
        if retimed:
            moments, angles = TIME_STEP_S * one.sample_step, one.sample_rad
            moments, first = np.unique(moments, return_index=True)
            angles = angles[first]
        else:
            moments, angles = trial.read_time_s[seen] - start, trial.position_rad[seen]
        given.append(
            PeerTrial(
                one.rest_rad, trial.send_time_s - start, trial.command_rad, moments, angles,
                one.steps,
            )
        )  # fmt: skip
    return given


def theirs(method: str, script: str, case: Case, data: tuple[Run, ...]) -> Outcome:
    """Through a peer, in its own environment."""
    folds = folds_of(data)
    fits = [list(range(len(data)))]
    fits += [np.flatnonzero(~out).tolist() for out in folds.values()]
    answer = subprocess.run(
        [HERE / ".venv/bin/python", HERE / script],
        input=dump(peer_trials(case, data, method == RETIMED), fits),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if answer.returncode:
        raise SystemExit(f"{method} failed on {case.name}:\n{answer.stderr[-2000:]}")
    answers = json.loads(answer.stdout.splitlines()[-1])
    tracks = [track_of(a["positions_rad"], data) for a in answers]
    held_out = {}
    for (name, out), track in zip(folds.items(), tracks[1:], strict=True):
        rows = zip(track, data, out, strict=True)
        held_out[name] = np.concatenate(
            [at_steps(p, one.sample_step) - one.sample_rad for p, one, gone in rows if gone]
        )
    scores = score(tracks[0], data, held_out)
    whole, seconds = answers[0], sum(a["seconds"] for a in answers)
    return outcome(
        method, case, scores, tracks[0], whole["dead_time_s"], whole["dead_time_interval_s"],
        whole["step_s"], seconds,
    )  # fmt: skip


def track_of(positions_rad: list[list[float]], data: tuple[Run, ...]) -> list[NDArray]:
    """A peer's positions as the scores want them: to the end of each trial."""
    return [
        np.pad(np.array(p), (0, max(0, run.steps + 1 - len(p))), mode="edge")
        for p, run in zip(positions_rad, data, strict=True)
    ]


def print_table(outcomes: list[Outcome], names: list[str]) -> None:
    """Print medians over the recordings."""

    def shown(value: float) -> str:
        return f"{1e3 * value:.1f}" if np.isfinite(value) else "–"

    def cells(name: str) -> list[str]:
        every = [o for o in outcomes if o.method == name]
        spans = [o for o in every if o.covered is not None]
        errors = [shown(float(np.median([getattr(o, k) for o in every]))) for k in ERRORS]
        off = np.median([abs(o.delay_error_s) for o in every])
        covered = f"{sum(bool(o.covered) for o in spans)} of {len(spans)}" if spans else ""
        width = np.median([o.width_s for o in spans]) if spans else np.nan
        seconds = f"{np.median([o.seconds for o in every]):.1f}"
        return [name, *errors, shown(off), covered or "none stated", shown(width), seconds]

    print_rows(
        ("method", "held", "unseen tone", "raw", "true motion", "dead time off, ms",
         "90 % interval holds it", "its width ms", "s per joint"), map(cells, names),
    )  # fmt: skip
    print("\nErrors in mrad, medians of the recordings.\n")


def real_cases(folder: Path) -> list[Case]:
    """The sweeps in a folder of the published recordings."""
    recordings = [load(path) for path in sorted(folder.glob("real_motor_*.csv"))]
    return [Case(f"real {joint}", r, joint) for r in recordings for joint in r.joints]


def main(robots: int = 12, real: Path | None = None, only: str = "") -> None:
    """Print the tables of `robots` and of a folder; `only`: a part of a method's name, and ours."""
    methods = {k: v for k, v in PEERS.items() if only in k}
    groups = {"Real recordings": real_cases(real) if real else [],
              "Emulated robots": map(emulated, range(robots))}  # fmt: skip
    for title, cases in groups.items():
        outcomes: list[Outcome] = []
        for case in cases:
            mine, data = ours(case)
            outcomes += [mine, *(theirs(*method, case, data) for method in methods.items())]
            print(case.name, file=sys.stderr, flush=True)
        if outcomes:
            print(title)
            print_table(outcomes, [*methods, OURS])


if __name__ == "__main__":
    tyro.cli(main)
