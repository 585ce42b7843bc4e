"""0 is a value: an option of 0 means 0 or is refused, and never stands for the default."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.cards.files import (
    BamParameters,
    class_of,
    from_bam,
    load_card,
    to_bam,
)
from pupper_sysid.sysid.sweep.bench import bench_plan, parse_load
from support.package import ROOT

ROOMS = ("common", "servo_models", "hardware", "sysid", "sim", "policies", "cli")
_OPTIONAL_NUMBER = re.compile(r"(float|int) \| None")


def test_a_smaller_amplitude_makes_a_smaller_motion_on_a_bench():
    def largest(amplitude: float, kind: str) -> float:
        load = None if kind == "sine" else parse_load("pendulum:0.1kg@0.10m")
        made = bench_plan("knee", load, kind=kind, amplitude_rad=amplitude, loop_period_s=0.01,
                          start_rad=0.0, margin_rad=2.0)  # fmt: skip
        times = np.linspace(0, made.trials[0].duration_s, 2000)
        return float(np.abs(made.trials[0].offset(times)).max())

    for kind in ("sine", "drop", "reversal"):
        assert largest(0.01, kind) == pytest.approx(0.1 * largest(0.1, kind), rel=0.01)


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
