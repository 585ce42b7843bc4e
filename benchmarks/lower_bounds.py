"""Do the oldest versions that pyproject.toml allows work?

    python benchmarks/lower_bounds.py                            # .venv-lower, about 10 minutes
    python benchmarks/lower_bounds.py tests/sysid/lag --try scipy==1.14.1

Installs exactly the lower bound of every dependency, extras included, into an environment of its
own, runs tests there, and prints the bounds beside the constraints that the project is developed
with. `--try` puts another version on top, to see how far a bound can go down. Bounds are those of
Python 3.11, the oldest one: newer ones need newer wheels, which pip finds by itself.

PyTorch's index of processor-only builds saves 3 GB: PIP_EXTRA_INDEX_URL names it, as for `make`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
TESTS = ["tests", "-m", "not slow and not wall_clock"]


def lower_bounds(project: dict) -> dict[str, Version]:
    """Oldest version of each dependency that the `[project]` table of pyproject.toml allows."""
    extras = project["optional-dependencies"].values()
    bounds: dict[str, Version] = {}
    for line in (line for lines in (project["dependencies"], *extras) for line in lines):
        requirement = Requirement(line)
        if requirement.name == project["name"]:  # an extra made of others
            continue
        (bound,) = (Version(s.version) for s in requirement.specifier if s.operator in (">=", "=="))
        if bounds.setdefault(requirement.name, bound) != bound:
            raise ValueError(f"{requirement.name} has two lower bounds")
    return bounds


def main(arguments: Sequence[str] | None = None) -> int:
    """Install the lower bounds, run the tests, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tests", nargs="*", default=TESTS, help="arguments of pytest")
    parser.add_argument("--python", default="python3.11", help="makes the environment")
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv-lower")
    parser.add_argument("--try", dest="tries", action="append", default=[], metavar="NAME==VERSION")
    options = parser.parse_args(arguments)

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = lower_bounds(project)
    constraints = options.venv.with_suffix(".txt")
    constraints.write_text("".join(f"{name}=={bound}\n" for name, bound in bounds.items()))

    python = options.venv / "bin/python"
    if not python.exists():
        subprocess.run([options.python, "-m", "venv", options.venv], check=True)
    extras = ",".join(project["optional-dependencies"])
    pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    subprocess.run([*pip, "-c", constraints, "-e", f"{ROOT}[{extras}]"], check=True)
    if options.tries:
        subprocess.run([*pip, *options.tries], check=True)

    code = "import importlib.metadata as m, sys; print(*(m.version(name) for name in sys.argv[1:]))"
    done = subprocess.run([python, "-c", code, *bounds], check=True, capture_output=True, text=True)
    developed = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().split() if "==" in line
    )
    print(f"| dependency | lower bound | installed | {sys.platform}, developed with |\n|---|---|---|---|")
    for name, installed in zip(bounds, done.stdout.split(), strict=True):
        print(f"| {name} | {bounds[name]} | {installed} | {developed.get(name, '')} |")

    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    ran = subprocess.run(
        [python, "-m", "pytest", "-p", "no:cacheprovider", "-n", "2", *options.tests],
        cwd=ROOT, env=environment,
    )  # fmt: skip
    print("\nThe lower bounds", "work." if ran.returncode == 0 else "do not work.")
    return ran.returncode


if __name__ == "__main__":
    sys.exit(main())
