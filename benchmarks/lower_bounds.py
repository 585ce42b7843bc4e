"""Do the oldest versions that pyproject.toml allows work?

    .venv/bin/python benchmarks/lower_bounds.py                        # the suite of `make test`
    .venv/bin/python benchmarks/lower_bounds.py tests/sysid/lag --python python3.13

Installs the oldest version of every dependency, extras included, that pyproject.toml and that
Python's wheels allow into an environment of its own (`.venv-lower-VERSION`, 7 GB with CUDA), runs
tests there, and prints the bounds beside what was installed. On 3.11 a bound that was not installed
is not a true one, and fails.

uv chooses and installs; UV_TORCH_BACKEND=cpu saves the CUDA libraries where PyTorch's own index is
reachable.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

import tyro
from packaging.requirements import Requirement
from packaging.version import Version
from shared import ROOT, print_rows

TESTS = ("tests", "-m", "not slow and not wall_clock")
INSTALLED = "import importlib.metadata as m, sys; print(*map(m.version, sys.argv[1:]))"


def lower_bounds(project: dict) -> Iterator[tuple[str, Version]]:
    """Names and lower bounds in the `[project]` table of pyproject.toml, extras included."""
    extras = project["optional-dependencies"].values()
    for line in sorted({line for lines in (project["dependencies"], *extras) for line in lines}):
        requirement = Requirement(line)
        if requirement.name != project["name"]:  # an extra made of others
            (bound,) = (Version(s.version) for s in requirement.specifier if s.operator == ">=")
            yield requirement.name, bound


def install(base: str, venv: Path, extras: Sequence[str]) -> None:
    """Make `venv` and install the oldest versions."""
    if not (venv / "bin/uv").exists():
        subprocess.run([base, "-m", "venv", venv], check=True)
        subprocess.run([venv / "bin/pip", "install", "--quiet", "uv"], check=True)
    uv, python, oldest = [venv / "bin/uv", "pip"], venv / "bin/python", venv / "oldest.txt"
    subprocess.run(
        [*uv, "compile", "--quiet", "--python", python, "--resolution", "lowest-direct",
         "--only-binary", ":all:", "--no-binary", "feetech-servo-sdk",  # has no wheel
         *(f"--extra={extra}" for extra in extras), ROOT / "pyproject.toml", "-o", oldest],
        check=True,
    )  # fmt: skip
    for what in (["-r", oldest], ["--no-deps", "-e", ROOT]):
        subprocess.run([*uv, "install", "--quiet", "--python", python, *what], check=True)


def main(tests: tyro.conf.Positional[tuple[str, ...]] = TESTS, python: str = "python3.11") -> None:
    """Install, print the table, run the tests in an environment made by `python`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    command = [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    version = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    venv = ROOT / f".venv-lower-{version}"
    install(python, venv, list(project["optional-dependencies"]))

    bounds = dict(lower_bounds(project))
    command = [str(venv / "bin/python"), "-c", INSTALLED, *bounds]
    installed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    print_rows(
        ("dependency", "lower bound", f"installed on {version}"),
        zip(bounds, bounds.values(), installed, strict=True),
    )
    untrue = [n for n, v in zip(bounds, installed, strict=True) if Version(v) != bounds[n]]
    command = [venv / "bin/python", "-m", "pytest", "-p", "no:cacheprovider", "-n", "2", *tests]
    failed = subprocess.run(command, cwd=ROOT).returncode
    if untrue and version == "3.11":
        print(f"Not to be had together with the others: {', '.join(untrue)}.")
        failed = 1
    verdict = "a test fails or a bound is untrue" if failed else "work"
    print(f"The oldest versions on {version}:", verdict)
    sys.exit(failed)


if __name__ == "__main__":
    tyro.cli(main)
