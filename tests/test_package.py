"""The package as a whole: rooms, imports, wheel, examples in docstrings."""

from __future__ import annotations

import ast
import doctest
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import pupper_sysid as ps
from support.command_line import fresh_python
from support.package import FILES, FOLDERS, MODULES, PROJECT, ROOMS, ROOT

SETUPTOOLS = PROJECT["tool"]["setuptools"]


def test_examples_in_docstrings_run():
    with_examples = [name for name in MODULES if ">>>" in FILES[name].read_text()]
    assert len(with_examples) > 20
    assert [n for n in with_examples if doctest.testmod(import_module(n)).failed] == []


def test_every_folder_with_modules_is_packaged():
    folders = {
        path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for room in ROOMS
        for path in (ROOT / room).rglob("__init__.py")
    }
    packaged = {name.removeprefix("pupper_sysid.") for name in SETUPTOOLS["packages"]}
    assert folders == packaged - {"pupper_sysid"}


# ----- imports


def test_rooms_import_as_the_contract_says(tmp_path):
    """`[tool.importlinter]` in pyproject.toml; imports inside functions count."""
    linter = Path(sys.executable).with_name("lint-imports")
    if not linter.exists():
        pytest.skip("import-linter is not installed")
    links = tmp_path / "pupper_sysid"
    links.mkdir()
    for path in (ROOT / FOLDERS["pupper_sysid"]).glob("*.py"):
        (links / path.name).symlink_to(path)
    for room in ROOMS:
        (links / room).symlink_to(ROOT / room)
    done = subprocess.run(
        [linter, "--no-cache", "--config", ROOT / "pyproject.toml"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """What each module imports when it is imported itself."""
    return {name: set(imported_modules(path)) - {name} for name, path in FILES.items()}


def test_modules_import_each_other_without_circles(imports):
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as circle:
        pytest.fail(" -> ".join(circle.args[1]))


CALIBRATION = [ps._MODULES[n].split(":")[0] for n in ("load", "delay", "calibrate")]
POLICY = ["policies.network.policy_file"]


@pytest.mark.parametrize(
    ("modules", "without"),
    [(CALIBRATION, {"torch", "rsl_rl", "matplotlib"}), (POLICY, {"rsl_rl", "tensordict"})],
    ids=["calibration", "policy"],
)
def test_modules_that_need_no_heavy_library_import_none(imports, modules, without):
    """Of what is ours; slow tests run them without these libraries."""
    waiting = [f"pupper_sysid.{name}" for name in modules]
    reached: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += imports.get(name, ())
    assert len(reached & set(FILES)) > 10
    assert {name.split(".")[0] for name in reached} & without == set()


_STATEMENTS = (ast.stmt, ast.ExceptHandler, ast.match_case)


def imported_modules(path: Path) -> Iterator[str]:
    """Modules of the package that a file imports when it is imported itself."""
    waiting: list[ast.AST] = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in FILES else node.module for name in names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        waiting += (n for n in ast.iter_child_nodes(node) if isinstance(n, _STATEMENTS))


# ----- wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy of the sources."""
    pytest.importorskip("build")
    copy = tmp_path_factory.mktemp("sources")
    no_caches = shutil.ignore_patterns("__pycache__")
    for folder in (*FOLDERS.values(), "reproduction", "tests"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=no_caches)
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, copy)
    done = subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", copy],
        cwd=copy, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (built,) = (copy / "dist").glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_has_one_top_level_name_and_all_its_files(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert {"LICENSE", "NOTICE"} <= {Path(n).name for n in names if ".dist-info/licenses/" in n}
        (top_level,) = (n for n in names if n.endswith(".dist-info/top_level.txt"))
        assert archive.read(top_level).decode().split() == ["pupper_sysid"]
    assert {name.split("/")[0] for name in names} == {"pupper_sysid", top_level.split("/")[0]}
    data = {
        path.relative_to(ROOT).as_posix()
        for room in FOLDERS.values()
        for path in (ROOT / room).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert any(name.endswith(".j2") for name in data) and any("presets/" in n for n in data)
    modules = {path.relative_to(ROOT).as_posix() for path in FILES.values()}
    inside = {name.removeprefix("pupper_sysid/") for name in names}
    assert {name.removeprefix("api/") for name in data | modules} <= inside


@pytest.mark.slow
def test_the_wheel_works_beside_folders_of_the_same_names(wheel, tmp_path):
    """A user's `common.py`, `sim/` and `cli.py` lie where Python looks first."""
    installed, user = tmp_path / "installed", tmp_path / "user"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    user.mkdir()
    decoy = 'raise ImportError("the file of a user, not of pupper-sysid")\n'
    for name in ("common", "cli", "hardware", "servo_models"):
        (user / f"{name}.py").write_text(decoy)
    for name in ("sim", "sysid", "policies"):
        (user / name).mkdir()
        (user / name / "__init__.py").write_text(decoy)

    # its own files first, then what a command reads of its data
    program = (
        "import pupper_sysid; print(pupper_sysid.__file__)\n"
        "from pupper_sysid.cli.programs.pupper_sysid import main; main()"
    )
    printed = fresh_python(program, "servo", "list", folder=user, path=installed)
    assert str(installed) in printed and "sts3215" in printed


# ----- metadata and set-up


def test_the_oldest_python_is_the_same_everywhere():
    project = PROJECT["project"]
    prefix = "Programming Language :: Python :: 3."
    minors = [int(line.removeprefix(prefix)) for line in project["classifiers"] if prefix in line]
    assert minors == list(range(minors[0], minors[-1] + 1))
    assert project["requires-python"] == f">=3.{minors[0]}"
    assert f"needs Python 3.{minors[0]} or newer" in (ROOT / "Makefile").read_text()


def test_the_notice_names_the_source_and_the_licence_of_every_servo_card():
    notice = " ".join((ROOT / "NOTICE").read_text().split())
    cards = [yaml.safe_load(p.read_text()) for p in ROOT.glob("servo_models/cards/data/*.yaml")]
    sources = {f"{card['source']['url']} {card['source']['licence']}" for card in cards}
    assert sources and {source for source in sources if source not in notice} == set()


def script(path: Path, version: str) -> Path:
    """Stand-in for a Python of that version that has no module at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'#!/bin/sh\ntest "$1" = -c && echo {version}\n')
    path.chmod(0o755)
    return path


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`make` in a folder that has nothing but what set-up looks at."""
    if not shutil.which("make"):
        pytest.skip("make is not installed")
    for name in ("pyproject.toml", "constraints.txt"):
        (folder / name).touch()
    clean = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL", "PYTHON")}
    return subprocess.run(
        ["make", "-f", ROOT / "Makefile", *arguments],
        cwd=folder, env=clean, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("present", "named", "words"),
    [
        (None, "3.10", "is Python 3.10. pupper-sysid needs Python 3.11 or newer"),
        (None, "3.9", "is Python 3.9."),
        (None, "2.7", "is Python 2.7."),
        (None, None, "nowhere/python does not run. pupper-sysid needs Python 3.11 or newer"),
        (None, "3.12", "install python3-venv"),
        ("3.10", "3.12", ".venv is of Python 3.10. Run make clean first."),
        ("3.11", "3.12", ".venv is of Python 3.11,"),
    ],
)
def test_set_up_says_which_python_is_needed_before_pip_runs(tmp_path, present, named, words):
    python = script(tmp_path / "python", named) if named else "nowhere/python"
    if present:
        script(tmp_path / ".venv/bin/python", present)
    done = make(tmp_path, "demo", f"PYTHON={python}")
    assert done.returncode != 0 and words in done.stderr and "No module" not in done.stderr
    assert "make demo PYTHON=python3.12" in done.stderr or "make clean" in done.stderr
    assert (tmp_path / ".venv").exists() == bool(present)


def test_set_up_says_that_the_python_of_its_environment_is_gone(tmp_path):
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv/.installed").touch()
    assert "Run make clean" in make(tmp_path, "demo").stderr


def test_an_environment_of_a_newer_python_is_kept_when_none_is_named(tmp_path):
    script(tmp_path / ".venv/bin/python", "3.12")
    assert make(tmp_path, "interpreter").returncode == 0


# ----- clocks

DATES = {"cli/programs/pupper_train.py", "servo_models/calibration/calibration.py"}
DATES |= {"servo_models/cards/files.py", "sysid/recordings/files.py", "sysid/sweep/recorder.py"}
"""Names and dates in files, and the pause before a sweep that is resumed (a file has no other)."""

WALL_CLOCK = {"time.time", "time.time_ns", "time.localtime", "time.gmtime"}
WALL_CLOCK |= {"datetime.now", "datetime.utcnow", "datetime.today", "date.today"}
NAMES_OF_CLOCKS = {name.split(".")[1] for name in WALL_CLOCK}


def wall_clock(source: str) -> set[str]:
    """Functions of a clock that may be set, called or imported by name in `source`."""
    found = set()
    if not re.search(r"\bimport\b.*\b(time|date|datetime)\b|\bfrom (time|datetime)\b", source):
        return found
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and node.attr in NAMES_OF_CLOCKS:
            found.add(".".join(ast.unparse(node).split(".")[-2:]))
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            found.update(f"time.{name.name}" for name in node.names)
    return found & WALL_CLOCK


def test_nothing_that_waits_or_measures_reads_a_clock_that_may_be_set():
    used = {
        path.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        if wall_clock(path.read_text())
    }
    assert used == DATES


def test_a_clock_that_may_be_set_would_be_found():
    assert wall_clock("import time\nend = time.time() + 3") == {"time.time"}
    assert wall_clock("from time import time") == {"time.time"}
    assert wall_clock("import datetime as d\nd.datetime.now()") == {"datetime.now"}
    assert wall_clock("import time\ntime.monotonic()") == set()
