"""0 is a value: an option of 0 means 0 or is refused, and never stands for the default."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pupper_sysid.cli.programs import pupper_deploy, pupper_sysid
from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.address import parse_address
from pupper_sysid.policies.deploy.commands import checked_command
from pupper_sysid.policies.deploy.stacks import Stack
from pupper_sysid.policies.train.run_file import Run, resume_run, save_run
from pupper_sysid.servo_models.cards.bam import BamParameters, class_of, from_bam, to_bam
from pupper_sysid.servo_models.cards.card import Gains
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sysid.sweep.bench import BENCH, BENCH_KINDS, bench_plan, parse_load
from pupper_sysid.sysid.sweep.excitation import KINDS, LARGEST_AMPLITUDE_RAD, plan
from support.command_line import refused
from support.package import ROOT

LOAD = "pendulum:0.1kg@0.10m"
ROOMS = ("common", "servo_models", "hardware", "sysid", "sim", "policies", "cli")
_OPTIONAL_NUMBER = re.compile(r"(float|int) \| None")


@pytest.mark.parametrize(
    ("amplitude", "words"),
    [("0", ()), ("-0.1", ()), ("nan", ()), ("20", ()), ("0", ("--load", LOAD)),
     ("20", ("--load", LOAD, "--kind", "drop"))],
)  # fmt: skip
def test_a_sweep_of_no_excursion_or_of_degrees_is_refused(
    capsys, monkeypatch, tmp_path, amplitude, words
):
    monkeypatch.chdir(tmp_path)
    said = refused(capsys, pupper_sysid, "sweep", "--amplitude", amplitude, *words)
    assert said.startswith(f"error: --amplitude is {amplitude} rad")
    assert "at most 3.14 rad" in said
    assert not list(tmp_path.iterdir())


def test_an_amplitude_in_degrees_is_answered_with_its_radians(capsys):
    said = refused(capsys, pupper_sysid, "sweep", "--amplitude", "20")
    assert "3.2 turns" in said and "20 degrees are 0.35" in said


@pytest.mark.parametrize("amplitude", [0.0, np.nextafter(LARGEST_AMPLITUDE_RAD, 4.0), float("nan")])
def test_no_plan_in_python_takes_such_an_amplitude_either(amplitude):
    for kind in KINDS:
        with pytest.raises(InputError, match="amplitude_rad"):
            plan(kind, ["LF_hip"], amplitude_rad=amplitude)
    for kind in BENCH_KINDS:
        with pytest.raises(InputError, match="amplitude_rad"):
            bench_plan("knee", parse_load(LOAD), kind=kind, amplitude_rad=amplitude,
                       loop_period_s=0.01, start_rad=0.0, margin_rad=1.0)  # fmt: skip


@pytest.mark.parametrize("kind", [*KINDS, BENCH])
def test_a_duration_of_0_s_is_refused_and_not_taken_for_the_usual_one(kind):
    with pytest.raises(InputError, match="duration_s is 0"):
        bench_plan("knee", parse_load(LOAD), kind=kind, duration_s=0.0,
                   loop_period_s=0.01, start_rad=0.0, margin_rad=1.0)  # fmt: skip


def test_a_smaller_amplitude_makes_a_smaller_motion_on_a_bench():
    def largest(amplitude: float, kind: str) -> float:
        made = bench_plan("knee", None if kind == "sine" else parse_load(LOAD), kind=kind,
                          amplitude_rad=amplitude, loop_period_s=0.01, start_rad=0.0,
                          margin_rad=2.0)  # fmt: skip
        times = np.linspace(0, made.trials[0].duration_s, 2000)
        return float(np.abs(made.trials[0].offset(times)).max())

    for kind in ("sine", "drop", "reversal"):
        assert largest(0.01, kind) == pytest.approx(0.1 * largest(0.1, kind), rel=0.01)


@pytest.mark.parametrize("hanging", ["20", "-4"])
def test_a_load_that_hangs_at_degrees_is_refused(capsys, hanging):
    said = refused(capsys, pupper_sysid, "sweep", "--load", f"{LOAD},hanging={hanging}rad")
    assert "half a turn" in said and f"{hanging} degrees are" in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--playback", ROOT / "data/samples/walk_commands.csv", "--rate", "0"), "--rate is 0"),
        (("--rate", "0"), "--rate is 0"),
        (("--lowpass-hz", "-1"), "--lowpass-hz is -1"),
        (("--fade-in-s", "-1"), "--fade-in-s is -1"),
        (("--scale-rad", "0"), "--scale-rad is 0"),
        (("--scale-rad", "20"), "20 degrees are 0.35"),
        (("--seconds", "0"), "--seconds is 0"),
    ],
)
def test_a_deployment_at_0_is_refused_before_a_policy_is_read(
    capsys, monkeypatch, tmp_path, words, says
):
    monkeypatch.chdir(tmp_path)
    assert says in refused(capsys, pupper_deploy, *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [
        ("monitor", "--bus", "emulated", "--seconds", "0", "--once"),
        ("plan", "--seconds", "0"),
        ("plan", "--rate", "0"),
        ("sweep", "--rate", "0"),
        ("sweep", "--duration", "0"),
        ("sweep", "--most-seconds", "0"),
        ("sweep", "--loops", "0"),
        ("calibrate", "--stall-torque", "0"),
    ],
)
def test_0_seconds_hertz_or_newton_metres_are_refused(capsys, words):
    option = next(word for word in words if word.startswith("--") and word != "--bus")
    assert f"{option} is 0" in refused(capsys, pupper_sysid, *words)


def test_a_line_of_0_baud_is_refused_and_not_searched():
    with pytest.raises(InputError, match="'0' is no baud rate"):
        parse_address("feetech:/dev/ttyUSB0@0")


@pytest.mark.parametrize(("iterations", "minutes"), [(0, None), (None, 0.0)])
def test_a_training_resumed_for_0_iterations_or_minutes_is_refused(tmp_path, iterations, minutes):
    save_run(tmp_path, Run(actuator="paper"))
    with pytest.raises(InputError, match="(iterations|minutes) is 0"):
        resume_run(tmp_path, iterations, minutes)


def test_a_gain_ratio_of_0_is_not_1():
    card = load_card("sts3215-bam-m1")
    _, kind = class_of(card)
    numbers = {k: v for k, v in to_bam(card).items() if k != "q_offset"}
    assert kind.has_ratio
    with pytest.raises(InputError, match="error_gain_ratio is 0"):
        from_bam(BamParameters(**numbers | {"error_gain_ratio": 0.0}), kind)
    doubled = from_bam(BamParameters(**numbers | {"error_gain_ratio": 2.0}), kind)
    plain = from_bam(BamParameters(**numbers | {"error_gain_ratio": 1.0}), kind)
    assert doubled.duty_per_rad.value == pytest.approx(2 * plain.duty_per_rad.value)


def test_a_card_cannot_state_a_p_gain_of_0():
    with pytest.raises(ValidationError, match="greater than 0"):
        Gains(p=0.0)


def test_a_filter_of_0_hz_is_refused_where_none_stands_for_no_filter():
    with pytest.raises(InputError, match="lowpass_hz"):
        Stack(lowpass_hz=0.0)


@pytest.mark.parametrize("command", [(20.0, 0.0, 0.0), (0.0, 0.0, 45.0), (float("nan"), 0.0, 0.0)])
def test_a_command_that_no_leg_follows_is_refused(command):
    with pytest.raises(InputError, match="m/s, m/s, rad/s"):
        checked_command(command)


def test_no_optional_number_is_tested_for_its_truth():
    """`number or default` and `if number:` take 0 for no number; `is None` does not."""
    paths = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
    found = [f"{path.relative_to(ROOT)}:{line}" for path in paths for line in _truths_of(path)]
    assert not found


def _truths_of(path: Path) -> Iterator[int]:
    """Lines of a module that test an optional number of its own for truth."""
    text = path.read_text()
    if not _OPTIONAL_NUMBER.search(text):
        return
    tree = ast.parse(text)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    fields = {
        node.target.id
        for one in classes
        for node in one.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
        and _OPTIONAL_NUMBER.fullmatch(ast.unparse(node.annotation))
    }  # fmt: skip
    for tested in _tested(tree):
        if isinstance(tested, ast.Attribute) and tested.attr in fields:
            yield tested.lineno
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            arguments = {
                a.arg for a in (*function.args.args, *function.args.kwonlyargs)
                if a.annotation and _OPTIONAL_NUMBER.fullmatch(ast.unparse(a.annotation))
            }  # fmt: skip
            for tested in _tested(function) if arguments else ():
                if isinstance(tested, ast.Name) and tested.id in arguments:
                    yield tested.lineno


def _tested(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions whose truth is asked for."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BoolOp):
            yield from node.values[:-1]
        elif isinstance(node, ast.If | ast.IfExp | ast.While):
            yield node.test
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield node.operand
        elif isinstance(node, ast.comprehension):
            yield from node.ifs
