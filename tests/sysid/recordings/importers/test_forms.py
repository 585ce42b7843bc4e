"""One log in the forms that logs have in the wild: each is read, equal to 1e-9."""

import bz2
import gzip
import io
import json
import lzma
import re
import zipfile

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import reading_up_to
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.importers import recognise
from pupper_sysid.sysid.recordings.importers.options import LogOptions
from pupper_sysid.sysid.recordings.table import parse
from support.real_recordings import case
from support.refusals import assert_each_refused

ROWS = 80
TIME = np.round(0.005 * np.arange(ROWS) + 1e-4 * np.sin(np.arange(ROWS)), 6)
COMMAND = np.round(0.3 * np.sin(8 * TIME), 6)
POSITION = np.round(0.28 * np.sin(8 * (TIME - 0.03)), 6)
ROWS_OF = list(zip(TIME.tolist(), COMMAND.tolist(), POSITION.tolist(), strict=True))
COLUMNS = LogOptions("0", "1", "2")


def joined(separator, head=("time", "cmd", "pos"), comma=False, end="\n", width=0, tail=""):
    """The log as text: a row of names, if any, and the numbers."""
    lines = [separator.join(head)] if head else []
    for row in zip(TIME, COMMAND, POSITION, strict=True):
        cells = [f"{value:.6f}".rjust(width) for value in row]
        text = separator.join(cells) + tail
        lines.append(text.replace(".", ",") if comma else text)
    return end.join([*lines, ""])


def savetxt(header="", comments="# ", delimiter=" "):
    out = io.BytesIO()
    np.savetxt(out, np.column_stack([TIME, COMMAND, POSITION]), header=header, comments=comments,
               delimiter=delimiter)  # fmt: skip
    return out.getvalue()


def clock(pattern):
    """The log with a date and time of day for each row."""
    start = pd.Timestamp("2026-05-04T23:59:59.9")
    stamps = [(start + pd.Timedelta(seconds=float(t))).strftime(pattern) for t in TIME]
    rows = zip(stamps, COMMAND, POSITION, strict=True)
    return "\n".join(["time,cmd,pos", *(f"{t},{c:.6f},{p:.6f}" for t, c, p in rows), ""])


def matlab(variables):
    out = io.BytesIO()
    savemat(out, variables, do_compression=True)
    return out.getvalue()


def zipped(name, notes=None):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, joined(","))
        if notes:
            archive.writestr(notes, "P gain 16, 7.4 V")
        archive.writestr("__MACOSX/._log", b"\0\1")
    return out.getvalue()


def labelled():
    rows = zip(TIME, COMMAND, POSITION, strict=True)
    return "\n".join(f"time:{t:.6f},cmd:{c:.6f},pos:{p:.6f}" for t, c, p in rows)


def grouped(mark, quote="", separator=","):
    """The log in microseconds, digits in groups of three."""
    return "".join(
        f"{quote}{1e6 * t:,.0f}{quote}".replace(",", mark) + f"{separator}{c}{separator}{p}\n"
        for t, c, p in ROWS_OF
    )


def archived(**arrays):
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def repeated():
    lines = joined(",").splitlines()
    return "\n".join([lines[0], *(line for line in lines[1:] for _ in range(4)), ""])


POINTS = [{"t": t, "cmd": c, "pos": p} for t, c, p in ROWS_OF]
FORMS = {
    "commas": joined(","),
    "tabs": joined("\t"),
    "spaces": joined(" "),
    "bars": joined(" | "),
    "semicolons, decimal commas": joined(";", comma=True),
    "spaces, decimal commas": joined("   ", comma=True),
    "byte order mark": joined(",").encode("utf-8-sig"),
    "UTF-16": joined("\t").encode("utf-16"),
    "UTF-16 without a mark": joined(",").encode("utf-16-le"),
    "Latin-1": joined(";", ("Zeit; time", "cmd", "pos [rad], Motor n\xb0 1")).replace(
        "Zeit; time", "time").encode("latin-1"),
    "gzip": gzip.compress(joined(",").encode()),
    "bzip2": bz2.compress(joined(",").encode()),
    "xz": lzma.compress(joined(",").encode()),
    "zip": zipped("run 1/log.csv"),
    "MATLAB's comments": "% Matlab export\n% fs = 200\n" + joined(","),
    "savetxt": savetxt("time cmd pos"),
    "savetxt, names without a blank": savetxt("time\tcmd\tpos", "#", "\t"),
    "LaTeX names": "#t\t$u$\t$\\theta$\n" + joined("\t", ()),
    "units below": joined(",").replace("pos\n", "pos\ns,rad,rad\n", 1),
    "milliseconds and degrees below": "time;cmd;pos\nms;deg;deg\n" + "".join(
        f"{1e3 * t!r};{180 / np.pi * c!r};{180 / np.pi * p!r}\n"
        for t, c, p in zip(TIME.tolist(), COMMAND.tolist(), POSITION.tolist(), strict=True)),
    "quoted cells": joined('";"', tail='"').replace("\n", '\n"').removesuffix('"').replace(
        'time";"cmd";"pos', 'time;cmd;pos'),
    "trailing separators in the rows": joined(";", tail=";"),
    "sep= of a spreadsheet": "sep=;\n" + joined(";"),
    "lines above the names": "Bench 4\nOperator: none\n\n" + joined("\t"),
    "row numbers": "\n".join(
        f"{'' if n < 0 else n},{line}" for n, line in enumerate(joined(",").splitlines(), -1)),
    "names again half-way": joined(",").replace(
        f"\n{TIME[40]:.6f},", f"\ntime,cmd,pos\n{TIME[40]:.6f},"),
    "a remark half-way": joined("\t").replace(f"{TIME[40]:.6f}\t", f"% here\n{TIME[40]:.6f}\t"),
    "ISO times": clock("%Y-%m-%dT%H:%M:%S.%f"),
    "times of day over midnight": clock("%H:%M:%S.%f"),
    "pairs of name and number": labelled(),
    "a firmware's log": "ets Jul 29 2019\n" + "\n".join(
        f"I (37) servo: t={t:.6f}, goal={c:.6f}, pos={p:.6f}" for t, c, p in ROWS_OF),
    "quoted decimal commas": "time,cmd,pos\n" + "\n".join(
        f'"{t:.6f}","{c:.6f}","{p:.6f}"'.replace(".", ",") for t, c, p in ROWS_OF),
    "names in two lines": ",cmd,pos\n,knee,knee\ntime,,\n" + joined(",", ()),
    "lists in cells": "time,action,state\n" + "\n".join(
        f'{t:.6f},"[{c:.6f}]",[{p:.6f}]' for t, c, p in ROWS_OF),
    "seconds and nanoseconds": "header.stamp.sec,header.stamp.nanosec,cmd,pos\n" + "\n".join(
        f"{1_700_000_000 + int(t)},{1e9 * (t % 1):.0f},{c:.6f},{p:.6f}" for t, c, p in ROWS_OF),
    "German names": joined(";", ("Zeit [s]", "Sollwinkel [rad]", "Istwinkel [rad]"), comma=True),
    "JSON, lists by name": json.dumps({"time": TIME.tolist(), "cmd": COMMAND.tolist(),
                                       "pos": POSITION.tolist(), "about": {"rate": 200}}),
    "JSON Lines": "\n".join(
        json.dumps({"t": t, "cmd": {"knee": c}, "pos": {"knee": p}}) for t, c, p in ROWS_OF),
    "each row four times": repeated(),
    "Fortran's exponents": "time cmd pos\n" + "".join(
        " ".join(f"{v:.12E}".replace("E", "D") for v in row) + "\n" for row in ROWS_OF),
    "thousands in apostrophes": "time_us,cmd,pos\n" + grouped("'"),
    "thousands in commas, quoted": "time_us,cmd,pos\n" + grouped(",", '"'),
    "thousands in commas, tabs": "time_us\tcmd\tpos\n" + grouped(",", separator="\t"),
    "dates with slashes": clock("%m/%d/%Y %H:%M:%S.%f"),
    "dates with points": clock("%d.%m.%Y %H:%M:%S.%f"),
    "French names": joined(";", ("temps", "consigne", "mesure"), comma=True),
    "a typeset minus": joined(",").replace("-", "\u2212"),
    "zeros after a power cut": joined(",").encode() + bytes(512),
    "a unit behind each number": "time,cmd,pos\n" + "".join(
        f"{1e3 * t!r} ms,{180 / np.pi * c!r} deg,{p:.6f} rad\n" for t, c, p in ROWS_OF),
    "minutes and seconds": "time,cmd,pos\n" + "".join(
        f"{int((59.8 + t) // 60):02d}:{(59.8 + t) % 60:09.6f},{c:.6f},{p:.6f}\n"
        for t, c, p in ROWS_OF),
    "durations of pandas": pd.DataFrame(
        {"time": pd.to_timedelta(TIME, "s"), "cmd": COMMAND, "pos": POSITION}).to_csv(index=False),
    "lines of a logger": "".join(
        f"2026-05-04 12:30:{t:09.6f} INFO bench: cmd={c:.6f} pos={p:.6f}\n".replace(".", ",", 1)
        for t, c, p in ROWS_OF),
    "points between thousands": "t_us;cmd;pos\n" + "".join(
        f"{1e6 * t:,.0f};{c:_.6f};{p:_.6f}\n".replace(".", "_").replace(",", ".").replace("_", ",")
        for t, c, p in ROWS_OF),
    "R's row numbers": '"time" "cmd" "pos"\n' + "".join(
        f'"{k}" {t:.6f} {c:.6f} {p:.6f}\n' for k, (t, c, p) in enumerate(ROWS_OF, 1)),
    "Chinese names": joined(",", ("时间", "目标位置", "实际位置")).encode("gb18030"),
    "Swedish names": joined(";", ("tid [s]", "börvärde [rad]", "ärvärde [rad]")).encode("latin-1"),
    "a line that lost characters": joined(",").replace(
        f"\n{TIME[40]:.6f},", f"\n0.1\n{TIME[40]:.6f},"),
    "a row for each event": "time,event,value\n" + "".join(
        f"{t:.6f},cmd,{c:.6f}\n{t:.6f},pos,{p:.6f}\n" for t, c, p in ROWS_OF),
    "commands in rows of their own": "__time,/goal/data,/joint_states/position\n" + "".join(
        f"{t:.6f},{c:.6f},\n{t:.6f},,{p:.6f}\n" for t, c, p in ROWS_OF),
    "an archive with notes": zipped("log.csv", "notes.md"),
    "MATLAB": matlab({"t": TIME[:, None], "cmd": COMMAND[:, None], "pos": POSITION[:, None]}),
    "MATLAB's structure": matlab({"log": {"time": TIME, "cmd": COMMAND, "pos": POSITION}}),
    "a comment's name without cells": joined("\t").replace("pos\n", "pos\tComment\n", 1),
    "Python's tuples": "time, cmd, pos\n" + "".join(f"({t}, {c}, {p})\n" for t, c, p in ROWS_OF),
    "Python's dictionaries": "".join(
        f"{dict(t=t, goal=c, pos=p)}\n" for t, c, p in ROWS_OF),
    "tenths of a degree": "time,cmd (0.1deg),pos (0.1deg)\n" + "".join(
        f"{t!r},{1800 / np.pi * c!r},{1800 / np.pi * p!r}\n" for t, c, p in ROWS_OF),
    "JSON of pandas": pd.DataFrame(
        {"time": TIME, "cmd": COMMAND, "pos": POSITION}).to_json(double_precision=12),
    "JSON of pandas, split": pd.DataFrame(
        {"time": TIME, "cmd": COMMAND, "pos": POSITION}).to_json(orient="split"),
    "names of a controller in ROS 1": joined(",", ("%time", "field.set_point",
                                                   "field.process_value")),
    "missing in words": joined(",") + f"{TIME[-1] + 0.005:.6f},0.1,None\n",
    "Teleplot": "".join(
        f">goal:{1e3 * t!r}:{c}\n>pos:{1e3 * t!r}:{p}§rad\n" for t, c, p in ROWS_OF),
    "LabVIEW's measurement": "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n"
        "Channels\t2\t\t\nSamples\t80\t80\t\nX0\t0.0E+0\t0.0E+0\t\n***End_of_Header***\t\t\t\n"
        + joined("\t", ("X_Value", "Setpoint", "Encoder", "Comment"), tail="\t").replace(
            "Comment\t", "Comment"),
    "an index of dates": pd.DataFrame(
        {"cmd": COMMAND, "pos": POSITION},
        pd.Timestamp("2026-05-04 12:00+02:00") + pd.to_timedelta(TIME, "s")).to_csv(),
    "records of joints": json.dumps(
        [{"t": t, "motors": [{"id": 3, "goal": c, "present": p}]} for t, c, p in ROWS_OF]),
    "numbers in hexadecimal": "time_us,cmd [rad],pos [rad]\n" + "".join(
        f"0x{round(1e6 * t):08X},{c},{p}\n" for t, c, p in ROWS_OF),
    "a letter for desired": joined(",", ("t", "theta_d", "theta")),
    "a joint's bare name": joined(",", ("t", "phi_ref", "phi")),
    **{f"JSON points below {names}": json.dumps(content) for names, content in {
        "a joint": {"joints": {"knee": POINTS}},
        "a list of a joint": {"meta": {"robot": "x"}, "data": {"knee": {"samples": POINTS}}},
        "a record of a joint": {"joints": [{"name": "knee", "data": POINTS}]},
    }.items()},
    "JSON, rows below names": json.dumps({"columns": ["t", "cmd", "pos"], "rows": ROWS_OF}),
    "JSON Lines of topics": "".join(
        f'{{"topic": "{topic}", "t": {t}, "data": [{value}]}}\n'
        for t, c, p in ROWS_OF for topic, value in (("cmd", c), ("state", p))),
    "abbreviated current": joined(",", ("t", "goalPos", "curPos")),
    "arrays with time last": archived(time=TIME, q=POSITION[None], q_des=COMMAND[None]),
    "arrays of one robot of many": archived(
        time=TIME, q=POSITION[:, None, None], q_des=COMMAND[:, None, None]),
    "an array and its columns": archived(
        data=np.column_stack([TIME, COMMAND, POSITION]), columns=["time", "cmd", "pos"]),
}  # fmt: skip


def same(recording, offset=True):
    """Whether a recording holds the log, its first time apart."""
    (joint,) = recording.joints
    (trial,) = recording.trials(joint)
    np.testing.assert_allclose(np.diff(trial.send_time_s[:ROWS]), np.diff(TIME), atol=1e-9)
    np.testing.assert_allclose(trial.command_rad[:ROWS], COMMAND, atol=1e-9)
    np.testing.assert_allclose(trial.position_rad[:ROWS], POSITION, atol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_a_log_is_read_in_each_form(tmp_path, form):
    content = FORMS[form]
    path = tmp_path / "log.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    same(load(path))


def test_columns_without_names_have_numbers_and_the_refusal_has_the_line_that_takes_them(tmp_path):
    for separator in (",", "\t", "  "):
        (tmp_path / "log.txt").write_text(joined(separator, ()))
        with pytest.raises(InputError, match=r"log.txt --time 0 --command 1 --position 2 --out"):
            load(tmp_path / "log.txt")
        same(load(tmp_path / "log.txt", COLUMNS))
    np.save(tmp_path / "log.npy", np.column_stack([TIME, COMMAND, POSITION]))
    with pytest.raises(InputError, match=r"--time 0 --command 1 --position 2"):
        load(tmp_path / "log.npy")
    same(load(tmp_path / "log.npy", COLUMNS))


def test_columns_without_names_are_offered_in_the_pairs_and_as_the_times_that_go_together(tmp_path):
    path = tmp_path / "log.txt"
    later = [(t + 0.8, c, p) for t, c, p in ROWS_OF]
    stamps = [f"{1_700_000_000 + int(t)},{1e9 * (t % 1):.0f},base,{c},{p}\n" for t, c, p in later]
    squares = [f"{c},{50 * c},{p},{p - c},{c * c},{p * p}\n" for _, c, p in ROWS_OF]
    tuples = [f"({t}, [{c}, {c * c}], [{p}, {p * p}])\n" for t, c, p in ROWS_OF]
    for lines, line in (
        (squares, "--rate 50 --command 0,4 --position 2,5"),
        (tuples, "--time 0 --command 1,2 --position 3,4"),
        (stamps, "--time 0,1 --command 3 --position 4"),
    ):
        path.write_text("".join(lines))
        assert_each_refused([(path, f"log.txt {line} --out")], load)
    same(load(path, LogOptions("0,1", "3", "4")))


def test_pulses_are_offered_as_commands_and_a_speed_as_neither(tmp_path):
    """What another column is the sum of is no angle, whatever its name and however large."""
    path = tmp_path / "log.txt"
    degrees = np.degrees(POSITION)
    rpm = np.gradient(degrees, TIME) / 6
    pulses = 1500 + COMMAND / (2 * np.pi / 4000)
    for names in ("pwm_us,angle_deg,rpm", "pwm,value,n", "pulse,angle,speed"):
        np.savetxt(path, np.column_stack([TIME, pulses, degrees, rpm]), delimiter=",",
                   header=f"t,{names}", comments="")  # fmt: skip
        command, position, speed = names.split(",")
        with pytest.raises(InputError) as refusal:
            load(path)
        line = f"--unit counts:4000:1500,deg --command {command} --position {position} --out"
        assert line in str(refusal.value)
        assert not re.search(rf"--(command|position) {speed}\b", str(refusal.value))
        same(load(path, LogOptions("t", command, position, unit="counts:4000:1500,deg")))


def test_an_archive_without_times_takes_its_time_step_for_the_rate(tmp_path):
    for step in ({"dt": 0.005}, {"fs": 200}):
        np.savez(tmp_path / "log.npz", q=POSITION, q_des=COMMAND, **step)
        recording = load(tmp_path / "log.npz")
        assert recording.loop_period_s == pytest.approx(0.005)
        assert any("row numbers over 200 Hz" in text for text in recording.warnings)


def test_what_the_unit_may_be_is_offered_as_lines(tmp_path):
    for names, values, words in (
        ("t,goal,pos", (512 + 200 * COMMAND, 512 + 200 * POSITION), "--unit scale:0.005113 --out"),
        ("t,action.pan.pos,observation.state.pan.pos", (200 * COMMAND, 200 * POSITION),
         "--unit percent:3.5 --out"),
        ("t,cmd_pwm_us,angle_deg", (1500 + 640 * COMMAND, 57.3 * POSITION), ""),
    ):  # fmt: skip
        rows = zip(TIME, *(np.round(v) if "goal" in names else v for v in values), strict=True)
        text = "\n".join([names, *(",".join(map(str, row)) for row in rows), ""])
        (tmp_path / "log.csv").write_text(text)
        options = None if words else LogOptions(None, "cmd_pwm_us", "angle_deg")
        with pytest.raises(InputError, match=words or "pulse widths in µs"):
            load(tmp_path / "log.csv", options)


def test_the_line_of_a_refusal_keeps_what_was_stated(tmp_path):
    rows = [f"{400 * c:.1f},{400 * p:.1f}" for _, c, p in ROWS_OF]
    (tmp_path / "log.txt").write_text("\n".join(["target,actual", *rows]))
    with pytest.raises(InputError, match="--rate 50 --unit deg --command target --position actual"):
        load(tmp_path / "log.txt")
    options = LogOptions(None, "target", "actual", rate=50.0, read_before_send=True)
    with pytest.raises(InputError, match=r"actual --read-before-send --rate 50 --unit deg --out"):
        load(tmp_path / "log.txt", options)


def test_what_was_assumed_of_the_form_is_said_in_one_sentence(tmp_path):
    for form, words in (
        ("commas", ()), ("tabs", ("separated by tabs",)),
        ("semicolons, decimal commas", ("semicolons", "decimal commas")),
        ("savetxt", ("from a comment", "spaces")), ("units below", ("their units",)),
        ("lines above the names", ("2 lines above",)), ("each row four times", ("75 %", "once")),
    ):  # fmt: skip
        (tmp_path / "log.txt").write_bytes(
            FORMS[form] if isinstance(FORMS[form], bytes) else FORMS[form].encode()
        )
        said = [w for w in load(tmp_path / "log.txt").warnings if "one time stamp" not in w]
        assert len(said) == bool(words) and all(word in said[0] for word in words), (form, said)


def test_what_cannot_be_read_is_refused_with_the_cure(tmp_path):
    (tmp_path / "log.csv").write_text(joined(",", ("time", "cmd_percent", "pos_percent")))
    (tmp_path / "log.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    (tmp_path / "echo.txt").write_text("header:\n  stamp:\n    sec: 1\n---\n")
    (tmp_path / "log73.mat").write_bytes(b"MATLAB 7.3 MAT-file" + bytes(200))
    (tmp_path / "log.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    (tmp_path / "log.xls").write_bytes(b"\xd0\xcf\x11\xe0" + bytes(200))
    text = joined(",").replace(f"\n{TIME[3]:.6f},", "\nsoon,")
    (tmp_path / "word.csv").write_text(text)
    cases = [("log.csv", "log.csv --unit percent:3.5 --out"), ("log.mat", "writematrix"),
             ("echo.txt", "ros2 bag record"), ("log73.mat", "'-v7'"),
             ("log.h5", "h5py"), ("log.xls", "save it as CSV"),
             ("word.csv", "'soon' is no")]  # fmt: skip
    assert_each_refused(cases, lambda name: load(tmp_path / name), names=tmp_path)


def test_what_is_packed_otherwise_is_refused_with_the_way_out(tmp_path):
    two = io.BytesIO()
    with zipfile.ZipFile(two, "w") as archive:
        archive.writestr("a.csv", joined(","))
        archive.writestr("b.csv", joined(","))
    whole = gzip.compress(joined(",").encode())
    for name, data in (
        ("two.zip", two.getvalue()), ("twice.gz", gzip.compress(whole)), ("cut.gz", whole[:200]),
        ("cut.xz", lzma.compress(joined(",").encode())[:-30]), ("log.zst", b"\x28\xb5\x2f\xfd12"),
        ("bomb.gz", gzip.compress(bytes(9_000_000))),
        ("bomb.xz", lzma.compress(bytes(9_000_000))),
        ("bomb.bz2", bz2.compress(bytes(9_000_000))),
    ):  # fmt: skip
        (tmp_path / name).write_bytes(data)
    cases = [("two.zip", "archive of 2 files"), ("twice.gz", "holds an archive"),
             ("cut.gz", "is damaged"), ("cut.xz", "is damaged"), ("log.zst", "zstd")]  # fmt: skip
    assert_each_refused(cases, lambda name: load(tmp_path / name), names=tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pupper_sysid.sysid.recordings.files.LARGEST_BYTES", 8e6)
        for name in ("bomb.gz", "bomb.xz", "bomb.bz2"):
            with pytest.raises(InputError, match="unpacked, has more than"):
                load(tmp_path / name)
        with reading_up_to(2), pytest.raises(InputError, match="not a text file|has no rows"):
            load(tmp_path / "bomb.gz")


@pytest.mark.parametrize("form", ["dof.csv", "mit.csv", "odrive.csv", "pct.csv", "semi.csv",
                                  "tab.txt", "z.csv.gz"])  # fmt: skip
def test_real_forms_of_one_log_are_one_recording(form):
    first, other = (load(case(f"real/forms_of_one_log/{name}")) for name in ("tab.txt", form))
    (trial,) = first.trials(first.joints[0])
    (same_trial,) = other.trials(other.joints[0])
    for name in ("send_time_s", "command_rad", "position_rad"):
        np.testing.assert_allclose(getattr(same_trial, name), getattr(trial, name), atol=1e-9)


def test_the_log_of_the_forms_without_names_counts_its_repeated_rows_once():
    path = case("real/c09_hubo_no_header_repeated_rows.csv")
    with pytest.raises(InputError, match="--time 0 --command 1 --position 3"):
        load(path)
    recording = load(path, LogOptions("0", "1", "3"))
    assert any("77 %" in text and "counted once" in text for text in recording.warnings)
    assert recording.loop_period_s == pytest.approx(0.005, abs=1e-4)
    (trial,) = recording.trials("joint")
    (form,) = load(case("real/forms_of_one_log/tab.txt")).trials("joint")
    np.testing.assert_allclose(trial.position_rad, form.position_rad[:501], atol=1e-9)


def test_commands_and_states_in_two_tables_of_a_folder_are_one_log(tmp_path):
    """Each with times of its own; a folder of two recordings stays one of two."""
    for name, time, values in (("joint_commands", TIME, COMMAND),
                               ("joint_states", TIME + 0.001, POSITION)):  # fmt: skip
        table = pd.DataFrame({"timestamp": time, "joint_0": values, "joint_1": -values})
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    recording = load(tmp_path)
    assert [*recording.joints] == ["joint_0", "joint_1"]
    for joint, sign in (("joint_0", 1), ("joint_1", -1)):
        (trial,) = recording.trials(joint)
        assert trial.read_time_s[0] - trial.send_time_s[0] == pytest.approx(0.001)
        np.testing.assert_allclose(trial.command_rad, sign * COMMAND, atol=1e-9)
        np.testing.assert_allclose(trial.position_rad, sign * POSITION, atol=1e-9)
    (tmp_path / "joint_states.csv").write_text(joined(","))
    with pytest.raises(InputError, match="holds 2 logs"):
        load(tmp_path)


def test_a_folder_s_tables_are_read_once_with_what_their_remarks_say(tmp_path, monkeypatch):
    """Their heads tell that the folder is a log."""
    time = np.round(0.002 * np.arange(9000), 6)
    turns = np.round(0.05 * np.sin(8 * time), 9)
    for name in ("joint_commands", "joint_states"):
        table = pd.DataFrame({"timestamp": time, "knee": turns}).to_csv(index=False)
        (tmp_path / f"{name}.csv").write_text(f"# moteus r4.11\n{table}")
    sizes = []

    def counted(path, text, *more):
        sizes.append(len(text))
        return parse(path, text, *more)

    monkeypatch.setattr(recognise, "parse", counted)
    (trial,) = load(tmp_path).trials("knee")
    assert sum(size > 100_000 for size in sizes) == 2 and min(sizes) < 100_001
    np.testing.assert_allclose(trial.command_rad, 2 * np.pi * turns, atol=1e-9)


@pytest.mark.parametrize("under", [(), ("knee",)])
def test_lists_of_times_and_values_are_read(tmp_path, under):
    columns = {"target": (TIME, COMMAND), "actual": (TIME + 0.001, POSITION)}
    lists = {name: np.column_stack(pair).tolist() for name, pair in columns.items()}
    for name in under:
        lists = {name: lists}
    (tmp_path / "log.json").write_text(json.dumps(lists))
    recording = load(tmp_path / "log.json")
    assert [*recording.joints] == [*(under or ["joint"])]
    same(recording)


def test_what_drives_a_motor_is_not_offered_as_a_goal(tmp_path):
    path = tmp_path / "log.csv"
    for names in ("pwm,position,speed", "duty,rpm,current", "servo_us,rpm,volt"):
        rows = zip(TIME, 255 * COMMAND, POSITION, 9 * COMMAND, strict=True)
        text = "\n".join(f"{t},{d:.3f},{p},{s}" for t, d, p, s in rows)
        path.write_text(f"time,{names}\n{text}\n")
        with pytest.raises(InputError) as refusal:
            load(path)
        assert not re.search(r"--command (?!and)", str(refusal.value))
