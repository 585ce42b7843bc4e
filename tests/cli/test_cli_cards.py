"""`servo list | show | diff`, and cards in the place of calibrations."""

import pytest

from pupper_sysid.cli import terminal
from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import load
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.files import bam_card, card_names, load_card, to_bam
from pupper_sysid.sim.walking.servo_ranges import check_actuator, servo_ranges
from support.command_line import json_of, ran, refused


@pytest.fixture(autouse=True)
def narrow(monkeypatch) -> None:
    """A terminal of 80 columns."""
    monkeypatch.setattr(terminal.out, "_width", 80)


def lines_of(capsys, *arguments: str) -> list[str]:
    """What a command prints on stdout."""
    return ran(capsys, *arguments)[0].splitlines()


def test_the_list_names_every_card_and_fits_the_terminal(capsys):
    lines = lines_of(capsys, "servo", "list")
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in lines[2:]] == list(card_names())
    assert list(json_of(capsys, "servo", "list")["cards"]) == list(card_names())


@pytest.mark.parametrize("name", card_names())
def test_every_card_is_shown_with_its_source_within_the_terminal(name, capsys):
    lines = lines_of(capsys, "servo", "show", name)
    assert max(map(len, lines)) <= 80
    text = "".join(line.strip() for line in lines)
    card = load_card(name)
    assert (card.source.commit or "") in text and card.source.url in text


def test_another_gain_and_the_file_itself(capsys, tmp_path):
    found = json_of(capsys, "servo", "show", "sts3215-kscale-m1", "--gain", "16")
    assert found["pd"]["servo"]["stiffness_nm_per_rad"] == pytest.approx(23.458 / 2, rel=1e-3)
    lines = lines_of(capsys, "servo", "show", "sts3215-open-duck", "--yaml")
    assert load("\n".join(lines))[0]["name"] == "sts3215-open-duck"


def test_a_difference_of_two_cards_and_of_a_card_and_a_calibration(capsys):
    lines = lines_of(capsys, "servo", "diff", "sts3215-kscale-m1", "sts3215-soarm100")
    assert max(map(len, lines)) <= 80
    # 998.22 at P 16 against 23.458 · 16 / 32
    assert any("stiffness" in line and "85.1" in line for line in lines)
    found = json_of(capsys, "servo", "diff", "sts3215-bam-m1", "paper", "--joint", "LF_thigh")
    assert found["second"]["part"] == "LF_thigh" and found["p_gain"] is None
    stiffness = found["differences"][0]
    assert (stiffness["quantity"] == "stiffness" and stiffness["second"] == 70.0) or (
        stiffness["second"]["value"] == 70.0
    )


def test_an_mjcf_is_recognised_by_its_content(here, capsys):
    ran(capsys, "export", "sts3215-bam-m1", "--to", "mjcf", "--out", "servo.xml")
    joint = '<joint name="servo" class="servo_servo"/><geom size=".02" mass=".1"/>'
    robot = f"<worldbody><body>{joint}</body></worldbody>"
    robot = f'<mujoco><include file="servo.xml"/>{robot}</mujoco>'
    for name in ("robot.xml", "robot"):
        (here / name).write_text(robot)
    plain, unnamed = (
        json_of(capsys, "servo", "diff", name, "sts3215-bam-m1") for name in ("robot.xml", "robot")
    )
    assert plain["differences"] == unnamed["differences"]


def test_a_card_is_taken_where_a_calibration_is(here, capsys):
    load_card("sts3215-bam-m1").save("mine.yaml")
    for given in ("sts3215-bam-m1", "mine.yaml"):
        assert load_calibration(given).joint("elbow").actuator.effort_limit_nm.value > 3
        check_actuator(given)
    ranges = servo_ranges("sts3215-bam-m1")
    assert set(ranges.value["stiffness"]) == {ranges.value["stiffness"][0]}
    for target in ("mjcf", "isaaclab", "mjlab", "json", "csv"):
        ran(capsys, "export", "sts3215-bam-m1", "--to", target, "--out", f"servo.{target}")
    assert 'class="servo_servo"' in (here / "servo.mjcf").read_text()


def test_a_card_goes_to_bam_and_comes_back(capsys, here):
    ran(capsys, "export", "sts3215-bam-m6", "--to", "bam")
    back, there = load_card("sts3215-bam-m6_bam.json").pd(), load_card("sts3215-bam-m6").pd()
    assert back.stiffness_nm_per_rad.value == pytest.approx(there.stiffness_nm_per_rad.value)
    ran(capsys, "export", "sts3215-bam-m6_bam.json", "--to", "mjcf")
    said = refused(capsys, pupper_sysid, "export", "paper", "--to", "bam")
    assert "was fitted without a known load" in said


def test_a_servo_calibrated_under_load_goes_to_bam_and_one_in_free_air_is_told_why_not():
    card = load_card("sts3215-bam-m5")
    calibration = card.calibration()
    of_card, of_fit = to_bam(card), to_bam(bam_card(calibration))
    assert of_card.keys() - of_fit.keys() <= {"max_velocity"}
    assert of_fit["model"] == of_card["model"] == "m5"
    for name in ("kt", "R", "armature", "friction_base", "command_delay", "load_friction_motor"):
        assert of_fit[name] == pytest.approx(of_card[name], rel=1e-6), name
    (name, joint), *_ = calibration.joints.items()
    free = joint.model_copy(update={"servo": None})
    with pytest.raises(InputError, match="without a known load"):
        bam_card(calibration.model_copy(update={"joints": {name: free}}))
