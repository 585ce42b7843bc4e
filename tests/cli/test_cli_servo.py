"""`fit-servo`, `compare` and what they answer to data and files that cannot be used."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid.servo_fit import networks
from pupper_sysid.sysid.servo_fit.training import Recipe
from support.command_line import json_of, ran, refused, run

pytestmark = pytest.mark.usefixtures("here", "unexamined")


@pytest.fixture
def quick(monkeypatch):
    """Networks small and briefly trained: what is tested is not how good they are."""
    small = Recipe(4, 2, (0.3, 3.0), 40, 1e-2, 20, 2)
    monkeypatch.setattr(networks, "MLP", small)
    monkeypatch.setattr(networks, "LSTM", small)


def playback(path: str, loops: int = 3, rows: int = 60, step_s: float = 0.04) -> str:
    """A 25 Hz log of one joint that follows its command two ticks late."""
    t = step_s * np.arange(loops * rows)
    command = 0.2 * np.sin(2 * np.pi * 0.9 * t) + 0.1 * np.sin(2 * np.pi * 2.3 * t + 1)
    noise = np.random.default_rng(0).normal(0, 0.003, len(t))
    position = np.concatenate([[0.0, 0.0], command[:-2]]) + noise
    pd.DataFrame(
        {
            "time_s": t, "loop": np.repeat(np.arange(loops), rows),
            "LF_hip_command_rad": command, "LF_hip_position_rad": position,
        }
    ).to_csv(path, index=False)  # fmt: skip
    return path


@pytest.mark.slow
def test_the_mlp_on_the_real_walk_keeps_what_was_reached(capsys, real_playback):
    found = json_of(
        capsys, "fit-servo", real_playback, "--train-loops", "0,1", "--test-loops", "2"
    )  # fmt: skip
    mean, joints = found["mean"], found["joints"]
    assert mean["rmse_free_run_rad"] <= 0.0275 and len(joints) == 12
    assert max(j["rmse_free_run_rad"] for j in joints.values()) <= 0.037
    assert mean["delayed_pd_rmse_rad"] <= 0.040
    # two facts of the recording that need no model
    assert mean["repeatability_rad"] == pytest.approx(0.0227, abs=1e-4)
    assert mean["persistence_rmse_rad"] == pytest.approx(0.0594, abs=1e-3)
    interval = found["rmse_free_run_rad"]
    assert interval["value"] == mean["rmse_free_run_rad"]
    assert interval["low"] < interval["value"] < interval["high"]
    assert "better than the linear model" in found["verdict"]
    saved = load_servo_model(Path("servo"))
    assert saved.contract.recordings[0].name == "playback_lstm_25hz"
    assert saved.contract.inputs[0] == "command_rad[t]" and not saved.contract.feedback


@pytest.mark.slow
def test_hold_aware_scores_on_the_real_sweeps_keep_what_was_reached(capsys, real_sweeps):
    found = json_of(
        capsys, "fit-servo", *real_sweeps, "--train-before", "2",
        "--test-after", "2",
    )  # fmt: skip
    mean = found["mean"]
    assert mean["rmse_free_run_rad"] <= 0.0155 and mean["rmse_held_rad"] <= 0.0175
    # rows as logged are predicted at the dates of their own poll
    assert mean["rmse_raw_rad"] == pytest.approx(mean["rmse_held_rad"])


@pytest.mark.parametrize(
    "kinds", [("fir",), pytest.param(("mlp", "lstm", "delayed-pd"), marks=pytest.mark.slow)]
)
def test_what_was_fitted_is_saved_and_compared_with_a_calibration(capsys, quick, kinds):
    sample = (SAMPLES / "playback.csv", "--joints", "LF_calf")
    for kind in kinds:
        ran(capsys, "fit-servo", *sample, "--arch", kind, "--out", kind)
    found = json_of(capsys, "compare", *sample, "--models", *kinds, SAMPLES / "calibrated.yaml")
    assert len(found["models"]) == len(kinds) + 2 and Path("compare.png").exists()
    assert "too small" in " ".join(found["notes"])
    for model in list(found["models"].values())[: len(kinds)]:
        assert model["mean"]["rmse_free_run_rad"] < 0.03  # the emulated robot's noise is 8…14 mrad


def test_a_second_model_takes_a_free_name_and_an_old_one_is_never_replaced(capsys, quick):
    log = playback("log.csv", loops=1, rows=200)
    for _ in range(2):
        _, err = ran(capsys, "fit-servo", log, "--arch", "fir")
        assert "one group to learn from" in err
    assert Path("servo/contract.json").exists() and Path("servo-2/contract.json").exists()
    again = ("fit-servo", log, "--arch", "fir", "--out", "servo")
    assert "--force" in refused(capsys, pupper_sysid, *again)


def test_a_fit_repeats_under_its_seed_and_sees_nothing_of_the_test_loop(capsys, quick):
    log = playback("log.csv")
    split = ("--train-loops", "0,1", "--test-loops", "2", "--arch", "mlp", "--json")
    run(capsys, "fit-servo", log, *split, "--out", "a")
    run(capsys, "fit-servo", log, *split, "--out", "b")
    table = pd.read_csv(log)
    table.loc[table["loop"] == 2, "LF_hip_position_rad"] += 0.5
    table.to_csv("other.csv", index=False)
    run(capsys, "fit-servo", "other.csv", *split, "--out", "c")
    a, b, c = (load_servo_model(Path(name)).parameters for name in "abc")
    for name in a:
        assert np.array_equal(a[name], b[name]) and np.array_equal(a[name], c[name])


def test_a_model_for_another_rate_or_joint_is_refused_where_it_would_be_used(capsys, quick):
    ran(capsys, "fit-servo", playback("log.csv"), "--arch", "fir")
    slow, other = playback("slow.csv", step_s=0.08), SAMPLES / "playback.csv"
    for words, says in (
        ((slow, "--models", "servo"), ("every 40.0 ms", "fit again")),
        ((other, "--models", SAMPLES / "calibrated.yaml"), ("only (--joints)", "has no joint")),
    ):
        said = refused(capsys, pupper_sysid, "compare", *words)
        assert all(part in said for part in says), said


# ----- a fleet's results go beside its folder, by whatever name the folder is given


@dataclass
class Reached(Exception):
    """Where the results were about to be written."""

    out: Path


@pytest.mark.parametrize(
    ("command", "ending"), [("calibrate", "calibrated"), ("fit-servo", "servos")]
)
@pytest.mark.parametrize(
    ("here", "given"), [("robots", "."), ("robots/one", ".."), (".", "robots")]
)
def test_results_are_beside_the_folder(capsys, tmp_path, monkeypatch, command, ending, here, given):
    (tmp_path / "robots/one").mkdir(parents=True)
    (tmp_path / "robots/one/sweep.csv").touch()

    def reach(root, out, *_):
        raise Reached(out)

    monkeypatch.setattr("pupper_sysid.sysid.fleet.run_fleet", reach)
    monkeypatch.chdir(tmp_path / here)
    with pytest.raises(Reached) as reached:
        run(capsys, command, given, "--debug")
    assert reached.value.out.resolve() == tmp_path / f"robots_{ending}"
