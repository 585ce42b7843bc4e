"""Calibration files under hypothesis: round trips, and files with a fault anywhere in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.common.strict_yaml import dump, load
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.quantity import Quantity
from support.calibration_examples import calibration, joint_calibration

TEXT = st.text(max_size=20)
SMALL = st.floats(0, 0.05)
JUNK = (
    st.none() | st.booleans() | st.integers(-9, 10**12) | st.floats() | TEXT
    | st.lists(st.integers(), max_size=2) | st.dictionaries(TEXT, st.integers(), max_size=2)
)  # fmt: skip
EXAMPLE = calibration().model_dump(mode="json", by_alias=True)
PLACES = sorted((p for p in load(dump(EXAMPLE))[1] if p), key=str)


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("calibration") / "calibrated.yaml"


@st.composite
def quantities(draw) -> Quantity:
    low, value, high = sorted(draw(st.tuples(SMALL, SMALL, SMALL)))
    identified = draw(st.sampled_from(["yes", "ratio only", "no"]))
    why = draw(st.text(min_size=1, max_size=20))
    if identified == "no" and draw(st.booleans()):
        return Quantity(value=value, identified="no", why=why)
    return Quantity(value=value, low=low, high=high, identified=identified, why=why)


@st.composite
def calibrations(draw) -> Calibration:
    joints = {}
    for name in draw(st.lists(st.sampled_from(JOINT_NAMES), min_size=1, max_size=3, unique=True)):
        plain = joint_calibration(draw(st.floats(0, 1e5)))
        feedback = {key: draw(quantities()) for key in ("poll_period_s", "loss", "offset_rad")}
        joints[name] = plain.model_copy(
            update={
                "actuator": plain.actuator.model_copy(update={"dead_time_s": draw(quantities())}),
                "feedback": plain.feedback.model_copy(update=feedback),
                "warnings": tuple(draw(st.lists(TEXT, max_size=2))),
            }
        )
    made = calibration(**joints)
    return made.model_copy(
        update={"robot": draw(TEXT), "notes": tuple(draw(st.lists(TEXT, max_size=2)))}
    )


def loaded_or_refused(path: Path) -> None:
    try:
        found = load_calibration(path)
    except InputError as error:
        said = str(error)
        assert said.startswith(str(path)) and said.isprintable() and said.endswith((".", "?", ".)"))
    else:
        assert isinstance(found, Calibration)


@settings(max_examples=40)
@given(calibrations())
def test_any_calibration_that_is_saved_reads_back(path, made):
    made.save(path, force=True)
    found = load_calibration(path)
    assert found.model_dump() == made.model_dump() | {"joints": found.model_dump()["joints"]}
    assert found.joints == made.joints


@settings(max_examples=40)
@given(place=st.sampled_from(PLACES), value=JUNK)
def test_a_file_with_another_value_anywhere_is_read_or_refused(path, place, value):
    data: Any = load(dump(EXAMPLE))[0]
    part = data
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    path.write_text(dump(data))
    loaded_or_refused(path)


@settings(max_examples=40)
@given(place=st.sampled_from([p for p in PLACES if isinstance(p[-1], str)]), name=TEXT)
def test_a_file_with_a_key_renamed_is_read_or_refused(path, place, name):
    data: Any = load(dump(EXAMPLE))[0]
    part = data
    for key in place[:-1]:
        part = part[key]
    part[name] = part.pop(place[-1])
    path.write_text(dump(data))
    loaded_or_refused(path)


@settings(max_examples=40)
@given(start=st.integers(0, 10**6), length=st.integers(0, 30), new=st.binary(max_size=5))
def test_a_file_damaged_anywhere_is_read_or_refused(path, start, length, new):
    content = calibration().to_yaml().encode()
    start %= len(content)
    path.write_bytes(content[:start] + new + content[start + length :])
    loaded_or_refused(path)
