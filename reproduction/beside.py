"""Verdicts of a page beside those of another, such as one on policies that began otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.csv_table import read_table
from reproduction.claims import Claim, Verdict

_COLUMNS = ("id", "ours", "verdict")


def differences(found: Sequence[Claim], beside: Path) -> list[dict[str, str]]:
    """Claims that another page judges otherwise.

    Parameters
    ----------
    found : sequence of Claim
    beside : Path
        `tables/claims.csv` of the other page.

    Returns
    -------
    list of dict of str to str
        `id`, `claim`, `here`, `verdict`, `there` and `verdict_there` of each such claim.
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
