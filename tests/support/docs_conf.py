"""`docs/conf.py`, for the tests: what the documentation knows of the commands."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType


@cache
def _conf() -> ModuleType:
    """The module, imported on first use, because Sphinx takes a second to import."""
    spec = importlib.util.spec_from_file_location(
        "documentation", Path(__file__).resolve().parents[2] / "docs/conf.py"
    )
    assert spec is not None and spec.loader is not None
    module, path = importlib.util.module_from_spec(spec), list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = path  # conf.py adds the folder of its extensions
    return module


@cache
def subcommands(program: str) -> list[str]:
    return _conf().subcommands(program)


@cache
def help_text(program: str, *command: str) -> str:
    return _conf().help_text(program, *command)


def front_door() -> str:
    return _conf()._front_door()
