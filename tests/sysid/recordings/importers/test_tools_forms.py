"""Logs as monitors, data bases, drives and simulators write them: read, or refused with a line.

`READ` are read, `LINES` are refused and the first `import` line of the message reads them, `WRONG`
are refused in words that name what they are.
"""

import io
import json
import re
import shlex

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.io import savemat

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from support.refusals import assert_each_refused

ROWS = 80
TIME = np.round(0.01 * np.arange(ROWS), 3)
COMMAND = np.round(0.3 * np.sin(8 * TIME), 6)
POSITION = np.round(0.28 * np.sin(8 * (TIME - 0.03)), 6)
SECOND = (np.round(0.2 * np.cos(5 * TIME), 6), np.round(0.19 * np.cos(5 * (TIME - 0.03)), 6))
LOG = list(zip(TIME.tolist(), COMMAND.tolist(), POSITION.tolist(), strict=True))
BOTH = [(*row, c, p) for row, c, p in zip(LOG, *map(np.ndarray.tolist, SECOND), strict=True)]
JOINTS = (COMMAND, POSITION), SECOND


def each(pattern, rows=LOG, head=""):
    """A line a row: `t` or `m` (milliseconds), `c`, `p`; of a second joint `d` and `q`."""
    names = "tcpdq"[: len(rows[0])]
    return f"{head}\n" * bool(head) + "".join(
        pattern.format(
            **dict(zip(names, row, strict=True)),
            m=round(1e3 * row[0]),
            n=n,
            ns=1_700_000_000_000_000_000 + round(1e9 * row[0]),
        )
        + "\n"
        for n, row in enumerate(rows)
    )


CSV = each("{t},{c},{p}")
NAMED = "time,cmd,pos\n" + CSV


def saved(write, *values, **arrays):
    out = io.BytesIO()
    write(out, *values, **arrays)
    return out.getvalue()


def matlab(**variables):
    return saved(savemat, variables)


LONG = pd.DataFrame({"time": TIME, "knee_cmd": COMMAND, "knee_pos": POSITION, "hip_cmd": SECOND[0],
                     "hip_pos": SECOND[1]}).melt("time", var_name="signal")  # fmt: skip
STACKED = {"q": np.column_stack([POSITION, SECOND[1]]),
           "q_des": np.column_stack([COMMAND, SECOND[0]])}  # fmt: skip
INFLUX = "#group,false,false,false,true,true\n#datatype,string,long,dateTime:RFC3339,double,string"

TURNS = [(t, c / (2 * np.pi), p / (2 * np.pi)) for t, c, p in LOG]
DEGREES = [(t, *np.degrees((c, p)).tolist()) for t, c, p in LOG]
GERMAN = "".join(f"{t:.2f}\t{c!r}\t{t:.2f}\t{p!r}\n" for t, c, p in DEGREES).replace(".", ",")
BOTH_DEGREES = [(t, *np.degrees(values).tolist()) for t, *values in BOTH]
KEYED = [f"{t},{name},{c},{p}\n" for name, (commands, positions) in zip("ab", JOINTS, strict=True)
         for t, c, p in zip(TIME, commands, positions, strict=True)]  # fmt: skip
SIGNED = [(t, *(round(652 * v) for v in (c, p))) for t, c, p in LOG]
COUNTS = [(t, *(round(2048 + 652 * v) for v in (c, p))) for t, c, p in LOG]

READ: dict[str, tuple[str | bytes, str]] = {  # and the joints
    # monitors
    "ESP-IDF, in colours": (
        "boot:0x13\n" + each("\x1b[0;32mI ({m}) servo: cmd={c} pos={p}\x1b[0m"), "joint"),
    "remarks of other programs": (NAMED.replace("\n", "\n[D][BLE] scan\n"), "joint"),
    "a traceback": (NAMED + '^CTraceback:\n  File "log.py", line 12, in <module>\n', "joint"),
    "a first line that was cut": ("m [ms],cmd,pos\n.1,-0.1\n" + each("{m},{c},{p}"), "joint"),
    "a last line that was cut": (NAMED + "0.8,0.3,-", "joint"),
    "Tera Term": ("[2026-05-04 12:29:59.900] cmd,pos\n"
                  + each("[2026-05-04 12:30:{t:06.3f}] {c},{p}"), "joint"),
    "names without a clock": ("cmd\tpos\n" + each("12:30:{t:06.3f} -> {c}\t{p}"), "joint"),
    "Dynamixel's servos in a line": (
        each("{t} [ID:001] goal:{c}  pos:{p}\t[ID:002] goal:{d}  pos:{q}", BOTH),
        "joint_1 joint_2"),
    "Dynamixel's servos in turn": (
        each("[{m} ms] [ID:1] goal:{c} pos:{p}\n[{m} ms] [ID:2] goal:{d} pos:{q}", BOTH),
        "motor_1 motor_2"),
    "units behind named numbers": (
        each("t = {m} ms | target = {c!r}° | actual = {p!r}°", DEGREES), "joint"),
    "vectors behind names": (
        each("{t} target [{c} {d}] actual [{p} {q}]", BOTH), "joint_0 joint_1"),
    "names of two words": (
        each("Target angle: {c!r} deg, Actual angle: {p!r} deg, elapsed: {m} ms", DEGREES),
        "joint"),
    # words and marks in cells
    "decimal commas in one column": ("time;cmd;pos\n" + "".join(
        f"{t};{str(c).replace('.', ',')};{p}\n" for t, c, p in LOG), "joint"),
    "negative numbers in parentheses": ("time;cmd;pos\n" + re.sub(
        r"-([\d.]+)", r"(\1)", each("{t};{c};{p}")), "joint"),
    "units in texts of JSON": (json.dumps([
        {"t": t, "cmd": f"{c!r} deg", "pos": f"{p!r} deg"} for t, c, p in DEGREES]), "joint"),
    "spaces between thousands": ("time_us;cmd;pos\n" + "".join(
        f"{1e6 * t:,.0f};".replace(",", " ") + f"{c};{p}\n".replace(".", ",") for t, c, p in LOG),
        "joint"),
    "words for failed reads": (NAMED + "".join(f"{0.8 + 0.01 * k:.2f},0.1,{word}\n" for k, word in (
        enumerate(("-nan(ind)", "1.#QNAN", "#DIV/0!", "-1.#IND", "(null)", "----", ".")))),
        "joint"),
    "single quotes": ("'" + NAMED.strip().replace(",", "','").replace("\n", "'\n'") + "'\n",
                      "joint"),
    "Mathematica": (re.sub(r"(0\.\d+)", r"\1*^0", NAMED), "joint"),
    "tensors in cells": ("time,action,state\n" + each(
        "{t},\"tensor([{c}, {d}])\",\"array('d', [{p}, {q}])\"", BOTH), "joint_0 joint_1"),
    "units in a comment": (
        "# units: s, deg, deg\ntime\tcmd\tpos\n" + each("{t}\t{c!r}\t{p!r}", DEGREES), "joint"),
    "a unit in a remark": (
        "Bench 3 (angles in degrees)\ntime,cmd,pos\n" + each("{t},{c!r},{p!r}", DEGREES), "joint"),
    "units behind decimal commas": ("Zeit;Soll;Ist\n" + "".join(
        f"{1e3 * t:.1f} ms;{c!r} °;{p!r} °\n".replace(".", ",") for t, c, p in DEGREES), "joint"),
    "centidegrees": ("t,cmd (cdeg),pos (cdeg)\n" + "".join(
        f"{t},{18000 / np.pi * c!r},{18000 / np.pi * p!r}\n" for t, c, p in LOG), "joint"),
    "dictionaries of NumPy": (each("{{'t': np.float64({t}), 'cmd': np.float32({c}), 'pos': {p}}}"),
                              "joint"),
    # tables that were printed, turned or grouped
    "boxes": ("┌──────┬──────┬──────┐\n│ time │ goal │ pos  │\n├──────┼──────┼──────┤\n"
              + each("│ {t} │ {c} │ {p} │") + "└──────┴──────┴──────┘\n", "joint"),
    "rules of equals signs": (
        "=====  =====  =====\ntime   goal   pos\n=====  =====  =====\n" + each("{t}  {c}  {p}")
        + "=====  =====  =====\n", "joint"),
    "Markdown": ("|    | time | goal | pos |\n|---:|-----:|-----:|----:|\n"
                 + each("|  {n} | {t} | {c} | {p} |"), "joint"),
    "NumPy's long lists": ("time,action,qpos\n" + each(
        '{t},"[{c}\n  {d}]","[{p}\n  {q}]"', BOTH), "joint_0 joint_1"),
    "an index without a name": (
        pd.DataFrame({"cmd": COMMAND, "pos": POSITION}, TIME).to_csv(), "joint"),
    "names of two levels": (pd.DataFrame(
        np.column_stack([*JOINTS[0], *JOINTS[1]]), pd.Index(TIME, name="time"),
        pd.MultiIndex.from_product([["knee", "hip"], ["cmd", "pos"]], names=["joint", "signal"]),
        ).to_csv(), "knee hip"),
    "a row for each quantity": ("".join(
        f"{name},{','.join(map(str, values))}\n"
        for name, values in (("time", TIME), ("cmd", COMMAND), ("pos", POSITION))), "joint"),
    "cells over two columns": (
        ",Knee,,Hip,\nTime,Goal,Present,Goal,Present\n" + each("{t},{c},{p},{d},{q}", BOTH),
        "Knee Hip"),
    "LabVIEW's times for each channel": (
        "Separator\tTab\n***End_of_Header***\t\n\t\nChannels\t2\t\t\t\nY_Unit_Label\tdeg\t\tdeg\t\n"
        "***End_of_Header***\t\t\t\t\nX_Value\tSetpoint\tX_Value\tPosition\tComment\n" + GERMAN,
        "joint"),
    "LabVIEW without times": (
        "Separator\tTab\n***End_of_Header***\t\n\t\nChannels\t2\t\nSamples\t80\t80\nDelta_X\t0.01"
        "\t0.01\n***End_of_Header***\t\t\nX_Value\tSetpoint\tPosition\tComment\n"
        + each("\t{c}\t{p}"), "joint"),
    # times
    "seconds that are milliseconds": ("time (s),cmd,pos\n" + each("{m},{c},{p}"), "joint"),
    "a clock that was set": ("time,cmd,pos\n0,0,0\n" + "".join(
        f"{1_790_000_000 + t:.4f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "rows in no order": ("t,servo,target,actual\n" + "".join(
        np.random.default_rng(1).permutation(KEYED)), "a b"),
    "a counter of 16 bits": ("t_us,cmd,pos\n" + "".join(
        f"{round(1e6 * t) % 65536},{c},{p}\n" for t, c, p in LOG), "joint"),
    "a date beside": ("Datum;Uhrzeit;Soll;Ist\n" + each("04.05.2026;12:30:{t:06.3f};{c};{p}"),
                      "joint"),
    "minutes": ("Time (min),Goal,Present\n" + "".join(
        f"{t / 60!r},{c},{p}\n" for t, c, p in LOG), "joint"),
    "days of a spreadsheet": ("Timestamp,Goal,Present\n" + "".join(
        f"{46146 + t / 86400:.12f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "afternoon": ("Time,Goal,Present\n" + each("5/4/2026 12:30:{t:06.3f} PM,{c},{p}"), "joint"),
    "milliseconds behind a colon": ("Time,Goal,Present\n" + "".join(
        f"12:30:00:{1e3 * t:03.0f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "milliseconds beside": ("time,ms,goal,present\n" + each("12:30:01,{m},{c},{p}"), "joint"),
    "time between rows": ("dt_us,cmd,pos\n" + each("10000,{c},{p}"), "joint"),
    "a time step that rises": ("timestep,joint_pos_0,joint_pos_target_0\n" + each("{t},{p},{c}"),
                               "joint_0"),
    "a rate in a remark": ("# sample rate: 100 Hz\nsample,cmd,pos\n" + each("{n},{c},{p}"),
                           "joint"),
    "a first time column that is empty": (
        "header_stamp,receive_time,cmd,pos\n" + each(",{t},{c},{p}"), "joint"),
    # commands in rows of their own, several joints
    "InfluxDB": (f"{INFLUX},string\n,result,table,_time,_value,_field,joint\n" + each(
        ",,0,2026-05-04T12:30:{t:09.6f}Z,{c},goal,knee\n,,1,2026-05-04T12:30:{t:09.6f}Z,{p},present"
        ",knee\n,,2,2026-05-04T12:30:{t:09.6f}Z,{d},goal,hip\n,,3,2026-05-04T12:30:{t:09.6f}Z,{q},"
        "present,hip", BOTH), "knee hip"),
    "a kind and a joint": ("time,joint,kind,angle\n" + each(
        "{t},knee,target,{c}\n{t},knee,measured,{p}\n{t},hip,target,{d}\n{t},hip,measured,{q}",
        BOTH), "knee hip"),
    "Dynamixel's Wizard": ("Time,ID,Item,Value\n" + each(
        "{m},1,Goal Position,{c}\n{m},1,Present Position,{p}"), "motor_1"),
    "writes and reads": ("time,op,id,value\n" + each("{t},write,1,{c}\n{t},read,1,{p}"),
                         "motor_1"),
    "commands as they change": ("time,cmd,pos\n" + "".join(
        f"{t},{c if n == 0 or c != COMMAND[n - 1] else ''},{p}\n" for n, (t, c, p) in
        enumerate(LOG)), "joint"),
    "a melted parquet": (saved(lambda f: LONG.to_parquet(f)), "knee hip"),
    "a parquet of dates": (saved(lambda f: pd.DataFrame({"cmd": COMMAND, "pos": POSITION},
        pd.to_datetime(TIME, unit="s", utc=True)).to_parquet(f)), "joint"),
    "InfluxDB's lines": (each("servo,joint=knee,robot=a goal={c},present={p} {ns}\n"
                              "servo,joint=hip,robot=a goal={d},present={q} {ns}", BOTH),
                         "knee hip"),
    "messages of a CAN bus, decoded": (each(
        "(1700000000.{n:02d}) can0 141 [8] 00 11 :: Goal(knee_goal: {c} rad)\n"
        "(1700000000.{n:02d}) can0 241 [8] 00 11 :: Status(knee_pos: {p} rad, knee_vel: 0 rad/s)"),
        "knee"),
    "two tables, one beside the other": ("goal_time,goal,position_time,position\n" + "".join(
        f"{t},{c},{TIME[n // 2]},{POSITION[n // 2]}\n" for n, (t, c, _) in enumerate(LOG))
        + "".join(f",,{t},{p}\n" for t, _, p in LOG[40:]), "joint"),
    # drives: what their words mean
    "a message of a status": ('"timestamps","Motor_1_Cmd.Position [rad]","Motor_1_Status.Position '
                              '[rad]"\n' + CSV, "Motor_1"),
    "registers and their addresses": (each(
        "{t},{c},{p},{d},{q}", BOTH, "Time,[ID:1]Goal Position(116),[ID:1]Present Position(132),"
        "[ID:2]Goal Position(116),[ID:2]Present Position(132)"), "joint_1 joint_2"),
    "a joint spelled in two ways": ("time,shoulder_pan_cmd,ShoulderPan_pos\n" + CSV,
                                    "ShoulderPan"),
    "moteus's view": (each("{t},{p!r},{c!r},0.5", TURNS, "timestamp,servo_stats.position,"
                           "servo_control.position,servo_stats.q_A"), "servo_stats"),
    "moteus's state": (json.dumps([
        {"time": t, "cmd": {"position": c, "kp_scale": 1}, "state": {"position": p, "q_current": 0}}
        for t, c, p in TURNS]), "joint"),
    "SimpleFOC": ("time,target,voltage.q,current.q,current.d,angle\n"
                  + each("{t},{c},{p},{p},{c},{p}"), "joint"),
    "ODrive's current": ("time,input_pos,pos_estimate,Iq_setpoint,Iq_measured\n"
                         + each("{t},{c!r},{p!r},0,0", TURNS), "joint"),
    "MIT's letters": ("t,p_des,v_des,p,v,t_ff\n" + each("{t},{c},0,{p},1,0"), "joint"),
    "d behind a number": ("t,q1,q2,q1d,q2d\n" + each("{t},{p},{q},{c},{d}", BOTH),
                          "joint_1 joint_2"),
    "desired and actual by a letter": ("t,q_d,q_a\n" + each("{t},{c},{p}"), "a"),
    "a raw angle": ("time,cmd,pos_raw\n" + each("{t},{c},{p}"), "joint"),
    "ODrive's mapper": (each("{t},{c!r},{p!r},{n}", TURNS, "t,axis0.controller.input_pos,"
                             "axis0.pos_vel_mapper.pos_rel,axis0.encoder.count_in_cpr"),
                        "axis_0_controller"),
    "ODrive's tree": ("t,axis0.controller.input_pos,axis0.encoder.pos_estimate\n"
                      + each("{t},{c!r},{p!r}", TURNS), "axis_0"),
    "a drive in a remark": (each("{t},{c!r},{p!r}", TURNS, "# moteus r4.11\ntime,cmd,pos"),
                            "joint"),
    "a drive in JSON": (json.dumps({"metadata": {"drive": "ODrive v3.6"}, "data": [
        {"t": t, "cmd": c, "pos": p} for t, c, p in TURNS]}), "joint"),
    "a drive beside arrays": (saved(np.savez, time=TIME, cmd=COMMAND / (2 * np.pi),
                                    pos=POSITION / (2 * np.pi), drive="moteus"), "joint"),
    "a drive in prose": ("# compared with ODrive and moteus\n" + NAMED, "joint"),
    "a drive with its unit behind": ("# VESC, values rad\n" + NAMED, "joint"),
    "two headers in JSON Lines": ('{"drive": "ODrive"}\n{"unit": "rad"}\n' + each(
        '{{"t": {t}, "cmd": {c!r}, "pos": {p!r}}}'), "joint"),
    "a drive in degrees": (each("{t},{c!r},{p!r}", DEGREES, "# VESC 6 mk5\ntime,cmd,pos"), "joint"),
    "a drive and its unit": ("# ODrive v3.6, angles in radians\n" + NAMED, "joint"),
    "a drive's columns and their unit": (each("{t},{c},{p}", LOG, "# angles in rad\nt,"
                            "axis0.controller.input_pos,axis0.encoder.pos_estimate"), "axis_0"),
    "ODrive's counts beside its turns": (each("{t},{c!r},{p!r},{n}", TURNS, "t,pos_setpoint,"
                                         "pos_estimate,pos_estimate_counts"), "joint"),
    "WPILib's rotations": (each("{t},{c!r},{p!r}", TURNS, "Timestamp,/arm/setpoint (rotations),"
                                "/arm/position (rotations)"), "arm"),
    "ODrive's liveplotter": (each("{t},{p!r},{c!r}", TURNS, "t,odrv0.axis0.pos_estimate,odrv0.axis0"
                                  ".controller.input_pos"), "odrv0_axis_0"),
    "SimpleFOC's studio": (each("{m},{c},{p},0.1,2", head="timestamp,target,shaft_angle,"
                                "shaft_velocity,voltage_q"), "shaft"),
    "CyberGear": (each("{t},{c},{p},0,1", head="time,loc_ref,mechPos,mechVel,iqf"), "loc"),
    "CubeMars": (each("{m},{c!r},{p!r},1", DEGREES, "time_ms,pos_des_deg,pos_act_deg,spd"),
                 "joint"),
    "RobStride": (each("{t},11,{p},0.1,0,{c}", head="timestamp,motor_id,position_rad,"
                       "velocity_rad_s,torque_nm,target_position_rad"), "motor_11"),
    "K-Scale's table": (each("{m},{c!r},{p!r}", DEGREES, "timestamp_ms,actuator_11_command_deg,"
                             "actuator_11_position_deg"), "actuator_11"),
    "MyActuator": ("time,angle_cmd(0.01deg),angle_fb(0.01deg)\n" + "".join(
        f"{t},{100 * c!r},{100 * p!r}\n" for t, c, p in DEGREES), "joint"),
    "Arduino's PID": ("time,Setpoint,Input,Output\n" + "".join(
        f"{1e3 * t},{c},{p},{200 * (c - p):.3f}\n" for t, c, p in LOG), "joint"),
    "a process value and a drive": ("t,SP,PV,MV\n" + "".join(
        f"{t},{c},{p},{2 * (c - p):.4f}\n" for t, c, p in LOG), "joint"),
    # robots
    "Unitree's messages": (each("{t},{c},{d},{p},{q},0", BOTH, "time,motor_cmd[0].q,motor_cmd[1].q,"
                                "motor_state[0].q,motor_state[1].q,motor_state[0].dq"),
                           "joint_0 joint_1"),
    "Unitree's legs": (each("{t},{c},{d},{p},{q},1", BOTH, "t,FR_0_q_des,FR_1_q_des,FR_0_q,FR_1_q,"
                            "FR_0_tau"), "FR_0 FR_1"),
    "Spot": ("timestamp_sec,timestamp_nsec,fl.hx.position,fl.hx.command.position,fl.hx.load\n"
             + "".join(f"1700000000,{round(1e9 * t)},{p},{c},0\n" for t, c, p in LOG), "fl_hx"),
    "RTDE": (each("{t} {c} {d} 0.1 {p} {q} 0.2 1", BOTH, "timestamp target_q_0 target_q_1 "
                  "target_qd_0 actual_q_0 actual_q_1 actual_qd_0 actual_current_0"),
             "joint_0 joint_1"),
    "Franka": (each("{t},{c},{d},{p},{q},0,1", BOTH, "time,q_d[0],q_d[1],q[0],q[1],dq[0],tau_J[0]"),
               "joint_0 joint_1"),
    "MuJoCo": (each("{t},{c},{d},{p},{q},0", BOTH, "time,ctrl[0],ctrl[1],qpos[0],qpos[1],qvel[0]"),
               "joint_0 joint_1"),
    "Drake": (each("{t},{c},{d},{p},{q}", BOTH, "t,desired_state[0],desired_state[1],state[0],"
                   "state[1]"), "joint_0 joint_1"),
    "Cheetah's LCM": (each("{m},{c},{p},0,0,0", head="lcm_timestamp,q_des[0],q[0],qd_des[0],qd[0],"
                           "tau_est[0]"), "joint_0"),
    # ROS as tables
    "a bag's set-point": (each("{ns},{n},{c},{p},0", head="%time,field.header.seq,field.set_point,"
                               "field.process_value,field.error"), "joint"),
    "a controller's state in ROS 2": (each("{t},{c},{d},{p},{q},0", BOTH, "timestamp,reference."
        "positions[0],reference.positions[1],feedback.positions[0],feedback.positions[1],"
        "error.positions[0]"), "joint_0 joint_1"),
    "a controller's state in ROS 1": (each("{t},{c},{d},{p},{q}", BOTH, "time,desired.positions.0,"
        "desired.positions.1,actual.positions.0,actual.positions.1"), "joint_0 joint_1"),
    "PlotJuggler's array": (each("{t},{p},0,{c}", head="__time,/joint_states/knee/position,"
        "/joint_states/knee/velocity,/position_controller/commands/data[0]"), "knee"),
    # monitors and desks
    "Teleplot": (each(">cmd:{m}:{c}\n>pos:{m}:{p}"), "joint"),
    "MATLAB's remark with units": (each("{t} {c!r} {p!r}", DEGREES, "% t [s]  q_ref [deg]  q_meas "
                                        "[deg]"), "joint"),
    "MATLAB's durations": (each("{t} sec,{c},{p}", head="Time,Ref,Meas"), "joint"),
    "time deltas of pandas": (pd.DataFrame({"cmd": COMMAND, "pos": POSITION}, pd.to_timedelta(
        TIME, unit="s")).to_csv(), "joint"),
    "Excel's separator": ("sep=;\r\n" + each("{t};{c};{p}", head="time;cmd;pos").replace(
        ".", ",").replace("\n", "\r\n"), "joint"),
    "a header in JSON Lines": ('{"drive": "moteus", "rate": 100}\n' + each(
        '{{"t": {t}, "cmd": {c!r}, "pos": {p!r}}}', TURNS), "joint"),
    "a servo in JSON Lines": (each(
        '{{"ts": {t}, "servo": {{"id": 3, "goal": {c}, "present": {p}}}}}'), "joint"),
    "TOML above": (each("{t},{c!r},{p!r}", DEGREES, '[log]\nrate = 100\nunit = "deg"\n[data]\n'
                        "time,cmd,pos"), "joint"),
    "YAML above": (each("{t},{c!r},{p!r}", DEGREES, "---\nrobot: a\nangle_unit: deg\n---\n"
                        "time,cmd,pos"), "joint"),
    "INI above": (each("{n},{c!r},{p!r}", DEGREES, "[Header]\nSampleRate=100\nUnits=deg\n[Data]\n"
                       "Index,Setpoint,Position"), "joint"),
    "a control frequency": (each("{n},{c},{p}", head="# control_frequency: 100\nstep,cmd,pos"),
                            "joint"),
    "a simulation beside": ("t,cmd,sim_pos,real_pos\n" + "".join(
        f"{t},{c},{0.5 * p},{p}\n" for t, c, p in LOG), "joint"),
    # units of a pair
    "a unit of the command": (each("{t},{c!r},{p!r}", DEGREES, "time,cmd_deg,pos"), "joint"),
    "a unit of the position": (each("{t},{c!r},{p!r}", DEGREES, "time,cmd,pos_deg"), "joint"),
    "a unit of each": (each("{t},{c},{p!r}", [(t, c, d) for (t, c, _), (*_, d) in
                            zip(LOG, DEGREES, strict=True)], "time,cmd_rad,pos_deg"), "joint"),
    "parts of pi": (each("{t},{c!r},{p!r}", [(t, c / np.pi, p / np.pi) for t, c, p in LOG],
                         "t,cmd [pi rad],pos [pi rad]"), "joint"),
    "thousandths of a radian": ("t,cmd [1e-3 rad],pos [1e-3 rad]\n" + "".join(
        f"{t},{1000 * c!r},{1000 * p!r}\n" for t, c, p in LOG), "joint"),
    **{f"tenths as {unit}": (f"t,cmd{unit},pos{unit}\n" + "".join(
        f"{t},{10 * c!r},{10 * p!r}\n" for t, c, p in DEGREES), "joint")
       for unit in ("_deg_x10", " (deg/10)", " [deg*10]", "_decideg")},
    # units: small angles, which a unit that is not understood would leave as they are
    "German degrees": (each("{t};{c!r};{p!r}", DEGREES, "Zeit;Sollwinkel in Grad;Istwinkel [Grad]"),
                       "joint"),
    "French degrees": (each("{t};{c!r};{p!r}", DEGREES, "temps;consigne (degrés);mesure (degrés)"),
                       "joint"),
    "Russian": ("время,задание,положение\n" + CSV, "joint"),
    "Spanish degrees": (each("{t};{c!r};{p!r}", DEGREES, "Tiempo (s);Ángulo deseado (°);Ángulo "
                             "medido (°)").encode("cp1252"), "joint"),
    "Dutch degrees": (each("{t};{c!r};{p!r}", DEGREES, "tijd;gewenste hoek (graden);gemeten hoek "
                           "(graden)"), "joint"),
    "Japanese degrees": (each("{t},{c!r},{p!r}", DEGREES, "時間[s],目標角度[deg],現在角度[deg]")
                         .encode("shift_jis"), "joint"),
    "Chinese degrees": (each("{m},{c!r},{p!r}", DEGREES, "时间(ms),目标角度（度）,实际角度(度)"),
                        "joint"),
    "Korean degrees": (each("{m},{c!r},{p!r}", DEGREES, "시간(ms),목표각도(도),현재각도(도)"),
                       "joint"),
    **{f"degrees of {names}": (each("{t},{c!r},{p!r}", DEGREES, names), "joint") for names in (
        "zaman,hedef_aci_derece,olculen_aci_derece", "tid,börvärde (grader),ärvärde (grader)",
        "aika,ohjearvo (deg),mittaus (deg)", "čas,žádaná poloha [°],skutečná poloha [°]",
        "idő,alapjel [fok],szög [fok]", "時刻[s],指令値[deg],計測値[deg]")},
    "a unit by column above": (each("{t},{c!r},{p}", [(t, d[1], p) for (t, _, p), d in
                               zip(LOG, DEGREES, strict=True)], "# cmd in deg, pos in rad\n"
                               "time,cmd,pos"), "joint"),
    "a unit in JSON": (json.dumps({"angle_unit": "deg", "t": TIME.tolist(),
                                   "cmd": np.degrees(COMMAND).tolist(),
                                   "pos": np.degrees(POSITION).tolist()}), "joint"),
    "a unit beside arrays": (saved(np.savez, time=TIME, cmd=np.degrees(COMMAND),
                                   pos=np.degrees(POSITION), unit="deg"), "joint"),
    # times
    "ticks of a remark": ("# tick = 0.5 us\nticks,cmd,pos\n" + "".join(
        f"{2e6 * t:.0f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "a timer's clock": ("# timer clock: 2 MHz\ntimer,cmd,pos\n" + "".join(
        f"{2e6 * t:.0f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "tens of microseconds": ("time (10us),cmd,pos\n" + "".join(
        f"{1e5 * t:.0f},{c},{p}\n" for t, c, p in LOG), "joint"),
    "100 ns of Windows": ("time_100ns,cmd,pos\n" + "".join(
        f"{134 * 10**15 + round(1e7 * t)},{c},{p}\n" for t, c, p in LOG), "joint"),
    "frames and their rate": ("# 100 fps\nframe,cmd,pos\n" + each("{n},{c},{p}"), "joint"),
    "MATLAB's dates": ("Time,ref,theta\n" + each("04-May-2026 12:30:{t:06.3f},{c},{p}"), "joint"),
    "seconds and milliseconds": ("sec,ms,cmd,pos\n" + "".join(
        f"{int(100 * t + 50) // 100},{10 * (round(100 * t + 50) % 100)},{c},{p}\n"
        for t, c, p in LOG), "joint"),
    "an epoch and milliseconds": ("epoch,msec,cmd,pos\n" + each("1760000000,{m},{c},{p}"), "joint"),
    "changes alone, by what they are": ("time,what,value\n" + "".join(
        f"{t},cmd,{c}\n{t},pos,{p}\n" for t, c, p in LOG), "joint"),
    # cells
    "remarks with commas": ("time,cmd,pos,comment\n" + "".join(
        f"{t},{c},{p},{'warm, so far' if n % 9 == 5 else ''}\n" for n, (t, c, p) in
        enumerate(LOG)), "joint"),
    "remarks behind rows": (NAMED.split("\n", 1)[0] + "\n" + each("{t},{c},{p}  # ok"), "joint"),
    "decimal commas between commas": ("time,cmd,pos\n" + each("{t:.3f},{c:.6f},{p:.6f}").replace(
        ",", ";").replace(".", ",").replace(";", ","), "joint"),
    "commands and positions by word": (each("{t} CMD {c}\n{t} POS {p}"), "joint"),
    # messages
    "rostopic's messages": (each("header: \n  stamp: \n    secs: 100\n    nsecs: {n}0000000\n"
                                 "set_point: {c}\nprocess_value: {p}\n---"), "joint"),
    "YAML by rows": (each("- {{t: {t}, cmd: {c}, pos: {p}}}"), "joint"),
    # JSON and arrays
    "rows by number": (pd.DataFrame({"t": TIME, "cmd": COMMAND, "pos": POSITION}).to_json(
        orient="index", double_precision=12), "joint"),
    "a record a joint": (json.dumps({"dt": 0.01, "joints": [
        {"name": name, "cmd": c.tolist(), "pos": p.tolist()}
        for name, (c, p) in zip(("knee", "hip"), JOINTS, strict=True)]}), "knee hip"),
    "a record a servo": (each(
        '{{"t": {t}, "servo": "knee", "cmd": {c}, "pos": {p}}}\n'
        '{{"t": {t}, "servo": "hip", "cmd": {d}, "pos": {q}}}', BOTH), "knee hip"),
    "a line that was cut": (each('{{"t": {t}, "cmd": {c}, "pos": {p}}}') + '{"t": 0.8, "c',
                            "joint"),
    "numbers in quotes": (json.dumps([{"t": f"{t}", "cmd": f"{c}", "pos": f"{p}"}
                                      for t, c, p in LOG]), "joint"),
    "dates in JSON": (json.dumps([{"time": f"2026-05-04T12:30:{t:09.6f}Z", "cmd": c, "pos": p}
                                  for t, c, p in LOG]), "joint"),
    "JSON in UTF-16": (json.dumps({"t": TIME.tolist(), "cmd": COMMAND.tolist(),
                                   "pos": POSITION.tolist()}).encode("utf-16"), "joint"),
    "Foxglove's messages": ("".join(json.dumps(
        {"topic": topic, "receiveTime": {"sec": 1_700_000_000, "nsec": round(1e9 * t)},
         "message": {"position": list(values)}}) + "\n" for t, c, p, d, q in BOTH
        for topic, values in (("/command", (c, d)), ("/joint_states", (p, q)))),
        "message_joint_0 message_joint_1"),
    "frames a second": (saved(np.savez, action=STACKED["q_des"], qpos=STACKED["q"], fps=100),
                        "joint_0 joint_1"),
    "Isaac Lab": (saved(lambda f: torch.save(
        {"joint_pos": torch.tensor(STACKED["q"]), "joint_pos_target": torch.tensor(
            STACKED["q_des"]), "dt": 0.01}, f)), "joint_0 joint_1"),
    "one environment first": (saved(np.savez, time=TIME, dof_pos=STACKED["q"][None],
                                    des_dof_pos=STACKED["q_des"][None]), "joint_0 joint_1"),
    "MATLAB's rate": (matlab(cmd=COMMAND, pos=POSITION, fs=100.0), "joint"),
    "Simulink's time": (matlab(tout=TIME[:, None], **STACKED), "joint_0 joint_1"),
}  # fmt: skip

LINES: dict[str, tuple[str | bytes, str]] = {  # and options of the line
    "Simulink's rows": (matlab(ans=np.vstack([TIME, COMMAND, POSITION])), "--time 0 --command 1"),
    "Simulink's structure": (
        matlab(simout={"time": TIME[:, None], "signals": {"values": np.column_stack([COMMAND,
                                                                                     POSITION])}}),
        "--time simout.time"),
    "Octave": ("# Created by Octave\n# name: data\n# type: matrix\n# rows: 80\n# columns: 3\n"
               + each(" {t} {c} {p}"), "--time 0 --command 1 --position 2"),
    "JSON without names": (json.dumps(LOG), "--time 0 --command 1 --position 2"),
    "names that say nothing": ("Var1,Var2,Var3\n" + CSV, "--time Var1 --command Var2"),
    "two angles": ("t,angle_in,angle_out\n" + CSV, "--command angle_in --position angle_out"),
    "a clock without names": (each("2026-05-04 12:30:{t:06.3f}\t{c}\t{p}"), "--time time_of_day"),
    "Dynamixel's example": (each("[ID:001] GoalPos:{c:03d}  PresPos:{p:03d}", COUNTS),
                            "--rate 50 --unit counts:4096 --command GoalPos"),
    "arrows": (each("{t}: {c} -> {p}"), "--time 0 --command 1 --position 3"),
    "NMEA": (each("$SRV,{m},{c},{p}*5A"), "--time 1 --command 2 --position 3"),
    "a counter called loop": ("loop,cmd,pos\n" + each("{n},{c},{p}"), "--rate 50 --command cmd"),
    "control engineering's letters": ("t,w,x,u\n" + each("{t},{c},{p},0.4"),
                                      "--time t --command w --position x"),
    "rows that are counted": (each("{n}\t{p:.0f}\t{c:.0f}\t32", COUNTS, "Num\tPosition\tGoal\tTemp",
    ),
                              "--rate 50 --unit counts:4096 --command Goal --position Position"),
    "words that no table has": ("t,Ziel,Lage hier\n" + CSV,
                                "--time t --command Ziel --position 'Lage hier'"),
    "letters": (each("[2026-05-04 12:30:{t:06.3f}] T:{c} A:{p}", DEGREES),
                "--time time_of_day --unit deg --command T --position A"),
    "a percent sign": ("time,cmd,pos\n" + "".join(
        f"{t},{60 * c:.2f}%,{60 * p:.2f}%\n" for t, c, p in LOG), "--unit percent:3.5"),
    "counts around 0": (each("{t},{c},{p}", SIGNED, "time,goal,pos"), "--unit counts:4096:0"),
    "degrees beside radians": ("time,goal,pos\n" + "".join(
        f"{t},{np.degrees(c)},{p}\n" for t, c, p in LOG), "--unit deg,rad"),
    "scaled counts beside radians": ("time,goal,pos\n" + "".join(
        f"{t},{c},{1024 / (2 * np.pi) * p:.3f}\n" for t, c, p in LOG),
        "--unit rad,counts:1024:0"),
    "counts beside radians": ("time,goal,pos\n" + "".join(
        f"{t},{2048 + 652 * c:.0f},{p}\n" for t, c, p in LOG), "--unit counts:4096,rad"),
    "hexadecimal cells": (each("{m},{c:04X},{p:04X}", COUNTS, "time_ms,goal,pos"),
                          "--unit counts:4096"),
    "one name twice": ("time,angle,angle\n" + CSV, "--time 0 --command 1 --position 2"),
    "Unitree's tick": (json.dumps([{"tick": round(1e3 * t), "motorCmd": [{"q": c, "kp": 20}],
                                    "motorState": [{"q": p, "dq": 0}]} for t, c, p in LOG]),
                       "--time tick"),
    "ODrive's older counts": ("t,axis0.controller.pos_setpoint,axis0.encoder.pos_estimate\n"
        + "".join(f"{t},{8192 * c!r},{8192 * p!r}\n" for t, c, p in TURNS),
        "--unit counts:8192:0"),
    "ODrive's counts beside turns": ("t,axis0.controller.input_pos,axis0.encoder.shadow_count\n"
        + "".join(f"{t},{c!r},{8192 * p:.0f}\n" for t, c, p in TURNS),
        "--unit turns,counts:8192:0"),
    "a set-point beside counts": ("t,pos_setpoint,pos_estimate_counts\n" + "".join(
        f"{t},{c!r},{8192 * p:.1f}\n" for t, c, p in TURNS), "--unit turns,counts:8192:0"),
    "Tinymovr": ("t,pos_setpoint_ticks,pos_estimate_ticks\n" + "".join(
        f"{t},{8192 * c:.0f},{8192 * p:.0f}\n" for t, c, p in TURNS), "--unit counts:8192:0"),
    "places of a motor and a joint": ("t,target_position,joint_position,motor_position\n" + "".join(
        f"{t},{c},{p},{9 * p}\n" for t, c, p in LOG), "--position joint_position"),
    "pulses beside degrees": ("t,servo_us,angle_deg\n" + "".join(
        f"{t},{1500 + 636.6 * c:.1f},{np.degrees(p)}\n" for t, c, p in LOG),
        "--unit counts:4000:1500,deg"),
    "ticks beside degrees": ("ms,target,ticks\n" + "".join(
        f"{1e3 * t},{np.degrees(c)},{2048 + 652 * p:.0f}\n" for t, c, p in LOG),
        "--unit deg,counts:4096"),
    "an encoder beside degrees": ("t,goal_deg,encoder\n" + "".join(
        f"{t},{np.degrees(c)},{2048 + 652 * p:.0f}\n" for t, c, p in LOG),
        "--unit deg,counts:4096"),
    "a potentiometer beside degrees": ("ms\tgoal\tpot\n" + "".join(
        f"{1e3 * t}\t{90 + np.degrees(c):.2f}\t{512 + 1024 / (2 * np.pi) * p:.0f}\n"
        for t, c, p in LOG), "--unit deg,counts:1024"),
    "VESC": (each("{m};24;{c!r};{p!r};10", DEGREES, "ms_today;input_voltage;pid_pos_set;"
                  "pid_pos_now;rpm"), "--unit deg"),
    "Feetech's FD": (each("{m},1,{c},{p},0,120,30", COUNTS, "Time,ID,GoalPosition,PresentPosition,"
                          "Speed,Voltage,Temperature"), "--unit counts:4096"),
    "Kinova": (each("{t},{c!r},{d!r},{p!r},{q!r}", BOTH_DEGREES, "time,commanded_position_0,"
                    "commanded_position_1,actuator_position_0,actuator_position_1"), "--unit deg"),
    "KUKA's RSI": (each("{t},{c!r},{d!r},{p!r},{q!r}", BOTH_DEGREES, "time,ASPos.A1,ASPos.A2,"
                        "AIPos.A1,AIPos.A2"), "--unit deg --command ASPos.A1,ASPos.A2"),
    "SimpleFOC's monitor": (each("{c}\t0.12\t0.1\t{p}"), "--command 0 --position 3"),
    "how long a loop takes": ("exec_time_us,cmd,pos\n" + "".join(
        f"{9800 + n % 7},{c},{p}\n" for n, (_, c, p) in enumerate(LOG)), "--rate 50"),
    "lengths": (each("{t},{c},{p}", head="time_s,cmd_mm,pos_mm"), "--unit scale:0.05"),
    "shares": (each("{t},{c},{p}", head="time_s,cmd_norm,pos_norm"), "--unit scale:1.5708"),
    "steps": (each("{t},{c},{p}", SIGNED, "t,target_steps,actual_steps"), "--unit counts:3200:0"),
    "percent in brackets": (each("{t},{c!r},{p!r}", DEGREES, "time,set-point [%],actual [%]"),
                            "--unit percent:3.5"),
    "readings of a converter beside degrees": ("t_ms,servo_deg,analog\n" + "".join(
        f"{1e3 * t:.0f},{90 + np.degrees(c)!r},{512 + 1024 / (2 * np.pi) * p:.0f}\n"
        for t, c, p in LOG), "--unit deg,counts:1024"),
    "degrees that are called radians": (each("{t},{c!r},{p!r}", DEGREES, "t,cmd_rad,pos_rad"),
                                        "--unit deg"),
    "a policy's actions": ("time,actions_0,dof_pos_0\n" + "".join(
        f"{t},{4 * c - 0.8},{p}\n" for t, c, p in LOG), "--unit scale:0.25,rad"),
    "whole seconds": ("time,cmd,pos\n" + "".join(
        f"12:30:{int(2.5 * t):02d},{c},{p}\n" for t, c, p in LOG), "--rate 40"),
}  # fmt: skip

WRONG: dict[str, tuple[str | bytes, str]] = {
    "XML": ("<?xml version='1.0'?><log/>", "is XML or HTML"),
    "a page": ("<html><table></table></html>", "is XML or HTML"),
    "a bag of ROS 1": (b"#ROSBAG V2.0\n" + bytes(50), "rosbags-convert"),
    "several robots": (saved(np.savez, dof_pos=np.zeros((90, 2, 3)), dt=0.01),
                       "90 × 2 × 3 values, of several robots"),
    "candump": (each("(17000.{n:06d}) can0 001#8C2D7FF0333"), "raw frames of a CAN bus"),
    "candump on a screen": (each("  can0  141   [8]  A4 00 F4 01 1C 00 00 00"), "raw frames"),
    "columns named anew": (NAMED + "time,pos,cmd\n" + CSV, "named again, and differently"),
    "speeds": (each("{t},{c},{p}", head="t,cmd_rad_s,meas_rad/s"), "no column is a command or"),
    "torques": (each("{t},{c},{p}", head="t,cmd_Nm,meas [N]"), "no column is a command or"),
    "a speed's set-point": (each("{t},{c},{p}", head="t,speed_setpoint,position"),
                            "no column is a command"),
    "changes of the goal": (each("{t},{c},{p}", head="t,delta_cmd,pos"), "is changes of the goal"),
    "speeds to go at": (each("{t},{c},{p}", head="t,cmd_vel,pos"), "cmd_vel is a speed"),
    "torques to give": (each("{t},{c},{p}", head="t,target_torque,pos"), "is a torque or current"),
    "numbers without their sign": (each("{t},{c},{p}", [
        (t, c % 65536, p % 65536) for t, c, p in SIGNED], "t,goal,pos"), "Take 65,536 off those"),
    "errors": (each("{t},{c},{p}", head="t,setpoint,error"), "Add a column setpoint - error"),
    "errors and a drive": (each("{t},{c},{p},{p}", head="t,setpoint,error,output"),
                           "Add a column setpoint - error"),
    "servo's answers alone": (each("ID 1 at {p}"), "no names"),
}  # fmt: skip


def written(tmp_path, content):
    path = tmp_path / "log.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("form", READ)
def test_a_log_of_another_tool_is_read(tmp_path, form):
    content, joints = READ[form]
    recording = load(written(tmp_path, content))
    assert set(recording.joints) == set(joints.split())
    for joint, (command, position) in zip(joints.split(), JOINTS, strict=False):
        trial = recording.trials(joint)[0]
        rows = np.arange(ROWS)
        assert len(trial.send_time_s) >= ROWS and recording.loop_period_s == pytest.approx(
            0.01, rel=1e-4
        )
        np.testing.assert_allclose(trial.command_rad[rows], command, atol=1e-9)
        np.testing.assert_allclose(trial.position_rad[rows], position, atol=1e-9)


@pytest.mark.parametrize("form", LINES)
def test_the_first_line_of_a_refusal_reads_the_log(tmp_path, form):
    content, words = LINES[form]
    with pytest.raises(InputError) as refused:
        load(written(tmp_path, content))
    line = re.findall(r"`pupper-sysid import ([^`]*) --out rec\.csv`", str(refused.value))[0]
    assert words in line
    options = dict(part.split(maxsplit=1) for part in line.split(" --")[1:])
    stated = {k.replace("-", "_"): shlex.split(v)[0] for k, v in options.items()}
    rate = {"rate": float(stated.pop("rate"))} if "rate" in stated else {}
    recording = load(tmp_path / "log.txt", LogOptions(**stated, **rate))
    (trial, *_) = recording.trials(recording.joints[0])
    for read, true in ((trial.command_rad, COMMAND), (trial.position_rad, POSITION)):
        assert np.corrcoef(read, true)[0, 1] > 0.9999
        if form not in (
            "a percent sign",
            "steps",
            "lengths",
            "shares",
        ):  # of ranges that the log does not say
            assert np.std(read) == pytest.approx(np.std(true), rel=0.01), line


def test_a_length_of_one_joint_leaves_the_angles_of_others_alone(tmp_path):
    head = "t,knee_cmd,knee_pos,gripper_cmd_mm,gripper_pos_mm"
    path = written(tmp_path, each("{t},{c},{p},{d},{q}", BOTH, head))
    with pytest.raises(
        InputError, match=r"`units: \{gripper: 'scale:0.05'\}`.*--joints knee --out"
    ):
        load(path)
    (trial,) = load(path, {"joints": ["knee"]}).trials("knee")
    np.testing.assert_allclose(trial.position_rad, POSITION, atol=1e-9)
    both = load(path, {"units": {"gripper": "scale:0.05"}})
    np.testing.assert_allclose(both.trials("gripper")[0].position_rad, 0.05 * SECOND[1], atol=1e-9)


FAILED = range(11, ROWS, 20)
FLAGS = {
    "valid": lambda bad: int(not bad), "read_ok": lambda bad: not bad, "timeout": int,
    "status": lambda bad: "TIMEOUT" if bad else "OK", "comm_result": lambda bad: -3001 * bad,
}  # fmt: skip


@pytest.mark.parametrize("flag", FLAGS)
def test_readings_that_a_column_calls_failed_are_left_out(tmp_path, flag):
    rows = [(*row[:2], 0.0 if n in FAILED else row[2], FLAGS[flag](n in FAILED))
            for n, row in enumerate(LOG)]  # fmt: skip
    lines = "".join(",".join(map(str, row)) + "\n" for row in rows)
    recording = load(written(tmp_path, f"time,cmd,pos,{flag}\n{lines}"))
    (trial,) = recording.trials("joint")
    assert np.flatnonzero(np.isnan(trial.position_rad)).tolist() == [*FAILED]
    assert any(f"4 readings failed by the column {flag}" in text for text in recording.warnings)


def test_a_flag_of_one_joint_says_nothing_of_another(tmp_path):
    lines = each("{t},{c},{p},{n},{d},{q}", BOTH).replace(",11,", ",0,").splitlines()
    lines = [",".join([*cells[:3], "0" if n == 11 else "1", *cells[4:]])
             for n, cells in enumerate(line.split(",") for line in lines)]  # fmt: skip
    names = "time,hip_cmd,hip_pos,hip_valid,knee_cmd,knee_pos\n"
    recording = load(written(tmp_path, names + "\n".join(lines)))
    lost = {j: int(np.isnan(recording.trials(j)[0].position_rad).sum()) for j in recording.joints}
    assert lost == {"hip": 1, "knee": 0}


def test_what_is_no_table_is_called_by_its_name(tmp_path):
    def read(form):
        load(written(tmp_path, WRONG[form][0]))

    assert_each_refused([(form, words) for form, (_, words) in WRONG.items()], read)


def test_what_may_be_several_joints_is_said_to_be_taken_as_trials(tmp_path):
    blocks = f"# t cmd pos\n{each('{t} {c} {p}')}\n\n# knee\n{each('{t} {c} {p}')}"
    recording = load(written(tmp_path, blocks))
    assert any("start again" in text for text in recording.warnings)


def test_what_may_be_turns_is_said_to_be_taken_for_radians(tmp_path):
    head = "time,command_position,position,velocity,torque"  # moteus's, and others'
    recording = load(written(tmp_path, each("{t},{c},{p},0,0", head=head)))
    assert any("counts turns; the values were taken as rad" in w for w in recording.warnings)


def test_tenths_of_degrees_are_offered_beside_degrees(tmp_path):
    rows = [(t, round(10 * c), c) for t, c, _ in DEGREES]
    with pytest.raises(InputError, match="--unit scale:0.00174533,deg --out"):
        load(written(tmp_path, each("{t},{c},{p}", rows, "t,cmd_x10,pos")))


def test_a_unit_of_one_joint_s_angles_leaves_another_s_alone(tmp_path):
    rows = [(t, *np.degrees((c, p)), d, q) for t, c, p, d, q in BOTH]
    path = written(
        tmp_path, each("{t},{c},{p},{d},{q}", rows, "t,hip_cmd,hip_pos,knee_cmd,knee_pos")
    )
    with pytest.raises(InputError, match=r"If knee are in radians .* `units: \{hip: 'deg'\}`"):
        load(path)
    (trial,) = load(path, {"units": {"hip": "deg"}}).trials("knee")
    np.testing.assert_allclose(trial.position_rad, SECOND[1], atol=1e-9)


def test_a_suffix_that_may_mean_degrees_is_said_to_be_taken_for_a_joint(tmp_path):
    recording = load(written(tmp_path, each("{t},{c},{p}", head="time_s,ref_d,meas_d")))
    assert recording.joints == ["d"]
    assert any("for degrees give `unit='deg'`" in text for text in recording.warnings)
