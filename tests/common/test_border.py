"""Files at the border: limited, of a known version, valid, or refused in a sentence."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pupper_sysid.common.border import read_yaml, refuse_other_version, unit_of, validated
from support.refusals import assert_each_refused, refusal

# ----------------------------------------------------------------------------------- versions


def test_only_the_versions_that_are_known_pass():
    for found in (1, 2, 3):
        refuse_other_version("a", found, 3)
    assert "newer version of pupper-sysid (schema_version 4; this one reads 3). Upgrade" in refusal(
        refuse_other_version, "a", 4, 3
    )
    for found in (0, -1, None, True, 1.0, "2", [3], "9" * 99):
        assert "schema_version is" in refusal(refuse_other_version, "a", found, 3)


# --------------------------------------------------------------------------------- validation


class Leg(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    length_m: Annotated[float, Field(gt=0)]
    lag_s: float | dict[str, float] | None = None
    """Lag of its servos."""
    side: Literal["left", "right"]
    joints: list[str] = []

    @model_validator(mode="after")
    def _check(self):
        if self.length_m > 10:
            raise ValueError("a leg of this length is a tower")
        return self


class Robot(BaseModel):
    legs: dict[str, Leg]


GOOD = {"length_m": 0.1, "side": "left"}


def test_a_fault_is_named_with_its_place_and_what_to_do():
    unit = "this file holds it in s. Convert it and name it lag_s."
    cases = [
        ({"side": "left"}, ".length_m is missing. Add it."),
        (GOOD | {"length_m": -1.0}, ".length_m is -1.0; it must be greater than 0."),
        (GOOD | {"length_m": "0.1"}, ".length_m is the text '0.1'. Write the number only."),
        (GOOD | {"length_m": 50.0}, " is not usable: a leg of this length is a tower."),
        (GOOD | {"side": "top"}, ".side is top. Write 'left' or 'right'."),
        (GOOD | {"sid": "left"}, ".sid is not a key of this file. Did you mean side?"),
        (GOOD | {"lag_ms": 30}, f".lag_ms is in another unit: {unit}"),
        (GOOD | {"lag": 30}, f".lag has no unit in its name: {unit}"),
        (GOOD | {"lag_s": "30"}, ".lag_s is the text '30'. Write the number only, in s."),
        (GOOD | {"lag_s": {"hip": None}}, ".lag_s is {'hip': None}. Write a number, in s. (1 more"),
        (GOOD | {"joints": "hip"}, ".joints is hip. Write a list, one line and one dash per entry"),
        (GOOD | {"joints": ["hip", 5]}, ".joints[1] is 5. Write text (in quotes if"),
        (5, " is 5 where a mapping of keys is expected. Fill it in."),
        # the first fault is the one that explains others, and the rest are counted
        ({"lenght_m": 0.1, "side": "up"}, ".lenght_m is not a key of this file. Did you mean "
         "length_m? (2 more faults in this file.)"),
    ]  # fmt: skip
    cases = [(leg, f"robot.yaml: legs.LF{says}") for leg, says in cases]
    check = lambda leg, **options: validated(  # noqa: E731
        Robot, {"legs": {"LF": leg}}, "robot.yaml", **options
    )
    assert_each_refused(cases, check)
    said = refusal(check, {"side": "left"}, remedy="fit it again")
    assert said.endswith("Add it. Or fit it again.")


def test_the_line_is_that_of_the_place_or_of_what_holds_it(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("legs:\n  LF:\n    side: left\n    length_m: x\n  RF: {side: right}\n")
    data, lines = read_yaml(path)
    assert f"{path}, line 4: legs.LF.length_m is" in refusal(validated, Robot, data, path, lines)
    del data["legs"]["LF"]
    assert f"{path}, line 5: legs.RF.length_m is" in refusal(validated, Robot, data, path, lines)


def test_a_sentence_is_one_printable_line_whatever_the_file_says():
    said = refusal(validated, Robot, {"legs": {"a\n\x1b[31mb": 1}}, "robot.yaml")
    assert said.isprintable()


def test_units_are_the_ends_of_names():
    names = ["counts_per_rad", "stiffness_nm_per_rad", "dead_time_s", "rate_rad_s", "steps", "s"]
    assert [unit_of(n) for n in names] == ["counts/rad", "N·m/rad", "s", "rad/s", "", "s"]
