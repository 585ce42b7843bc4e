"""Oversized logs are refused before they are unpacked, and strange names are called otherwise."""

import sys
import tracemalloc
import zipfile

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sysid.recordings.files import load
from support.refusals import assert_each_refused

TIME = 0.02 * np.arange(60)
WAVE = 0.3 * np.sin(3 * TIME)


def table():
    return pd.DataFrame({"time": TIME, "knee_command": WAVE, "knee_position": 0.9 * WAVE})


def parquet(folder):
    pytest.importorskip("pyarrow")
    table().to_parquet(folder / "log")


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


def test_control_characters_of_names_are_in_no_warning(tmp_path):
    names = {"knee_command": "\x1b[2J_command", "knee_position": "position"}
    table().rename(columns=names).to_csv(tmp_path / "log.csv", index=False)
    recording = load(tmp_path / "log.csv")
    assert recording.warnings and all(map(str.isprintable, recording.warnings))


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
