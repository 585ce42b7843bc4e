"""`pupper-sysid`: record a sweep, find out what is bus, sensor and servo, calibrate, report."""

from __future__ import annotations

import os
from collections.abc import Sequence

# Vectorised NumPy is the inner loop and joints run in processes: BLAS threads would only fight.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pupper_sysid.cli.program import commands_of, run_command

DESCRIPTION = "Measure a cheap servo."
_SUMMARIES = {
    "robot": {
        "init-robot": "Begin a joint map for another robot.",
        "scan": "List the servos on a bus.",
        "monitor": "Watch the joints live; nothing moves.",
        "park": "Switch the torque of robots off.",
        "calibrate-joints": "Measure zero, range and direction of each joint.",
        "emulate": "Emulate a robot behind the real protocols.",
    },
    "recording": {
        "sweep": "Record joints that move, also without a robot.",
        "import": "Turn another project's log into a recording.",
        "view": "Write a file for Rerun or Foxglove.",
        "doctor": "Check whether a recording is usable.",
        "delay": "Split the lag into bus, sensor and servo.",
        "bode": "Measure frequency response; hysteresis and play.",
        "backlash": "",
        "plan": "Plan the sweep that narrows the intervals most.",
    },
    "model": {
        "calibrate": "Fit DelayedPD per joint; write YAML.",
        "sindy": "Find a sparse equation of motion per joint.",
        "fit-servo": "Fit an MLP, LSTM, FIR or other model.",
        "compare": "Compare models on the same readings.",
        "compare-truth": "Compare a calibration with the emulated truth.",
    },
    "use": {
        "report": "Write figures and tables as one HTML page.",
        "export": "Convert for MuJoCo, Isaac Lab, Newton, CSV …",
        "servo": "List, show and compare servo cards.",
        "samples": "Copy sample recordings, policies and models here.",
    },
}
_MODULES = {
    "bus": "scan monitor park", "joint_maps": "init-robot calibrate-joints", "cards": "servo",
    "recordings": "import view doctor delay bode backlash report samples",
    "models": "calibrate sindy fit-servo compare compare-truth",
}  # fmt: skip
COMMANDS = commands_of(
    _SUMMARIES, _MODULES,
    holding_bus={"scan", "monitor", "park", "calibrate-joints", "emulate", "sweep"},
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    run_command("pupper-sysid", DESCRIPTION, COMMANDS, arguments)


if __name__ == "__main__":
    main()
