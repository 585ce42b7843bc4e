"""The border where files come in: limited reading, versions, validation, and one form of refusal.

`read_yaml`, `read_json` and `read_text` turn a file into plain data; `refuse_other_version` checks
its schema version; `validated` turns the data into a pydantic model. Whatever is wrong becomes an
`InputError` of a sentence or two: the file, the line, the place, what stands there, what to do.

`refuse_other_kind` names what is another kind of file of this project, and what reads it.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import json
import math
import re
import textwrap
from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.content import allowed, content, open_regular, refuse_more
from pupper_sysid.common.strict_yaml import MAX_DEPTH, Place, load, place_text, printable

LARGEST_BYTES = 2_000_000
MOST_VALUES = 5_000_000  # of a JSON text: values, names and brackets

UNIT_OF_SUFFIX = {
    "counts_per_rad": "counts/rad",
    "nm_s_per_rad": "N·m·s/rad",
    "nm_per_rad": "N·m/rad",
    "nm": "N·m",
    "kg_m2": "kg·m²",
    "rad_s2": "rad/s²",
    "rad_s": "rad/s",
    "per_s2": "1/s²",
    "per_s": "1/s",
    "rad": "rad",
    "hz": "Hz",
    "s": "s",
    "percent": "%",
}
"""Unit of a name by its ending; longer endings first."""

_UNITS = (
    "nm_s_per_rad|nm_per_rad|nm_s_per_deg|nm_per_deg|kg_m2|g_cm2|kg_cm|mnm|nmm|nm|"
    "rad_s|deg_s|rpm|rad|deg|degrees|mrad|ms|us|s|hz|steps|percent"
)
_UNIT_ENDING = re.compile(rf"_({_UNITS})$", re.IGNORECASE)
_JSON_TEXT = re.compile(r'"(?:[^"\\]|\\.)*"')

_WANTED = {
    "string_type": "text (in quotes if it looks like a number)",
    "tuple_type": "a list, one line and one dash per entry",
    "list_type": "a list, one line and one dash per entry",
    "dict_type": "a mapping of names",
    "bool_type": "true or false",
}
_NOT_A_MAPPING = ("model_type", "model_attributes_type")
# A misspelt key is also a missing key, and a wrong type hides what stands below it.
_FIRST = ("extra_forbidden", *_NOT_A_MAPPING)

_Model = TypeVar("_Model", bound=BaseModel)


class Part(BaseModel):
    """Strict, frozen part of a file: no unknown key, no conversion, no NaN, no infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def __str__(self) -> str:  # pydantic's lists every field, of what has a short repr, too
        return repr(self)


def read_bytes(path: Path, largest_bytes: float = LARGEST_BYTES, remedy: str = "") -> bytes:
    """Content of a regular file of limited size; a larger one is refused without being read.

    `remedy` is what to do, as a sentence; by default, to check the file's name.
    """
    return content(path, largest_bytes, remedy)


def read_text(path: Path, largest_bytes: float = LARGEST_BYTES, remedy: str = "") -> str:
    """Text of a UTF-8 file of limited size, without a byte order mark."""
    try:
        return read_bytes(path, largest_bytes, remedy).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path} is not a text file (byte {error.start} is not UTF-8). "
            f"{remedy or 'Check that it is the file you meant.'}"
        ) from error


def read_yaml(path: Path) -> tuple[Any, dict[Place, int]]:
    """Data of a YAML file, read strictly (`common.strict_yaml`), and every place's line."""
    return load(read_text(path), str(path))


def read_json(path: Path, remedy: str = "") -> Any:
    """Data of a JSON file of limited size."""
    return parse_json(read_text(path, remedy=remedy), str(path), remedy)


def parse_json(text: str, name: str, remedy: str = "") -> Any:
    """Data of JSON `text`; `name` says in messages what it is, `remedy` what to do."""
    refuse_more(name, sum(map(text.count, ",:[{")), MOST_VALUES, "values", remedy)
    refuse_more(name, _depth(text), MAX_DEPTH, "levels of nesting", remedy)
    try:
        return json.loads(text)
    except RecursionError:
        what = "it is nested too deeply"
    except ValueError as error:
        what = str(error)
    raise InputError(f"{name} is not JSON: {what}. {remedy}".rstrip())


def _depth(text: str) -> int:
    """Levels of brackets in JSON text; 0 where they are certainly few."""
    if text.count("[") + text.count("{") <= allowed(MAX_DEPTH):
        return 0
    levels = _levels(text)
    return levels if levels <= allowed(MAX_DEPTH) else _levels(_JSON_TEXT.sub("", text))


def _levels(text: str) -> int:
    import numpy as np

    data = np.frombuffer(text.encode(errors="replace"), np.uint8)
    data = data[(data == ord("[")) | (data == ord("{")) | (data == ord("]")) | (data == ord("}"))]
    steps = np.where((data == ord("[")) | (data == ord("{")), 1, -1)
    return int(np.cumsum(steps).max(initial=0))


def refuse_other_version(path: Path | str, version: Any, known: int) -> None:
    """Refuse a file whose `schema_version` is none that this code reads, 1 to `known`."""
    if type(version) is int and version > known:
        raise InputError(
            f"{path} was written by a newer version of pupper-sysid (schema_version {version}; "
            f"this one reads {known}). Upgrade pupper-sysid."
        )
    if type(version) is not int or version < 1:
        raise InputError(
            f"{path}: schema_version is {_short(version)}; this version reads {known}. Put the "
            "file back as it was written."
        )


def refuse_other_schema(
    name: Path | str, data: Any, what: str, schema: str, version: int, remedy: str
) -> None:
    """Refuse data of a file that does not state `schema`, or has another version of it.

    `what` names the expected file in the message, such as "is not a plan"; `remedy` says where
    one comes from.
    """
    if not isinstance(data, dict) or data.get("schema") != schema:
        raise InputError(f"{name} {what}: it does not say `schema: {schema}` at the top. {remedy}")
    refuse_other_version(name, data.get("schema_version"), version)


RECORDING = "pupper-sysid recording"
_TRUTH = "truth"
_KINDS = {
    RECORDING: ("a recording", "`pupper-sysid doctor`, `delay` and `calibrate` read it"),
    _TRUTH: ("the truth of an emulated recording", "`pupper-sysid compare-truth` reads it"),
    "pupper-calibration": (
        "a calibration", "`pupper-sysid export` reads it, `compare` takes it as --models"),
    "pupper-servo-card": ("a servo card", "`pupper-sysid servo show` and `servo diff` read it"),
    "pupper-servo-model": (
        "a fitted servo model", "`pupper-sysid compare` takes its folder as --models"),
    "pupper-sysid plan": ("a plan", "`pupper-sysid sweep` takes it as `plan`"),
    "pupper-policy": ("a policy", "`pupper-eval`, `pupper-play` and `pupper-deploy` read it"),
    "pupper-run": ("a training run", "`pupper-eval` reads its folder, `pupper-train` resumes it"),
}  # fmt: skip
"""By the schema that a file states: what it is, and what reads it."""
_INSIDE = ("contract.json", "run.yaml")  # of a folder
_HEAD = 8192
_SCHEMA = re.compile(r"^[ \t{]*\"?schema\"?: *\"?(pupper-[\w -]*\w)", re.MULTILINE)
_OURS = re.compile(rf"# {RECORDING}|[\w,]*\b(send_time_s|motor_idx)\b")
_EMULATED = re.compile(r"spec:\s+dead_time_s:")


def refuse_other_kind(path: Path, expected: str) -> None:
    """Refuse what is another kind of file, or folder, of this project, and name what reads it.

    What is no file of this project, or cannot be read, is left to its reader. `expected` is
    `RECORDING`, or the schema that the expected kind states.
    """
    kind = _kind_of(path)
    if kind not in (None, expected):
        what, readers = _KINDS[kind]
        raise InputError(f"{path} is {what}, not {_KINDS[expected][0]}: {readers}.")


def _kind_of(path: Path) -> str | None:
    with suppress(InputError, OSError):
        if path.is_dir():
            inside = (path / name for name in _INSIDE)
            return next((kind for p in inside if p.is_file() and (kind := _kind_of(p))), None)
        with open_regular(path) as file:
            head = file.read(_HEAD).decode(errors="replace")
        if _OURS.match(head):
            return RECORDING
        if _EMULATED.match(head):
            return _TRUTH
        stated = _SCHEMA.search(head)
        return stated[1] if stated and stated[1] in _KINDS else None
    return None


def read_own(path: Path, schema: str, version: int, remedy: str) -> tuple[Any, dict[Place, int]]:
    """Data and lines of a YAML file of this project that states `schema`; others are refused."""
    refuse_other_kind(path, schema)
    data, lines = read_yaml(path)
    refuse_other_schema(path, data, f"is not {_KINDS[schema][0]}", schema, version, remedy)
    return data, lines


def validated(
    model: type[_Model],
    data: Any,
    name: Path | str,
    lines: Mapping[Place, int] | None = None,
    remedy: str = "",
) -> _Model:
    """`data`, plain data from the file `name`, as a pydantic model.

    `lines` has the line of every place of the file, from `read_yaml`; `remedy` is what to do
    instead of editing the file, such as "fit the model again".

    Examples
    --------
    >>> class Servo(BaseModel, extra="forbid"):
    ...     lag_s: float
    >>> validated(Servo, {"lag_ms": 30.0}, "servo.yaml", {("lag_ms",): 1})
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: servo.yaml, line 1: lag_ms is in another unit: \
this file holds it in s. Convert it and name it lag_s. (1 more fault in this file.)
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        invalid = error
    # the sentence on the first fault, and how many more there are
    faults = sorted(
        invalid.errors(include_url=False),
        key=lambda f: (
            f["type"] == "missing",
            _FIRST.index(f["type"]) if f["type"] in _FIRST else len(_FIRST),
        ),
    )
    place = known = _place(faults[0], data)
    while known and known not in (lines or {}):
        known = known[:-1]
    at = f", line {lines[known]}" if lines and known else ""
    where = f"{name}{at}: {place_text(place)}" if place else f"{name}{at}"
    more = len({_place(f, data) for f in faults}) - 1
    advice = f" Or {remedy}." if remedy else ""
    advice += f" ({more} more fault{'s' if more > 1 else ''} in this file.)" if more else ""
    raise InputError(printable(f"{where} {_fault(faults[0], model, place)}{advice}")) from invalid


def unit_of(name: str) -> str:
    """Unit of a quantity by the ending of its name; empty if it has none.

    Examples
    --------
    >>> unit_of("damping_nm_s_per_rad"), unit_of("dead_time_s"), unit_of("loss")
    ('N·m·s/rad', 's', '')
    """
    return next((u for end, u in UNIT_OF_SUFFIX.items() if f"_{name}".endswith(f"_{end}")), "")


def _place(fault: ErrorDetails, data: Any) -> Place:
    """Where a fault stands in the data; pydantic's location also names members of unions."""
    place: list[str | int] = []
    steps: tuple[Any, ...] = fault["loc"]
    for step in steps:
        if (isinstance(data, dict) and step in data) or (
            isinstance(data, list | tuple) and isinstance(step, int) and step < len(data)
        ):
            data = data[step]
            place.append(step)
    return (*place, fault["loc"][-1]) if fault["type"] == "missing" else tuple(place)


def _fault(fault: ErrorDetails, top: type[BaseModel], place: Place) -> str:
    kind, value = fault["type"], fault["input"]
    name = str(place[-1]) if place else ""
    siblings = _fields(top, place[:-1])
    if kind == "extra_forbidden":
        return _unknown_key(name, siblings)
    field = siblings.get(name)
    text = (field.description or "").strip().rstrip(".") if field else ""
    meaning = f": {text[:1].lower()}{text[1:]}" if text else ""
    if kind == "missing":
        return f"is missing. Add it{meaning}."
    if kind in _NOT_A_MAPPING:
        return _not_a_mapping(value, field, meaning)
    if kind == "value_error":
        return f"is not usable: {fault['msg'].removeprefix('Value error, ')}."
    # of the quantity at `place`, whose last part may be value, low or high
    names = [part for part in place if isinstance(part, str)]
    if len(names) > 1 and names[-1] in ("value", "low", "high"):
        names.pop()
    unit = f", in {unit_of(names[-1])}" if names and unit_of(names[-1]) else ""
    if kind in ("float_type", "int_type", "int_from_float"):
        kind_of_number = "a whole number" if kind.startswith("int") else "a number"
        if isinstance(value, str) and value.strip().lower().lstrip("+-.") in ("nan", "inf"):
            return f"is {value}. Write a finite number{unit}."
        if isinstance(value, str):
            return f"is the text '{_short(value)}'. Write the number only{unit}."
        return f"is {_short(value)}. Write {kind_of_number}{unit}."
    if kind == "finite_number":
        return f"is {_short(value)}. Write a finite number{unit}."
    if kind == "literal_error":
        return f"is {_short(value)}. Write {fault.get('ctx', {}).get('expected', 'another word')}."
    if kind in _WANTED:
        return f"is {_short(value)}. Write {_WANTED[kind]}{meaning}."
    message = fault["msg"].replace("Input should", "it must").replace(" should ", " must ")
    message = message.replace(" after validation", "")
    return f"is {_short(value)}; {message[:1].lower()}{message[1:]}{meaning}."


def _unknown_key(name: str, fields: dict[str, FieldInfo]) -> str:
    stem = _stem(name)
    for known in fields:
        # the stems must be the same word: "delay_steps_min" is no unit of "delay_s"
        if name not in fields and stem == _stem(known) != known and name.lower() != known:
            had = "has no unit in its name" if stem == name.lower() else "is in another unit"
            return f"{had}: this file holds it in {unit_of(known)}. Convert it and name it {known}."
    near = difflib.get_close_matches(name, list(fields), n=1, cutoff=0.6)
    if near:
        return f"is not a key of this file. Did you mean {near[0]}?"
    return f"is not a key of this file. Remove it, or use one of {', '.join(fields)}."


def _stem(name: str) -> str:
    return _UNIT_ENDING.sub("", name.lower())


def _not_a_mapping(value: Any, field: FieldInfo | None, meaning: str) -> str:
    """A model may show in `EXAMPLE` how to write it; its validators may know a `problem`."""
    example = getattr(_part(field.annotation), "EXAMPLE", "") if field else ""
    if not field or not example:
        return f"is {_short(value)} where a mapping of keys is expected. Fill it in{meaning}."
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return f"is {_short(value)}. Write {example}{meaning}."
    checks = (getattr(getattr(entry, "func", None), "problem", None) for entry in field.metadata)
    problem = next((reason for check in checks if check and (reason := check(value))), "")
    return f"is a bare number{f' ({problem})' if problem else ''}. Write {example}{meaning}."


def _short(value: Any) -> str:
    text = "null" if value is None else str(value)
    # control characters of a file must not reach the terminal
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _fields(top: type[BaseModel], place: Place) -> dict[str, FieldInfo]:
    """Keys (as the file spells them) of the part that stands at `place`."""
    annotation: Any = top
    for step in place:
        model = _part(annotation)
        if model is not None:
            field = described_fields(model).get(str(step))
            if field is None:
                return {}
            annotation = field.annotation
        else:
            inner = [a for a in get_args(annotation) if a is not Ellipsis]
            if not inner:
                return {}
            annotation = inner[-1]
    model = _part(annotation)
    return described_fields(model) if model is not None else {}


@cache
def described_fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields by their keys in the file, each described by the string that follows it in the class.

    pydantic would read every class's source for that at each start.
    """
    meanings: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not issubclass(base, BaseModel) or base is BaseModel:
            continue
        try:
            source = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError):  # made at run time, or shipped without its source
            continue
        # of a class defined at a prompt, Python 3.13 returns the other lines of that input, too
        bodies = (p.body for p in source if isinstance(p, ast.ClassDef) and p.name == base.__name__)
        for line, after in pairwise(next(bodies, [])):
            if not (isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)):
                continue
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                meanings[line.target.id] = inspect.cleandoc(str(after.value.value))
    fields = {}
    for name, field in model.model_fields.items():
        described = copy(field)
        described.description = field.description or meanings.get(name)
        fields[field.alias or name] = described
    return fields


def _part(annotation: Any) -> type[BaseModel] | None:
    """The model behind an annotation, through Annotated and `| None`; None for a container."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, UnionType):
        models = [_part(argument) for argument in get_args(annotation)]
        return next((part for part in models if part is not None), None)
    return None
