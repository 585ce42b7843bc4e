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


def call(module, *arguments, folder):
    command = [sys.executable, "-m", module, *map(str, arguments)]
    subprocess.run(
        command, cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def processed(trials, root):
    raw, logs = Path(root) / "raw", Path(root) / "logs"
    raw.mkdir(), logs.mkdir()
    for number, trial in enumerate(trials):
        write(trial, raw / f"{number}.json")
    call("bam.process", "--raw", raw, "--logdir", logs, folder=root)
    return logs


def fit(trials):
    with tempfile.TemporaryDirectory() as root:
        logs = processed(trials, root)
        call("bam.fit", "--logdir", logs, "--actuator", "sts3215", "--model", "m4",
             "--trials", TRIALS, "--output", "params.json", folder=root)  # fmt: skip
        model = load_model(f"{root}/params.json")

    def predict(trial):
        with tempfile.TemporaryDirectory() as root:
            log = Logs(str(processed([trial], root))).make_batch()
        path = Simulator(model).rollout_log(log, simulate_control=True)[0]
        time = trial.time_s[0] + np.array([e["timestamp"][0] for e in log["entries"]])
        return np.interp(trial.grid_s, time, np.array(path).ravel()) + trial.rest_rad

    return Fitted(predict)


serve(fit)
