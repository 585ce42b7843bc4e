"""A finding: what was found about one joint, by a code and numbers; `words` makes sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

USE, CARE, REFUSE = "use", "use with care", "do not use"
VERDICTS = (REFUSE, CARE, USE)
"""Worst first."""


@dataclass(frozen=True)
class Finding:
    """What was found about a joint."""

    code: str
    """A key of `words.WORDS`."""
    verdict: str
    """One of `VERDICTS`."""
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """What the sentence of this code holds."""
    joint: str = ""
    """Empty where one joint is looked at."""

    @property
    def text(self) -> str:
        """Reason and cure, without the joint's name."""
        from pupper_sysid.sysid.doctor.words import text

        return text(self)


def rivalled(finding: Finding, rival: str) -> Finding:
    """The finding with the code of an explanation that is nearly as good, empty where none is."""
    return replace(finding, values={**finding.values, "rival": rival}) if rival else finding
