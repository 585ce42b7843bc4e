"""The report's section on servo models: what `compare` finds, as table and pictures."""

from __future__ import annotations

import numpy as np

from pupper_sysid.common.page import Column, Picture, Section, Table
from pupper_sysid.sysid.report.data_curve import MODELS, DataCurve, data_curve_figure, measured
from pupper_sysid.sysid.servo_fit.compare import LINEAR, Comparison


def servo_section(found: Comparison) -> Section:
    """Section of a comparison of servo models on the report's recordings."""
    rows = tuple(found.to_frame().reset_index().to_dict("records"))
    columns = (
        Column("joint", lambda row: row["joint"], "key"),
        Column("model", lambda row: row["model"], "words"),
        *(
            Column(heading, lambda row, key=key: _mrad(row[key]))
            for heading, key in (
                ("free run, mrad", "rmse_free_run_rad"),
                ("through the hold", "rmse_held_rad"),
                ("rows as logged", "rmse_raw_rad"),
                ("one step", "rmse_one_step_rad"),
                ("stays put", "persistence_rmse_rad"),
                ("robot repeats", "repeatability_rad"),
            )
        ),
    )
    pictures = [
        Picture(
            f"servo_{joint}",
            f"{joint}: models in free run, commands only. The shaded band is where the first "
            "model expects nine readings in ten, from its errors on data held out of its fit; it "
            "widens with speed, because a polled reading's time is uncertain.",
            found.plot([joint]),
        )
        for joint in found.data.joints
    ]
    curve = measured()
    own = int(np.median([sum(len(r.readings.rows) for r in found.data.runs[j])
                         for j in found.data.joints]))  # fmt: skip
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
            "How far each model is from the readings when it is shown commands only. "
            f"“{LINEAR}” predicts each group from a filter fitted to the others; “stays put” is "
            "the reading before, which makes no prediction at all."
        ],
        figures=pictures,
        tables=[
            Table("servo_models", "Error of the servo models", columns, rows),
            _curve_table(curve),
        ],
        notes=found.notes,
    )


def _curve_table(curve: DataCurve) -> Table:
    rows = [
        {"samples_per_joint": n, **{f"{m}_rad": errors[i] for m, errors in curve.error_rad.items()}}
        for i, n in enumerate(curve.samples)
    ]
    columns = (
        Column("samples per joint", lambda row: f"{row['samples_per_joint']:,}", "key"),
        *(
            Column(f"{MODELS[m][0]}, mrad", lambda row, m=m: _mrad(row[f"{m}_rad"]))
            for m in curve.error_rad
        ),
    )
    return Table("servo_data_curve", "Error against samples, emulated robot", columns, tuple(rows))


def _mrad(value: float) -> str:
    return f"{1e3 * value:.1f}" if value == value else "–"
