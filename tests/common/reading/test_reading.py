"""Whatever a name stands for, only regular files are read, up to a limit that one option raises."""

import json
import os
import socket
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.border import (
    MOST_VALUES,
    parse_json,
    read_bytes,
    read_json,
    read_text,
    read_yaml,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256, write_text
from pupper_sysid.common.reading.content import allowed, reading_up_to, refuse_more
from pupper_sysid.common.strict_yaml import MAX_DEPTH, MOST_NODES, load
from support.refusals import assert_each_refused, refusal


def test_what_is_no_regular_file_is_refused_at_once_and_never_replaced(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(tmp_path / "socket"))
    for path in (tmp_path, Path("/dev/zero"), *(tmp_path / n for n in ("fifo", "link", "socket"))):
        for reads in (read_bytes, sha256):
            assert_each_refused([(path, "is not a file")], reads, names=path)
        if path != tmp_path:
            before = os.lstat(path)
            assert "is not a file" in refusal(write_text, path, "x", True)
            assert os.lstat(path) == before


def test_names_and_contents_that_cannot_be_read_are_refused_with_the_callers_remedy(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("a\0b", "a" * 5000, "nothing", "loop"):
        said = refusal(read_bytes, tmp_path / name, remedy="Copy it again.")
        assert said.startswith(str(tmp_path / name)) and said.endswith("Copy it again.")
    assert refusal(read_bytes, tmp_path / "a").endswith("does not exist. Check the name.")
    (tmp_path / "a.json").write_text("{")
    said = refusal(read_json, tmp_path / "a.json", remedy="Fit it again.")
    assert "a.json is not JSON: " in said and said.endswith("Fit it again.")
    (tmp_path / "latin").write_bytes("Hüfte".encode("latin-1"))
    assert "is not a text file (byte 1 is not UTF-8)" in refusal(read_text, tmp_path / "latin")
    (tmp_path / "mark").write_bytes(b"\xef\xbb\xbfa: 1")
    assert read_yaml(tmp_path / "mark")[0] == {"a": 1}, "a byte order mark is no text"


def test_files_of_the_system_are_read_up_to_the_limit_and_not_waited_for():
    kept, message = Path("/proc/kallsyms"), Path("/proc/kmsg")
    if not (kept.exists() and os.access(message, os.R_OK)):
        pytest.skip("no readable /proc on this system")
    assert "has more than 1,000 bytes" in refusal(read_bytes, kept, 1000)
    assert "/proc/kmsg cannot be read" in refusal(read_bytes, message, 1e9)


def test_a_file_is_read_up_to_its_limit_and_the_refusal_says_how_to_read_it_all(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 2500)
    assert read_bytes(path, 2500) == b"x" * 2500
    assert "at most 2,499 bytes are read" in refusal(read_bytes, path, 2499)
    assert refusal(read_text, path, 1000) == (
        f"{path} has 2,500 bytes; at most 1,000 bytes are read. If it is meant to be so large, "
        "raise the limits of reading with `read_limit=3`."
    )
    with reading_up_to(3):
        assert len(read_text(path, 1000)) == 2500
    assert allowed(7) == 7


def test_what_was_not_counted_to_its_end_is_ten_times_as_much_at_the_next_try():
    with pytest.raises(InputError, match=r"more than 5 rows\. .*`read_limit=10`"):
        refuse_more("a", 6, 5, "rows", exact=False)
    with reading_up_to(10), pytest.raises(InputError, match="more than 50 rows.*`read_limit=100`"):
        refuse_more("a", 51, 5, "rows", exact=False)
    for times in (0.5, 0, -1, 1001, float("inf"), float("nan")):
        with pytest.raises(InputError, match="must be a number from 1"), reading_up_to(times):
            pass


def test_too_many_values_or_levels_are_refused_before_they_are_built():
    cases = [
        ("[" * 200_000, "200,000 levels of nesting"),
        ('{"a":' * 30 + "1" + "}" * 30, "30 levels of nesting"),
        ("[" + "{}," * MOST_VALUES, "values"),
    ]
    assert_each_refused(cases, lambda text: parse_json(text, "the log"), names="the log has ")
    # brackets within texts are no levels
    text = '["' + "[" * 500 + '\\"' + "{" * 500 + '"]'
    assert parse_json(text, "the log") == ["[" * 500 + '"' + "{" * 500]
    with reading_up_to(2):
        assert parse_json("[" * 2 * MAX_DEPTH + "]" * 2 * MAX_DEPTH, "the log")
    assert_each_refused([("- a\n" * (MOST_NODES + 1), f"more than {MOST_NODES:,} values")], load)
    with reading_up_to(1000), pytest.raises(InputError, match="nested too deeply"):
        load("[" * 15_000 + "]" * 15_000)


@settings(max_examples=100)
@given(st.text() | st.sampled_from(["", "{", "9" * 5000, "nothing"]))
def test_any_text_is_json_or_refused(text):
    try:
        expected = json.loads(text)
    except (ValueError, RecursionError):
        assert "x is not JSON: " in refusal(parse_json, text, "x")
    else:
        assert repr(parse_json(text, "x")) == repr(expected)
