r"""How many small errors in a module do the tests notice? One operator, comparison or constant is
changed at a time, in a temporary copy of the repository, and the tests are run on it.

    python benchmarks/mutation.py hardware/safety/guard.py --tests tests/hardware/safety \
        --select "not wall_clock" --mutants 60 --seed 1

Changed are comparisons, arithmetic and boolean operators, `not`, signs, numbers, True and False,
and pairs of functions (min and max, any and all, floor and ceil); not what only makes a message or
an annotation. A mutant that the tests do not notice is either equivalent to the original or a gap
in the tests: `benchmarks/README.md` has the survivors of the last run.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from shared import ROOT

ROOMS = ("common", "servo_models", "hardware", "sysid", "sim", "policies", "cli")
COPIED = (
    *ROOMS, "api", "tests", "data", "benchmarks", "reproduction", "docs", "pyproject.toml",
    "Makefile",
)  # fmt: skip

OPERATORS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.And: ast.Or,
    ast.Or: ast.And,
}  # fmt: skip
REVERSED: dict[type, type] = {
    ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE
}  # fmt: skip
_PAIRS = ("min max", "minimum maximum", "any all", "floor ceil", "nanmin nanmax", "fmin fmax")
NAMES = {a: b for pair in _PAIRS for a, b in (pair.split(), pair.split()[::-1])}


@dataclass(frozen=True)
class Mutation:
    """One change of a tree, which `set_to` makes (True) and takes back (False)."""

    line: int
    set_to: Callable[[bool], None]
    statement: ast.AST


def mutations(tree: ast.AST) -> list[Mutation]:
    """All changes of a module, in the order of its text."""
    found: list[Mutation] = []

    def visit(node: ast.AST, statement: ast.AST) -> None:
        if isinstance(node, ast.JoinedStr):
            return
        statement = node if isinstance(node, ast.stmt) else statement
        for set_to in _changes(node):
            found.append(Mutation(getattr(node, "lineno", 0), set_to, statement))
        for field, value in ast.iter_fields(node):
            if field in ("annotation", "returns", "decorator_list"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    visit(child, statement)

    visit(tree, tree)
    return found


def _changes(node: ast.AST) -> Iterator[Callable[[bool], None]]:
    """The changes of one node itself."""
    if isinstance(node, ast.Compare):
        for k, operator in enumerate(node.ops):
            for table in (OPERATORS, REVERSED):
                if type(operator) in table:
                    yield _swap(node.ops, k, table[type(operator)]())
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        if type(node.op) in OPERATORS:
            yield _swap(node, "op", OPERATORS[type(node.op)]())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield _swap(node, "op", ast.UAdd(), also=("operand", _as_bool(node.operand)))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield _swap(node, "op", ast.UAdd())
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield _swap(node, "value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int):
        yield _swap(node, "value", node.value + 1)
    elif isinstance(node, ast.Constant) and isinstance(node.value, float):
        yield _swap(node, "value", 2 * node.value or 1.0)
    elif isinstance(node, ast.Name) and node.id in NAMES:
        yield _swap(node, "id", NAMES[node.id])
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        yield _swap(node, "attr", NAMES[node.attr])


def _as_bool(operand: ast.expr) -> ast.expr:
    return ast.Call(ast.Name("bool", ast.Load()), [operand], [])


def _swap(owner, key, new, also=None) -> Callable[[bool], None]:
    """Set an item of a list, or one or two attributes of a node."""
    pairs = [(key, new), *([also] if also else [])]
    if isinstance(owner, list):
        old = owner[key]
        return lambda on: owner.__setitem__(key, new if on else old)
    before = [(name, getattr(owner, name)) for name, _ in pairs]

    def set_to(on: bool) -> None:
        for name, value in pairs if on else before:
            setattr(owner, name, value)

    return set_to


def changed(mutation: Mutation) -> str:
    """The changed line before and after."""
    before = ast.unparse(mutation.statement).splitlines()
    mutation.set_to(True)
    after = ast.unparse(mutation.statement).splitlines()
    mutation.set_to(False)
    pairs = zip(before, after, strict=True)
    return next((f"{a.strip()} → {b.strip()}" for a, b in pairs if a != b), "no change")


def copy_of_the_repository(folder: Path) -> Path:
    """What the tests need, with the rooms linked as one package in `links`."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, folder / name)
    package = folder / "links" / "pupper_sysid"
    package.mkdir(parents=True)
    for room in ROOMS:
        (package / room).symlink_to(folder / room)
    for part in (folder / "api").iterdir():
        (package / part.name).symlink_to(part)
    return folder


def run_tests(copy: Path, tests: tuple[str, ...], select: str, limit_s: float) -> str:
    """`killed` or `survived`, or what else pytest made of it."""
    environment = os.environ | {
        "PYTHONPATH": str(copy / "links"), "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", select]
    process = subprocess.Popen(
        [*command, *tests], cwd=copy, env=environment, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        code = process.wait(limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.wait()
        return "killed"
    return {0: "survived", 1: "killed", 2: "killed"}.get(code, f"pytest ended with {code}")


def main(
    modules: tyro.conf.Positional[tuple[Path, ...]],
    tests: tuple[str, ...],
    select: str = "",
    mutants: int = 50,
    seed: int = 0,
) -> None:
    """Copy, mutate, test, print: `mutants` of the `modules` (0: all), by pytest's `-m select`."""
    trees = {m: ast.parse((ROOT / m).read_text()) for m in modules}
    every = [(m, mutation) for m, tree in trees.items() for mutation in mutations(tree)]
    chosen = range(len(every))
    if 0 < mutants < len(every):
        chosen = sorted(np.random.default_rng(seed).choice(len(every), mutants, replace=False))
    killed = 0
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        copy = copy_of_the_repository(Path(name))
        for module, tree in trees.items():  # without comments, as the mutants are
            (copy / module).write_text(ast.unparse(tree))
        started = time.monotonic()
        if (verdict := run_tests(copy, tests, select, 1e4)) != "survived":
            raise SystemExit(f"The tests fail without any change: {verdict}.")
        limit_s = 20 + 5 * (time.monotonic() - started)
        for module, mutation in (every[k] for k in chosen):
            what = changed(mutation)
            mutation.set_to(True)
            (copy / module).write_text(ast.unparse(trees[module]))
            mutation.set_to(False)
            verdict = run_tests(copy, tests, select, limit_s)
            (copy / module).write_text(ast.unparse(trees[module]))
            killed += verdict == "killed"
            print(f"{verdict:9} {module}:{mutation.line}  {what}", flush=True)
    print(f"\n{killed} of {len(chosen)} mutants killed ({len(every)} possible).")


if __name__ == "__main__":
    tyro.cli(main)
