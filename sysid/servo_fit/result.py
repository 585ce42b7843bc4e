"""ServoFit: a fitted servo model with its scores on unseen data, saved with its contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.files import versions
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result, internal, plain
from pupper_sysid.servo_models.calibration.calibration import utc_now
from pupper_sysid.servo_models.interface import ServoModel
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.servo_models.servo_file import input_names, save_servo_model
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.scores import ModelScores, Scores, Tracks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Learned = CommandNetwork | RecurrentNetwork


@dataclass(frozen=True, kw_only=True)
class FitScores(Scores):
    """Scores of a fitted model on one joint, or their means, beside the baselines."""

    linear_rmse_rad: float
    delayed_pd_rmse_rad: float
    """`linear_rmse_rad` and `delayed_pd_rmse_rad`: free run of a linear filter and of DelayedPD
    fitted to the same readings [rad]."""
    persistence_rmse_rad: float
    """The last reading as the prediction of the next [rad]."""
    repeatability_rad: float
    """RMS difference of repetitions over √2 [rad]; NaN if no command was repeated."""
    band_noise_rad: float
    band_timing_s: float
    """`band_noise_rad` and `band_timing_s`: standard deviation of the error at speed v: sqrt(noise²
    + (timing · v)²)."""


@dataclass(frozen=True, kw_only=True)
class ServoFit(Result):
    """A fitted servo model and its scores on readings it was not fitted to."""

    arch: str
    preset: str
    seed: int
    split: str
    """What was for training and what for testing."""
    readings_counted: dict[str, str]
    """Per joint, "fresh" or "all"."""
    groups: tuple[str, ...]
    """What could be held out."""
    time_step_s: float
    """Time between commands."""
    choices: dict[str, float]
    """Hyper-parameters chosen by held-out groups."""
    joints: dict[str, FitScores]
    mean: FitScores
    """Over joints."""
    rmse_free_run_rad: Interval
    linear_rmse_rad: Interval
    difference_to_linear_rad: Interval
    """`rmse_free_run_rad`, `linear_rmse_rad` and `difference_to_linear_rad`: means over joints of
    the model, of the linear filter, and their difference."""
    coverage_of_90_percent_band: float
    """Share of the test readings inside the predictive band."""
    readings: dict[str, int]
    """Per joint, that the model was fitted to."""
    recordings: tuple[dict[str, str], ...]
    """Name and SHA-256 of each."""
    verdict: str
    """Whether the model is better than the linear filter."""
    notes: tuple[str, ...]
    interrupted: bool
    """Whether Ctrl-C ended the training; the best model so far was kept."""
    model: ServoModel = internal()
    """Fitted to the whole training part (to everything, where groups were left out in turn)."""
    parameters: Mapping[str, NDArray[np.floating]] = internal()
    """Its arrays, for a model file."""
    scored: dict[str, ModelScores] = internal()
    """Under the name of the architecture, "linear" and "delayed-pd"."""
    data: ServoData = internal()
    tracks: Tracks = internal()
    """Free run of the model."""

    def to_frame(self) -> pd.DataFrame:
        """Scores, one row per joint."""
        rows = [{"joint": joint} | asdict(s) for joint, s in self.joints.items()]
        return pd.DataFrame(rows).set_index("joint")

    def plot(self, joints: Sequence[str] | None = None) -> Figure:
        """Figure of the model in free run beside commands and readings, a panel per joint."""
        from pupper_sysid.sysid.servo_fit.figures import free_run_figure

        bands = {j: (s.band_noise_rad, s.band_timing_s) for j, s in self.joints.items()}
        return free_run_figure(
            self.data, {self.arch: self.tracks}, {self.arch: self.scored[self.arch].errors},
            {self.arch: bands}, joints,
        )  # fmt: skip

    def save(self, folder: Path | str, force: bool = False) -> None:
        """Save the model with its contract: what it was fitted to, how, and how good it is.

        Parameters
        ----------
        folder : Path or str
            Made if missing.
        force : bool
            Replace a model that is there.
        """
        feedback = isinstance(self.model, Learned) and self.model.feedback
        warm_up = self.model.warm_up if isinstance(self.model, RecurrentNetwork) else 0
        contract = {
            "arch": self.arch, "preset": self.preset, "created": utc_now(),
            "time_step_s": self.time_step_s, "inputs": input_names(self.parameters, feedback),
            "feedback": feedback, "warm_up": warm_up,
            "joints": {joint: self._joint(joint) for joint in self.joints},
            "readings_counted": self.readings_counted, "split": self.split,
            "choices": self.choices, "recordings": self.recordings, "seed": self.seed,
            "versions": versions("torch", "safetensors"), "notes": [self.verdict, *self.notes],
        }  # fmt: skip
        save_servo_model(Path(folder), self.parameters, contract, force)

    def _joint(self, joint: str) -> dict[str, Any]:
        known = plain(self.joints[joint])
        return {
            "scores": {k: v for k, v in known.items() if k.endswith("_rad")},
            "band_noise_rad": known["band_noise_rad"] or 0.0,
            "band_timing_s": known["band_timing_s"] or 0.0,
            "readings": self.readings[joint],
        }


def verdict(
    arch: str, scores: Mapping[str, ModelScores], difference: Interval, repeatability_rad: float
) -> str:
    """Comparison with the linear filter and with the robot's repeatability, in words."""
    if arch == "fir":
        return "This is the linear model itself."
    name = {"delayed-pd": "DelayedPD", "sindy": "sparse equation"}.get(arch, arch.upper())
    linear = scores["linear"].mean.rmse_free_run_rad
    gain, low, high = (
        100 * x / linear for x in (difference.value, difference.low, difference.high)
    )
    how = "better" if high < 0 else "worse" if low > 0 else "not better"
    text = (
        f"The {name} is {how} than the linear model on this data "
        f"({gain:+.0f} %, 90 % interval {low:+.0f} to {high:+.0f} %)."
    )
    if np.isfinite(repeatability_rad):
        above = scores[arch].mean.rmse_free_run_rad - repeatability_rad
        text += (
            f" The robot's repeatability is {1e3 * repeatability_rad:.1f} mrad; the model is "
            f"{1e3 * above:.1f} mrad above it."
        )
    return text
