"""`samples` gives what the examples of the documentation need, also from an installed wheel."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.data import SAMPLES
from pupper_sysid.sysid.recordings.files import load
from support.command_line import ran, refused


def test_the_samples_are_copied_whole_and_never_over_other_files(capsys, here):
    out, _ = ran(capsys, "samples")
    made = {p.relative_to("samples") for p in Path("samples").rglob("*") if p.is_file()}
    assert made == {p.relative_to(SAMPLES) for p in SAMPLES.rglob("*") if p.is_file()}
    assert all((SAMPLES / p).read_bytes() == (Path("samples") / p).read_bytes() for p in made)
    assert str(Path("samples") / "sweep.csv") in out
    when = Path("samples/arm.csv").stat().st_mtime_ns
    ran(capsys, "samples")
    assert Path("samples/arm.csv").stat().st_mtime_ns == when, "the same files stay"
    Path("samples/sweep.csv").write_text("mine")
    Path("samples/README.md").unlink()
    assert "exists already" in refused(capsys, pupper_sysid, "samples")
    assert Path("samples/sweep.csv").read_text() == "mine"
    assert not Path("samples/README.md").exists(), "nothing was written"


@pytest.fixture
def arm(tmp_path, monkeypatch, capsys) -> str:
    """Joint map of the sample arm, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    model = SAMPLES / "so101.xml"
    ran(capsys, "init-robot", model, "--out", "arm.yaml")
    assert yaml.safe_load(Path("arm.yaml").read_text())["servo"] == "STS3215"
    return "arm.yaml"


SHORT = ("--joints", "wrist_roll", "--freqs", "1,4", "--duration", "1", "--seed", "1")


def test_an_arm_of_sts3215_is_emulated_by_its_servos_data_sheet_and_registers(arm, capsys):
    found = data_sheet("STS3215")
    assert found
    sheet = found.at(7.4)
    ran(
        capsys, "sweep", "--joint-map", arm, *SHORT, "--registers", "p=16",
        "--truth", "--out", "sweep.csv"
    )  # fmt: skip
    recording = load("sweep.csv")
    servo = recording.trials("wrist_roll")[0].servo
    assert (servo.model, servo.p_gain, servo.d_gain, servo.supply_voltage_v) == (
        "STS3215", 16, 32, 7.4,
    )  # fmt: skip
    assert recording.metadata["bus"]["speed_limit_rad_s"] == sheet.no_load_speed_rad_s
    assert recording.metadata["bus"]["command_quantum_rad"]["wrist_roll"] == 2 * np.pi / 4096
    # at 4 Hz 0.3 rad would be 7.5 rad/s, which no STS3215 reaches
    tone = recording.table[recording.table.frequency_hz == 4].command_rad
    assert tone.abs().max() * 8 * np.pi < sheet.no_load_speed_rad_s
    truth = yaml.safe_load(Path("sweep.truth.yaml").read_text())["joints"]["wrist_roll"]
    assert truth["actuator"]["effort_limit"] == pytest.approx(sheet.stall_torque_nm, rel=0.3)
    loaded = truth["loaded_servo"]
    assert truth["actuator"]["stiffness"] == pytest.approx(
        16 * loaded["duty_per_rad"] * loaded["torque_nm"]
    )
