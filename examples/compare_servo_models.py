# %% [markdown]
# # Compare servo models
#
# Fit two kinds of model to a sweep and score them, beside a published setting, on motions that
# neither has seen: the playback of a trot. This page is `examples/compare_servo_models.py`, run
# when the documentation is built.
# %%
import pupper_sysid as ps
from pupper_sysid.data import SAMPLES

sweep, walk = ps.load(SAMPLES / "sweep.csv"), ps.load(SAMPLES / "playback.csv")
joint = "LF_thigh"
calibrated = ps.calibrate(sweep, joint).calibration
linear = ps.fit_servo(sweep, joint, arch="fir")

# %% [markdown]
# Every model predicts *readings*: positions in free run from the commands alone, with the age that
# the bus gives them. `rmse_held_rad` compares those with what was logged, stale readings included.
# %%
found = ps.compare(walk, [calibrated, linear, "paper"], joint)
for name, model in found.models.items():
    print(f"{name:20s} {1e3 * model.mean.rmse_held_rad:6.1f} mrad")

# %% [markdown]
# The last row is a linear filter that has seen these very readings: what a model without friction
# and without limits could reach. All scores are in `to_frame()`; here is the figure.
# %%
found.plot()
