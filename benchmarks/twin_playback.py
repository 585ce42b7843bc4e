"""Twin test of the real walk: does the simulated robot move like the real one?

The commands of `playback_lstm_25hz.csv` on the whole simulated robot, in the air and on the ground,
with four sets of servos: the published ones (`paper`, `release`), those calibrated from the sweeps
of one hip and one thigh, which have not seen the walk, and those refitted on its loops 0 and 1.
Scored on loop 2, with the offsets of the others. Readings are predicted with the poll of the
sweeps; the published settings, whose delay was found with ideal feedback, also without it. A linear
filter and an MLP fitted to loops 0 and 1 stand beside them (`real_recordings.py walk`).

    .venv/bin/python benchmarks/twin_playback.py --picture docs/pictures/twin.png
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from shared import REAL, print_rows  # isort: skip

import numpy as np
import tyro
from matplotlib.figure import Figure
from real_recordings import SPLIT, SWEEPS, WALK

from pupper_sysid.common.figure_style import ORANGE, PINK, save, styled
from pupper_sysid.common.interval import Interval
from pupper_sysid.policies.twin.drawing import Actuator, of_calibration, robot_for
from pupper_sysid.policies.twin.twin import ActuatorTwin, Twin, draw_bars, draw_joint, twin
from pupper_sysid.servo_models.calibration.calibration import PRESETS, load_calibration
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit.fit import fit_servo

CALIBRATED, REFITTED = "calibrated (sweeps)", "refitted (loops 0, 1)"
SHOWN = ("LF_hip", "LF_thigh", "LF_calf")


def mrad(error: Interval) -> str:
    """An error with its interval."""
    return f"{1e3 * error.value:.1f} ({1e3 * error.low:.1f}–{1e3 * error.high:.1f})"


def cells(name: str, model: ActuatorTwin) -> list[str]:
    """Row of the first table."""
    assert model.air is not None and model.ground is not None and model.evidence is not None
    errors = [(mrad(c.rmse_rad), f"{1e3 * c.mean.mae_rad:.1f}") for c in (model.air, model.ground)]
    upright = f"{model.ground.upright} of {model.ground.copies}"
    return [name, *errors[0], *errors[1], upright, model.evidence.verdict]


def evidence_of(found: Twin) -> Iterator[list[str]]:
    """Rows of each actuator's evidence of where the robot was."""
    for name, model in found.models.items():
        assert model.evidence is not None
        every = zip(model.evidence.motion, model.evidence.load_share, strict=True)
        for scale, (motion, sag) in zip(("as they are", "× 4"), every, strict=True):
            shares = (motion and motion.correlation, motion and motion.share, sag)
            yield [name, scale, *(
                "–" if x is None else f"{x.value:.2f} ({x.low:.2f}–{x.high:.2f})" for x in shares
            )]  # fmt: skip


@styled
def drawn(found: Twin, beside: dict[str, float]) -> Figure:
    """Errors by actuator with the fitted models as lines, and one leg of the calibrated robot."""
    figure = Figure(figsize=(7.6, 6.0), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=[1.5, 1])
    bars = figure.add_subplot(grid[0, :])
    for (name, error), colour in zip(beside.items(), (ORANGE, PINK), strict=True):
        bars.axvline(1e3 * error, color=colour, ls=":", lw=1.8, label=f"{name} {1e3 * error:.1f}")
    draw_bars(bars, found)
    for column, joint in enumerate(SHOWN):
        axes = figure.add_subplot(grid[1, column])
        draw_joint(axes, found, joint, CALIBRATED)
        axes.set_xlabel("time [s]")
        if not column:
            axes.set_ylabel("rad")
    lines, labels = figure.axes[1].get_legend_handles_labels()
    figure.legend(
        lines, labels, loc="outside lower center", ncols=len(lines), title=f"{CALIBRATED}: one leg"
    )
    return figure


def main(picture: Path | None = None, seed: int = 0) -> None:
    """Print the tables, draw the picture."""
    walk = load(REAL / WALK)
    robot = robot_for(walk)
    first = Recording.from_frame(walk.table[walk.table["trial"] < 2], metadata=walk.metadata)
    calibrations = {name: load_calibration(name) for name in PRESETS} | {
        CALIBRATED: calibrate([load(REAL / name) for name in SWEEPS]).calibration,
        REFITTED: calibrate(first).calibration,
    }
    actuators: dict[str, Actuator] = {
        name: of_calibration(own, robot, walk) for name, own in calibrations.items()
    }
    loops = {"test_loops": [2], "seed": seed}
    found = twin(walk, actuators, robot, **loops)
    ideal = twin(walk, {name: actuators[name] for name in PRESETS}, robot, **loops).models
    models = {f"{name}, ideal feedback": own for name, own in ideal.items()} | found.models
    fitted = fit_servo(walk, None, "mlp", split=SPLIT, seed=seed).scored
    errors = {name: fitted[name].rmse_free_run_rad for name in ("linear", "mlp")}
    rows = [cells(name, model) for name, model in models.items()]
    for name, error in errors.items():
        rows.append([f"{name}, fitted to loops 0 and 1, no robot", mrad(error), *["–"] * 5])
    floor = 1e3 * np.mean(list(found.repeatability_rad.values()))
    print_rows(
        ("servos", "in the air: RMS mrad (90 %)", "mean abs.", "on the ground: RMS mrad (90 %)",
         "mean abs.", "upright", "the robot was"),
        [*rows, ["repeatability", f"{floor:.1f}", *["–"] * 5]],
    )  # fmt: skip
    print_rows(
        ("actuator", "torques", "correlation", "share of the motion", "share of the load"),
        evidence_of(found),
    )
    evidence = found.models[CALIBRATED].evidence
    assert evidence is not None
    print(f"\n{CALIBRATED}: {evidence.why}")
    if picture:
        beside = {"linear filter": errors["linear"].value, "MLP": errors["mlp"].value}
        save(drawn(replace(found, models=models), beside), picture, force=True)


if __name__ == "__main__":
    tyro.cli(main)
