"""MuJoCo, imported by name: type checkers cannot see into the compiled module.

Whoever only needs a robot's numbers or MJCF does not import this: it costs 0.2 s.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

mujoco: Any = import_module("mujoco")


def in_a_line(error: Exception) -> str:
    """What MuJoCo says of a model, without line breaks and full stop."""
    return " ".join(str(error).split()).rstrip(".")
