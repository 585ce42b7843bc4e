"""Servo models on recordings of real servos: motions and gains that were not fitted.

    .venv/bin/python benchmarks/real_recordings.py walk sweep xl330 [--bam PYTHON]

Recordings are found in `$PUPPER_REAL_DATA`, else in `../shared/real`. All errors are of free runs.

`walk`: kinds of servo model fitted to loops 0 and 1 of a Mini Pupper 2's walk at 25 Hz, scored on
loop 2. `sweep`: the sweeps of its hip and thigh are calibrated, and predict the same joints of that
walk, as positions and as readings of the sweep's poll. `xl330`: a Dynamixel XL330 with a pendulum,
fitted at P 100, 400 and 800, scored at P 200; with `--bam`, the Python of BAM's environment
(`peers/install.sh`), BAM's models are fitted to the same. An SO-101: `which_sts3215.py`.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from shared import REAL, mrad, print_rows  # isort: skip

import numpy as np
import tyro
from numpy.typing import NDArray

from pupper_sysid.common.signals import rms
from pupper_sysid.servo_models.calibration.calibration import PRESETS, load_calibration
from pupper_sysid.servo_models.kernel import COLUMNS
from pupper_sysid.sysid.compare.compare import calibrated_run, compare
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.joint_fit import fit_joint
from pupper_sysid.sysid.fit.predict import rule_of
from pupper_sysid.sysid.fit.results import LoadedFit
from pupper_sysid.sysid.fit.run import Run, at_steps, prepare, simulate
from pupper_sysid.sysid.fit.structure import loaded_columns
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.servo_fit import scores
from pupper_sysid.sysid.servo_fit.data import ServoData, servo_data
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.windows import everything

SWEEPS = ("real_motor_0_LF_hip_amp0.3.csv", "real_motor_1_LF_thigh_amp0.3.csv")
WALK = "playback_lstm_25hz.csv"
SPLIT = Split(
    "trained on loops 0 and 1, tested on 2",
    lambda number, elapsed, group: number < 2,
    lambda number, elapsed, group: number == 2,
)
MODELS = (("fir", "default"), ("delayed-pd", "default"), ("mlp", "paper"), ("lstm", "default"),
          ("mlp", "default"), ("lstm", "paper"))  # fmt: skip
"""Architecture and preset of `fit-servo`."""
JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
MOTIONS = ("chirp_sweep", "prbs_excitation", "step_response", "frequency_sweep")
BAM_TRIALS = 2500
FITTED_S = 40.0
"""Of each motion of the SO-101 but the last, of which nothing is fitted."""


# ---------------------------------------------------------------------------------- Mini Pupper 2


def walk(seed: int) -> None:
    """Kinds of servo model on the unseen loop of the walk, mean of 12 joints."""
    recording = load(REAL / WALK)

    def rows() -> Iterable[list[str]]:
        for arch, preset in MODELS:
            begun = time.process_time()
            fit = fit_servo(recording, None, arch, preset, SPLIT, seed=seed)
            error, floor = fit.rmse_free_run_rad, fit.mean.repeatability_rad
            yield [
                arch + (", as published" if preset == "paper" else ""),
                mrad(fit.mean.rmse_one_step_rad), mrad(error.value),
                f"{mrad(error.low)} … {mrad(error.high)}",
                mrad(max(s.rmse_free_run_rad for s in fit.joints.values())),
                mrad(error.value - floor), f"{time.process_time() - begun:.0f}",
            ]  # fmt: skip

    print_rows(
        ("model", "one step", "free run", "90 % interval", "worst joint", "above repeatability",
         "processor s"), rows(),
    )  # fmt: skip


def sweep(seed: int) -> None:
    """The walk of two joints predicted by a calibration of their sweeps, all rows."""
    recording = load(REAL / WALK)
    result = calibrate([load(REAL / name) for name in SWEEPS], seed=seed)
    joints = list(result.joints)
    data = scores.as_rows(servo_data([recording], joints, "all"), joints)
    known = {"the sweeps": result.calibration}
    aged = scores.with_ages(
        data, {j: rule_of(j, data.lattices[j], "the walk", known) for j in joints}
    )
    offset = [result.calibration.joint(j).feedback.offset_rad.value for j in data.joints]
    calibrated = calibrated_run(result.calibration, data)
    tracks = calibrated(np.zeros(scores.stacked(data)[1].shape) + offset)
    moved = {j: [t + own for t in tracks[j]] for j, own in zip(data.joints, offset, strict=True)}
    lines = {
        "calibration: position, offset of the sweep": rows_error(moved, data),
        **by_rule("calibration", calibrated, data, aged),
    }
    for preset in PRESETS:
        lines |= by_rule(preset, calibrated_run(load_calibration(preset), data), data, aged)
    scored = compare(recording, [result.calibration], joints).models[scores.LINEAR]
    name = f"{scores.LINEAR} to the walk's other loops"
    lines[name] = {j: s.rmse_raw_rad for j, s in scored.joints.items()}
    print_rows(
        ("mrad", *joints, "mean"),
        (
            [name, *map(mrad, by_joint.values()), mrad(float(np.mean(list(by_joint.values()))))]
            for name, by_joint in lines.items()
        ),
    )


def rows_error(tracks: scores.Tracks, data: ServoData) -> dict[str, float]:
    """RMS of all rows as logged against the predicted readings, by joint [rad]."""
    return {j: rms(e.raw) for j, e in scores.errors(None, tracks, data, everything).items()}


def by_rule(
    name: str, run: scores.FreeRun, data: ServoData, aged: ServoData
) -> dict[str, dict[str, float]]:
    """Errors with the walk's offset, of positions and of readings with their age."""
    return {
        f"{name}: position, offset of the walk": rows_error(
            scores.run_with_offset(run, data)[0], data
        ),
        f"{name}: reading, offset of the walk": rows_error(
            scores.run_with_offset(run, aged)[0], aged
        ),
    }


# ------------------------------------------------------------------------------- servos under load


def loaded_fit(joint: str, trials: Sequence[Trial], seed: int) -> LoadedFit:
    """Fit a servo under load, whether or not its trials tell of one."""
    fit = fit_joint(joint, trials, seed, free_air=False).loaded
    assert fit is not None
    return fit


def track(fit: LoadedFit, run: Run) -> NDArray[np.float64]:
    """Readings that a fitted servo predicts at the edges of the steps of a run [rad]."""
    columns = loaded_columns(fit.servo)
    for name in ("gravity_nm", "hanging_rad", "offset_rad"):
        if name in fit.numbers:
            columns[COLUMNS.index(name)] = fit.numbers[name].value
    return simulate(columns[None], np.array([fit.numbers["dead_time_s"].value]), run)[:, 0]


def xl330(seed: int, bam: str) -> None:
    """Mean absolute error at the gain that was not fitted, by trajectory."""
    files = sorted((REAL / "bam_xl330").glob("*.json"))
    gain = {f: json.loads(f.read_text())["kp"] for f in files}
    fitted, scored = ([f for f in files if (gain[f] == 200) is unseen] for unseen in (False, True))

    def rows() -> Iterable[list[str]]:
        fit = loaded_fit("xl330", [t for f in fitted for t in load(f).trials("xl330")], seed)
        trials = [load(f).trials("xl330")[0] for f in scored]
        dead = fit.numbers["dead_time_s"]
        ends = "{:.1f} [{:.1f}, {:.1f}]".format(
            *(1e3 * x for x in (dead.value, dead.low, dead.high))
        )
        runs = [prepare(t, fit.lattice, fit.reference_voltage_v) for t in trials]
        errors = [at_steps(track(fit, run), run.row_step) - run.row_rad for run in runs]
        mean = [float(np.mean(np.abs(e))) for e in errors]
        values = {f"pupper-sysid, dead time {ends} ms": mean}
        for model in ("m4", "m6") if bam else ():
            script = Path(__file__).parent / "peers" / "bam_pendulum.py"
            command = [bam, script, model, BAM_TRIALS, seed, "xl330", *fitted, "--", *scored]
            answer = subprocess.run(
                [*map(str, command)], check=True, capture_output=True, text=True
            )
            values[f"BAM 1.0.2, {model.upper()}"] = json.loads(answer.stdout)["mae_rad"]
        for name, by_file in values.items():
            yield [name, *map(mrad, by_file), mrad(float(np.mean(by_file)))]

    print_rows(("mean absolute error, mrad", *(f.stem for f in scored), "mean"), rows())


def first(trial: Trial) -> Trial:
    """The part of a trial that is fitted."""
    use = trial.send_time_s <= trial.send_time_s[0] + FITTED_S
    return replace(
        trial, send_time_s=trial.send_time_s[use], read_time_s=trial.read_time_s[use],
        command_rad=trial.command_rad[use], position_rad=trial.position_rad[use],
        position_count=None,
    )  # fmt: skip


def main(
    parts: tyro.conf.Positional[tuple[Literal["walk", "sweep", "xl330"], ...]],
    seed: int = 0,
    bam: str = "",
) -> None:
    """Print the tables of the parts; `bam` is the Python of BAM's environment."""
    for part in parts:
        {"walk": walk, "sweep": sweep, "xl330": partial(xl330, bam=bam)}[part](seed)


if __name__ == "__main__":
    tyro.cli(main)
