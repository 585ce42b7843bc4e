"""Error of servo models against the amount of data, measured by a benchmark.

`benchmarks/servo_data_curve.py` fits every kind of model to more and more samples of the emulated
robot and writes `data/servo_data_curve.csv`, which this module reads and draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, INK, RED, axes_column, styled

FILE = "servo_data_curve.csv"
MODELS = {
    "fir": ("linear", INK, "o", "-"),
    "delayed-pd": ("DelayedPD", GREEN, "s", "-"),
    "mlp": ("MLP", BLUE, "^", "-"),
    "lstm": ("LSTM", RED, "D", "-"),
    "mlp paper": ("MLP, as published", BLUE, "v", ":"),
    "lstm paper": ("LSTM, as published", RED, ">", ":"),
}
"""Title, colour, marker and line of each model of the curve."""


@dataclass(frozen=True)
class DataCurve:
    """Error in free run against samples.

    Attributes
    ----------
    samples : tuple of int
        Per joint, increasing.
    error_rad : dict of str to tuple of float
        By model (a key of `MODELS`), one per number of samples; NaN where it was not run.
    """

    samples: tuple[int, ...]
    error_rad: dict[str, tuple[float, ...]]


def measured() -> DataCurve:
    """The curve as measured last."""
    with (resources.files("pupper_sysid.sysid.report") / "data" / FILE).open() as file:
        table = pd.read_csv(file)
    by_model = table.pivot(
        index="samples_per_joint", columns="model", values="rmse_free_run_rad"
    ).sort_index()
    return DataCurve(
        tuple(int(s) for s in by_model.index),
        {m: tuple(by_model[m]) for m in MODELS if m in by_model},
    )


@styled
def data_curve_figure(curve: DataCurve, own_samples: int | None = None) -> Figure:
    """Error against samples, a line per model; `own_samples` marks a recording's own number."""
    figure, (axes,) = axes_column(1, 3.6)
    for model, errors in curve.error_rad.items():
        title, colour, marker, line = MODELS[model]
        axes.loglog(
            curve.samples, 1e3 * np.array(errors), marker=marker, color=colour, ls=line,
            label=title,
        )  # fmt: skip
    if own_samples:
        axes.axvline(own_samples, color=FAINT, lw=1.5, zorder=0)
        axes.text(
            own_samples, 0.98, " this recording", transform=axes.get_xaxis_transform(), va="top",
            fontsize=8,
        )  # fmt: skip
    axes.set_xlabel("samples per joint")
    axes.set_ylabel("error in free run [mrad]")
    axes.set_xticks(curve.samples, [f"{s:,}" for s in curve.samples])
    axes.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5)
    figure.set_figwidth(8.0)
    return figure
