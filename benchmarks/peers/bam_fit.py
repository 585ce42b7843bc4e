"""BAM's own commands (`bam.process`, `bam.fit`) on a free-air sweep: a pendulum without a mass.

BAM is made for a pendulum of known mass under several loads and gains; of one servo in free air it
can fit everything but what a load would show. It has no delay. Model M4, its STS3215.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from bam.logs import Logs
from bam.model import load_model
from bam.simulate import Simulator
from bam_pendulum import processed
from exchange import Fitted, serve

TRIALS = 600


def write(trial, path):
    goal = np.searchsorted(trial.command_time_s, trial.time_s, "right") - 1
    entries = [
        {"timestamp": t, "position": q, "speed": 0.0, "goal_position": g, "torque_enable": 1}
        for t, q, g in zip(
            trial.time_s - trial.time_s[0], trial.position_rad - trial.rest_rad,
            trial.command_rad[np.maximum(goal, 0)] - trial.rest_rad, strict=True,
        )
    ]  # fmt: skip
    about = {"mass": 0.0, "arm_mass": 0.0, "length": 0.1, "kp": 32, "vin": 7.4, "motor": "sts3215"}
    path.write_text(json.dumps({**about, "trajectory": "sweep", "entries": entries}))


def logs_of(trials, root):
    files = [Path(root) / f"{number}.json" for number in range(len(trials))]
    for trial, file in zip(trials, files, strict=True):
        write(trial, file)
    return processed(files, root, "sweep")


def fit(trials):
    with tempfile.TemporaryDirectory() as root:
        command = [
            sys.executable, "-m", "bam.fit", "--logdir", str(logs_of(trials, root)),
            "--actuator", "sts3215", "--model", "m4", "--trials", str(TRIALS),
            "--output", "params.json",
        ]  # fmt: skip
        subprocess.run(command, cwd=root, check=True, capture_output=True)
        model = load_model(f"{root}/params.json")

    def predict(trial):
        with tempfile.TemporaryDirectory() as root:
            log = Logs(str(logs_of([trial], root))).make_batch()
        path = Simulator(model).rollout_log(log, simulate_control=True)[0]
        time = trial.time_s[0] + np.array([e["timestamp"][0] for e in log["entries"]])
        return np.interp(trial.grid_s, time, np.array(path).ravel()) + trial.rest_rad

    return Fitted(predict)


serve(fit)
