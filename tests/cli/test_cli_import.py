"""`import` and the commands that take logs of other projects directly."""

import json

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.recognise import is_fleet
from support.command_line import json_of, ran, refused, run
from support.real_recordings import real_folder

TIME = 0.02 * np.arange(200)


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """A log in degrees, with columns of its own."""
    monkeypatch.chdir(tmp_path)
    wave = np.rad2deg(0.4 * np.sin(2 * np.pi * TIME))
    late = np.rad2deg(0.4 * np.sin(2 * np.pi * (TIME - 0.06)))
    columns = {"t_ms": 1e3 * TIME}
    for joint in ("pan", "tilt"):
        columns |= {f"u {joint}": wave, f"y {joint}": late}
    pd.DataFrame(columns).to_csv(tmp_path / "arm.log", index=False)
    return tmp_path / "arm.log"


COLUMNS = ("--time", "t_ms", "--command", "u {joint}", "--position", "y {joint}", "--unit", "deg")


def test_a_log_is_imported_by_its_columns_and_says_what_was_assumed(capsys, arm):
    out, err = ran(capsys, "import", arm, *COLUMNS, "--out", "rec.csv")
    assert "pan" in out and "Wrote rec.csv" in err and "half a turn" in err
    (trial,) = load("rec.csv").trials("tilt")
    np.testing.assert_allclose(trial.command_rad, 0.4 * np.sin(2 * np.pi * TIME), atol=1e-9)
    again = ("import", arm, *COLUMNS, "--out", "rec.csv")
    assert "exists already" in refused(capsys, pupper_sysid, *again)


def test_joints_order_and_json(capsys, arm):
    words = ("--joints", "pan", "--send-after", "0.5ms")
    found = json_of(capsys, "import", arm, *COLUMNS, *words)
    assert found["joints"] == ["pan"] and found["written"] == "arm.csv"
    assert found["rows"] == 200 and found["imported_from"] == "table" and not found["warnings"]
    (trial,) = load("arm.csv").trials("pan")
    assert (trial.read_time_s < trial.send_time_s).all()


def test_a_mapping_file_stands_for_the_options(capsys, arm):
    (arm.parent / "map.yaml").write_text(
        "time: t_ms\ncommand: 'u {joint}'\nposition: 'y {joint}'\nunit: deg\n"
        "joints: {pan: shoulder}\n"
    )
    assert run(capsys, "import", arm, "--mapping", "map.yaml")[0] == 0
    assert load("arm.csv").joints == ["shoulder"]


def test_options_that_a_format_does_not_need_are_refused(capsys, tmp_path):
    entries = [{"timestamp": 0.1, "position": 0, "goal_position": 0}]
    (tmp_path / "bam.json").write_text(json.dumps({"entries": entries}))
    said = refused(capsys, pupper_sysid, "import", tmp_path / "bam.json", "--unit", "deg")
    assert "BAM JSON" in said and "--unit" in said


def test_doctor_takes_several_logs_and_folders_of_logs(capsys, arm):
    shorter = arm.with_name("shorter.log")
    shorter.write_text("".join(arm.read_text().splitlines(keepends=True)[:-1]))
    for log, name in ((arm, "a.csv"), (shorter, "b.csv")):
        assert run(capsys, "import", log, *COLUMNS, "--out", f"logs/{name}")[0] == 0
    for given in (("logs/a.csv", "logs/b.csv"), ("logs",)):
        found = json_of(capsys, "doctor", *given)
        assert found["recording"] == "a, b"


def test_a_folder_of_another_projects_logs_is_one_robot(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "sweep.csv").write_text("")
    assert is_fleet(tmp_path / "own") and not is_fleet(tmp_path / "own" / "sweep.csv")
    (tmp_path / "bam").mkdir()
    (tmp_path / "bam" / "a.json").write_text("{}")
    assert not is_fleet(tmp_path / "bam")


@pytest.mark.parametrize(
    "folder",
    [
        "mini_pupper_full_band",
        pytest.param("ktune_robstride", marks=pytest.mark.slow),
        pytest.param("lerobot_so101", marks=pytest.mark.slow),
    ],
)
def test_folders_of_real_logs_are_examined_as_they_are_but_for_those_of_an_imu(capsys, folder):
    found = json_of(capsys, "doctor", real_folder(folder))
    assert all(j["verdict"] != "do not use" for j in found["joints"].values())
    assert "IMU" in refused(capsys, pupper_sysid, "doctor", real_folder("mini_pupper_imu"))


def test_the_log_itself_is_never_written_over(capsys, arm):
    log = arm.rename(arm.with_suffix(".csv"))
    before = log.read_bytes()
    _, err = ran(capsys, "import", log.name, *COLUMNS)
    assert "Wrote arm_recording.csv" in err
    assert "is the log itself" in refused(
        capsys, pupper_sysid, "import", log, *COLUMNS, "--out", "arm.csv", "--force"
    )
    assert log.read_bytes() == before


def test_a_column_that_does_not_exist_is_named(capsys, arm):
    for option, wrong, words in (
        ("y {joint}", "z {joint}", "--position is z {joint}, which fits no column; it has"),
        ("u {joint}", "u joint", "({joint} stands for a joint's name)"),
        ("y {joint}", "y pa{joint}", "no joint has both"),
    ):
        columns = [c.replace(option, wrong) for c in COLUMNS]
        assert words in refused(capsys, pupper_sysid, "import", arm, *columns)
