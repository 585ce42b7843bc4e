"""Error of servo models against the amount of data, measured by a benchmark.

`benchmarks/servo_data_curve.py` fits every kind of model to more and more samples of the emulated
robot and writes `data/servo_data_curve.csv`, which this module reads and draws.
"""

from __future__ import annotations

from importlib import resources

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


def measured() -> pd.DataFrame:
    """Error in free run [rad] by samples per joint (rows) and model of `MODELS` (columns)."""
    with (resources.files("pupper_sysid.sysid.report") / "data" / FILE).open() as file:
        table = pd.read_csv(file)
    curve = table.pivot(index="samples_per_joint", columns="model", values="rmse_free_run_rad")
    return curve.sort_index().reindex(columns=[m for m in MODELS if m in curve])


@styled
def data_curve_figure(curve: pd.DataFrame, own_samples: int | None = None) -> Figure:
    """Error against samples, a line per model; `own_samples` marks a recording's own number."""
    figure, (axes,) = axes_column(1, 3.6)
    for model, errors in curve.items():
        title, colour, marker, line = MODELS[str(model)]
        axes.loglog(curve.index, 1e3 * errors, marker=marker, color=colour, ls=line, label=title)
    if own_samples is not None:
        axes.axvline(own_samples, color=FAINT, lw=1.5, zorder=0)
        axes.text(
            own_samples, 0.98, " this recording", transform=axes.get_xaxis_transform(), va="top",
            fontsize=8,
        )  # fmt: skip
    axes.set_xlabel("samples per joint")
    axes.set_ylabel("error in free run [mrad]")
    axes.set_xticks(list(curve.index), [f"{samples:,}" for samples in curve.index])
    axes.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=7.5)
    figure.set_figwidth(8.0)
    return figure
