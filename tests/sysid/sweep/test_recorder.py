"""A recording holds what was sent and read, survives its process, and leaves the robot safe."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import BusError, FileExistsRefusal, InputError, SafetyStop
from pupper_sysid.common.joints import DEFAULT_POSE, JOINT_NAMES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.loop import GENTLE_RAD_S
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.sweep.excitation import LEAD_IN_S, Plan, plan
from pupper_sysid.sysid.sweep.recorder import REST_S, record
from support.command_line import refused
from support.following_bus import FollowingBus

PERIOD = 0.019


def emulated(seed: int = 1, **spec: float) -> EmulatedBus:
    rng = np.random.default_rng(seed)
    return EmulatedBus(draw_robot(rng, RobotSpec(**spec)), rng)


def short_sweep(joints=("LF_hip",), frequencies=(2.0, 3.0), **more) -> Plan:
    return plan("sine", list(joints), list(frequencies), duration_s=1.0, **more)


class ScriptedBus(FollowingBus):
    """Twelve servos, one of whose writes is slow or fails."""

    name = "scripted"

    def __init__(self, start: np.ndarray, slow_at: int = -1, fail_at: int = -1, raises=None):
        super().__init__(JOINT_NAMES, reach_rad=np.inf)
        self.metadata, self.goal = {"kind": "scripted", "readings": "live"}, start.astype(float)
        self._slow_at, self._fail_at, self._raises = slow_at, fail_at, raises

    def write(self, position_rad):
        if len(self.written) == self._fail_at:
            self._fail_at = -1
            raise self._raises
        self.time += 0.055 if len(self.written) == self._slow_at else 0.0
        return super().write(position_rad)

    def read(self):
        self.time += 0.001
        return BusSample(np.full(12, self.time), self.goal.copy(), np.arange(12))


POSE = np.array([DEFAULT_POSE[j] for j in JOINT_NAMES])


def test_a_recording_holds_every_command_and_reading_of_every_trial(tmp_path):
    bus = ScriptedBus(POSE)
    made = short_sweep(["LF_hip", "RB_calf"])
    path = record(bus, made, tmp_path / "a.csv", loop_period_s=PERIOD, metadata={"seed": 5})
    recording = load(path)
    assert recording.joints == ["LF_hip", "RB_calf"]
    assert recording.metadata["seed"] == 5
    assert recording.metadata["bus"] == {"name": "scripted", "kind": "scripted"}
    assert recording.metadata["readings"] == "live"
    assert recording.metadata["excitation"]["kind"] == "sine"
    assert recording.metadata["start_pose_rad"] == DEFAULT_POSE
    trials = [*recording.trials("LF_hip"), *recording.trials("RB_calf")]
    assert [t.frequency_hz for t in trials] == [2.0, 3.0, 2.0, 3.0]
    for trial, planned in zip(trials, made.trials, strict=True):
        assert len(trial.send_time_s) == np.ceil((1.0 + LEAD_IN_S) / PERIOD)
        # a perfect servo's reading is the command, read 1 ms after it was sent
        np.testing.assert_allclose(trial.position_rad, trial.command_rad, atol=1e-7)
        np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.001, atol=1e-6)
        assert set(trial.position_count) == {JOINT_NAMES.index(trial.joint)}
        elapsed = trial.send_time_s - trial.send_time_s[0]
        np.testing.assert_allclose(elapsed, PERIOD * np.arange(len(elapsed)), atol=1e-6)
        expected = DEFAULT_POSE[trial.joint] + planned.offset(elapsed)
        np.testing.assert_allclose(trial.command_rad, expected, atol=1e-5)
    footer = recording.metadata["completed"]
    assert footer["rows"] == len(recording.table) == footer["loop"]["ticks"]
    assert footer["loop"]["missed_deadlines"] == 0
    assert footer["loop"]["mean_period_s"] == pytest.approx(PERIOD, abs=1e-6)


def test_other_joints_rest_and_moves_between_trials_are_gentle(tmp_path):
    bus = ScriptedBus(POSE + 0.5)
    record(bus, short_sweep(frequencies=[2.3]), tmp_path / "a.csv", loop_period_s=PERIOD)
    times, goals = np.array(bus.written_s), np.stack(bus.written)
    recorded = load(tmp_path / "a.csv").trials("LF_hip")[0].send_time_s
    inside = (times >= recorded[0] - 1e-9) & (times <= recorded[-1] + 1e-9)
    np.testing.assert_allclose(goals[inside][:, 1:], np.tile(POSE[1:], (inside.sum(), 1)))
    before = times < recorded[0] - 1e-9
    way = np.abs(np.diff(goals[before], axis=0, prepend=[POSE + 0.5])).max(axis=1)
    allowed = GENTLE_RAD_S * np.diff(times[before], prepend=0.0)
    assert (way <= 1.01 * allowed + 1e-12).all() and way.max() > 0.5 * GENTLE_RAD_S * PERIOD
    resting = np.abs(goals[before] - POSE).max(axis=1) < 1e-12
    assert recorded[0] - times[before][np.argmax(resting)] >= REST_S - 1e-9
    np.testing.assert_allclose(goals[-1], POSE + 0.5, atol=1e-12, err_msg="where it was found")
    # parking ticks every 20 ms and a read takes 1 ms
    assert np.abs(np.diff(goals[~before & ~inside], axis=0)).max() <= 1.01 * GENTLE_RAD_S * 0.021
    assert bus.log == ["torque True", "torque False", "close"]


def test_a_late_tick_is_counted_and_the_tone_keeps_its_phase(tmp_path):
    late = ScriptedBus(POSE, slow_at=40)
    made = short_sweep(frequencies=[3.0])
    recording = load(record(late, made, tmp_path / "a.csv", loop_period_s=PERIOD))
    trial = recording.trials("LF_hip")[0]
    elapsed = trial.send_time_s - trial.send_time_s[0]
    # 56 ms are 2.9 periods: one tick is left out, the next comes late, the rest on time
    assert recording.metadata["completed"]["loop"]["missed_deadlines"] == 1
    slow = int(np.argmax(np.diff(elapsed))) + 1
    others = np.delete(np.arange(len(elapsed)), slow)  # the slow write stamps its end
    expected = DEFAULT_POSE["LF_hip"] + made.trials[0].offset(elapsed)
    np.testing.assert_allclose(trial.command_rad[others], expected[others], atol=1e-5)
    ticks = elapsed[slow + 3 :] / PERIOD
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-3, err_msg="the schedule drifted")


@pytest.mark.parametrize(
    "raises", [KeyboardInterrupt(), BusError("cable out"), SafetyStop("10 deadlines in a row")]
)
def test_an_interrupted_recording_keeps_its_rows_and_switches_the_torque_off(tmp_path, raises):
    at_rest = round(REST_S / PERIOD + 0.5)  # written before the trial, not recorded
    bus = ScriptedBus(POSE, fail_at=at_rest + 60, raises=raises)
    with pytest.raises(type(raises)):
        record(bus, short_sweep(), tmp_path / "a.csv", loop_period_s=PERIOD)
    assert bus.log[-2:] == ["torque False", "close"]
    recording = load(tmp_path / "a.csv")
    assert "completed" not in recording.metadata
    assert len(recording.table) == 60
    if isinstance(raises, KeyboardInterrupt):
        np.testing.assert_allclose(bus.written[-1], POSE, atol=1e-12)
    if isinstance(raises, SafetyStop):
        assert len(bus.written) == at_rest + 60, "it was driven on after the stop"


def test_nothing_moves_before_file_plan_and_pose_are_known(tmp_path):
    taken, free = tmp_path / "a.csv", tmp_path / "b.csv"
    taken.write_text("precious")
    silent = POSE.copy()
    silent[3] = np.nan
    for start, made, path, raises, says in (
        (POSE, short_sweep(), taken, FileExistsRefusal, "a.csv"),
        (POSE, plan("sine", ["tail"], [1.0]), free, InputError, "tail"),
        (POSE, Plan(()), free, InputError, "no trials"),
        (silent, short_sweep(), free, BusError, "RF_hip"),
    ):
        bus = ScriptedBus(start)
        with pytest.raises(raises, match=says):
            record(bus, made, path)
        assert bus.written == [] and bus.log == ["close"]
    with pytest.raises(InputError, match="loop_period_s"):
        record(ScriptedBus(POSE), short_sweep(), free, loop_period_s=0.0)
    assert taken.read_text() == "precious" and not free.exists()
    record(ScriptedBus(POSE), short_sweep(), taken, force=True)
    assert len(load(taken).table) > 100


def test_each_recorded_row_has_its_truth_and_the_file_does_not_tell_it(tmp_path):
    bus = emulated()
    path = record(bus, short_sweep(["LF_hip", "RB_calf"]), tmp_path / "sweep.csv")
    bus.write_truth(tmp_path / "sweep")
    rows, truth = load(path).table, pd.read_csv(tmp_path / "sweep.truth.csv")
    merged = rows.merge(truth, on=["read_time_s", "joint"])
    assert len(merged) == len(rows)
    age = merged["read_time_s"] - merged["reading_time_s"]
    assert (age >= 0).all() and age.mean() > 0.015
    assert (merged["position_rad"] - merged["true_position_rad"]).std() > 0.02
    said = path.read_text()
    for secret in ("0.02685", "0.42", "delay", "stiffness", "loss"):
        assert secret not in said


KILLED = """
import sys
from pathlib import Path
import numpy as np
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.sweep.excitation import plan
from pupper_sysid.sysid.sweep.recorder import record
rng = np.random.default_rng(1)
bus = EmulatedBus(draw_robot(rng), rng, real_time=True)
slow = {"loop_period_s": 0.05}  # a busy machine keeps up
made = plan("sine", ["LF_hip"], [2.0], duration_s=60.0, **slow)
record(bus, made, Path(sys.argv[1]), **slow)
"""


def test_a_process_killed_in_mid_sweep_leaves_a_recording(tmp_path):
    path = tmp_path / "killed.csv"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)])
    try:
        while not (path.exists() and path.read_text().count("LF_hip,") > 30):
            assert process.poll() is None
            time.sleep(0.05)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    recording = load(path)
    assert "completed" not in recording.metadata
    trial = recording.trials("LF_hip")[0]
    assert len(trial.send_time_s) >= 30
    assert recording.loop_period_s == pytest.approx(0.05, rel=0.1)
    # real time passed as the recording says
    assert np.ptp(trial.send_time_s) > 0.9 * 0.05 * len(trial.send_time_s)
    assert any("not recorded to its end" in warning for warning in recording.warnings)


# ----- a recording that was cut short goes on at its first unfinished trial, and says so

FREQUENCIES = "2,3,5"


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Path:
    """A complete recording of three trials of one joint."""
    path = tmp_path_factory.mktemp("complete") / "a.csv"
    words = ("--joints", "LF_hip", "--freqs", FREQUENCIES, "--duration", "1")
    run("sweep", *words, "--out", str(path))
    return path


@pytest.fixture
def whole(complete, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(complete, tmp_path))


def run(*arguments: str) -> None:
    pupper_sysid.main(list(arguments))


def cut(path, trial: int, rows: int, torn: str = "") -> None:
    """Leave `rows` rows of `trial` and nothing behind them."""
    kept, seen = [], 0
    for line in path.read_text().splitlines(keepends=True):
        if line[0] != "#" and line[0].isdigit():
            number = int(line.split(",")[2])
            seen += number == trial
            if number > trial or (number == trial and seen > rows):
                continue
        if line.startswith("# completed"):
            continue
        kept.append(line)
    path.write_text("".join(kept) + torn)


@pytest.mark.parametrize(("trial", "rows", "torn"), [(1, 30, "7.123,7.1"), (0, 0, "")])
def test_a_cut_recording_is_continued_to_its_end(complete, whole, trial, rows, torn):
    before = load(complete).table
    cut(whole, trial, rows, torn)
    text = whole.read_text()
    run("sweep", "--resume", str(whole))
    resumed = load(whole)
    assert resumed.metadata["completed"]["rows"] == len(resumed.table)
    assert [t.number for t in resumed.trials("LF_hip")] == [0, 1, 2]
    # rows of the interrupted trial stay in the file; each trial is there once, in full, and time
    # runs forward over the interruption
    assert whole.read_text().startswith(text.removesuffix(torn))
    per_trial = resumed.table.groupby("trial").size()
    assert (per_trial - before.groupby("trial").size()).abs().max() <= 1
    assert (np.diff(resumed.table["send_time_s"]) > 0).all()
    for number in range(trial):
        old, new = (
            table[table["trial"] == number].reset_index(drop=True)
            for table in (before, resumed.table)
        )
        assert old.equals(new), "what had been recorded was changed"
    if rows:
        assert any(f"trial {trial} was interrupted" in w for w in resumed.warnings)


@pytest.mark.parametrize("years", [-50, 50])
def test_a_clock_that_was_set_during_the_interruption_does_not_move_the_recording(whole, years):
    cut(whole, 1, 30)
    written = whole.stat().st_mtime + years * 365.25 * 86_400
    os.utime(whole, (written, written))
    run("sweep", "--resume", str(whole))
    times = load(whole).table["send_time_s"].to_numpy()
    assert (np.diff(times) > 0).all() and times[-1] - times[0] < 2 * 86_400


def test_a_finished_recording_is_not_continued_and_one_without_its_footer_only_gets_that(
    whole, capsys
):
    before, rows = whole.read_bytes(), len(load(whole).table)
    assert "nothing to continue" in refused(capsys, pupper_sysid, "sweep", "--resume", whole)
    assert whole.read_bytes() == before
    asked = load(whole).metadata["sweep"]  # the header holds all options of the sweep
    assert asked["frequencies_hz"] == [2, 3, 5] and asked["joints"] == ["LF_hip"]
    cut(whole, 9, 0)
    run("sweep", "--resume", str(whole))
    assert len(load(whole).table) == rows == load(whole).metadata["completed"]["rows"]


def test_what_cannot_be_continued_or_was_played_from_a_file_that_changed_is_refused(capsys, here):
    path = Path("b.csv")
    for text, says in (
        ("time_s,x\n1,2\n", "not a recording of pupper-sysid"),
        ("# pupper-sysid recording\n# schema_version: 1\n", "does not hold its plan"),
        ('# pupper-sysid recording\n# sweep: {"bus": 3}\n', "sweep: bus is 3. Write text"),
    ):
        path.write_text(text)
        assert says in refused(capsys, pupper_sysid, "sweep", "--resume", path)
        assert path.read_text() == text
    rows = [f"{0.05 * k},{0.01 * (k % 5)}" for k in range(60)]
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows) + "\n")
    run("sweep", "--playback", "gait.csv", "--joints", "LF_hip", "--out", "a.csv")
    cut(Path("a.csv"), 0, 40)
    Path("gait.csv").write_text("time_s,LF_hip\n" + "\n".join(rows[:-1]) + "\n")
    capsys.readouterr()
    assert "another plan" in refused(capsys, pupper_sysid, "sweep", "--resume", "a.csv")
