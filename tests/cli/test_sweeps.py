"""`plan`, `sweep --plan`, `sweep --until` and `sweep --load`, as typed."""

import io
import json
import shutil
from contextlib import chdir, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.cli.programs.pupper_sysid import main
from pupper_sysid.hardware.feetech import STS3215
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.feetech import FeetechEmulator
from pupper_sysid.sim.emulator.pendulum import BENCH_MAP, Pendulum, PendulumBench, draw_bench
from pupper_sysid.sysid.doctor import checks as joints
from pupper_sysid.sysid.doctor.examination import examine
from pupper_sysid.sysid.plan.plan_file import load_plan
from pupper_sysid.sysid.recordings.files import load
from support.command_line import json_of, ran, refused, run
from support.json_keys import DOCUMENTED, key_line
from support.planned_servos import fit_of_half_width
from support.virtual_line import on_a_virtual_line


def test_a_planned_sweep_that_was_cut_short_is_continued_unless_its_plan_has_changed(
    capsys, planned
):
    whole = load("a.csv").table.groupby(["joint", "trial"]).size()
    cut(Path("a.csv"), 0.6)
    plan = Path("plan.yaml").read_bytes()
    change_plan()
    assert "another plan" in refused(capsys, pupper_sysid, "sweep", "--resume", "a.csv")
    Path("plan.yaml").write_bytes(plan)
    ran(capsys, "sweep", "--resume", "a.csv")
    again = load("a.csv")
    assert (again.table.groupby(["joint", "trial"]).size() - whole).abs().max() <= 1
    assert "completed" in again.metadata


pytestmark = pytest.mark.usefixtures("here", "unexamined")


@pytest.fixture
def widths(monkeypatch):
    """Half widths [ms] of the dead times of the fits to come, by joint; no fit is computed."""
    given: dict[str, list[float]] = {}

    def fits(work, recordings, chosen, workers, progress):
        return {joint: fit_of_half_width(joint, given[joint].pop(0)) for joint in chosen}

    monkeypatch.setattr(joints, "each_joint", fits)
    return given


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    """Folder of a plan of two joints, its sweep, and what the sweep printed."""
    folder = tmp_path_factory.mktemp("planned")
    with chdir(folder), redirect_stdout(io.StringIO()) as printed:
        main("plan --joints LF_hip,LF_thigh --seconds 6.4 --out plan.yaml".split())
        printed.truncate(printed.seek(0))
        main("sweep --plan plan.yaml --out a.csv --json".split())
    (folder / "printed.json").write_text(printed.getvalue())
    return folder


@pytest.fixture
def planned(first) -> None:
    """The same, in the folder of a test."""
    shutil.copytree(first, ".", dirs_exist_ok=True)


def change_plan() -> None:
    """Halve the first amplitude of the plan."""
    plan = yaml.safe_load(Path("plan.yaml").read_text())
    plan["trials"][0]["amplitude_rad"] /= 2
    Path("plan.yaml").write_text(yaml.safe_dump(plan))


def cut(path: Path, share: float) -> None:
    """Leave that share of a recording's rows, and no footer."""
    lines = path.read_text().splitlines(keepends=True)
    rows = [n for n, line in enumerate(lines) if line[0].isdigit()]
    path.write_text("".join(lines[: rows[int(share * len(rows))]]))


def test_a_first_sweep_is_planned_and_executed_trial_by_trial(planned):
    plan = load_plan(Path("plan.yaml"))
    assert plan.joints == ["LF_hip", "LF_thigh"] and plan.made_from == ()
    found = json.loads(Path("printed.json").read_text())
    assert found["trials"] == len(plan.trials) and found["joints"] == plan.joints
    recording = load("a.csv")
    assert recording.metadata["excitation"]["kind"] == "plan"
    assert recording.metadata["excitation"]["file"] == "plan.yaml"
    tones = [t.frequency_hz for t in plan.trials if t.joint == "LF_hip" and t.kind == "sine"]
    assert [t.frequency_hz for t in recording.trials("LF_hip")][: len(tones)] == tones


def test_the_emulated_robot_does_not_repeat_its_noise_in_a_planned_sweep(capsys, planned):
    for name in "bcd":  # ten held readings of a joint at rest may well be the same ones once
        change_plan()
        run(capsys, "sweep", "--plan", "plan.yaml", "--joints", "LF_hip", "--out", f"{name}.csv")
    at_rest = {tuple(load(f"{name}.csv").table["position_rad"][:10]) for name in "abcd"}
    assert len(at_rest) > 1


SHORT = ("--joints", "LF_hip,LF_thigh", "--freqs", "4", "--duration", "2", "--out", "a.csv")


@pytest.mark.slow
def test_a_sweep_goes_on_with_planned_rounds_until_the_goal(capsys, widths):
    widths |= {"LF_hip": [1.9], "LF_thigh": [5.0, 1.9]}
    out, err = ran(capsys, "sweep", *SHORT, "--until", "dead_time:2ms", "--json")
    found = json.loads(out)
    assert key_line(found) == DOCUMENTED["sweep --until"]
    assert found["reached"] and found["recordings"] == ["a.csv", "a_2.csv"]
    assert load("a_2.csv").joints == ["LF_thigh"]
    assert load_plan(Path("a_2.plan.yaml")).joints == ["LF_thigh"]
    assert "5.0 (dead_time:2ms)" in err and "1.9 (dead_time:2ms): reached" in err


@pytest.mark.slow
def test_rounds_that_were_cut_short_are_continued(capsys, widths):
    widths |= {"LF_hip": [1.9], "LF_thigh": [5.0, 1.9]}
    run(capsys, "sweep", *SHORT, "--until", "dead_time:2ms")
    first = Path("a.csv").read_bytes()
    cut(Path("a_2.csv"), 0.5)
    widths |= {"LF_hip": [1.9], "LF_thigh": [5.0, 1.9]}
    found = json_of(capsys, "sweep", "--resume", "a.csv")
    assert found["recordings"] == ["a.csv", "a_2.csv", "a_3.csv"]
    assert "completed" in load("a_2.csv").metadata and Path("a.csv").read_bytes() == first


def test_a_goal_out_of_reach_is_said_with_its_reason(capsys, widths):
    widths |= {"LF_hip": [1.9], "LF_thigh": [5.0]}
    out, err = ran(capsys, "sweep", *SHORT, "--until", "dead_time:2ms", "--most-seconds", "4")
    assert "not reached" in out
    assert "LF_thigh: the goal was not reached: 2 s are recorded and --most-seconds is 4" in err


# ----- `sweep --load` from the command line: a bench without a joint map, over both kinds of bus

LOAD = "pendulum:0.1kg@0.10m"


def sweep(capsys, *more: str) -> str:
    """What a sweep of a bench prints."""
    return ran(capsys, "sweep", "--load", LOAD, *more)[0]


def test_an_emulated_bench_needs_no_joint_map_and_its_truth_has_the_load(capsys, tmp_path):
    words = "--gains 8,32 --kind drop --truth --duration 1 --out a.csv --json"
    found = json.loads(sweep(capsys, *words.split()))
    assert found["joints"] == ["bench"] and found["trials"] == 4
    recording = load(tmp_path / "a.csv")
    assert [t.p_gain for t in recording.trials("bench")] == [8.0, 8.0, 32.0, 32.0]
    assert recording.trials("bench")[0].load.mass_kg == 0.1
    assert recording.loop_period_s == pytest.approx(0.01, rel=0.02)
    truth = yaml.safe_load((tmp_path / "a.truth.yaml").read_text())["joints"]["bench"]
    assert truth["loaded_servo"]["mass_kg"] == 0.1


def test_an_interrupted_bench_is_continued_at_its_gain(capsys, tmp_path):
    sweep(capsys, "--gains", "8,32", "--kind", "steps", "--duration", "2", "--out", "a.csv")
    cut(tmp_path / "a.csv", 0.75)  # within the second trial
    _, err = ran(capsys, "sweep", "--resume", "a.csv")
    assert "trial 2 of 2" in err
    gains = [t.p_gain for t in load(tmp_path / "a.csv").trials("bench")]
    assert gains == [8.0, 32.0]


def test_a_servo_at_two_gains_is_no_lag_that_drifts(capsys, tmp_path):
    sweep(capsys, "--gains", "16,32", "--kind", "steps", "--duration", "4", "--out", "a.csv")
    assert examine(load(tmp_path / "a.csv")).joints["bench"].verdict == "use"


def test_a_bench_over_a_serial_line_is_swept_and_its_gain_set_back(capsys, tmp_path):
    rng = np.random.default_rng(2)
    robot = draw_bench(rng, Pendulum(0.1, 0.1))
    plant = PendulumBench(robot)
    bench = ServoBench(robot, load_joint_map(BENCH_MAP), rng.spawn(1)[0], plant=plant)
    with on_a_virtual_line(tmp_path, FeetechEmulator(bench, STS3215, rng)) as (device,):
        sweep(
            capsys, "--gains", "8,16", "--kind", "steps", "--duration", "1", "--rate", "40",
            "--bus", f"feetech:{device}", "--out", "a.csv",
        )  # fmt: skip
    assert plant.register(0, "p") == 32
    assert [t.p_gain for t in load(tmp_path / "a.csv").trials("bench")] == [8.0, 16.0]
