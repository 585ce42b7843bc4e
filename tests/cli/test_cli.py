"""The command line: JSON alone on stdout, one sentence per error, exit codes."""

import io
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.walks import interval, table_of
from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import plain
from pupper_sysid.data import SAMPLES
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.report import report
from support.command_line import json_of, ran, refused, run

SWEEP = SAMPLES / "sweep.csv"


pytestmark = pytest.mark.usefixtures("here")


@pytest.mark.usefixtures("unexamined")
def test_one_tone_is_calibrated_with_a_warning_and_written_as_printed_and_never_over(
    capsys, tmp_path
):
    path = table_with(tmp_path, lambda t: t[t.trial == 2])
    arguments = ("calibrate", path, "--out", "c.yaml", "--jobs", "1", "--json")
    code, out, _ = run(capsys, *arguments)
    found = json.loads(out)
    joint = found["joints"]["LF_hip"]
    assert code == 0 and {"model", "candidate_models", "lag", "presets", "warnings"} <= {*joint}
    scores = joint["candidate_models"]["delayed_pd"]["scores"]
    assert {"rmse_fresh_rad", "rmse_held_rad", "rmse_raw_rad"} <= set(scores)
    assert scores["rmse_leave_one_frequency_out_rad"] is None
    assert any("one frequency only" in w for w in joint["warnings"])
    saved = load_calibration("c.yaml").joint("LF_hip")
    assert saved.actuator.dead_time_s.value == joint["lag"]["dead_time_s"]["value"]
    assert found["calibration"]["joints"]["LF_hip"] == plain(saved)
    before = Path("c.yaml").read_bytes()
    code, out, err = run(capsys, *arguments)
    assert code == 2 and out == "" and "--force" in err
    assert Path("c.yaml").read_bytes() == before


def test_a_sweep_repeats_under_its_seed(capsys):
    for name in ("a.csv", "b.csv"):
        _, err = ran(capsys, "sweep", "--freqs", "1,3", "--joints", "RB_calf", "--duration",
                           "2", "--seed", "4", "--out", name)  # fmt: skip
        assert "No robot: using the emulated one" in err
    first, second = (load(Path(n)).table for n in ("a.csv", "b.csv"))
    assert first.equals(second)
    assert load(Path("a.csv")).joints == ["RB_calf"]


def test_a_command_without_a_recording_takes_the_newest(capsys):
    run(capsys, "sweep", "--freqs", "2", "--joints", "LF_hip", "--duration", "2")
    out, err = ran(capsys, "doctor", "--json")
    assert "Taking the newest recording" in err and "LF_hip" in out


def test_export_of_presets_calibrations_and_recordings(capsys):
    for source, expected in (("paper", "paper.csv"), (SWEEP, "sweep.tidy.csv")):
        found = json_of(capsys, "export", source, "--to", "csv")
        assert found["written"] == expected
    assert len(load(Path("sweep.tidy.csv")).table) == len(load(SWEEP).table)
    assert "--force" in refused(capsys, pupper_sysid, "export", "paper", "--to", "csv")


def table_with(tmp_path, change):
    """The sample's LF_hip rows, changed, as a file."""
    table = load(SWEEP).table.query("joint == 'LF_hip' and trial < 3").copy()
    table = change(table)
    path = tmp_path / "changed.csv"
    path.write_text('# pupper-sysid recording\n# completed: {"rows": 1}\n')
    table.to_csv(path, mode="a", index=False)
    return path


def test_constant_feedback_is_answered_in_a_sentence_by_every_command(capsys, tmp_path):
    path = table_with(tmp_path, lambda t: t.assign(position_rad=0.1))
    for command in ("delay", "bode", "calibrate"):
        assert "LF_hip" in refused(capsys, pupper_sysid, command, path)


def test_a_number_in_a_table_that_is_too_wide_is_folded_not_cut():
    table = terminal.table("Gait", "policy", "Hz", "sine fit")
    table.add_row("lstm", "3.27 (3.26–3.28)", "0.641234567890")
    written = io.StringIO()
    Console(width=24, file=written).print(table)
    shown = written.getvalue()
    assert "…" not in shown
    assert sorted(c for c in shown if c.isdigit()) == sorted("327326328" + "0641234567890")


def test_completion_is_written_where_bash_looks_for_it(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/bin/bash")
    _, err = ran(capsys, "--install-completion")
    script = tmp_path / ".local/share/bash-completion/completions/pupper-sysid"
    assert "fit-servo" in script.read_text() and str(script) in err
    monkeypatch.setenv("SHELL", "/usr/bin/fish")
    assert "fish" in refused(capsys, pupper_sysid, "--install-completion")


def test_a_report_opens_in_the_browser_that_there_is(capsys, tmp_path, monkeypatch, hip):
    opened, page = [], tmp_path / "page/report.html"
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or False)
    monkeypatch.setattr(report, "write_report", lambda *_, **__: SimpleNamespace(path=page))
    _, err = ran(capsys, "report", hip, "--out", page.parent, "--open")
    assert "No browser could be started" in err
    assert opened == [page.resolve().as_uri()]


def test_tables_of_analyses_fit_a_terminal_whatever_the_policy_is_called():
    rows = [
        {"extra_delay_ms": 40, "mode": "jittered", "survival": 1.0, "frequency_hz": 3.569,
         "amplitude_rad": 0.139, "mae_vx_m_s": 0.018},
        {"channel": "joint_position_relative", "kind": "noise", "level": 0.05, "sigma": 0.005,
         "correlation": 1.0, "survival": 1.0, "mae_vx_m_s": 0.018},
        {"ground": "slopes", "survival": 1.0, "frequency_hz": 3.569, "mae_vx_m_s": 0.018,
         "mae_vy_m_s": 0.1, "mae_yaw_rad_s": 0.123},
    ]  # fmt: skip
    for row in rows:
        table = table_of("Rows", {"lstm_high_steps": [SimpleNamespace(**row)]}, list(row))
        with terminal.out.capture() as printed:
            terminal.out.print(table, width=80)
        *_, last = [line for line in printed.get().splitlines() if "lstm_high_steps" in line]
        assert last.split()[-1] == f"{list(row.values())[-1]:.3f}" and "_" not in last[16:]
    assert interval(Interval(0.5, float("nan"), float("nan")), 2) == "0.50"
