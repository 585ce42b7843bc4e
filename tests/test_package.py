"""The package as a whole: its examples run, its list of folders is complete."""

from __future__ import annotations

import doctest
import importlib
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
ROOMS = [folder for folder in SETUPTOOLS["package-dir"].values() if folder != "api"]
MODULES = sorted(
    "pupper_sysid." + path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
    for room in ROOMS
    for path in (ROOT / room).rglob("*.py")
    if path.stem != "__init__"
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_every_folder_with_modules_is_packaged():
    folders = {
        path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for room in ROOMS
        for path in (ROOT / room).rglob("__init__.py")
    }
    packaged = {name.removeprefix("pupper_sysid.") for name in SETUPTOOLS["packages"]}
    assert folders == packaged - {"pupper_sysid"}
