"""Damaged and oversized logs of every layout: read, or refused in a printable sentence."""

import io
import json
import random
import shutil
import sys
import tracemalloc
import zipfile

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load

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


@pytest.mark.parametrize("write", [bam, ktune, wide, npz, parquet, sage])
def test_damage_is_refused_in_a_sentence_that_can_be_printed(tmp_path, write):
    source, work = tmp_path / "whole", tmp_path / "damaged"
    source.mkdir()
    write(source)
    load(source / "log")
    rng = random.Random(write.__name__)
    refused = 0
    for _ in range(40):
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
    assert refused > 5


def test_json_that_is_nested_too_deeply_is_refused(tmp_path):
    (tmp_path / "log.json").write_text('{"entries": ' + "[" * 100_000)
    with pytest.raises(InputError, match="100,001 levels of nesting"):
        load(tmp_path / "log.json")


def test_an_archive_that_unpacks_to_more_than_the_budget_is_not_unpacked(tmp_path):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(6):
            archive.writestr(f"a{k}.npy", bytes(100_000_000))
    (tmp_path / "bomb.npz").write_bytes(packed.getvalue())
    with pytest.raises(InputError, match="unpacked, has 600 MB; at most 500 MB"):
        load(tmp_path / "bomb.npz")


def test_a_table_of_too_many_columns_or_rows_is_refused(tmp_path, monkeypatch):
    names = ",".join(f"joint_{k}_command,joint_{k}_position" for k in range(1500))
    (tmp_path / "log.csv").write_text(f"time,{names}\n" + ",".join(["0"] * 3001) + "\n")
    with pytest.raises(InputError, match="3,001 columns; at most 2,000"):
        load(tmp_path / "log.csv")
    monkeypatch.setattr("pupper_sysid.common.reading.csv_table.MOST_CELLS", 100)
    table().to_csv(tmp_path / "rows.csv", index=False)
    with pytest.raises(InputError, match="cells; at most 100 cells"):
        load(tmp_path / "rows.csv")


def test_joints_with_strange_names_are_called_by_letters_and_digits(tmp_path):
    made = table().rename(columns=lambda n: n.replace("knee", "\x1b[31m<b>Knie</b>"))
    made.to_csv(tmp_path / "log.csv", index=False)
    assert load(tmp_path / "log.csv").joints == ["joint_31m_b_Knie_b"]


def test_a_parquet_file_without_the_library_names_the_extra(tmp_path, monkeypatch):
    parquet(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match=r"Install pupper-sysid\[logs\]"):
        load(tmp_path / "log")


def test_an_archive_without_arrays_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("x.txt", b"hello")
    with pytest.raises(InputError, match="no column is a command"):
        load(tmp_path / "log.npz")


def test_names_of_joints_in_parquet_take_the_memory_of_the_names_alone(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet as files

    names = pa.DictionaryArray.from_arrays(np.tile(np.array([0, 1], np.int8), 60), ["knee", "hip"])
    columns = {"time": np.repeat(TIME[:60], 2), "goal": np.repeat(WAVE[:60], 2),
               "position": np.repeat(WAVE[:60], 2)}  # fmt: skip
    files.write_table(pa.table(columns | {"joint": names}), tmp_path / "two.parquet")
    assert load(tmp_path / "two.parquet").joints == ["hip", "knee"]
    count = 10**6
    names = pa.DictionaryArray.from_arrays(np.zeros(count, np.int8), ["x" * 10**6])
    columns = {name: np.zeros(count) for name in columns}
    files.write_table(pa.table(columns | {"joint": names}), tmp_path / "long.parquet")
    tracemalloc.start()
    with pytest.raises(InputError):
        load(tmp_path / "long.parquet")
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def test_times_that_are_no_seconds_are_refused(tmp_path):
    made = table()
    made["time_s"] = 1e12 * TIME
    made = made.drop(columns=[c for c in made.columns if c in ("t", "time")])
    made.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(InputError, match="times reach"):
        load(tmp_path / "log.csv")
