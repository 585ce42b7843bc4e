"""`pupper-analyze`: measures of a gait, the origin of its rhythm, and its robustness."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pupper_sysid.cli.program import commands_of, run_command, user_errors
from pupper_sysid.common.errors import InputError

DESCRIPTION = """Analyse the walk of policies in the simulator: tables, JSON and a picture each.

Example: pupper-analyze gait runs/<name> --command 0.15 0 0
"""
_SUMMARIES = {
    "rhythm": {
        "gait": "Frequency, sine fit, phases, duty, jitter.",
        "attractor": "Orbits of actions and hidden states.",
        "autonomy": "Frozen inputs, pushes, other control rates.",
    },
    "walk": {
        "delay": "More delay, in replay and closed loop.",
        "ablation": "Noise, zeros and staleness per channel.",
        "terrain": "Rough ground, slopes, troughs.",
        "compliance": "Path, drift and arc in six directions.",
    },
    "servos": {
        "servo": "Four servo models on unseen readings.",
        "twin": "A recording's commands on the whole simulated robot.",
        "servo-demand": "What a gait needs, against what a servo has.",
    },
}
COMMANDS = commands_of(
    _SUMMARIES, {"servo_tests": "servo servo-demand twin",
                 "walks": "gait attractor autonomy delay ablation terrain compliance"},
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; ends the process with 0, 2 (bad input, one sentence) or 1."""
    typed = list(sys.argv[1:] if arguments is None else arguments)
    if typed[:1] == ["claims"]:
        with user_errors(typed, "pupper-analyze"):
            raise InputError(
                "The published claims are tested apart from the tool: run "
                f"`{' '.join(['python -m reproduction', *typed[1:]])}` in the repository."
            )
    run_command("pupper-analyze", DESCRIPTION, COMMANDS, typed)


if __name__ == "__main__":
    main()
