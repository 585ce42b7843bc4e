"""Section of the report on servo models: a comparison as table and figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from pupper_sysid.common.page import Column, Picture, Section, Table
from pupper_sysid.sysid.report.data_curve import MODELS, data_curve_figure, measured
from pupper_sysid.sysid.report.tables import KEY, number, text
from pupper_sysid.sysid.servo_fit.scores import LINEAR

if TYPE_CHECKING:  # it brings torch
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
