"""A published claim beside what we find: one row of the claims report.

A claim is a function of evidence under `claim`, which returns a `Finding`, or raises `NotTestable`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Literal, TypeVar

Verdict = Literal["holds", "holds partly", "does not hold here", "not testable here"]
Interval = dict[str, list[float]] | None
Evidence = TypeVar("Evidence")


@dataclass(frozen=True)
class Claim:
    """One row of the report.

    Attributes
    ----------
    id : str
    claim, paper, ours : str
    interval : dict of str to [low, high], or None
        90 % intervals of the numbers in `ours`: over policies of a kind where there are several,
        else over robots or stretches of time.
    verdict : Verdict
    how : str
        How it was measured and judged.
    """

    id: str
    claim: str
    paper: str
    ours: str
    interval: Interval
    verdict: Verdict
    how: str


@dataclass(frozen=True)
class Finding:
    """What the evidence says of a claim: `ours`, `interval` and `verdict` of `Claim`.

    Attributes
    ----------
    note : str
        The threshold, and what to make of it; goes behind the claim's `how`.
    """

    ours: str
    interval: Interval
    verdict: Verdict
    note: str


class NotTestable(Exception):
    """The evidence at hand cannot decide; the message says what could."""


def claim(
    id: str, text: str, paper: str, how: str
) -> Callable[[Callable[[Evidence], Finding]], Callable[[Evidence], Claim]]:
    """Make a row of the report of a function that looks at evidence.

    Parameters
    ----------
    id, text, paper : str
        See `Claim`.
    how : str
        How it is measured, whatever comes of it.
    """

    def made(look: Callable[[Evidence], Finding]) -> Callable[[Evidence], Claim]:
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

    return made


def holds(wholly: bool, partly: bool = False) -> Verdict:
    """The verdict of evidence that could decide."""
    return "holds" if wholly else "holds partly" if partly else "does not hold here"
