# ruff: noqa: E402
# %% [markdown]
# # Lag of a log
#
# Load a recording, ask whether it is usable, and split its lag. This page is
# `examples/lag_of_a_log.py`, run when the documentation is built: below each piece of code is what
# it printed. The recording is one of the samples that come with the package, of an emulated robot.
#
# Everything starts at one import. `ps.load` reads logs of other projects, too; a `Recording` also
# comes from arrays (`ps.Recording.from_arrays`) or a table (`from_frame`).
# %%
import pupper_sysid as ps
from pupper_sysid.data import SAMPLES

recording = ps.load(SAMPLES / "sweep.csv")
print(recording.joints, f"at {1 / recording.loop_period_s:.1f} Hz")

# %% [markdown]
# ## Is it usable?
# %%
found = ps.doctor(recording, "LF_thigh")["LF_thigh"]
print(found.verdict)
for reason in found.reasons:
    print("-", reason)

# %% [markdown]
# ## How late, and which part is the servo's?
#
# Functions take some of the joints, or by default all, and return results by joint. Times are in
# seconds; a number with an interval has `value`, `low` and `high`.
# %%
lags = ps.delay(recording, "LF_thigh")
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
# The lag is not one number: a filter's grows with frequency or falls, a dead time's does not.
# %%
import matplotlib.pyplot as plt
import numpy as np

frequency_hz, _, late = zip(*tones, strict=True)
low, high = np.array([(value.low, value.high) for value in late]).T
figure, axes = plt.subplots(figsize=(7, 3))
axes.fill_between(frequency_hz, 1e3 * low, 1e3 * high, alpha=0.3, label="90 % interval")
axes.plot(frequency_hz, [1e3 * value.value for value in late], "o-", label="servo lag")
axes.axhline(1e3 * lag.dead_time_s.value, color="0.5", ls="--", label="dead time")
axes.set(xlabel="frequency [Hz]", ylabel="lag [ms]", title="LF_thigh", ylim=(0, None))
axes.legend()
