"""YAML at the border: what is written reads back, and no text does more than be refused."""

import math

import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import MAX_DEPTH, dump, load
from support.refusals import assert_each_refused

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**18), 10**18)
    | st.floats(allow_nan=False)
    | st.text()
    | st.sampled_from(["yes", "no", "null", "1e3", "0x10", "1:30", "2026-01-31", "<<", "-", "~"])
)
DATA = st.recursive(
    SCALARS, lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(), part, max_size=4)
)
SIGNS = st.text(alphabet="-?:,[]{}#&*!|>'\"%@` \n\tab0.~<", max_size=40)


def plain(data) -> bool:
    """Whether `data` is of nothing but plain types."""
    if type(data) is dict:
        return all(type(k) is str and plain(v) for k, v in data.items())
    if type(data) is list:
        return all(map(plain, data))
    return data is None or type(data) in (str, int, float, bool)


@settings(max_examples=60)
@given(DATA)
def test_plain_data_that_is_written_reads_back_with_its_types(data):
    found, _ = load(dump(data))
    assert found == data and repr(found) == repr(data)


@settings(max_examples=60)
@given(st.dictionaries(st.text(), SCALARS))
def test_an_ordinary_reader_sees_the_same_data(data):
    assert yaml.safe_load(dump(data)) == data


@settings(max_examples=150)
@given(SIGNS | st.text())
def test_any_text_is_plain_data_or_refused_in_one_line(text):
    try:
        data, lines = load(text, "x.yaml")
    except InputError as error:
        assert "x.yaml" in str(error) and "\n" not in str(error).replace(text, "")
    else:
        assert plain(data) and lines[()] >= 1


def test_no_tag_builds_an_object():
    texts = ("!!python/object/apply:os.mkdir [made]", "!!python/name:os.system",
             "a: !!python/tuple [1]", "a: !!set {b}", "a: !!timestamp 2026-01-31",
             "a: !!binary aGk=")  # fmt: skip
    assert_each_refused([(text, "uses a YAML tag") for text in texts], load)


def test_scalars_follow_yaml_1_2():
    for text, value in (
        ("yes", "yes"), ("no", "no"), ("on", "on"), ("true", True), ("~", None), ("", None),
        ("1e-3", 1e-3), ("010", 10), ("0x10", "0x10"), ("1_000", "1_000"), ("1:30", "1:30"),
        (".inf", math.inf), ("-.inf", -math.inf), ("2026-01-31", "2026-01-31"), ("'7'", "7"),
        ("=", "="), ("<<", "<<"), ("9" * 25, float("9" * 25)), ("{<<: {b: 1}}", {"<<": {"b": 1}}),
    ):  # fmt: skip
        assert load(f"a: {text}")[0] == {"a": value}


def test_each_place_has_its_line():
    _, lines = load("a: 1\nb:\n- x\n- {c: 2,\n   d: 3}\n")
    assert lines == {
        (): 1, ("a",): 1, ("b",): 3, ("b", 0): 3, ("b", 1): 4, ("b", 1, "c"): 4, ("b", 1, "d"): 5,
    }  # fmt: skip


def test_nesting_is_refused_from_the_first_level_that_is_too_deep():
    assert plain(load("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1))[0])  # the file is level 0
    words = f"more than {MAX_DEPTH} levels of nesting"
    assert_each_refused([("[" * n + "]" * n, words) for n in (MAX_DEPTH + 2, 200_000)], load)
