"""Names in a file: of columns, arrays and joints. Each stands once, and one for each value.

Every reader of tables asks here, so that a name that stands twice is refused in the same words
whatever the format: a mapping from names to columns would keep the last of two without a word.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import printable


def distinct(where: Path | str, names: Iterable[str], what: str = "columns") -> None:
    """Refuse names of which two are the same.

    Parameters
    ----------
    where : Path or str
        File, and place in it, for messages.
    names : iterable of str
    what : str
        Things that are named, in the plural.

    Raises
    ------
    InputError
        If one stands twice.

    Examples
    --------
    >>> distinct("log.npz", ["knee", "ankle", "knee"], "joints")
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: log.npz: two joints would be called knee. Rename one of \
them.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            called = f"would be called {printable(name)[:60]}" if name else "have no name"
            raise InputError(f"{where}: two {what} {called}. Rename one of them.")
        seen.add(name)


def one_each(where: Path | str, counts: Mapping[str, int], remedy: str = "Mend the log.") -> None:
    """Refuse parts of a row that are not equally long: commands, positions, names of joints.

    Parameters
    ----------
    where : Path or str
        File, and place in it, for messages.
    counts : mapping of str to int
        How many values each part has.
    remedy : str
        What else to do, as a sentence.

    Raises
    ------
    InputError
        If two differ.

    Examples
    --------
    >>> one_each("log.npz", {"command": 3, "joint_names": 2})
    Traceback (most recent call last):
    ...
    pupper_sysid.common.errors.InputError: log.npz: command has 3 values and joint_names has 2; \
each joint has one of each. Mend the log.
    """
    if len(set(counts.values())) > 1:
        first, *others = counts.items()
        listed = [f"{printable(first[0])[:60]} has {first[1]} values"]
        listed += [f"{printable(what)[:60]} has {n}" for what, n in others]
        text = f"{', '.join(listed[:-1])} and {listed[-1]}"
        raise InputError(f"{where}: {text}; each joint has one of each. {remedy}")
