"""BAM's own `bam.process` and `bam.fit` on pendulum logs, in BAM's environment (install.sh).

    .venv-bam/bin/python bam_pendulum.py m4 TRIALS SEED ACTUATOR FIT.json … -- SCORE.json …

Prints the mean absolute error [rad] on each log to score, in free run with simulated control, as
BAM's fit scores itself.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from bam.logs import Logs
from bam.model import load_model
from bam.simulate import Simulator

SEEDED = (
    "import optuna, runpy, sys\n"
    "own, seed = optuna.samplers.CmaEsSampler, int(sys.argv.pop(1))\n"
    "optuna.samplers.CmaEsSampler = lambda **k: own(**{**k, 'seed': seed})\n"
    "optuna.logging.set_verbosity(optuna.logging.WARNING)\n"
    "runpy.run_module('bam.fit', run_name='__main__')\n"
)


def processed(files, root, name):
    root = Path(root)
    raw, logs = root / f"{name}-raw", root / f"{name}-logs"
    raw.mkdir(), logs.mkdir()
    for file in files:
        data = json.loads(Path(file).read_text())
        data.setdefault("arm_mass", 0.0)
        (raw / Path(file).name).write_text(json.dumps(data))
    command = [sys.executable, "-m", "bam.process", "--raw", str(raw), "--logdir", str(logs)]
    subprocess.run(command, cwd=root, check=True, stdout=subprocess.DEVNULL)
    return logs


def main():
    model, trials, seed, actuator = sys.argv[1:5]
    cut = sys.argv.index("--")
    root = Path(tempfile.mkdtemp())
    try:
        logs = processed(sys.argv[5:cut], root, "fit")
        command = [
            sys.executable, "-c", SEEDED, seed, "--logdir", str(logs), "--actuator", actuator,
            "--model", model, "--trials", trials, "--output", "params.json",
        ]  # fmt: skip
        subprocess.run(command, cwd=root, check=True, stdout=subprocess.DEVNULL)
        fitted = load_model(str(root / "params.json"))
        errors = []
        for log in Logs(str(processed(sys.argv[cut + 1 :], root, "score"))).logs:
            path = Simulator(fitted).rollout_log(log, simulate_control=True)[0]
            true = [e["position"] for e in log["entries"]]
            errors.append(float(np.mean(np.abs(np.array(path).ravel() - np.array(true)))))
        parameters = json.loads((root / "params.json").read_text())
        print(json.dumps({"mae_rad": errors, "parameters": parameters}))
    finally:
        shutil.rmtree(root)


if __name__ == "__main__":
    main()
