"""CSV tables: the fast path and the strict one agree, faults are named, limits hold."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading import csv_table
from pupper_sysid.common.reading.content import reading_up_to
from pupper_sysid.common.reading.csv_table import column_names, comments_of, read_table
from pupper_sysid.common.reading.dialect import decimal, whole_number
from support.refusals import assert_each_refused


def strictly(monkeypatch, text: str, **options):
    """The table as the strict path reads it."""
    with monkeypatch.context() as patch:
        patch.setattr(csv_table._Blocks, "_plain", lambda *_: False)
        return read_table("log", text, **options)


def outcome(read, *given, **options):
    try:
        return read(*given, **options)
    except InputError as refusal:
        return str(refusal)


cells = st.one_of(
    st.floats().map(repr),
    st.sampled_from(
        ["", " ", "1", "-1.5e3", "4_1", "٣", "１", "nan", "inf", "-Infinity", "1e400", "0x1", "1,5",
         '"1"', '"1,2"', '"', "# 1", "+.5", "5.", "1e", "1 2", " 7 ", "true", "None", "1\u00a0",
         "1d3", "1e5_0", "\x0b1", "a\x1cb", "−1", "1f", "1j", "NaN", "NA", "null"]
    ),
    st.text(max_size=6),
)  # fmt: skip


@settings(max_examples=30)
@given(rows=st.lists(st.lists(cells, min_size=1, max_size=3), max_size=6), end=st.booleans())
@example(rows=[["1", "2"], ["4_1", "2"]], end=True)
@example(rows=[["1", "a"], ["2"]], end=False)
def test_the_fast_path_reads_what_the_strict_one_reads_or_leaves_it_alone(rows, end):
    text = "t,joint\n" + "\n".join(",".join(row) for row in rows) + ("\n" if end else "")
    for strict in (True, False):
        options = {"texts": ("joint",), "strict": strict}
        fast = outcome(read_table, "log", text, **options)
        with pytest.MonkeyPatch.context() as patch:
            slow = outcome(strictly, patch, text, **options)
        if isinstance(fast, str) or isinstance(slow, str):
            assert fast == slow
            continue
        assert (fast.texts, fast.faults, fast.comments, fast.cut) == (
            slow.texts, slow.faults, slow.comments, slow.cut
        )  # fmt: skip
        np.testing.assert_array_equal(fast.line, slow.line)
        for name, values in slow.numbers.items():
            np.testing.assert_array_equal(fast.numbers[name], values)


@given(values=st.lists(st.floats(allow_nan=True, allow_infinity=False), min_size=1))
def test_numbers_are_those_that_were_written_bit_for_bit(values):
    text = "x\n" + "".join(f"{value!r}\n" for value in values)
    np.testing.assert_array_equal(read_table("log", text).numbers["x"], values)


def test_blocks_do_not_show_in_the_result(monkeypatch):
    lines = [f"{k},{'ab'[k % 2]},{k / 7!r}" for k in range(500)]
    lines[100:100] = ['# resumed: {"trial": 1}', "", "  "]
    lines[300] = f'"{300}","a",""'
    text = "\n".join(["# title", "t,joint,x", *lines, "# end"])
    whole_text = read_table("log", text, ("joint",))
    monkeypatch.setattr(csv_table, "_BLOCK", 64)
    pieces = read_table("log", text, ("joint",))
    np.testing.assert_array_equal(pieces.line, whole_text.line)
    assert pieces.texts == whole_text.texts and pieces.comments == whole_text.comments
    assert [n for n, _ in pieces.comments] == [1, 103, 506]
    assert pieces.comments == comments_of("log", text)
    # lines 1 and 2 are title and names; three lines were put between rows 99 and 100
    assert whole_text.line[99] == 102 and whole_text.line[100] == 106
    for name, values in whole_text.numbers.items():
        np.testing.assert_array_equal(pieces.numbers[name], values)


def test_a_fault_in_a_late_block_is_named_with_its_line_and_column(monkeypatch):
    monkeypatch.setattr(csv_table, "_BLOCK", 64)
    lines = [f"{k},{k}" for k in range(500)]
    lines[437] = "437,4_1"
    with pytest.raises(InputError, match="log, line 439, column b: '4_1' is not a number"):
        read_table("log", "\n".join(["a,b", *lines]))
    lines[437] = "437"
    with pytest.raises(InputError, match="log, line 439: 1 cells where the header names 2"):
        read_table("log", "\n".join(["a,b", *lines]))


def test_lines_end_as_on_other_systems_and_one_without_its_end_is_left_out_where_asked():
    for end in ("\r\n", "\r"):
        table = read_table("log", end.join(["# x", "a,b", "1,2", "3,4", ""]))
        assert table.numbers["b"].tolist() == [2, 4] and table.line.tolist() == [3, 4]
    text = "a,b\n1,2\n3,4"
    assert len(read_table("log", text)) == 2
    cut = read_table("log", text, whole_lines=True)
    assert len(cut) == 1 and cut.cut
    short = read_table("log", "a,b\n1,2\n3")
    assert len(short) == 1 and short.cut
    # names of columns are found behind comments and blank lines
    assert column_names("log", "# a\n\n  \n a , b\n1,2\n") == ["a", "b"]
    assert column_names("log", "# a\n\n") == [] and column_names("log", "") == []


def test_limits_are_said_with_the_way_to_raise_them(monkeypatch):
    monkeypatch.setattr(csv_table, "MOST_CELLS", 1_000_000)
    cases = [
        (",".join(f"c{k}" for k in range(10**5)), "100,000 columns; at most 2,000"),
        ("a\n" + "1\n" * 1_100_000, "at most 1,000,000"),
        ("x" * 200_000 + ",b\n1,2", "a cell has 200,000 characters"),
        ("a,b\n" + "1,2\n" * 3 + "x" * 200_000 + ",2\n", "line 5: a cell has 200,000 characters"),
        ("# a\n" * 11_000 + "a\n1\n", "more than 10,000 lines before"),
        ("a\n1\n" + "# a\n" * 11_000, "more than 10,000 comment lines"),
        ("# " + "a" * 2_000_000 + "\na\n1\n", "line 1 has 2,000,002 characters"),
        ("\n" * 20_000 + "a\n1\n", "more than 10,000 lines before"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda text: read_table("log", text), names="`read_limit=")


def test_a_raised_limit_reads_what_was_refused():
    text = ",".join(f"c{k}" for k in range(3000)) + "\n" + ",".join(["1"] * 3000) + "\n"
    with reading_up_to(2):
        assert len(read_table("log", text).numbers) == 3000
        long = "joint\n" + "x" * 150_000 + "\n"
        assert read_table("log", long, ("joint",)).texts["joint"] == ["x" * 150_000]


@given(st.text(max_size=12))
def test_any_text_is_a_number_in_ascii_or_none(text):
    for read, plain in ((decimal, float), (whole_number, int)):
        try:
            value = read(text)
        except ValueError:
            continue
        assert text.isascii() and "_" not in text
        assert value == plain(text) or math.isnan(value)
