"""How near is the compiled simulation of the fit to the same loop in C, and to NumPy?

    .venv/bin/python benchmarks/kernel_speed.py

All three simulate DelayedPD candidates on one trial of 1,500 steps and subtract 160 readings.
Slices of about 0.2 s alternate between them; the medians of the ratios of processor time are
printed with their middle half, beside the load of the machine. C is the same arithmetic on 16
candidates abreast, optimised for this processor (flags in `in_c`); without `cc` it is left out.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from pupper_sysid.servo_models.delay_line import fractional_shift
from pupper_sysid.servo_models.delayed_pd import FRICTION_IMPEDANCE, TIME_STEP_S
from pupper_sysid.sysid.identify.candidates.models import candidate_model
from pupper_sysid.sysid.identify.candidates.simulation import TrialData, look_up, residuals

STEPS, READINGS, CANDIDATES, SLICES = 1500, 160, 2048, 15
PAD = 64

C_SOURCE = r"""
#include <math.h>
#include <stdlib.h>
#define L 16
static inline double clip(double x, double a) { x = x > a ? a : x; return x < -a ? -a : x; }
void residuals(const double *values, const double *command, const double *step,
               const double *reading, double *out, double *track, int count, int samples,
               int steps, int pad, double h, double stop) {
  for (int first = 0; first < count; first += L) {
    double kp[L], kd[L], fr[L], ef[L], sl[L], gn[L], y[L], v[L], s[L], part[L];
    int shift[L];
    for (int i = 0; i < L; i++) {
      const double *p = values + 7 * (first + i);
      double late = p[0] / h, whole = floor(late);
      shift[i] = pad - (int)whole; part[i] = late - whole;
      kp[i] = p[1]; kd[i] = p[2]; fr[i] = p[3]; ef[i] = p[4]; sl[i] = p[5] * h;
      gn[i] = h / (1 + h * kd[i]); y[i] = v[i] = s[i] = 0; track[i] = 0;
    }
    for (int k = 0; k < steps; k++) {
      double *row = track + L * (k + 1);
      for (int i = 0; i < L; i++) {
        double now = command[k + shift[i]];
        double d = (command[k + shift[i] - 1] - now) * part[i] + now;
        s[i] += clip(d - s[i], sl[i]);
        double wanted = (s[i] - y[i]) * kp[i] - kd[i] * v[i], force = clip(wanted, ef[i]);
        double gain = force == wanted ? gn[i] : h;
        force += clip((v[i] * (1 / h) + force) * stop, fr[i]);
        v[i] += force * gain; y[i] += v[i] * h; row[i] = y[i];
      }
    }
    for (int n = 0; n < samples; n++) {
      int row = (int)step[n]; if (row > steps - 1) row = steps - 1;
      double share = step[n] - row;
      for (int i = 0; i < L; i++) {
        double low = track[L * row + i];
        double position = low + share * (track[L * (row + 1) + i] - low);
        out[(long)(first + i) * samples + n] = position + values[7 * (first + i) + 6] - reading[n];
      }
    }
  }
}
"""


def in_c(values: np.ndarray, trial: TrialData) -> Callable[[], np.ndarray] | None:
    """The loop in C on the same candidates, or None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp())
    (folder / "loop.c").write_text(C_SOURCE)
    flags = [
        "-O3", "-march=native", "-mprefer-vector-width=512", "-ffp-contract=off",
        "-fno-trapping-math", "-fno-signed-zeros", "-shared", "-fPIC",
    ]  # fmt: skip
    library = folder / "loop.so"
    subprocess.run([compiler, *flags, "-o", library, folder / "loop.c", "-lm"], check=True)
    loop = ctypes.CDLL(str(library)).residuals
    command = np.concatenate([np.zeros(PAD), trial.command])
    out, track = np.empty((len(values), READINGS)), np.empty((STEPS + 1, 16))
    arrays = (values, command, trial.sample_step, trial.sample_rad, out, track)
    numbers = [ctypes.c_int(n) for n in (len(values), READINGS, STEPS, PAD)]
    reals = [ctypes.c_double(x) for x in (TIME_STEP_S, -FRICTION_IMPEDANCE)]

    def run() -> np.ndarray:
        loop(*(ctypes.c_void_p(a.ctypes.data) for a in arrays), *numbers, *reals)
        return out

    return run


def in_numpy(values: np.ndarray, trial: TrialData) -> np.ndarray:
    """The reference: all candidates abreast."""
    history = np.concatenate([np.zeros(PAD), trial.command])[:, None]
    track = np.zeros((STEPS + 1, len(values)))
    column = np.zeros(len(values), int)
    track[1:] = fractional_shift(history, STEPS, values[:, 0] / TIME_STEP_S, column)
    candidate_model("delayed_pd").simulate(np.ascontiguousarray(values[:, 1:-1].T), track[1:])
    return look_up(track, trial.sample_step).T + values[:, -1:] - trial.sample_rad


def slice_ns(work: Callable[[], np.ndarray]) -> float:
    """Processor time per simulated step over a slice of 0.2 s [ns]."""
    began, count = time.process_time(), 0
    while time.process_time() - began < 0.2:
        work()
        count += 1
    return 1e9 * (time.process_time() - began) / (count * CANDIDATES * STEPS)


def main() -> None:
    """Check that all agree, measure in turns, print."""
    rng = np.random.default_rng(0)
    model = candidate_model("delayed_pd")
    unit = rng.uniform(0.2, 0.8, (CANDIDATES, len(model.parameters)))
    columns = []
    for p, u in zip(model.parameters, unit.T, strict=True):
        low, high = float(p.encode(p.low)), float(p.encode(p.high))
        columns.append(p.decode(low + u * (high - low)))
    values = np.ascontiguousarray(np.stack(columns, axis=1))
    command = 0.3 * np.sin(2 * np.pi * 3.0 * TIME_STEP_S * np.arange(STEPS))
    empty = np.zeros(0)
    trial = TrialData(
        3.0, 0.0, command, np.sort(rng.uniform(0, STEPS, READINGS)), np.zeros(READINGS), empty,
        empty, empty,
    )  # fmt: skip
    ways: dict[str, Callable[[], np.ndarray]] = {
        "numba": lambda: residuals(model, values, [trial]),
        "NumPy": lambda: in_numpy(values, trial),
    }
    if c := in_c(values, trial):
        ways["C"] = c
    expected = ways["NumPy"]()
    for name, work in ways.items():
        assert np.allclose(work(), expected, atol=1e-9), f"{name} computes something else"
    load = os.getloadavg()[0]
    measured = {name: [] for name in ways}
    for _ in range(SLICES):
        for name, work in ways.items():
            measured[name].append(slice_ns(work))
    print("| way | ns per step | times numba (middle half) |\n|---|---|---|")
    for name, times in measured.items():
        ratio = np.array(times) / np.array(measured["numba"])
        low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75])
        print(f"| {name} | {np.median(times):.2f} | {middle:.2f} ({low:.2f} to {high:.2f}) |")
    print(f"\nLoad of the machine at the start {load:.1f}, at the end {os.getloadavg()[0]:.1f}.")


if __name__ == "__main__":
    main()
