"""A published claim beside what is found here: one row of the claims report.

A claim is a function of evidence under `claim`, which returns a `Finding`, or raises `NotTestable`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Literal, TypeVar

from pupper_sysid.common.interval import Interval
from pupper_sysid.common.results import Result

Verdict = Literal["holds", "holds partly", "does not hold here", "not testable here"]
Evidence = TypeVar("Evidence")


@dataclass(frozen=True)
class Claim(Result):
    """One row of the report.

    Attributes
    ----------
    id : str
    claim, paper, ours : str
    interval : dict of str to Interval, or None
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
    interval: dict[str, Interval] | None
    verdict: Verdict
    how: str


@dataclass(frozen=True)
class Finding:
    """Finding on a claim: `ours`, `interval` and `verdict` of `Claim`.

    Attributes
    ----------
    note : str
        The threshold, and its meaning; appended to the claim's `how`.
    """

    ours: str
    interval: dict[str, Interval] | None
    verdict: Verdict
    note: str


class NotTestable(Exception):
    """The evidence cannot decide the claim; the message names what could."""


def claim(
    id: str, text: str, paper: str, how: str
) -> Callable[[Callable[[Evidence], Finding]], Callable[[Evidence], Claim]]:
    """Decorate a function of evidence so that it returns a row of the report.

    Parameters
    ----------
    id, text, paper : str
        See `Claim`.
    how : str
        How it is measured.
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
