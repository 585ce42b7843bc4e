"""Why a calibration file was refused, in one sentence: the file, the line, the place, the remedy.

pydantic finds what is wrong; `explain` picks the fault that most likely caused the others and
says it in words that someone with the file open in an editor can act on.
"""

from __future__ import annotations

import difflib
import math
import re
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from pupper_sysid.common.strict_yaml import Place, place_text
from pupper_sysid.servo_models.calibration.parts import UNIT_OF_NAME, Band, Quantity, unit_of

_UNITS = (
    "nm_s_per_rad|nm_per_rad|nm_s_per_deg|nm_per_deg|kg_m2|g_cm2|kg_cm|mnm|nmm|nm|"
    "rad_s|deg_s|rpm|rad|deg|degrees|mrad|ms|us|s|hz|steps|percent"
)
_UNIT_ENDING = re.compile(rf"_({_UNITS})$", re.IGNORECASE)

_WANTED = {
    "string_type": "text (in quotes if it looks like a number)",
    "tuple_type": "a list, one line and one dash per entry",
    "dict_type": "a mapping of names",
}

# A misspelt key is also a missing key, and a wrong type hides what stands below it.
_FIRST = ("extra_forbidden", "model_type", "model_attributes_type")


def explain(
    error: ValidationError, top: type[BaseModel], path: Path | str, lines: dict[Place, int]
) -> str:
    """One sentence (or two) on the first fault of a file.

    Parameters
    ----------
    error : pydantic.ValidationError
        What validation found.
    top : type of pydantic.BaseModel
        The model that was validated.
    path : Path or str
        The file, as the user named it.
    lines : dict
        The line of every place of the file, from `strict_yaml.read`.
    """
    faults = sorted(
        error.errors(include_url=False), key=lambda f: (f["type"] == "missing", _rank(f))
    )
    fault = faults[0]
    place = tuple(fault["loc"])
    known = place
    while known and known not in lines:
        known = known[:-1]
    at = f", line {lines[known]}" if known in lines and known else ""
    where = f"{path}{at}: {place_text(place)}" if place else f"{path}"
    more = len(faults) - 1
    rest = f" ({more} more fault{'s' if more > 1 else ''} in this file.)" if more else ""
    message = f"{where} {_say(fault, top, place)}{rest}"
    # a file may hold line breaks and terminal codes in its keys; a sentence may not
    return "".join(c if c.isprintable() else " " for c in message)


def _rank(fault: ErrorDetails) -> int:
    return _FIRST.index(fault["type"]) if fault["type"] in _FIRST else len(_FIRST)


def _say(fault: ErrorDetails, top: type[BaseModel], place: Place) -> str:
    kind, given = fault["type"], fault["input"]
    name = str(place[-1]) if place else ""
    if kind == "extra_forbidden":
        return _unknown_key(name, given, _fields(top, place[:-1]))
    field = _fields(top, place[:-1]).get(name)
    meaning = _meaning(field)
    if kind == "missing":
        return f"is missing. Add it{meaning}."
    if kind in _FIRST:
        return _not_a_mapping(given, field, meaning)
    unit = _unit_in_words(place)
    if kind in ("float_type", "int_type", "int_from_float"):
        whole = "a whole number" if kind.startswith("int") else "a number"
        if isinstance(given, str) and given.strip().lower().lstrip("+-.") in ("nan", "inf"):
            return f"is {given}. Write a finite number{unit}."
        if isinstance(given, str):
            return f"is the text '{_short(given)}'. Write the number only{unit}."
        return f"is {_short(given)}. Write {whole}{unit}."
    if kind == "finite_number":
        return f"is {_short(given)}. Write a finite number{unit}; low and high may be null."
    if kind == "literal_error":
        return f"is {_short(given)}. Write {fault.get('ctx', {}).get('expected', 'another word')}."
    if kind in _WANTED:
        return f"is {_short(given)}. Write {_WANTED[kind]}{meaning}."
    if kind in ("band", "interval", "why", "delay_steps", "joint", "created"):
        return f"is not usable: {fault['msg']}."
    return f"is {_short(given)}: {fault['msg'][:1].lower()}{fault['msg'][1:]}{meaning}."


def _unknown_key(name: str, given: Any, fields: dict[str, FieldInfo]) -> str:
    stem = _stem(name)
    for known in fields:
        # "delay_steps_min" is no other unit of "dead_time_s"; the stems must be the same word
        if name not in fields and stem == _stem(known) != known and name.lower() != known:
            unit = unit_of(known)
            had = "has no unit in its name" if stem == name.lower() else "is in another unit"
            return f"{had}: this file holds it in {unit}. Convert it and name it {known}."
    near = difflib.get_close_matches(name, list(fields), n=1, cutoff=0.6)
    if near:
        return f"is not a key of this file. Did you mean {near[0]}?"
    return f"is not a key of this file. Remove it, or use one of {', '.join(fields)}."


def _stem(name: str) -> str:
    return _UNIT_ENDING.sub("", name.lower())


def _not_a_mapping(given: Any, field: FieldInfo | None, meaning: str) -> str:
    if field is None or _part(field.annotation) is not Quantity:
        return f"is {_short(given)} where a mapping of keys is expected. Fill it in{meaning}."
    example = "{value: …, low: …, high: …, identified: yes | ratio only | no, why: …}"
    if isinstance(given, bool) or not isinstance(given, int | float) or not math.isfinite(given):
        return f"is {_short(given)}. Write {example}{meaning}."
    problem = next((p for band in _bands(field) if (p := band.problem(given))), "")
    return f"is a bare number{f' ({problem})' if problem else ''}. Write {example}{meaning}."


def _bands(field: FieldInfo) -> list[Band]:
    functions = [getattr(entry, "func", None) for entry in field.metadata]
    return [function for function in functions if isinstance(function, Band)]


def _meaning(field: FieldInfo | None) -> str:
    text = (field.description or "").strip().rstrip(".") if field else ""
    return f": {text[:1].lower()}{text[1:]}" if text else ""


def _unit_in_words(place: Place) -> str:
    """The unit of the quantity at `place`, whose last part may be value, low or high."""
    names = [str(part) for part in place if isinstance(part, str)]
    if len(names) > 1 and names[-1] in ("value", "low", "high"):
        names.pop()
    unit = unit_of(names[-1]) if names else ""
    if unit == "1":
        return ", as a fraction of 1"
    return f", in {unit}" if unit and names[-1] not in UNIT_OF_NAME else ""


def _short(given: Any) -> str:
    text = "null" if given is None else str(given)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _fields(top: type[BaseModel], place: Place) -> dict[str, FieldInfo]:
    """Keys (as the file spells them) of the part that stands at `place`."""
    annotation: Any = top
    for step in place:
        model = _part(annotation)
        if model is not None:
            field = _named(model).get(str(step))
            if field is None:
                return {}
            annotation = field.annotation
        else:
            inner = [a for a in get_args(annotation) if a is not Ellipsis]
            if not inner:
                return {}
            annotation = inner[-1]
    model = _part(annotation)
    return _named(model) if model is not None else {}


def _named(model: type[BaseModel]) -> dict[str, FieldInfo]:
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _part(annotation: Any) -> type[BaseModel] | None:
    """The model behind an annotation, through Annotated and `| None`; None for a container."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, UnionType):
        parts = [_part(argument) for argument in get_args(annotation)]
        return next((part for part in parts if part is not None), None)
    return None
