"""Results of fits and comparisons: plain data, tables, figures, and models that are read back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.compare.compare import LINEAR, compare
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.servo_fit.fit import Split, fit_servo
from pupper_sysid.sysid.servo_fit.result import ServoFit
from support.servo_recordings import JOINT, P, recording, trial

ROWS = 120


@pytest.fixture(scope="module")
def walk() -> Recording:
    """Three equal loops of a servo that follows two ticks late, with noise of 3 mrad."""
    t = P * np.arange(3 * ROWS)
    command = 0.2 * np.sin(2 * np.pi * 0.9 * (t % (P * ROWS))) + 0.1 * np.sin(2 * np.pi * 2.5 * t)
    noise = np.random.default_rng(0).normal(0, 0.003, len(t))
    position = np.concatenate([[0.0, 0.0], command[:-2]]) + noise
    rows = [slice(ROWS * n, ROWS * n + ROWS) for n in range(3)]
    made = recording(*(trial(n, P * r.start, command[r], position[r]) for n, r in enumerate(rows)))
    return Recording.from_frame(made.table, metadata={"start_pose_rad": {JOINT: 0.0}})


@pytest.fixture(scope="module")
def fit(walk) -> ServoFit:
    return fit_servo(walk, arch="fir", split=Split.by_trials([0, 1], [2]), readings="all")


def test_a_fit_is_plain_data_and_its_table_has_the_same_numbers(walk, fit):
    again = fit_servo([walk], [JOINT], "fir", split=Split.by_trials([0, 1], [2]), readings="all")
    assert again.to_dict() == fit.to_dict(), "one recording is a sequence of one"
    data = json.loads(json.dumps(fit.to_dict()))
    assert data["split"] == "trained on loops 0,1, tested on 2" and data["arch"] == "fir"
    assert data["rmse_free_run_rad"]["value"] == data["mean"]["rmse_free_run_rad"]
    assert data["difference_to_linear_rad"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert data["readings"] == {JOINT: 2 * ROWS} and "model" not in data and "data" not in data
    (row,) = fit.to_frame().reset_index().to_dict("records")
    assert row.pop("joint") == JOINT and row == pytest.approx(data["joints"][JOINT], nan_ok=True)


def test_a_fit_is_saved_with_its_scores_and_not_over_another(fit, tmp_path):
    fit.save(tmp_path / "a")
    contract = load_servo_model(tmp_path / "a").contract
    scores = fit.to_dict()["joints"][JOINT]
    assert contract.joints[JOINT].scores == {k: v for k, v in scores.items() if k[-4:] == "_rad"}
    assert contract.split == fit.split and contract.seed == fit.seed
    with pytest.raises(FileExistsRefusal):
        fit.save(tmp_path / "a")
    fit.save(tmp_path / "a", force=True)


def test_models_are_compared_from_memory_as_from_files(walk, fit, tmp_path):
    fit.save(tmp_path / "a")
    found = compare(walk, [fit, load_calibration("paper")])
    files = compare(walk, [tmp_path / "a", "paper"])
    names = list(found.models)
    assert names == ["FIR", "DelayedPD", LINEAR]
    for ours, theirs in zip(names, files.models, strict=True):
        assert found.models[ours].joints == files.models[theirs].joints
    table = found.to_frame()
    assert list(table.index) == [(JOINT, name) for name in names]
    assert table.loc[(JOINT, "FIR"), "rmse_free_run_rad"] < 0.01
    assert json.loads(json.dumps(found.to_dict()))["time_step_s"] == pytest.approx(P)


def test_figures_have_a_panel_per_joint_and_a_line_per_model(walk, fit):
    (panel,) = fit.plot().axes
    assert panel.get_title(loc="left") == JOINT
    (panel,) = compare(walk, [fit, "paper"]).plot().axes
    labels = [text.get_text().split(",")[0] for text in panel.get_legend().get_texts()]
    assert labels == ["command", "reading", "FIR", "DelayedPD (paper)"]


def test_splits_that_would_test_on_seen_data_are_refused():
    with pytest.raises(InputError, match="Loop 1 is in `train_loops` and in `test_loops`"):
        Split.by_trials([0, 1], [1])
    with pytest.raises(InputError, match="`train_before_s` is 2 and `test_after_s` 1"):
        Split.by_time(2.0, 1.0)
