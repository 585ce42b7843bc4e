"""Many robots: one table, outliers named, failures told, and nothing done twice."""

import json
import os
import shutil
from pathlib import Path

import pandas as pd
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.reading.content import reading_up_to
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.servo_file import load_servo_model
from pupper_sysid.sysid import fleet
from pupper_sysid.sysid.fleet import OUTLIER, QUANTITIES, ServoModels, _outliers
from pupper_sysid.sysid.recordings.files import load
from support.command_line import ran, refused, run
from support.refusals import assert_each_refused

NAMES = tuple(QUANTITIES)
SWEEP = ("sweep", "--freqs", "2,4", "--joints", "LF_hip", "--duration", "2")


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory) -> Path:
    """Two robots that can be calibrated, and a log that cannot."""
    folder = tmp_path_factory.mktemp("robots")
    for seed in (1, 2):
        pupper_sysid.main([*SWEEP, "--seed", str(seed), "--out", str(folder / f"r{seed}.csv")])
    (folder / "torn.csv").write_text("time,what\n1,2\n")
    return folder


@pytest.fixture(scope="module")
def calibrated(sweeps, tmp_path_factory) -> tuple[fleet.Fleet, Path]:
    """The fleet of calibrations of these robots, made by two workers, and its folder."""
    out = tmp_path_factory.mktemp("fleet") / "out"
    return fleet.run_fleet(sweeps, out, fleet.Calibrations(), jobs=2), out


def two_made_and_one_failed(found: dict, out: Path) -> pd.DataFrame:
    """What is said of `sweeps`, and what the table has of them, which it returns."""
    assert sorted(found["made"]) == ["r1", "r2"] and found["failed"] == ["torn"]
    table = pd.read_csv(out / "fleet.csv")
    assert table["robot"].to_list() == ["r1", "r2", "torn"]
    assert "column" in table["problem"].iloc[2]
    return table


def test_a_folder_becomes_a_calibration_per_robot_and_one_table(
    sweeps, calibrated, tmp_path, capsys
):
    made, out = calibrated
    table = two_made_and_one_failed(vars(made), out)
    own = load_calibration(out / "r2.yaml").joint("LF_hip").actuator
    assert table["dead_time_ms"].iloc[1] == pytest.approx(1e3 * own.dead_time_s.value)
    # alone it gets the same numbers
    ran(capsys, "calibrate", sweeps / "r1.csv", "--out", tmp_path / "alone.yaml")
    alone, among = (
        load_calibration(path).joint("LF_hip")
        for path in (tmp_path / "alone.yaml", out / "r1.yaml")
    )
    assert alone.actuator == among.actuator and alone.feedback == among.feedback
    # nothing is calibrated twice, and what was edited is seen
    code, said, err = run(capsys, "calibrate", sweeps, "--out", out, "--json")
    assert code == 1 and "1 of 3 recordings could not be used: torn" in err
    assert sorted(json.loads(said)["kept"]) == ["r1", "r2"] and json.loads(said)["made"] == []
    other_seed = ("calibrate", sweeps, "--out", out, "--seed", "3")
    assert "--force" in refused(capsys, pupper_sysid, *other_seed)


def test_a_folder_becomes_a_servo_model_per_robot_and_one_table(sweeps, tmp_path, capsys):
    out = tmp_path / "models"
    arguments = ("fit-servo", sweeps, "--arch", "fir", "--out", out)
    code, said, err = run(capsys, *arguments, "--json")
    assert code == 1 and "torn" in err
    table = two_made_and_one_failed(json.loads(said), out)
    known = load_servo_model(out / "r2").contract.joints["LF_hip"].scores["rmse_free_run_rad"]
    assert table["free_run_mrad"].iloc[1] == pytest.approx(1e3 * known)
    assert 0 < known < 1e-3 * table["persistence_mrad"].iloc[1]

    code, said, err = run(capsys, *arguments)
    assert code == 1 and "2 kept" in err and "torn was left out" in err
    # another seed, split or other readings are another model; what auto took stays
    counted = load_servo_model(out / "r1").contract.readings_counted["LF_hip"]
    code, _, err = run(capsys, *arguments, "--readings", counted)
    assert code == 1 and "2 kept" in err
    other = "all" if counted == "fresh" else "fresh"
    loops = ("--train-before", "1", "--test-after", "1")
    for change in (("--seed", "3"), loops, ("--readings", other)):
        assert "--force" in refused(capsys, pupper_sysid, *arguments, *change), change


def test_a_robot_that_fails_now_is_not_shown_with_what_it_was_before(sweeps, calibrated, tmp_path):
    root, out = tmp_path / "robots", tmp_path / "out"
    root.mkdir(), out.mkdir()
    (root / "r1.csv").write_text("time,what\n1,2\n")
    shutil.copy(calibrated[1] / "r1.yaml", out)
    again = fleet.run_fleet(root, out, fleet.Calibrations(), force=True)
    assert again.failed == ["r1"] and again.table["robot"].to_list() == ["r1"]
    assert again.table["problem"].iloc[0]


def test_an_interrupted_training_is_not_kept_for_a_finished_one(sweeps, tmp_path, monkeypatch):
    def stop(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr("pupper_sysid.sysid.servo_fit.training._Adam.descend", stop)
    with pytest.raises(KeyboardInterrupt):
        fleet.run_fleet(sweeps, tmp_path / "out", ServoModels())
    assert not (tmp_path / "out" / "r1").exists()


@pytest.mark.slow
def test_a_dask_cluster_gives_what_one_process_gives(sweeps, calibrated, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        there = fleet.run_fleet(
            sweeps, tmp_path / "there", fleet.Calibrations(), cluster=cluster.scheduler_address
        )
    pd.testing.assert_frame_equal(there.table, calibrated[0].table)


def test_a_cluster_is_an_address_that_is_written_out_and_what_it_is_trusted_with_is_said(
    sweeps, tmp_path, monkeypatch
):
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", "tcp://127.0.0.1:9")
    addresses = (
        "", "scheduler", "inproc://x", "tcp://", "tls://a", "http://a:1", "tcp://a:1/x",
        "tcp://a:1 b", "file:scheduler.json", "tcp://a\x1b[31m:1",
    )  # fmt: skip
    assert_each_refused(
        [(a, "write out the scheduler's address") for a in addresses],
        lambda a: fleet.run_fleet(sweeps, tmp_path, fleet.Calibrations(), cluster=a),
    )
    for address in ("tls://host:8786", "tcp://[::1]:8786"):
        said = fleet.trust(address)
        assert "is enough to run programs on this computer" in said
        assert ("within a network of your own" in said) == address.startswith("tcp")


class Names(fleet.Calibrations):
    """A product that is made at once."""

    quantities = ()

    def make(self, path: Path, target: Path) -> None:
        """The recording's name, once it has been read."""
        target.write_text(load(path).name)

    def numbers(self, target: Path) -> dict[str, dict[str, float]]:
        """None."""
        return {"LF_hip": {}}


def test_of_30_recordings_10_are_broken_and_20_are_done(sweeps, tmp_path, capsys):
    """With a product that is made at once: what counts is who is done, and who is named."""
    root, out = tmp_path / "robots", tmp_path / "out"
    root.mkdir(), out.mkdir()
    good = (sweeps / "r1.csv").read_bytes()
    broken = {
        "empty": b"", "cut": good[:900], "binary": bytes(range(256)) * 9, "text": b"hello\n" * 50,
        "degrees": good.replace(b",0.", b",90."), "long": b"x" * 300_000,
        "resumed": good + b'# resumed: {"trial": Infinity}\n', "digits": good.replace(b"1", b"1_1"),
    }  # fmt: skip
    for k in range(20):
        (root / f"r{k:03}.csv").write_bytes(good + b"# robot: %d\n" % k)
    for name, data in broken.items():
        (root / f"{name}.csv").write_bytes(data)
    os.mkfifo(root / "pipe.csv")
    (root / "device.csv").symlink_to("/dev/zero")
    made = fleet.run_fleet(root, out, Names(), force=True)
    assert len(made.made) == 20
    assert sorted(made.failed) == sorted([*broken, "pipe", "device"])
    assert all(problem.endswith(".") for problem in made.problems.values())


def test_the_limit_of_reading_holds_for_every_worker(sweeps, tmp_path):
    root = tmp_path / "robots"
    root.mkdir()
    shutil.copy(sweeps / "r1.csv", root / "r1.csv")
    with (root / "r1.csv").open("a") as file:
        file.write("# note: " + '"' + "x" * 1_500_000 + '"\n')
    first = fleet.run_fleet(root, tmp_path / "a", ServoModels(arch="fir"), jobs=2)
    assert "read_limit=2" in first.problems["r1"]
    with reading_up_to(2):
        again = fleet.run_fleet(root, tmp_path / "b", ServoModels(arch="fir"), jobs=2)
    assert again.made == ["r1"]


def test_an_outlier_is_named_in_any_order_and_equal_servos_are_not():
    rows = [
        {"robot": f"r{k}", "joint": "LF_hip"} | dict.fromkeys(QUANTITIES, 1.0) for k in range(9)
    ]
    for k, row in enumerate(rows):
        row["lag_ms"] = 40 + 0.1 * k
    # with it the median is 40.5, the median deviation 0.3
    rows[4]["lag_ms"] = 40.5 + 1.1 * OUTLIER * 1.4826 * 0.3
    named = ["lag_ms" if k == 4 else "" for k in range(9)]
    assert _outliers(pd.DataFrame(rows), NAMES) == named
    assert _outliers(pd.DataFrame(rows[::-1]), NAMES) == named[::-1]
    assert _outliers(pd.DataFrame(rows[2:6]), NAMES) == [""] * 4  # too few to say what is usual


def test_what_is_no_fleet_is_refused_in_a_sentence(sweeps, tmp_path, capsys, monkeypatch):
    (tmp_path / "empty").mkdir()
    program = pupper_sysid
    assert "no recording" in refused(capsys, program, "calibrate", tmp_path / "empty")
    double = tmp_path / "double"
    shutil.copytree(sweeps, double / "a")
    shutil.copy(sweeps / "r1.csv", double / "a_r1.csv")
    assert "a_r1" in refused(capsys, program, "calibrate", double)
    assert "--jobs" in refused(capsys, program, "calibrate", sweeps, "--jobs", "0")
    monkeypatch.setattr(fleet, "_CONNECT_S", 0.5)
    assert "--cluster" in refused(
        capsys, program, "calibrate", sweeps, "--cluster", "tcp://127.0.0.1:1", "--out", tmp_path
    )
