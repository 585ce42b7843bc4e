"""What a report shows of a calibration file is what the fit that made the file found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sysid.identify.calibrate import calibrate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.report.figure_data import tracks
from pupper_sysid.sysid.report.recall import can_recall, recall

SWEEP = Path(__file__).resolve().parents[3] / "data/samples/sweep.csv"
JOINT = "LF_thigh"


def test_results_of_the_file_are_those_of_the_fit(tmp_path):
    swept = load(SWEEP)
    made = calibrate(swept, JOINT)
    made.save(tmp_path / "made.yaml")
    known = load_calibration(tmp_path / "made.yaml")
    assert can_recall(known.joint(JOINT))
    fitted, found = made[JOINT], recall(known, swept, [JOINT])[JOINT]
    assert (found.model, found.simulated_model) == (fitted.model, fitted.simulated_model)
    assert found.dead_time_s == fitted.dead_time_s and found.warnings == fitted.warnings
    for name in ("lag_s", "raw_lag_s", "fresh_lag_s", "stale_lag_s", "command_hold_s"):
        assert getattr(found.lag, name) == getattr(fitted.lag, name), name
    assert list(found.candidate_models) == list(fitted.candidate_models)
    for name, fit in fitted.candidate_models.items():
        again = found.candidate_models[name]
        assert again.values == pytest.approx(fit.values)
        for score in ("rmse_fresh_rad", "rmse_held_rad", "rmse_leave_one_frequency_out_rad"):
            own, other = getattr(fit.scores, score), getattr(again.scores, score)
            assert own == pytest.approx(other, nan_ok=True), (name, score)
    assert found.delayed_pd.parameters == fitted.delayed_pd.parameters
    for before, after in zip(tracks(fitted), tracks(found), strict=True):
        np.testing.assert_allclose(after.model_rad, before.model_rad, atol=1e-9)
