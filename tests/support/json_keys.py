"""Keys of a JSON object in one line, as docs/formats.md lists them."""

import re
from typing import Any

from pupper_sysid.common.joints import JOINT_NAMES
from support.package import ROOT

_ROWS = re.findall(r"^\| `([^`]+)` \| `([^`]+)` \|$", (ROOT / "docs/formats.md").read_text(), re.M)
DOCUMENTED = {command: keys for commands, keys in _ROWS for command in commands.split(", ")}
"""Keys by command."""

# objects whose keys are names of the data
_BY_NAME = frozenset(
    {"models", "gaits", "orbits", "ablations", "autonomy", "curves", "terrain", "compliance", "imu"}
    | {"parameters", "choices", "transfer_functions", "estimators_s", "values"}
    | {"coefficients", "leave_one_out_ranges", "candidate_models", "presets", "undecided"}
)
# objects that another line, or a file, describes
_ELSEWHERE = {
    "calibration": ": as in the YAML file", "lag": ": as in delay", "trot": ": as policy",
    "standing": ": as policy",
}  # fmt: skip
_INTERVAL = {"value", "low", "high"}
_QUANTITY = _INTERVAL | {"identified", "why"}


def key_line(value: Any) -> str:
    """Keys of an object, nested in braces, in their order.

    Examples
    --------
    >>> key_line({"lag_s": {"value": 1, "low": 0, "high": 2}, "joints": {"LF_hip": {"a": [1]}}})
    'lag_s: interval, joints.<joint>.{a[]}'
    """
    return _inside(_tree(value))


def _tree(value: Any, key: str = "") -> Any:
    """Nested dicts of keys; entries of a list, and of an object by name, are one."""
    if isinstance(value, dict):
        if set(value) == _QUANTITY:
            return ": quantity"
        if set(value) == _INTERVAL:
            return ": interval"
        if key in _ELSEWHERE:
            return _ELSEWHERE[key]
        entries = {k: _tree(v, k) for k, v in value.items()}
        name = ""
        if entries and set(entries) <= set(JOINT_NAMES):
            name = "<joint>"
        elif entries and key in _BY_NAME:
            name = "<name>"
        elif entries and all(k.replace(".", "", 1).isdigit() for k in entries):
            name = "<Hz>"
        return {name: _merged(list(entries.values()))} if name else entries
    if isinstance(value, list):
        inner = _merged([_tree(v) for v in value]) if value else None
        return {"[]": inner}
    return None


def _merged(trees: list[Any]) -> Any:
    """One tree with the keys of all."""
    dicts = [tree for tree in trees if isinstance(tree, dict)]
    if not dicts:
        return next((tree for tree in trees if tree), None)
    keys = dict.fromkeys(key for tree in dicts for key in tree)
    return {key: _merged([tree[key] for tree in dicts if key in tree]) for key in keys}


def _inside(tree: Any) -> str:
    return ", ".join(key + _suffix(inner) for key, inner in tree.items())


def _suffix(tree: Any) -> str:
    if tree is None or isinstance(tree, str):
        return tree or ""
    if len(tree) == 1:
        ((key, inner),) = tree.items()
        if key == "[]":
            return "[]" + _suffix(inner)
        if key[0] == "<":
            return f".{key}{_suffix(inner)}"
    return ".{" + _inside(tree) + "}" if tree else ""
