"""The rooms of the package and their modules, as pyproject.toml maps them."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = PROJECT["tool"]["setuptools"]["package-dir"]
ROOMS = [folder for name, folder in FOLDERS.items() if name != "pupper_sysid"]
FILES = {
    "pupper_sysid." + path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."): path
    for room in ROOMS
    for path in sorted((ROOT / room).rglob("*.py"))
    if path.stem != "__init__"
}
MODULES = list(FILES)
