"""A published claim beside what we find: one row of the claims report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["holds", "holds partly", "does not hold here", "not testable here"]
Interval = dict[str, list[float]] | None
About = tuple[str, str, str]
"""Id, claim, and what the paper says."""


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


def untested(about: About, how: str) -> Claim:
    """A claim that the evidence at hand cannot decide; `how` says what could."""
    return Claim(*about, "–", None, "not testable here", how)
