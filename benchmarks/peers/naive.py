"""The usual script: cross-correlate, call the lag the delay, take gains from a paper."""

import numpy as np
from exchange import STEP_S, Fitted, serve

KP, KD, FRICTION, ARMATURE, EFFORT = 70.0, 1.2, 0.03, 0.005, 5.0


def fit(trials):
    lags = []
    for t in trials:
        period = np.mean(np.diff(t.time_s))
        command = t.command_rad[: len(t.position_rad)]
        position = t.position_rad - np.mean(t.position_rad)
        product = np.correlate(position, command - np.mean(command), "full")
        lags.append((np.argmax(product) - len(command) + 1) * period)
    delay = float(np.mean(lags))

    def predict(trial):
        order = np.searchsorted(trial.command_time_s, trial.grid_s - delay, "right") - 1
        command = np.where(order >= 0, trial.command_rad[np.maximum(order, 0)], trial.rest_rad)
        q, v, out = trial.rest_rad, 0.0, []
        for target in command:
            out.append(q)
            effort = np.clip(KP * (target - q) - KD * v, -EFFORT, EFFORT)
            v += STEP_S * (effort - FRICTION * np.sign(v)) / ARMATURE
            q += STEP_S * v
        return out

    return Fitted(predict, delay)


serve(fit)
