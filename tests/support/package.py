"""The rooms of the package and their modules, as pyproject.toml maps them."""

import inspect
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import FunctionType

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


def public_names(module: str) -> Iterator[str]:
    """A module, its public classes and functions, and their public methods and properties."""
    yield module
    for name, item in vars(import_module(module)).items():
        if name.startswith("_") or getattr(item, "__module__", None) != module:
            continue
        if inspect.isfunction(item):
            yield f"{module}.{name}"
        elif inspect.isclass(item):
            yield f"{module}.{name}"
            for member, value in list(vars(item).items()):
                value = getattr(value, "__func__", value)  # class and static methods
                if not member.startswith("_") and isinstance(value, (FunctionType, property)):
                    yield f"{module}.{name}.{member}"
