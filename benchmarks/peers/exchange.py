"""What passes between `compare.py` and a peer, as JSON: trials and which of them to fit, and back
where the fitted model goes under the commands of every trial.

A peer is a script with one function, `fit(trials)`; `serve(fit)` does the rest. Needs NumPy only,
because each peer has an environment of its own.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

STEP_S = 0.002  # of the grid on which predictions are given back


@dataclass(frozen=True)
class Trial:
    """One joint over one tone, as it stands in a log. Times from the first command on.

    Attributes
    ----------
    rest_rad : float
        Command in force before.
    command_time_s, command_rad : ndarray
    time_s, position_rad : ndarray
        Readings, none missing.
    steps : int
        Length of the prediction, in steps of `STEP_S`.
    """

    rest_rad: float
    command_time_s: NDArray[np.float64]
    command_rad: NDArray[np.float64]
    time_s: NDArray[np.float64]
    position_rad: NDArray[np.float64]
    steps: int

    @property
    def grid_s(self) -> NDArray[np.float64]:
        """Times of the prediction, shape (steps + 1,)."""
        return STEP_S * np.arange(self.steps + 1)


@dataclass(frozen=True)
class Fitted:
    """A fitted model: `predict(trial)` is its position on the trial's grid [rad]."""

    predict: Callable[[Trial], NDArray[np.float64]]
    dead_time_s: float | None = None
    step_s: float = STEP_S
    """Of the simulation that the delay is for: a longer step answers sooner."""
    dead_time_interval_s: tuple[float, float] | None = None
    """Of 90 %, where the method states one."""


def dump(trials: list[Trial], fits: list[list[int]]) -> str:
    """What a peer reads."""
    plain = [
        {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(t).items()}
        for t in trials
    ]
    return json.dumps({"trials": plain, "fits": fits})


def serve(fit: Callable[[list[Trial]], Fitted]) -> None:
    """Fit what standard input asks for, and print the answer as one line of JSON."""
    asked = json.load(sys.stdin)
    trials = [
        Trial(**{k: np.array(v) if isinstance(v, list) else v for k, v in t.items()})
        for t in asked["trials"]
    ]
    answers: list[dict[str, Any]] = []
    for chosen in asked["fits"]:
        began = time.perf_counter()
        made = fit([trials[i] for i in chosen])
        seconds = time.perf_counter() - began
        answers.append(
            {
                "seconds": seconds,
                "dead_time_s": made.dead_time_s,
                "step_s": made.step_s,
                "dead_time_interval_s": made.dead_time_interval_s,
                "positions_rad": [np.asarray(made.predict(t)).tolist() for t in trials],
            }
        )
    print(json.dumps(answers))
