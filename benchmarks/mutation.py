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

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("common", "servo_models", "hardware", "sysid", "sim", "policies", "cli")
COPIED = (*ROOMS, "api", "tests", "data", "benchmarks", "reproduction", "pyproject.toml")

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
    for old, new in zip(before, after, strict=True):
        if old != new:
            return f"{old.strip()} → {_different(old.strip(), new.strip())}"
    return "no change"


def _different(old: str, new: str) -> str:
    """The part of `new` around what differs from `old`."""
    first = next((k for k, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), 0)
    tail = next(
        (k for k, (a, b) in enumerate(zip(old[::-1], new[::-1], strict=False)) if a != b), 0
    )
    return f"…{new[max(first - 12, 0) : len(new) - max(tail - 12, 0)]}…"


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


def run_tests(copy: Path, tests: list[str], select: str, limit_s: float) -> str:
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


def main() -> None:
    """Copy, mutate, test, print."""
    parser = argparse.ArgumentParser(
        description="Small errors in a module, and which of them its tests notice."
    )
    parser.add_argument("module", type=Path, nargs="+", help="modules, relative to the repository")
    parser.add_argument("--tests", nargs="+", required=True, help="files or folders of tests")
    parser.add_argument("--select", default="", help="marker expression for pytest -m")
    parser.add_argument("--mutants", type=int, default=50, help="how many to draw; 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="copies that are tested at a time")
    given = parser.parse_args()

    texts = {m: (ROOT / m).read_text() for m in given.module}
    trees = {m: ast.parse(text) for m, text in texts.items()}
    every = [(m, mutation) for m, tree in trees.items() for mutation in mutations(tree)]
    chosen = every
    if 0 < given.mutants < len(every):
        rng = np.random.default_rng(given.seed)
        drawn = sorted(rng.choice(len(every), given.mutants, replace=False))
        chosen = [every[k] for k in drawn]
    made = []
    for module, mutation in chosen:
        what = changed(mutation)
        mutation.set_to(True)
        made.append((module, mutation.line, what, ast.unparse(trees[module])))
        mutation.set_to(False)

    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        copies: SimpleQueue[Path] = SimpleQueue()
        for k in range(given.workers):
            copies.put(copy_of_the_repository(Path(name) / str(k)))
        first = copies.get()
        started = time.monotonic()
        for module, tree in trees.items():  # without comments, as the mutants are
            (first / module).write_text(ast.unparse(tree))
        if (verdict := run_tests(first, given.tests, given.select, 1e4)) != "survived":
            raise SystemExit(f"The tests fail without any change: {verdict}.")
        took_s = time.monotonic() - started
        copies.put(first)

        def tested(mutant: tuple[Path, int, str, str]) -> tuple[Path, int, str, str]:
            module, line, what, text = mutant
            copy = copies.get()
            try:
                (copy / module).write_text(text)
                verdict = run_tests(copy, given.tests, given.select, 20 + 5 * took_s)
                (copy / module).write_text(texts[module])
            finally:
                copies.put(copy)
            print(f"{verdict:9} {module}:{line}  {what}", flush=True)
            return module, line, what, verdict

        with ThreadPoolExecutor(given.workers) as pool:
            results = list(pool.map(tested, made))
    killed = sum(verdict == "killed" for *_, verdict in results)
    print(f"\n{killed} of {len(results)} mutants killed ({len(every)} possible).")


if __name__ == "__main__":
    main()
