"""How much of a file is read, and the one way to read more.

Every reader has limits: bytes, rows, columns, cells, nesting. They are far above what the files of
their kind have, so that a damaged or hostile file is refused in a moment instead of filling the
memory. `reading_up_to` raises all of them by a factor for a block of code, the option
`--read-limit` of every program for a command::

    with reading_up_to(4):
        recording = load("a_day.csv")
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from pupper_sysid.common.errors import InputError

MOST_TIMES = 1000.0

_times: ContextVar[float] = ContextVar("read_limit", default=1.0)


@contextmanager
def reading_up_to(times: float) -> Iterator[None]:
    """Within the block, read files up to `times` the usual limits.

    Parameters
    ----------
    times : float
        1 to 1000.

    Raises
    ------
    InputError
        If it is another number.
    """
    if not 1 <= times <= MOST_TIMES:
        raise InputError(
            f"`read_limit` is {times:g}; it must be a number from 1 (the usual limits) to "
            f"{MOST_TIMES:g} (times as much)."
        )
    before = _times.set(times)
    try:
        yield
    finally:
        _times.reset(before)


def read_limit() -> float:
    """By which factor the limits of reading are raised now."""
    return _times.get()


def allowed(most: float) -> float:
    """The limit `most`, raised as it is now."""
    return most * _times.get()


def refuse_more(
    name: Path | str, found: float, most: float, unit: str, remedy: str = "", exact: bool = True
) -> None:
    """Refuse what is beyond a limit.

    Parameters
    ----------
    name : Path or str
        The file, and the place in it where that helps.
    found : float
        How much it has.
    most : float
        The limit, before it is raised.
    unit : str
        Such as "rows" or "bytes".
    remedy : str
        What to do, as a sentence.
    exact : bool
        Whether `found` is all, rather than what was counted until the limit was passed.

    Raises
    ------
    InputError
        If `found` is more than `most`, raised as it is now.
    """
    bound = allowed(most)
    if found <= bound:
        return
    times = f"{min(max(math.ceil(found / most), 2), MOST_TIMES):.0f}" if exact else "10"
    if read_limit() > 1 and not exact:
        times = f"{min(10 * read_limit(), MOST_TIMES):.0f}"
    raise InputError(
        f"{name} has {_shown(found, unit) if exact else f'more than {_shown(bound, unit)}'}"
        f"{f'; at most {_shown(bound, unit)} are read' if exact else ''}. "
        f"{f'{remedy} ' if remedy else ''}If it is meant to be so large, raise the limits of "
        f"reading with `read_limit={times}`."
    )


def _shown(amount: float, unit: str) -> str:
    if unit != "bytes" or amount < 1e6:
        return f"{amount:,.0f} {unit}"
    return f"{amount / 1e6:,.0f} MB" if amount >= 10e6 else f"{amount / 1e6:.1f} MB"
