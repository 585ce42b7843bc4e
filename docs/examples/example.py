# ruff: noqa: E402
# %% [markdown]
# # An example in Python
#
# Load a recording, split its lag, calibrate a servo model, plot it and simulate it. This page is
# `docs/examples/example.py`, run when the documentation is built: what you see below each
# piece of code is what it printed. The recording is one of the samples, of an emulated robot.
#
# Everything starts at one import. A `Recording` also comes from arrays
# (`ps.Recording.from_arrays`) or a table (`from_frame`).
# %%
import pupper_sysid as ps

recording = ps.load("data/samples/sweep.csv")
print(recording.joints, f"at {1 / recording.loop_period_s:.1f} Hz")

# %% [markdown]
# ## Is it usable?
# %%
found = ps.examine(recording, "LF_thigh")["LF_thigh"]
print(found.verdict)
for reason in found.reasons:
    print("-", reason)

# %% [markdown]
# ## How late, and which part is the servo's?
#
# Functions take some of the joints, or by default all, and return results by joint. Times are in
# seconds; a number with an interval has `value`, `low` and `high`.
# %%
lags = ps.lag(recording, "LF_thigh")
print(lags)

lag = lags["LF_thigh"]
print(f"stale readings {1e3 * lag.stale_lag_s:.1f} ms")
print(f"command hold {1e3 * lag.command_hold_s:.1f} ms")
print(f"servo        {1e3 * lag.lag_s.value:.1f} ms")
low_s, high_s = lag.dead_time_s.low, lag.dead_time_s.high
print(f"  of it dead time {1e3 * low_s:.1f} to {1e3 * high_s:.1f} ms (90 % interval)")

# %% [markdown]
# `to_dict()` is what `pupper-sysid delay --json` prints, `to_frame()` a table.
# %%
tones = [(tone.frequency_hz, round(tone.gain, 3), tone.lag_s) for tone in lag.by_frequency]
for frequency_hz, gain, lag_s in tones:
    print(f"{frequency_hz:4.1f} Hz  gain {gain:.3f}  lag {1e3 * lag_s.value:.1f} ms")

# %% [markdown]
# ## Calibrate
#
# Six candidate models are fitted in free run and chosen on frequencies left out of the fit;
# DelayedPD is what simulators get. `calibrated.save("calibrated.yaml")` writes the file.
# %%
calibrated = ps.calibrate(recording, "LF_thigh")
for name, candidate in calibrated["LF_thigh"].candidate_models.items():
    print(f"{name:20s} {1e3 * candidate.scores.rmse_fresh_rad:6.2f} mrad")

calibrated.plot()

# %% [markdown]
# ## Simulate
#
# The calibration gives the servo as a `DelayedPD` with a batch of joints, in the time step you
# ask for, and its feedback as a `HeldFeedback`. Here is its response to a step, 0.3 rad.
# %%
import numpy as np

calibration = calibrated.calibration
servo = calibration.delayed_pd(["LF_thigh"], time_step_s=0.002)
time_s = np.arange(0.0, 0.3, 0.002)
command = np.where(time_s < 0.02, 0.0, 0.3)[:, None]
servo.reset([0.0])
position = servo.rollout(command)

feedback = calibration.held_feedback("LF_thigh")
print(f"polled every {1e3 * feedback.poll_period_s:.1f} ms, {feedback.loss:.0%} of the polls lost")

# %% [markdown]
# What a controller reads of that motion: the position at the last poll that succeeded.
# %%
import matplotlib.pyplot as plt

polls = np.arange(0.0, 0.3, feedback.poll_period_s)
good = polls[np.random.default_rng(0).random(len(polls)) >= feedback.loss]
last = np.searchsorted(good, time_s, side="right") - 1
at_poll = np.interp(good, time_s, position[:, 0])
reading = np.where(last < 0, 0.0, at_poll[np.maximum(last, 0)])

figure, axes = plt.subplots(figsize=(7, 3))
axes.step(1e3 * time_s, command[:, 0], where="post", label="command", color="0.6")
axes.plot(1e3 * time_s, position[:, 0], label="position")
axes.step(1e3 * time_s, reading, where="post", label="reading")
axes.set(xlabel="time [ms]", ylabel="LF_thigh [rad]")
axes.legend()
