# ruff: noqa: E402
# %% [markdown]
# # Calibrate and simulate
#
# Fit servo models to a sweep, and simulate the chosen one with its feedback. This page is
# `examples/calibrate_and_simulate.py`, run when the documentation is built.
# %%
import pupper_sysid as ps
from pupper_sysid.data import SAMPLES

recording = ps.load(SAMPLES / "sweep.csv")

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
