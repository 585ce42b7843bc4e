"""Damaged and oversized logs of every layout: read, or refused in a printable sentence."""

import json
import random
import shutil
import sys
import tracemalloc
import zipfile

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from support.refusals import assert_each_refused

TIME = 0.02 * np.arange(60)
WAVE = 0.3 * np.sin(3 * TIME)
PIECES = (b"NaN", b"1e999", b"null", b"[[", b"9" * 400, b",,", b"\n", b"\xff", b"\0", b"\x1b[31m")


def table():
    return pd.DataFrame({"time": TIME, "knee_command": WAVE, "knee_position": 0.9 * WAVE})


def bam(folder):
    entries = [
        {"timestamp": float(t), "position": float(w), "goal_position": float(w)}
        for t, w in zip(TIME, WAVE, strict=True)
    ]
    (folder / "log").write_text(
        json.dumps({"motor": "x", "mass": 1, "length": 1, "entries": entries})
    )


def ktune(folder):
    rows = [
        {"time_since_start": float(t), "position": float(w), "commanded_position": float(w)}
        for t, w in zip(TIME, WAVE, strict=True)
    ]
    (folder / "log").write_text(json.dumps({"config": {"kp": 1.0}, "data": rows}))


def wide(folder):
    table().to_csv(folder / "log", index=False)


def npz(folder):
    with (folder / "log").open("wb") as file:
        np.savez(file, t=TIME, command=WAVE, position=WAVE)


def mat(folder):
    signals = {"t": TIME, "cmd": WAVE, "pos": WAVE}
    savemat(str(folder / "log"), {"log": signals}, appendmat=False, do_compression=True)


def apart(folder):
    rows = [f"{t},{w},\n{t + 0.001},,{w}\n" for t, w in zip(TIME, WAVE, strict=True)]
    (folder / "log").write_text("time,cmd,pos\n" + "".join(rows))


def parquet(folder):
    pytest.importorskip("pyarrow")
    table().to_parquet(folder / "log")


def sage(folder):
    log = folder / "log"
    log.mkdir()
    for name in ("control", "state_motor"):
        lines = [f'X,{1e6 * t},"[{w}]"' for t, w in zip(TIME, WAVE, strict=True)]
        (log / f"{name}.csv").write_text("\n".join(["type,timestamp,positions", *lines, ""]))
    (log / "joint_list.txt").write_text("knee\n")


@pytest.mark.parametrize("write", [bam, ktune, wide, npz, mat, apart, parquet, sage])
def test_damage_is_refused_in_a_sentence_that_can_be_printed(tmp_path, write):
    source, work = tmp_path / "whole", tmp_path / "damaged"
    source.mkdir()
    write(source)
    load(source / "log")
    rng = random.Random(write.__name__)
    refused = 0
    for _ in range(20):
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(source, work)
        chosen = rng.choice([path for path in work.rglob("*") if path.is_file()])
        data = bytearray(chosen.read_bytes())
        at = rng.randrange(len(data))
        change = rng.randrange(3)
        if change == 0:
            data[at] = rng.randrange(256)
        elif change == 1:
            del data[at : at + rng.choice((1, 40, 4000))]
        else:
            data[at:at] = rng.choice(PIECES)
        chosen.write_bytes(bytes(data))
        try:
            load(work / "log")
        except InputError as error:
            refused += 1
            assert str(error).isprintable() and str(error).endswith(".")
    assert refused > (0 if write is apart else 2)


def test_logs_beyond_the_limits_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    (tmp_path / "log.json").write_text('{"entries": ' + "[" * 100_000)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(6):
            archive.writestr(f"a{k}.npy", bytes(100_000))
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("x.txt", b"hello")
    names = ",".join(f"joint_{k}_command,joint_{k}_position" for k in range(1500))
    (tmp_path / "wide.csv").write_text(f"time,{names}\n" + ",".join(["0"] * 3001) + "\n")
    table().to_csv(tmp_path / "rows.csv", index=False)
    table().assign(time_s=1e12 * TIME).drop(columns="time").to_csv(tmp_path / "t.csv", index=False)
    importers = "pupper_sysid.sysid.recordings.importers"
    monkeypatch.setattr(f"{importers}.arrays.LARGEST_BYTES", 500_000)
    cases = [
        ("log.json", "100,001 levels of nesting"), ("text.npz", "column names but no rows"),
        ("bomb.npz", "unpacked, has 600,000 bytes; at most 500,000"),
        ("wide.csv", "3,001 columns; at most 2,000"), ("t.csv", "times reach"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda name: load(tmp_path / name))
    monkeypatch.setattr("pupper_sysid.common.reading.csv_table.MOST_CELLS", 100)
    assert_each_refused([("rows.csv", "at most 100 cells")], lambda name: load(tmp_path / name))


def test_joints_with_strange_names_are_called_by_letters_and_digits(tmp_path):
    made = table().rename(columns=lambda n: n.replace("knee", "\x1b[31m<b>Knie</b>"))
    made.to_csv(tmp_path / "log.csv", index=False)
    assert load(tmp_path / "log.csv").joints == ["b_Knie_b"]


def test_a_parquet_file_without_the_library_names_the_extra(tmp_path, monkeypatch):
    parquet(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match=r"Install pupper-sysid\[logs\]"):
        load(tmp_path / "log")


def test_names_of_joints_in_parquet_take_the_memory_of_the_names_alone(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet as files

    names = pa.DictionaryArray.from_arrays(np.tile(np.array([0, 1], np.int8), 60), ["knee", "hip"])
    columns = {"time": np.repeat(TIME[:60], 2), "goal": np.repeat(WAVE[:60], 2),
               "position": np.repeat(WAVE[:60], 2)}  # fmt: skip
    files.write_table(pa.table(columns | {"joint": names}), tmp_path / "two.parquet")
    assert load(tmp_path / "two.parquet").joints == ["hip", "knee"]
    count = 10**5
    names = pa.DictionaryArray.from_arrays(np.zeros(count, np.int8), ["x" * 10**5])
    columns = {name: np.zeros(count) for name in columns}
    files.write_table(pa.table(columns | {"joint": names}), tmp_path / "long.parquet")
    tracemalloc.start()
    with pytest.raises(InputError):
        load(tmp_path / "long.parquet")
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
