"""Runs on the physics clock, made from arrays."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.servo_models.kernel import edges_of
from pupper_sysid.servo_models.step_size import CONTINUOUS_S
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run
from pupper_sysid.sysid.fit.search import Problem
from pupper_sysid.sysid.fit.structure import LONGEST_DEAD_TIME_S, Structure

PAD = int(LONGEST_DEAD_TIME_S / TIME_STEP_S) + 4
NOTHING = np.empty(0)


def run_of(
    command: NDArray[np.float64],
    frequency_hz: float = float("nan"),
    rest_rad: float = 0.0,
    sample_step: NDArray[np.float64] = NOTHING,
    sample_rad: NDArray[np.float64] = NOTHING,
    row_step: NDArray[np.float64] | None = None,
    held_step: NDArray[np.float64] | None = None,
    row_rad: NDArray[np.float64] | None = None,
) -> Run:
    """A run in free air under `command` [rad], one a step; its rows are its samples by default."""
    row_step = sample_step if row_step is None else row_step
    held = np.concatenate([np.full(PAD, rest_rad), command])
    return Run(
        label="trial 0", frequency_hz=frequency_hz, p_gain=1.0, load=np.zeros(3),
        held=held[None], edges=edges_of(held), pad=PAD, start_rad=rest_rad,
        sample_step=sample_step, sample_rad=sample_rad, row_step=row_step,
        held_step=row_step if held_step is None else held_step,
        row_rad=sample_rad if row_rad is None else row_rad,
    )  # fmt: skip


def fine_run(command: NDArray[np.float64], every_s: float = 0.01) -> Run:
    """A run under `command` [rad], one a `CONTINUOUS_S`, with readings of zero from 0.1 s on."""
    rest = np.full(int(LONGEST_DEAD_TIME_S / CONTINUOUS_S) + 25, command[0])
    held = np.concatenate([rest, command])
    step = np.arange(0.1 / CONTINUOUS_S, len(command) - 1, every_s / CONTINUOUS_S)
    return Run(
        label="", frequency_hz=float("nan"), p_gain=1.0, load=np.zeros(3), held=held[None],
        edges=edges_of(held), pad=len(rest), start_rad=0.0, sample_step=step,
        sample_rad=np.zeros(len(step)), row_step=step, held_step=step,
        row_rad=np.full(len(step), np.nan), step_s=CONTINUOUS_S,
    )  # fmt: skip


def problem_of(
    structure: Structure, truth: NDArray[np.float64], run: Run, noise_rad: float,
    rng: np.random.Generator,
) -> Problem:  # fmt: skip
    """To find the numbers of a servo from a run that it makes, read with noise."""
    (track,) = free_run(structure, truth, (run,))
    read = at_steps(track, run.sample_step)
    read += noise_rad * rng.standard_normal(len(read))
    return Problem(structure, (replace(run, sample_rad=read),), (noise_rad,))
