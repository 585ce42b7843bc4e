"""`docs/conf.py`, for the tests: what the documentation knows of the commands."""

from __future__ import annotations

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location(
    "documentation", Path(__file__).resolve().parents[2] / "docs/conf.py"
)
assert _spec is not None and _spec.loader is not None
_conf = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_conf)
subcommands = _conf.subcommands
