"""The fit of PACE (arXiv 2509.06342) without Isaac Sim: CMA-ES over a population of simulations.

Its parameters (armature, damping, friction, bias, one whole number of delay steps), its DC motor,
its squared error on a log resampled to the simulation's step; and, as its authors advise for servos
whose firmware gain is unknown, an effective gain.
"""

import cmaes
import numpy as np
from exchange import Fitted, serve

DT, EFFORT, SPEED, POPULATION, GENERATIONS = 0.0025, 5.0, 10.5, 256, 80
LOW = np.array([np.log(0.0005), np.log(0.01), 0.0, -0.2, 0.0, np.log(5.0)])
HIGH = np.array([np.log(0.05), np.log(10.0), 2.0, 0.2, 48.99, np.log(500.0)])


def simulate(values, commands):
    """Positions, shape (steps, candidates, trials), of commands (steps, trials) from rest."""
    armature, damping, friction, bias, delay, gain = np.array(values).T[:, :, None]
    armature, damping, gain = np.exp(armature), np.exp(damping), np.exp(gain)
    steps, late = len(commands), np.arange(len(commands))[:, None] - delay[:, 0].astype(int)
    delayed = np.where(late[..., None] >= 0, commands[np.maximum(late, 0)], 0.0)
    q = np.zeros(delayed.shape[1:])
    v, out = np.zeros_like(q), np.empty(delayed.shape)
    for k in range(steps):
        out[k] = q
        top, bottom = EFFORT * (1 - v / SPEED), EFFORT * (-1 - v / SPEED)
        effort = np.clip(
            gain * (delayed[k] - q - bias), np.clip(bottom, -EFFORT, 0), np.clip(top, 0, EFFORT)
        )
        free = (v + DT * effort / armature) / (1 + DT * damping / armature)
        v = np.sign(free) * np.maximum(np.abs(free) - DT * friction / armature, 0)
        q = q + DT * v
    return out


def held(trial, grid):
    last = np.searchsorted(trial.command_time_s, grid, "right") - 1
    return trial.command_rad[np.maximum(last, 0)] - trial.rest_rad


def fit(trials):
    grid = np.arange(0.0, min(t.time_s[-1] for t in trials), DT)
    commands = np.stack([held(t, grid) for t in trials], axis=1)
    measured = np.stack(
        [np.interp(grid, t.time_s, t.position_rad - t.rest_rad) for t in trials], axis=1
    )
    offset = np.mean(measured - commands)
    search = cmaes.CMA(
        np.zeros(6), 0.5, np.tile([-1.0, 1.0], (6, 1)), seed=0, population_size=POPULATION
    )
    for _ in range(GENERATIONS):
        asked = [search.ask() for _ in range(POPULATION)]
        values = LOW + (np.array(asked) + 1) / 2 * (HIGH - LOW)
        error = simulate(values, commands) + offset - measured[:, None]
        search.tell(list(zip(asked, np.mean(error**2, axis=(0, 2)), strict=True)))
    best = LOW + (search.mean + 1) / 2 * (HIGH - LOW)

    def predict(trial):
        grid = np.arange(0.0, trial.grid_s[-1] + DT, DT)
        path = simulate(best[None], held(trial, grid)[:, None])[:, 0, 0]
        return np.interp(trial.grid_s, grid, path) + offset + trial.rest_rad

    return Fitted(predict, DT * int(best[4]), DT)


serve(fit)
