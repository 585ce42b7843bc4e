"""`pupper-sysid`: record a sweep, find out what is bus, sensor and servo, calibrate, report."""

from __future__ import annotations

import os
from collections.abc import Sequence

# Vectorised NumPy is the inner loop and joints run in processes: BLAS threads would only fight.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pupper_sysid.cli.dispatch import Command, run_command

DESCRIPTION = """Measure a cheap servo and get a simulator that moves like it. Try it without a
robot: `pupper-sysid sweep --freqs 1-10`, then `delay`, `calibrate`, `report`.
"""
COMMANDS = {
    "init-robot": Command("robot", "Begin a joint map for another robot.", "init_robot:InitRobot"),
    "scan": Command("robot", "List the servos on a bus.", "scan:Scan"),
    "monitor": Command("robot", "Watch the joints live; nothing moves.", "monitor:Monitor"),
    "calibrate-joints": Command(
        "robot", "Measure zero, range and direction of each joint.",
        "calibrate_joints:CalibrateJoints",
    ),
    "emulate": Command("robot", "Emulate a robot behind the real protocols.", "emulate:Emulate"),
    "sweep": Command("recording", "Move joints in tones or steps and record them.", "sweep:Sweep"),
    "doctor": Command("recording", "Check whether a recording is usable.", "analyse:Doctor"),
    "delay": Command("recording", "Split the lag into bus, sensor and servo.", "analyse:Delay"),
    "bode": Command("recording", "Measure the frequency response.", "analyse:Bode"),
    "calibrate": Command("model", "Fit DelayedPD per joint; write YAML.", "calibrate:Calibrate"),
    "sindy": Command("model", "Find a sparse equation of motion per joint.", "sindy:Sindy"),
    "fit-servo": Command("model", "Fit an MLP, LSTM, FIR or other model.", "fit_servo:FitServo"),
    "compare": Command("model", "Compare models on the same readings.", "compare:Compare"),
    "report": Command("use", "Write all of it as one HTML page.", "report:Report"),
    "export": Command("use", "Convert for MuJoCo, Isaac Lab, Newton, CSV …", "export:Export"),
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    run_command("pupper-sysid", DESCRIPTION, COMMANDS, arguments)


if __name__ == "__main__":
    main()
