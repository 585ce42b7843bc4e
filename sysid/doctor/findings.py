"""A finding: a verdict on a joint's recording, and the sentence that says why and what to do."""

from __future__ import annotations

from dataclasses import dataclass

USE, CARE, REFUSE = "use", "use with care", "do not use"
VERDICTS = (REFUSE, CARE, USE)
"""Worst first."""


@dataclass(frozen=True)
class Finding:
    """A verdict on a joint and the sentence that goes with it.

    Attributes
    ----------
    verdict : {"use", "use with care", "do not use"}
    text : str
        Reason and cure, without the joint's name.
    """

    verdict: str
    text: str
