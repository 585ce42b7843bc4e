"""`docs/conf.py`, for the tests: what the documentation knows of the commands."""

import importlib.util
import sys
from functools import cache
from pathlib import Path

_spec = importlib.util.spec_from_file_location(
    "documentation", Path(__file__).resolve().parents[2] / "docs/conf.py"
)
assert _spec is not None and _spec.loader is not None
_conf = importlib.util.module_from_spec(_spec)
_path = list(sys.path)
_spec.loader.exec_module(_conf)
sys.path[:] = _path  # conf.py adds the folder of its extensions

subcommands = cache(_conf.subcommands)
help_text = cache(_conf.help_text)
front_door = _conf._front_door
