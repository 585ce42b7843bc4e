"""Fit servo models to the recordings of many robots at once.

One recording is one robot and becomes one model folder. Models that were fitted to the same file
with the same settings are kept; a recording that cannot be used does not stop the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pupper_sysid.common.files import sha256
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.fleet.calibration import Fleet, robots_in, run_fleet
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.servo_fit.data import servo_data
from pupper_sysid.sysid.servo_fit.fit import EACH_GROUP_IN_TURN, Split, fit_servo

QUANTITIES = {
    "free_run_mrad": "rmse_free_run_rad",
    "held_mrad": "rmse_held_rad",
    "linear_mrad": "linear_rmse_rad",
    "delayed_pd_mrad": "delayed_pd_rmse_rad",
    "persistence_mrad": "persistence_rmse_rad",
}
"""Columns of the table and the scores of the model's contract that they show: unseen data."""


@dataclass(frozen=True)
class ServoSettings:
    """Settings of every fit: parameters of `servo_fit.fit.fit_servo`."""

    arch: str = "mlp"
    preset: str = "default"
    split: Split = EACH_GROUP_IN_TURN
    readings: str = "auto"
    seed: int = 0


def fit_servo_fleet(
    root: Path,
    out: Path,
    settings: ServoSettings,
    jobs: int = 1,
    cluster: str | None = None,
    force: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Fleet:
    """Fit a servo model to every recording in `root`; a folder per robot in `out`, and the table.

    Parameters and errors as for `sysid.fleet.calibration.calibrate_fleet`.
    """
    targets = {path: out / name for path, name in robots_in(root).items()}
    return run_fleet(
        targets, lambda target, path: _is_of(target, path, settings),
        partial(_fitted, settings=settings), _numbers, tuple(QUANTITIES), out,
        jobs, cluster, force, progress,
    )  # fmt: skip


def _numbers(target: Path) -> dict[str, dict[str, float]]:
    """Scores of each joint of a model; NaN where it has no such score."""
    found = {}
    for joint, known in load_servo_model(target).contract.joints.items():
        errors = {name: known.scores.get(key) for name, key in QUANTITIES.items()}
        found[joint] = {k: float("nan") if e is None else 1e3 * e for k, e in errors.items()}
    return found


def _is_of(target: Path, path: Path, settings: ServoSettings) -> bool:
    """Whether a model was fitted to this file with these settings."""
    made = load_servo_model(target).contract
    return (
        [r.sha256 for r in made.recordings] == [sha256(path)]
        and (made.arch, made.preset, made.seed) == (settings.arch, settings.preset, settings.seed)
        and made.split == settings.split.name
        and made.readings_counted
        == servo_data([load(path)], list(made.joints), settings.readings, settings.seed).modes
    )


def _fitted(path: Path, target: Path, settings: ServoSettings) -> None:
    """Fit one robot's model."""
    fit_servo(load(path), **vars(settings), keep_unfinished=False).save(target, force=True)
