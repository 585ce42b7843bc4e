"""Do the oldest versions that pyproject.toml allows work?

    python benchmarks/lower_bounds.py                                     # the suite of `make test`
    python benchmarks/lower_bounds.py --try scipy==1.14.1 tests/sysid/lag
    python benchmarks/lower_bounds.py --python python3.13

Installs the oldest version of every dependency, extras included, that pyproject.toml and that
Python's wheels allow into an environment of its own (`.venv-lower-VERSION`, 7 GB with CUDA), runs
tests there, and prints the bounds beside what was installed. On 3.11 a bound that was not installed
is not a true one, and fails. `--try` puts another version on top: how far can a bound go down?

uv chooses and installs; UV_TORCH_BACKEND=cpu saves the CUDA libraries where PyTorch's own index is
reachable.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
TESTS = ["tests", "-m", "not slow and not wall_clock"]
INSTALLED = "import importlib.metadata as m, sys; print(*map(m.version, sys.argv[1:]))"


def lower_bounds(project: dict) -> Iterator[tuple[str, Version]]:
    """Names and lower bounds in the `[project]` table of pyproject.toml, extras included."""
    extras = project["optional-dependencies"].values()
    for line in sorted({line for lines in (project["dependencies"], *extras) for line in lines}):
        requirement = Requirement(line)
        if requirement.name != project["name"]:  # an extra made of others
            (bound,) = (Version(s.version) for s in requirement.specifier if s.operator == ">=")
            yield requirement.name, bound


def install(base: str, venv: Path, extras: Sequence[str], tries: Sequence[str]) -> None:
    """Make `venv` and install the oldest versions, `tries` in place of them where given."""
    if not (venv / "bin/uv").exists():
        subprocess.run([base, "-m", "venv", venv], check=True)
        subprocess.run([venv / "bin/pip", "install", "--quiet", "uv"], check=True)
    uv = [venv / "bin/uv", "pip"]
    python, oldest = venv / "bin/python", venv / "oldest.txt"
    subprocess.run(
        [*uv, "compile", "--quiet", "--python", python, "--resolution", "lowest-direct",
         "--only-binary", ":all:", "--no-binary", "feetech-servo-sdk",  # has no wheel
         *(f"--extra={extra}" for extra in extras), ROOT / "pyproject.toml", "-o", oldest],
        check=True,
    )  # fmt: skip
    into = [*uv, "install", "--quiet", "--python", python]
    subprocess.run([*into, "-r", oldest], check=True)
    subprocess.run([*into, "--no-deps", "-e", ROOT], check=True)
    if tries:
        subprocess.run([*into, *tries], check=True)


def main() -> int:
    """Install, print the table, run the tests."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default="python3.11", help="makes the environment")
    parser.add_argument("--venv", type=Path, help="default: .venv-lower-VERSION")
    parser.add_argument("--try", dest="tries", action="append", default=[], metavar="NAME==VERSION")
    parser.add_argument("tests", nargs=argparse.REMAINDER, help="arguments of pytest, last")
    options = parser.parse_args()

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    command = [options.python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    version = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    venv = (options.venv or ROOT / f".venv-lower-{version}").absolute()
    install(options.python, venv, list(project["optional-dependencies"]), options.tries)

    bounds = dict(lower_bounds(project))
    command = [venv / "bin/python", "-c", INSTALLED, *bounds]
    installed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    print(f"| dependency | lower bound | installed on {version} |\n|---|---|---|")
    for name, oldest in zip(bounds, installed, strict=True):
        print(f"| {name} | {bounds[name]} | {oldest} |")
    untrue = [n for n, v in zip(bounds, installed, strict=True) if Version(v) != bounds[n]]

    command = [venv / "bin/python", "-m", "pytest", "-p", "no:cacheprovider", "-n", "2"]
    failed = subprocess.run([*command, *(options.tests or TESTS)], cwd=ROOT).returncode
    if untrue and version == "3.11" and not options.tries:
        print(f"Not to be had together with the others: {', '.join(untrue)}.")
        failed = 1
    print(
        f"The oldest versions on {version}:",
        "a test fails or a bound is untrue" if failed else "work",
    )
    return failed


if __name__ == "__main__":
    sys.exit(main())
