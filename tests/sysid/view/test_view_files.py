"""Recordings as MCAP and Rerun files, opened again by the libraries of those formats."""

import sys
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.cli.programs import pupper_play, pupper_sysid
from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.data import SAMPLES
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.view import channels, guard_events, write_mcap, write_rerun
from support.command_line import refused, run, run_program
from support.viewer_files import entities_of, topics_of

ROUNDED_S = 0.6e-9  # both formats keep times in whole nanoseconds


def made(seed: int, joints=("LF_hip", "RB_calf"), metadata=None) -> Recording:
    """Joints that move together, with lost readings and repeated ones."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(0.005, 0.03, 300))
    command = {j: rng.uniform(-1, 1, 300) for j in joints}
    position = {j: np.repeat(rng.uniform(-1, 1, 150), 2) for j in joints}
    for values in position.values():
        values[rng.choice(300, 20, replace=False)] = np.nan
    return Recording.from_arrays(
        time_s, command, position, trial=np.arange(300) // 100, metadata=metadata
    )


def test_both_files_hold_every_channel_of_the_table_and_import_reads_it_back(tmp_path):
    recording = made(7)
    write_mcap(recording, tmp_path / "a.mcap")
    write_rerun(recording, tmp_path / "a.rrd")
    topics, _ = topics_of(tmp_path / "a.mcap")
    entities = entities_of(tmp_path / "a.rrd")
    again = load(tmp_path / "a.mcap")
    assert again.joints == recording.joints
    start = recording.table["read_time_s"].min()
    for joint, rows in recording.table.groupby("joint"):
        theirs = again.table[again.table["joint"] == joint]
        np.testing.assert_allclose(theirs["read_time_s"], rows["read_time_s"] - start, atol=2e-9)
        for column, clock in (("command_rad", "send_time_s"), ("position_rad", "read_time_s")):
            np.testing.assert_allclose(theirs[column], rows[column], rtol=0, atol=1e-9)
            for time_s, values in (
                topics[str(joint), column], entities[f"/joints/{joint}/{column}|scalars"]
            ):  # fmt: skip
                np.testing.assert_allclose(time_s, rows[clock], rtol=0, atol=ROUNDED_S)
                np.testing.assert_allclose(np.ravel(values), rows[column], rtol=0, atol=1e-9)
    assert set(topics) == {(c.joint, c.name) for c in channels(recording)}
    for channel in channels(recording):
        _, values = entities[f"/joints/{channel.joint}/{channel.name}|scalars"]
        np.testing.assert_array_equal(np.ravel(values), channel.values)
        np.testing.assert_array_equal(topics[channel.joint, channel.name][1], channel.values)


def test_the_age_is_the_time_since_a_reading_changed():
    time_s = 0.1 * np.arange(40)
    position = np.repeat(np.arange(10) * 0.01, 4)  # one fresh reading, then three stale ones
    recording = Recording.from_arrays(
        time_s, {"LF_hip": np.zeros(40)}, {"LF_hip": position}, read_time_s=time_s + 0.01
    )
    (age,) = (c.values for c in channels(recording) if c.name == "reading_age_s")
    assert np.isnan(age[:4]).all()  # the first value may be of any age
    np.testing.assert_allclose(age[4:], np.tile([0, 0.1, 0.2, 0.3], 9), atol=1e-12)


def test_what_the_guard_changed_is_in_both_files(tmp_path):
    counts = {"clipped": 3, "slowed": 0, "unsent": 1}
    events = [[0.5, "clipped"], [0.7, "unsent"], ["x", "clipped"], [1.0, "exploded"], 5]
    completed = {"rows": 600, "guard": counts, "guard_events": events}
    recording = made(1, metadata={"completed": completed})
    sentences = [
        "Guard: a command held at the limits.", "Guard: a command lost.",
        "Guard: 3 commands held at the limits.", "Guard: 1 commands lost.",
    ]  # fmt: skip
    assert guard_events(recording, 9.0) == list(zip([0.5, 0.7, 9, 9], sentences, strict=True))
    write_mcap(recording, tmp_path / "a.mcap")
    assert topics_of(tmp_path / "a.mcap")[1] == sentences
    write_rerun(recording, tmp_path / "a.rrd")
    times, texts = entities_of(tmp_path / "a.rrd")["/guard|text"]
    assert np.ravel(texts).tolist() == sentences
    np.testing.assert_allclose(times[:2], [0.5, 0.7])


def test_trials_that_overlap_in_time_are_refused(tmp_path):
    table = made(3).table.copy()
    for column in ("send_time_s", "read_time_s"):
        table[column] -= table.groupby(["joint", "trial"])["send_time_s"].transform("min")
    with pytest.raises(InputError, match="overlap in time"):
        write_mcap(Recording.from_frame(table), tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("module", "write", "name"),
    [("mcap_ros2.writer", write_mcap, "a.mcap"), ("rerun", write_rerun, "a.rrd")],
)
def test_what_is_missing_is_named_and_nothing_is_replaced(
    tmp_path, monkeypatch, module, write, name
):
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileExistsRefusal):
        write(made(1), tmp_path / name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'pupper-sysid\[live\]'"):
        write(made(1), tmp_path / f"new_{name}")
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_the_robot_of_the_rerun_file_stands_where_its_servos_were_read(tmp_path):
    """Feet by the closed-form kinematics of the leg, against the calves of the file."""
    import mujoco

    from pupper_sysid.policies.twin.drawing import robot_over_time
    from pupper_sysid.sim.robot.replay import compiled, mini_pupper_robot

    recording = load(SAMPLES / "playback.csv")
    time_s, bodies = robot_over_time(recording)
    assert np.diff(time_s).min() > 0 and len(time_s) <= 30 * np.ptp(time_s) + 2
    model = compiled(mini_pupper_robot(), 0.0, fixed=True)
    data = mujoco.MjData(model)
    by_name = {body.name: body for body in bodies}
    k = len(time_s) // 2
    for joint in recording.joints:
        rows = recording.table[recording.table["joint"] == joint]
        held = rows["position_rad"].to_numpy()[rows["read_time_s"].to_numpy() <= time_s[k]][-1]
        # the calf's servo holds thigh + calf, recorded with the thigh at its neutral
        data.qpos[model.joint(joint).qposadr[0]] = held
    for leg in ("LF", "RF", "LB", "RB"):
        thigh = model.joint(f"{leg}_thigh").qposadr[0]
        neutral = recording.metadata["start_pose_rad"][f"{leg}_thigh"]
        data.qpos[model.joint(f"{leg}_calf").qposadr[0]] -= data.qpos[thigh] - neutral
    mujoco.mj_kinematics(model, data)
    for number in range(1, model.nbody):
        body = by_name[model.body(number).name]
        np.testing.assert_allclose(body.position[k], data.xpos[number], atol=1e-9)
        assert body.vertices.shape[1] == 3 and body.triangles.max() < len(body.vertices)
    write_rerun(recording, tmp_path / "a.rrd", time_s, bodies)
    found = entities_of(tmp_path / "a.rrd")
    for body in bodies:
        _, values = found[f"/robot/{body.name}|translation"]
        np.testing.assert_allclose(np.squeeze(values), body.position, atol=1e-6)  # 32 bit


def test_the_command_writes_both_files_and_says_what_is_wrong(here, capsys):
    sample = str(SAMPLES / "playback.csv")
    code, out, _ = run(capsys, "view", sample, "--rerun", "a.rrd", "--mcap", "a.mcap")
    assert code == 0 and "rerun a.rrd" in out and Path("a.mcap").stat().st_size > 1000
    assert any(key.startswith("/robot/") for key in entities_of(here / "a.rrd"))
    for options, sentence in [
        ((), "Nothing to write"),
        (("--mcap", "a.mcap"), "exists already"),
        (("--mcap", "b.csv"), "must end in .mcap"),
        (("--mcap", "b.mcap", "--model", "x.xml"), "only a Rerun file"),
    ]:
        assert sentence in refused(capsys, pupper_sysid, "view", sample, *options)


def test_a_simulated_walk_is_written_with_its_trunk_moving_as_it_walked(here, capsys):
    policy = SAMPLES / "policies/mlp"
    words = (str(policy), "--seconds", "2", "--rerun", "w.rrd", "--mcap", "w.mcap")
    code, out, err = run_program(capsys, pupper_play, *words)
    assert code == 0 and "Wrote w.rrd" in err and "Wrote w.mcap" in err
    away = float(" ".join(out.split()).split("; ")[-1].split(" m ")[0])
    _, values = next(
        v for k, v in entities_of(here / "w.rrd").items()
        if k.startswith("/robot/") and k.endswith("translation") and np.ptp(v[1], axis=0).max() > 0
    )  # fmt: skip
    trunk = np.squeeze(values)
    assert len(trunk) == 100 and 0.05 < away < 0.5
    assert np.linalg.norm(trunk[-1, :2] - trunk[0, :2]) == pytest.approx(away, abs=0.03)
    found, _ = topics_of(here / "w.mcap")
    times, commands = found["LF_thigh", "command_rad"]
    assert len(times) == 100 and np.ptp(commands) > 0.1
    assert np.isfinite(found["LF_thigh", "position_rad"][1]).all()
    assert "must end in .mcap" in refused(capsys, pupper_play, policy, "--mcap", "w.csv")
