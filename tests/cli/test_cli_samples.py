"""`samples` gives what the examples of the documentation need, also from an installed wheel."""

from __future__ import annotations

from pathlib import Path

import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.data import SAMPLES
from pupper_sysid.sysid.recordings.files import load
from support.command_line import refused, run_program


def test_the_samples_are_copied_whole_and_never_over_other_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run_program(capsys, pupper_sysid, "samples")
    assert code == 0
    made = {p.relative_to("samples") for p in Path("samples").rglob("*") if p.is_file()}
    assert made == {p.relative_to(SAMPLES) for p in SAMPLES.rglob("*") if p.is_file()}
    assert all((SAMPLES / p).read_bytes() == (Path("samples") / p).read_bytes() for p in made)
    assert str(Path("samples") / "sweep.csv") in out
    Path("samples/sweep.csv").write_text("mine")
    Path("samples/README.md").unlink()
    assert "exists already" in refused(capsys, pupper_sysid, "samples")
    assert Path("samples/sweep.csv").read_text() == "mine"
    assert not Path("samples/README.md").exists(), "nothing was written"


def test_an_arm_of_sts3215_is_emulated_and_calibrated_with_the_torque_of_its_data_sheet(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    arm = SAMPLES / "so101.xml"
    run_program(capsys, pupper_sysid, "init-robot", arm, "--out", "arm.yaml")
    assert yaml.safe_load(Path("arm.yaml").read_text())["servo"] == "STS3215"
    code, _, err = run_program(
        capsys, pupper_sysid, "sweep", "--joint-map", "arm.yaml", "--joints", "wrist_roll",
        "--freqs", "1,2", "--duration", "1", "--seed", "1", "--truth", "--out", "sweep.csv",
    )  # fmt: skip
    assert code == 0, err
    recording = load("sweep.csv")
    assert recording.metadata["servos"]["wrist_roll"]["model"] == "STS3215"
    truth = yaml.safe_load(Path("sweep.truth.yaml").read_text())["joints"]["wrist_roll"]
    assert abs(truth["actuator"]["effort_limit"] - 1.912) < 0.01
