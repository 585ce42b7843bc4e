"""Limits of reading: one sentence, one option."""

from __future__ import annotations

import pytest

from pupper_sysid.common.border import MOST_VALUES, parse_json, read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import allowed, reading_up_to, refuse_more
from pupper_sysid.common.strict_yaml import MAX_DEPTH, MOST_NODES, load
from support.refusals import assert_each_refused


def test_the_refusal_says_how_much_there_is_is_read_and_how_to_read_it_all(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 2500)
    with pytest.raises(InputError) as refusal:
        read_text(path, 1000)
    assert str(refusal.value) == (
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


def test_a_limit_is_raised_by_a_factor_between_1_and_1000():
    for times in (0.5, 0, -1, 1001, float("inf"), float("nan")):
        with pytest.raises(InputError, match="must be a number from 1"), reading_up_to(times):
            pass


def test_json_of_too_many_values_or_levels_is_refused_before_it_is_built():
    cases = [
        ("[" * 200_000, "200,000 levels of nesting"),
        ('{"a":' * 30 + "1" + "}" * 30, "30 levels of nesting"),
        ("[" + "{}," * MOST_VALUES, "values"),
    ]
    assert_each_refused(cases, lambda text: parse_json(text, "the log"), names="the log has ")


def test_brackets_within_texts_are_no_levels():
    text = '["' + "[" * 500 + '\\"' + "{" * 500 + '"]'
    assert parse_json(text, "the log") == ["[" * 500 + '"' + "{" * 500]
    with reading_up_to(2):
        assert parse_json("[" * 2 * MAX_DEPTH + "]" * 2 * MAX_DEPTH, "the log")


def test_yaml_of_too_many_values_is_refused():
    with pytest.raises(InputError, match=f"more than {MOST_NODES:,} values"):
        load("- a\n" * (MOST_NODES + 1))


def test_yaml_deeper_than_python_reads_is_refused_however_far_the_limit_is_raised():
    with reading_up_to(1000), pytest.raises(InputError, match="nested too deeply"):
        load("[" * 15_000 + "]" * 15_000)
