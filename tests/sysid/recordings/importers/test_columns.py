"""Columns by the words of their names: robots', drives', simulators' and benches' layouts."""

import json

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.doctor.examination import examine
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.columns import column, time_columns
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.layouts import convert
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.recordings.table import parse
from support.real_recordings import case
from support.refusals import assert_each_refused

TIME = 0.01 * np.arange(100)
COMMAND = 0.3 * np.sin(8 * TIME)
POSITION = 0.29 * np.sin(8 * (TIME - 0.03))
NOISE = np.random.default_rng(0).normal(size=100)
VALUES = {
    "t": TIME, "tms": 1e3 * TIME, "ns": 1_700_000_000e9 + 1e9 * TIME, "c": COMMAND, "p": POSITION,
    "cd": np.degrees(COMMAND), "pd": np.degrees(POSITION), "x": NOISE, "": np.zeros(100),
    "cc": 2048 + COMMAND * 2048 / np.pi, "pc": 2048 + POSITION * 2048 / np.pi,
    "ct": COMMAND / (2 * np.pi), "pt": POSITION / (2 * np.pi),
}  # fmt: skip


def frame(layout):
    """A table of `name=kind` columns."""
    named = [part.partition("=") for part in layout.split("|")]
    return pd.DataFrame({name.strip(): VALUES[kind.strip()] for name, _, kind in named})


def holds(recording, joints):
    """Whether the recording holds the command and the position for each of these joints."""
    assert set(recording.joints) == set(joints)
    for joint in joints:
        (trial,) = recording.trials(joint)
        np.testing.assert_allclose(trial.command_rad, COMMAND, atol=1e-9)
        np.testing.assert_allclose(trial.position_rad, POSITION, atol=1e-9)


LAYOUTS = {
    # drives and servos
    "time=t|p_des=c|v_des|kp|kd|t_ff|p_act=p|v_act=x|t_act=x": "joint",
    "time=t|pos_setpoint=ct|pos_estimate=pt|vel_estimate=x|iq_measured=x": "joint",
    "t=t|axis0.controller.pos_setpoint=ct|axis0.encoder.pos_estimate=pt": "axis_0",
    "t=t|axis1.pos_setpoint_turns=ct|axis1.pos_estimate_turns=pt": "axis_1",
    "time_ms=tms|goal_position_tick=cc|q_cmd_rad=c|q_present_rad=p|present_position_tick=pc":
        "joint",
    "time=t|goalPosition=c|presentPosition=p|presentCurrent=x|presentLoad=x": "joint",
    "stamp=ns|dxl_3_goal_position=c|dxl_3_present_position=p|dxl_3_present_current=x": "dxl_3",
    "time=t|joint1_position_setpoint=c|joint1_position_actual=p|joint1_torque_actual=x": "joint_1",
    "Time (s)=t|Reference angle (deg)=cd|Measured angle (deg)=pd": "joint",
    "time=t|SollPosition=c|IstPosition=p": "joint",
    "t[ms]=tms|sp=c|pv=p|out=x": "joint",
    "time=t|target_angle=c|current_angle=p|current=x": "joint",
    # legged robots and simulators
    "time=t|joint_pos_target_0=c|joint_pos_target_1=c|dof_pos_0=p|dof_pos_1=p": "joint_0 joint_1",
    "t=t|dof_pos=p|dof_vel=x|dof_pos_target=c|dof_torque=x": "joint",
    "t=t|des_dof_pos=c|dof_pos=p": "joint",
    "time=t|actions[0]=c|actions[1]=c|dof_pos[0]=p|dof_pos[1]=p": "joint_0 joint_1",
    "time=t|LF_HFE_pos_cmd=c|LF_HFE_pos_meas=p|LF_HFE_vel_meas=x": "LF_HFE",
    "time=t|motor_cmd[3].q=c|motor_state[3].q=p|motor_state[3].dq=x": "joint_3",
    "time=t|ctrl[0]=c|qpos[0]=p|qvel[0]=x": "joint_0",
    "time=t|hip_roll_l_q_des=c|hip_roll_l_q=p|hip_roll_l_qd=x": "hip_roll_l",
    "time=t|q1=p|q1_des=c|qd1=x": "joint_1",
    # ROS, as PlotJuggler and rostopic write it
    "__time=t|/joint_commands/position/0=c|/joint_states/position/0=p|/joint_states/velocity/0=x":
        "joint_0",
    "__time=t|/joint_states/LF_HAA/position=p|/joint_commands/LF_HAA/position=c": "LF_HAA",
    "__time=t|/joint_states/name.position=p|/joint_commands/name.position=c": "joint",
    "__time=t|/arm/state/desired/positions[0]=c|/arm/state/actual/positions[0]=p|"
    "/arm/state/error/positions[0]=x": "arm_0",
    "%time=ns|field.position0=p|field.goal0=c|field.velocity0=x": "joint_0",
    # teleoperation
    "timestamp=t|leader_knee=c|follower_knee=p": "knee",
    "timestamp=t|observation.state.left_hip_joint=p|action.left_hip_joint=c": "left_hip_joint",
    "timestamp=t|main_shoulder_pan.goal=c|main_shoulder_pan.pos=p": "main_shoulder_pan",
    # benches
    "t=t|u=c|y=p": "joint",
    "t=t|r=c|u=x|y=p": "joint",
    "time=t|theta_ref=c|theta=p": "joint",
    "time=t|setpoint=c|feedback=p|error=x|output=x": "joint",
    "time=t|servo angle command=c|servo angle=p": "joint",
    "time=t|commanded_angle=c|potentiometer=p": "joint",
    "time=t|hipTargetPos=c|hipActualPos=p|hipCurrent=x": "hip",
    "time=t|x_cmd=c|x_pos=p|y_cmd=c|y_pos=p": "x y",
    "time=t|J1_CMD=c|J1_ACT=p|J2_CMD=c|J2_ACT=p": "J1 J2",
    "time=t|cmd_deg=cd|pos_rad=p": "joint",
    "time=t|cmd=c|pos=p|pos_filtered=x|cmd_prev=x|pos_sim=x": "joint",
    "t_cmd=t|cmd=c|t_pos=t|pos=p": "joint",
    "sent_at=t|read_at=t|cmd=c|pos=p": "joint",
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_by_its_words(layout):
    holds(Recording.from_frame(frame(layout)), LAYOUTS[layout].split())


def test_a_clock_of_commands_and_one_of_readings_are_taken_as_such():
    table = frame("t_cmd=t|cmd=c|t_read=t|pos=p")
    table["t_read"] += 0.003
    (trial,) = Recording.from_frame(table).trials("joint")
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.003, atol=1e-12)
    assert trial.read_time_doubt_s == 0
    with_third = table.assign(time=table["t_cmd"] + 0.002)
    named = LogOptions(time="t_read", command_time="t_cmd")
    (trial,) = Recording.from_frame(with_third, options=named).trials("joint")
    np.testing.assert_allclose(trial.read_time_s - trial.send_time_s, 0.003, atol=1e-12)
    recording = Recording.from_frame(with_third)
    assert any("'command_time': 't_cmd'" in text for text in recording.warnings)


def test_a_command_that_stays_in_force_is_sent_once_for_its_first_reading():
    """Commands at 25 Hz, readings at 100 Hz: the others of its rows count at their readings."""
    table = frame("t=t|cmd=c|pos=p")
    first = 4 * (np.arange(100) // 4)
    table["t_sent"], table["cmd"] = TIME[first] - 0.001, COMMAND[first]
    options = LogOptions(time="t", command_time="t_sent")
    (trial,) = Recording.from_frame(table, options=options).trials("joint")
    apart = trial.read_time_s - trial.send_time_s
    np.testing.assert_allclose(apart[::4], 0.001, atol=1e-12)
    np.testing.assert_allclose(np.delete(apart, np.s_[::4]), 0.0, atol=1e-12)


def test_two_columns_that_are_as_good_are_refused_with_the_line_that_takes_each(tmp_path):
    table = frame("time=t|goal.knee=c|target.knee=x|present.knee=p")
    table.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError) as caught:
        load(tmp_path / "log.csv")
    for word in ("goal", "target"):
        line = f"log.csv --command '{word}.{{joint}}' --position 'present.{{joint}}' --out"
        assert line in str(caught.value)
    holds(
        load(tmp_path / "log.csv", LogOptions(command="goal.{joint}", position="present.{joint}")),
        ["knee"],
    )
    # the same values under two names leave no choice
    holds(Recording.from_frame(table.assign(**{"target.knee": COMMAND})), ["knee"])


def test_refusals_name_what_is_there_and_a_line_that_takes_it(tmp_path):
    def file(name, layout):
        frame(layout).to_csv(tmp_path / name, index=False)
        return tmp_path / name

    cases = [
        (file("a.csv", "time=t|cmd=c|hippo=p"), "a.csv --time time --command cmd --position hippo"),
        (file("b.csv", "when=t|cmd=c|pos=p"), "b.csv --time when --command cmd --position pos"),
        (file("c.csv", "tick=t|cmd=c|pos=p"), "c.csv --time tick --command cmd --position pos"),
        (file("d.csv", "time=t|goal_position=cc|present_position=pc"), "d.csv --unit deg"),
        (file("e.csv", "time=t|cmd_1=c|cmd_2=c|pos_a=p|pos_b=p"),
         "--command cmd_1,cmd_2 --position pos_a,pos_b"),
    ]  # fmt: skip
    assert_each_refused(cases, load, names="pupper-sysid import")
    whole = frame("time=t|goal_position=cc|present_position=pc").round()
    whole.to_csv(tmp_path / "f.csv", index=False)
    assert_each_refused([(tmp_path / "f.csv", "f.csv --unit counts:4096")], load)
    two = LogOptions(command="cmd_1,cmd_2", position="pos_a,pos_b", joints={"a": "a", "b": "b"})
    holds(load(tmp_path / "e.csv", two), ["a", "b"])


def test_radians_go_before_counts_and_plain_values_before_filtered_ones():
    better = ["q_cmd_rad", "cmd", "cmd_deg", "goal_tick", "trajectory_rad", "cmd_rad_filtered"]
    ranks = [column(name).rank for name in better]
    assert ranks == sorted(ranks)
    positions = ["present_position", "position", "actual", "pos_tick", "output"]
    ranks = [column(name).rank for name in positions]
    assert ranks == sorted(ranks)
    for name in ("cmd_velocity", "torque_cmd", "position_error", "current", "kp", "battery_voltage",
                 "position_p_gain", "imu_angle_rate"):  # fmt: skip
        assert column(name).kind == "", name
    assert time_columns(["host_time_ns", "realtime_tick_ms", "time_s", "t"])[0] == "time_s"


def test_rows_of_several_joints_are_told_apart_by_the_columns_that_name_them(tmp_path):
    def keyed(**labels):
        parts = [
            frame("time=t|hip_cmd=c|hip_pos=p|knee_cmd=c|knee_pos=p").assign(
                **dict(zip(labels, values, strict=True))
            )
            for values in zip(*labels.values(), strict=True)
        ]
        return pd.concat(parts).sort_values("time", kind="stable")

    legs = keyed(leg=["LF", "RF"])
    holds(Recording.from_frame(legs), ["LF_hip", "LF_knee", "RF_hip", "RF_knee"])
    legs.to_csv(tmp_path / "log.csv", index=False)
    holds(load(tmp_path / "log.csv"), ["LF_hip", "LF_knee", "RF_hip", "RF_knee"])
    both = keyed(leg=["L", "L", "R", "R"], joint=["a", "b", "a", "b"])[
        ["time", "leg", "joint", "hip_cmd", "hip_pos"]
    ].rename(columns={"hip_cmd": "cmd", "hip_pos": "pos"})
    holds(Recording.from_frame(both), ["L_a", "L_b", "R_a", "R_b"])
    for name, joints in (("id", ["id_1", "id_7"]), ("servo_id", ["servo_1", "servo_7"]),
                         ("motor", ["motor_1", "motor_7"])):  # fmt: skip
        numbered = keyed(**{name: [1, 7]})[["time", name, "hip_cmd", "hip_pos"]]
        numbered.columns = ["time", name, "cmd", "pos"]
        expected = [j.replace("id_", "motor_") for j in joints]
        holds(Recording.from_frame(numbered), expected)
    # a number for each row is no joint's
    holds(Recording.from_frame(frame("time=t|cmd=c|pos=p").assign(id=np.arange(100))), ["joint"])


def test_labels_number_trials_and_a_change_of_frequency_begins_one(tmp_path):
    table = frame("time=t|cmd=c|pos=p").assign(phase=np.repeat(["a", "rest", "b", "rest"], 25))
    table.to_csv(tmp_path / "log.csv", index=False)
    recording = load(tmp_path / "log.csv", LogOptions(trial="phase"))
    assert len(recording.trials("joint")) == 4
    assert any("0: a, 1: rest, 2: b" in text for text in recording.warnings)
    tones = frame("time=t|cmd=c|pos=p").assign(freq_hz=np.repeat([1.0, 2.0, 1.0, 4.0], 25))
    found = [t.frequency_hz for t in Recording.from_frame(tones).trials("joint")]
    assert found == [1.0, 2.0, 1.0, 4.0]
    chirp = tones.assign(freq_hz=np.linspace(1, 4, 100))
    (trial,) = Recording.from_frame(chirp).trials("joint")
    assert np.isnan(trial.frequency_hz)


def test_times_come_from_a_rate_where_there_are_none():
    table = frame("cmd=c|pos=p")
    with pytest.raises(InputError, match="no column is a time"):
        Recording.from_frame(table)
    recording = Recording.from_frame(table, options=LogOptions(rate=100, readings="live"))
    (trial,) = recording.trials("joint")
    np.testing.assert_allclose(np.diff(trial.send_time_s), 0.01)
    assert trial.read_time_doubt_s == pytest.approx(0.005) and trial.readings == "live"
    assert any("scale with that rate" in text for text in recording.warnings)


def test_the_time_between_reading_and_command_is_taken_as_stated_and_else_said():
    table = frame("time=t|cmd=c|pos=p")
    for after, apart in (("3ms", 0.003), ("250us", 0.00025), ("-0.002 s", -0.002)):
        (trial,) = Recording.from_frame(table, options=LogOptions(send_after=after)).trials("joint")
        np.testing.assert_allclose(trial.send_time_s - trial.read_time_s, apart, atol=1e-12)
        assert trial.read_time_doubt_s == 0
    recording = Recording.from_frame(table, options=LogOptions(read_before_send=True))
    assert any("0.5 ms later" in t and "`send_after='3ms'`" in t for t in recording.warnings)
    cases = [({"send_after": "3"}, "with its unit"), ({"send_after": "5s"}, "at most 1 s"),
             ({"rate": 0.0}, "from 0.1 to"), ({"readings": "new"}, "'live' or 'polled'"),
             ({"command_time": "t", "rate": 30.0}, "leave `send_after`")]  # fmt: skip
    assert_each_refused(cases, lambda keywords: LogOptions(**keywords))


def test_angles_of_several_turns_are_angles_where_their_unit_is_stated():
    """A gearmotor that turns by 540 degrees."""
    table = frame("time=t|cmd=cd|pos=pd")
    table[["cmd", "pos"]] *= 540 / 17.2
    with pytest.raises(InputError, match="looks like degrees"):
        Recording.from_frame(table)
    recording = Recording.from_frame(table, options=LogOptions(unit="deg"))
    (trial,) = recording.trials("joint")
    assert trial.command_rad.max() == pytest.approx(3 * np.pi, rel=0.01) and trial.unit_stated
    assert not any("degrees" in reason for reason in examine(recording)["joint"].reasons)
    with pytest.raises(InputError, match="more than a hundred turns"):
        Recording.from_frame(table * 100, options=LogOptions("time", unit="rad"))


def test_tensors_of_pace_are_read_and_objects_are_not(tmp_path):
    torch = pytest.importorskip("torch")
    both = [torch.tensor(v)[:, None].repeat(1, 2) for v in (COMMAND, POSITION)]
    run = {"time": torch.tensor(TIME), "des_dof_pos": both[0], "dof_pos": both[1],
           "joint_names": ["knee", "ankle"]}  # fmt: skip
    torch.save(run, tmp_path / "run.pt")
    holds(load(tmp_path / "run.pt"), ["knee", "ankle"])
    del run["joint_names"]
    torch.save(run | {"time": run["time"][:, None]}, tmp_path / "run.pt")
    holds(load(tmp_path / "run.pt"), ["joint_0", "joint_1"])
    torch.save(torch.nn.Linear(2, 2), tmp_path / "net.pt")
    torch.save(run | {"time": torch.zeros(1).expand(10**9)}, tmp_path / "wide.pt")
    cases = [("net.pt", "tensors alone"), ("wide.pt", "1,000,000,000 values")]
    assert_each_refused(cases, lambda name: load(tmp_path / name))


def test_lerobot_names_may_be_nested_or_flat(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    listed = {"names": [["kneePitch", "ankle"]], "shape": [2]}
    nested = {"names": {"motors": [["kneePitch"], ["ankle"]]}, "shape": [2]}
    frames = {"episode_index": np.zeros(100, int), "frame_index": np.arange(100)}
    both = {key: np.repeat(v[:, None], 2, 1).tolist() for key, v in
            (("action", COMMAND), ("observation.state", POSITION))}  # fmt: skip
    flat = {f"{key}.{joint}": np.array(v)[:, 0] for key, v in both.items()
            for joint in ("kneePitch", "ankle")}  # fmt: skip
    for n, (features, columns) in enumerate((
        (dict.fromkeys(both, listed), both), (dict.fromkeys(both, nested), both),
        ({key: {"shape": [1], "dtype": "float32"} for key in flat}, flat),
    )):  # fmt: skip
        folder = tmp_path / str(n)
        (folder / "meta").mkdir(parents=True)
        (folder / "data").mkdir()
        (folder / "meta/info.json").write_text(json.dumps({"fps": 100, "features": features}))
        parquet.write_table(pa.table(columns | frames), folder / "data" / "0.parquet")
        holds(load(folder), ["kneePitch", "ankle"])
        (trial,) = load(folder, LogOptions(rate=50)).trials("ankle")
        np.testing.assert_allclose(np.diff(trial.read_time_s), 0.02)


# ------------------------------------------------------------------------------ shared cases


def test_radians_of_a_telemetry_with_ticks_are_taken_and_labels_number_its_trials():
    path = case("real/c07_mx106_telemetry_takes_ticks.csv")
    recording = load(path, LogOptions(trial="phase"))
    assert recording.metadata["columns"]["joint"] == {
        "command": "q_cmd_rad", "position": "q_present_rad",
    }  # fmt: skip
    assert len(recording.trials("joint")) == 3
    clocks = LogOptions(time="rx_end_ns", command_time="tx_start_ns", trial="phase")
    trial = load(path, clocks).trials("joint")[0]
    assert 1e3 * np.median(trial.read_time_s - trial.send_time_s) == pytest.approx(3.47, abs=0.05)


def test_readings_go_before_models_and_names_in_the_last_comment_of_savetxt_are_read():
    path = case("real/c13_command_real_and_models.csv")
    table = convert(path, parse(path, path.read_text())).table
    raw = pd.read_csv(path)
    np.testing.assert_allclose(table["command_rad"], raw["goal_position_rad"])
    np.testing.assert_allclose(table["position_rad"], raw["real_position_rad"])
    path = case("real/c11_savetxt_tabs_names_in_comment.txt")
    with pytest.raises(InputError, match=r"column u \(the command of joint\): values reach 100"):
        load(path)
    recording = load(path, LogOptions(unit="deg"))
    assert recording.metadata["columns"]["joint"]["command"] == "u"
    assert "theta" in recording.metadata["columns"]["joint"]["position"]
