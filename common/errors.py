"""Errors for users; each message names the fault, the place, and what to do next.

The command line prints the message and ends with `exit_code`, without a traceback. Anything that is
not a `PupperError` is a defect of this project.
"""

from typing import SupportsFloat


class PupperError(Exception):
    """A fault that is reported to the user in one sentence."""

    exit_code = 1


class InputError(PupperError):
    """A file, an option or a value that cannot be used."""

    exit_code = 2


class FileExistsRefusal(InputError):
    """A file exists and `force` is not set."""


class BusError(PupperError):
    """A servo bus failed."""


class MissingDevice(BusError):
    """There is no device of the name that was given."""

    exit_code = 2


class SafetyStop(BusError):
    """The robot was stopped to prevent harm."""


def refuse_outside(name: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Refuse a number that is not between two others, which are included; NaN is not, None passes.

    Examples
    --------
    >>> refuse_outside("`seconds`", 1e9, 0.1, 600, "s")
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: `seconds` is 1e+09 s; it must be from 0.1 to 600 s.
    """
    if value is None:
        return
    if not isinstance(value, SupportsFloat):
        raise InputError(f"{name} is a {type(value).__name__}; write a number.")
    if not low <= value <= high:
        unit = f" {unit}" if unit else ""
        raise InputError(f"{name} is {value:g}{unit}; it must be from {low:g} to {high:g}{unit}.")
