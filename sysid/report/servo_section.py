"""Section of the report on servo models: a comparison as table and figures.

Its curve of error against the amount of data is `data/servo_data_curve.csv`: the benchmark
`benchmarks/servo_data_curve.py` fits every kind of model to more and more samples of the emulated
robot.
"""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, FAINT, GREEN, INK, RED, axes_column, styled
from pupper_sysid.common.page import Column, Picture, Section, Table
from pupper_sysid.sysid.report.tables import KEY, number, text
from pupper_sysid.sysid.servo_fit.scores import LINEAR

if TYPE_CHECKING:
    from pupper_sysid.sysid.compare.comparison import Comparison


def servo_section(found: Comparison) -> Section:
    """Section of a comparison of servo models on the report's recordings."""
    rows = tuple(found.to_frame().reset_index().to_dict("records"))
    columns = (
        KEY,
        text("model", "model"),
        number("free run, mrad", "rmse_free_run_rad", 1, 1e3),
        number("held", "rmse_held_rad", 1, 1e3),
        number("raw, predicted readings", "rmse_raw_rad", 1, 1e3),
        number("one step", "rmse_one_step_rad", 1, 1e3),
        number("persistence", "persistence_rmse_rad", 1, 1e3),
        number("repeatability", "repeatability_rad", 1, 1e3),
    )
    pictures = [
        Picture(
            f"servo_{joint}",
            f"{joint}: models in free run, commands only. The shaded band is where the first "
            "model predicts nine readings in ten, from its errors on data held out of its fit; it "
            "widens with speed, because the time of a polled reading is uncertain.",
            found.plot([joint]),
        )
        for joint in found.data.joints
    ]
    curve = measured()
    runs = found.data.runs.values()
    own = int(np.median([sum(len(r.readings.rows) for r in joint) for joint in runs]))
    pictures.append(
        Picture(
            "servo_data_curve",
            "How much data a servo model needs, measured on the emulated robot under random "
            "commands of 0.5 to 4 Hz (the emulated servo is a DelayedPD, which therefore needs "
            "least). The line marks the readings per joint of this recording.",
            data_curve_figure(curve, own),
        )
    )
    return Section(
        "servo",
        "Servo models",
        text=[
            "Error of each model in free run, from commands only. "
            f"“{LINEAR}” predicts each group from a filter fitted to the others; persistence is "
            "the reading before as the prediction of the next."
        ],
        figures=pictures,
        tables=[
            Table("servo_models", "Error of the servo models", columns, rows),
            _curve_table(curve),
        ],
        notes=[*found.reading_notes(), *found.notes],
    )


def _curve_table(curve: pd.DataFrame) -> Table:
    rows = curve.add_suffix("_rad").reset_index().to_dict("records")
    columns = (
        Column("samples per joint", lambda row: f"{row['samples_per_joint']:,}", "key"),
        *(number(f"{MODELS[m][0]}, mrad", f"{m}_rad", 1, 1e3) for m in map(str, curve)),
    )
    return Table("servo_data_curve", "Error against samples, emulated robot", columns, tuple(rows))


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
