"""Numbers of users' texts, as decimal numerals in ASCII.

Python's `float` and `int` also take `4_1` for 41 and the digits of every script, which in a log or
an option are misprints rather than numbers.
"""

from __future__ import annotations

import re

_WHOLE = re.compile(r"[+-]?[0-9]{1,300}")
_DECIMAL = re.compile(
    r"[+-]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf|infinity)", re.IGNORECASE
)
_SPACES = " \t\r\n"


def decimal(text: str) -> float:
    """The number that `text` is.

    Parameters
    ----------
    text : str
        With `nan`, `inf` and an exponent as in Python, and spaces around it.

    Raises
    ------
    ValueError
        If it is none.

    Examples
    --------
    >>> decimal(" -4.1e2 ")
    -410.0
    >>> decimal("4_1")
    Traceback (most recent call last):
    ...
    ValueError: '4_1' is not a number
    """
    text = text.strip(_SPACES)
    # re.IGNORECASE matches the Kelvin sign and others to ASCII letters
    if not text.isascii() or not _DECIMAL.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is not a number")
    return float(text)


def whole(text: str) -> int:
    """The whole number that `text` is.

    Raises
    ------
    ValueError
        If it is none, or has more than 300 digits.

    Examples
    --------
    >>> whole("-12")
    -12
    """
    text = text.strip(_SPACES)
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is not a whole number")
    return int(text)
