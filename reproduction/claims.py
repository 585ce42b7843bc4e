"""A published claim beside what is found here: one row of the claims report.

A claim is a function of evidence under `claim`, which returns a `Finding`, or raises `NotTestable`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Literal, TypeVar, get_args

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import Result

Verdict = Literal["holds", "holds partly", "does not hold here", "not testable here"]
Evidence = TypeVar("Evidence")


@dataclass(frozen=True)
class Claim(Result):
    """One row of the report."""

    id: str
    claim: str
    paper: str
    ours: str
    interval: dict[str, Interval] | None
    """90 % intervals of the numbers in `ours`: over policies of a kind where there are several,
    else over robots or stretches of time."""
    verdict: Verdict
    how: str
    """How it was measured and judged."""


@dataclass(frozen=True)
class Finding:
    """Finding on a claim: `ours`, `interval` and `verdict` of `Claim`."""

    ours: str
    interval: dict[str, Interval] | None
    verdict: Verdict
    note: str
    """The threshold, and its meaning; appended to the claim's `how`."""


class NotTestable(Exception):
    """The evidence cannot decide the claim; the message names what could."""


def claim(
    id: str, text: str, paper: str, how: str
) -> Callable[[Callable[[Evidence], Finding]], Callable[[Evidence], Claim]]:
    """Decorate a function of evidence so that it returns a row of the report.

    `how` says how it is measured; the others are those of `Claim`.
    """

    def decorate(look: Callable[[Evidence], Finding]) -> Callable[[Evidence], Claim]:
        @wraps(look)
        def row(evidence: Evidence) -> Claim:
            try:
                found = look(evidence)
            except NotTestable as missing:
                return Claim(id, text, paper, "–", None, "not testable here", f"{how} {missing}")
            return Claim(
                id, text, paper, found.ours, found.interval, found.verdict, f"{how} {found.note}"
            )

        return row

    return decorate


def holds(wholly: bool, partly: bool = False) -> Verdict:
    """The verdict of evidence that could decide."""
    return "holds" if wholly else "holds partly" if partly else "does not hold here"


_COLUMNS = ("id", "ours", "verdict")


def differences(found: Sequence[Claim], beside: Path) -> list[dict[str, str]]:
    """Claims that another page judges otherwise.

    Each has `id`, `claim`, `here`, `verdict`, `there` and `verdict_there`.
    """
    text = read_text(beside)
    header = text.split("\n", 1)[0].strip().split(",")
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise InputError(
            f"{beside} has no column `{missing[0]}`. Give the tables/claims.csv of a page that "
            "`python -m reproduction` wrote."
        )
    table = read_table(beside, text, header)
    rows = zip(*(table.texts[name] for name in _COLUMNS), strict=True)
    there = {id: (ours, verdict) for id, ours, verdict in rows}
    for id, (_, verdict) in there.items():
        if verdict not in get_args(Verdict):
            raise InputError(f"{beside}: the verdict of {id} is {verdict!r}, which is none.")
    return [
        {
            "id": c.id, "claim": c.claim, "here": c.ours, "verdict": c.verdict,
            "there": there[c.id][0], "verdict_there": there[c.id][1],
        }
        for c in found
        if c.id in there and there[c.id][1] != c.verdict
    ]  # fmt: skip
