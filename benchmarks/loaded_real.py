"""Real servos under load: XL330 pendulums at an unseen gain, SO-101 motions that no one fitted.

    .venv/bin/python benchmarks/loaded_real.py --xl330 --so101 --seed 0 [--bam PYTHON]

XL330: fitted on P 100, 400 and 800, scored in free run on all rows at P 200; with `--bam`, the
Python of BAM's environment (benchmarks/peers/install.sh), BAM's M4 and M6 are fitted to the same
split. SO-101: fitted on the first 40 s of chirp, PRBS and steps. Recordings are found through
PUPPER_REAL_DATA, else in ../shared/real.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.servo_models.loaded_servo import COLUMNS
from pupper_sysid.sysid.loaded.joint_fit import LoadedFit, fit_loaded_joint
from pupper_sysid.sysid.loaded.kernel import OFFSET, WIDTH
from pupper_sysid.sysid.loaded.runs import Run, at_steps, prepare, simulate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Trial

HERE = Path(__file__).parent
REAL = Path(os.environ.get("PUPPER_REAL_DATA", HERE.parents[1] / "shared" / "real"))
JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
MOTIONS = ("chirp_sweep", "prbs_excitation", "step_response", "frequency_sweep")
FITTED_S = 40.0


def errors(found: LoadedFit, trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Model minus reading of every row [rad], and its time [s]."""
    run = prepare(trial, found.lattice, found.reference_voltage_v)
    assert run is not None
    return at_steps(track(found, run), run.row_step) - run.row_rad, run.row_step * run.step_s


def track(found: LoadedFit, run: Run) -> np.ndarray:
    """Positions that a fitted servo predicts at the edges of the steps of a run [rad]."""
    servo, row = found.servo.arrays(), np.zeros((1, WIDTH))
    row[0, : len(COLUMNS)] = [float(servo[name]) for name in COLUMNS]
    for column, name in ((-2, "gravity_nm"), (-1, "hanging_rad"), (0, "offset_rad")):
        row[0, OFFSET + column] = found.numbers[name].value if name in found.numbers else 0.0
    return simulate(row, np.array([float(servo["dead_time_s"])]), run)[:, 0]


def dead_time(found: LoadedFit) -> str:
    """With its interval, in ms."""
    d = found.numbers["dead_time_s"]
    return f"dead time {1e3 * d.value:.1f} [{1e3 * d.low:.1f}, {1e3 * d.high:.1f}] ms"


def xl330(seed: int, bam: str | None, trials: int) -> None:
    """The unseen gain of the pendulum logs."""
    files = sorted((REAL / "bam_xl330").glob("*.json"))
    gain = {f: json.loads(f.read_text())["kp"] for f in files}
    fit_on, score_on = (
        [f for f in files if (gain[f] == 200) is unseen] for unseen in (False, True)
    )
    own = [t for f in fit_on for t in load(f).trials("xl330")]
    found = fit_loaded_joint("xl330", own, seed)
    print(f"XL330: {found.structure}, {dead_time(found)}")
    means = [float(np.mean(np.abs(errors(found, load(f).trials("xl330")[0])[0]))) for f in score_on]
    table = {"pupper-sysid": means}
    for model in ("m4", "m6") if bam else ():
        command = [bam, HERE / "peers" / "bam_pendulum.py", model, str(trials), str(seed), "xl330",
                   *fit_on, "--", *score_on]  # fmt: skip
        said = subprocess.run(list(map(str, command)), check=True, capture_output=True, text=True)
        table[f"BAM 1.0.2, {model.upper()}"] = json.loads(said.stdout)["mae_rad"]
    for name, values in table.items():
        each = " ".join(f"{1e3 * v:5.1f}" for v in values)
        print(f"  {name:18s} {each}   mean {1e3 * np.mean(values):5.1f} mrad")


def so101(seed: int) -> None:
    """Motions that were not fitted, and what is left of those that were."""
    recordings = {m: load(REAL / "sage_so101" / m) for m in MOTIONS}
    every = []
    for joint in JOINTS:
        trials = {m: r.trials(joint)[0] for m, r in recordings.items()}
        found = fit_loaded_joint(joint, [first(trials[m]) for m in MOTIONS[:3]], seed)
        row = []
        for motion, trial in trials.items():
            error, time = errors(found, trial)
            counted = np.isfinite(error) & ((time > FITTED_S) | (motion == "frequency_sweep"))
            row.append(1e3 * float(np.sqrt(np.mean(error[counted] ** 2))))
        every.append(row)
        said = ", ".join(f"{m} {v:.1f}" for m, v in zip(MOTIONS, row, strict=True))
        print(f"{joint:12s} {found.structure:36s} {said}; {dead_time(found)}", flush=True)
    mean = ", ".join(f"{m} {v:.1f}" for m, v in zip(MOTIONS, np.mean(every, axis=0), strict=True))
    print(f"mean of joints [mrad RMS]: {mean}")


def first(trial: Trial) -> Trial:
    """The part of a trial that is fitted."""
    use = trial.send_time_s <= trial.send_time_s[0] + FITTED_S
    return replace(
        trial, send_time_s=trial.send_time_s[use], read_time_s=trial.read_time_s[use],
        command_rad=trial.command_rad[use], position_rad=trial.position_rad[use],
        position_count=None,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--xl330", action="store_true")
    parser.add_argument("--so101", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bam", help="Python of BAM's environment")
    parser.add_argument("--bam-trials", type=int, default=2500)
    asked = parser.parse_args()
    if asked.xl330:
        xl330(asked.seed, asked.bam, asked.bam_trials)
    if asked.so101:
        so101(asked.seed)


if __name__ == "__main__":
    main()
