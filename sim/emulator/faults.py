"""Faults of real buses, injected at chosen rates, repeatably.

    faults = BusFaults.parse("lost=0.02,late=0.01", rng)

Faults of single answers: lost, late, truncated, corrupted, duplicated, foreign, wrong length. Of
servos, for a while: error bits, frozen; one that reboots is limp, its registers as after power-on;
in a brown-out all do, and are deaf. Of the line: unplugged, a second writer. `counts` and `ended`
keep account.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.reading.dialect import decimal

ANSWER_KINDS = (
    "lost", "late", "truncated", "corrupted", "duplicated", "foreign", "wrong-length",
)  # fmt: skip
STATE_KINDS = ("error-bits", "frozen", "reboot", "brown-out", "unplugged", "second-writer")
KINDS = (*ANSWER_KINDS, *STATE_KINDS)

_LATE_S = (0.004, 0.06)


@dataclass
class BusFaults:
    """Faults drawn at given rates."""

    rates: dict[str, float]
    """Probability per answer, for each of `KINDS`."""
    rng: np.random.Generator
    lasts_s: float = 0.2
    """How long faults of servos and lines last."""
    counts: dict[str, int] = field(default_factory=dict)
    """How many were injected."""
    ended: list[tuple[str, float]] = field(default_factory=list)
    """Kind and end of faults that last, on the emulator's clock."""

    def __post_init__(self):
        for kind, rate in self.rates.items():
            if kind not in KINDS:
                raise InputError(f"fault '{kind}' is not known; known are {', '.join(KINDS)}.")
            if not 0 <= rate <= 1:
                raise InputError(f"fault {kind}: {rate} is not a probability; choose 0 to 1.")
        if sum(self.rates.values()) > 1:
            raise InputError("faults: the probabilities add up to more than 1.")
        self._kinds = [k for k, r in self.rates.items() if r > 0]
        self._edges = np.cumsum([self.rates[k] for k in self._kinds])

    @classmethod
    def parse(cls, text: str, rng: np.random.Generator) -> BusFaults:
        """Faults from `kind=rate,kind=rate`; an empty text is none."""
        rates = {}
        for part in filter(None, (piece.strip() for piece in text.split(","))):
            kind, _, rate = part.partition("=")
            try:
                rates[kind] = decimal(rate)
            except ValueError:
                raise InputError(
                    f"`faults`: '{part}' is not kind=probability, such as lost=0.02."
                ) from None
        return cls(rates, rng)

    def draw(self) -> str | None:
        """The fault of the next answer, if any; counted."""
        if not self._kinds:
            return None
        k = int(np.searchsorted(self._edges, self.rng.random(), side="right"))
        if k >= len(self._kinds):
            return None
        self.counts[self._kinds[k]] = self.counts.get(self._kinds[k], 0) + 1
        return self._kinds[k]

    def apply(self, kind: str | None, answer: bytes, foreign: bytes) -> list[tuple[float, bytes]]:
        """What arrives instead of `answer`: pieces, each with its delay [s].

        `foreign` is the answer to another request.
        """
        match kind:
            case "lost" | "reboot":
                return []
            case "late":
                return [(float(self.rng.uniform(*_LATE_S)), answer)]
            case "truncated":
                return [(0.0, answer[: int(self.rng.integers(1, len(answer)))])]
            case "corrupted":
                return [(0.0, corrupted(answer, self.rng))]
            case "duplicated":
                return [(0.0, answer), (0.0, answer)]
        return [(0.0, foreign if kind == "foreign" else answer)]


def corrupted(answer: bytes, rng: np.random.Generator) -> bytes:
    """One burst of noise on a line: some bits of one byte, or of two neighbours, flipped."""
    damaged = bytearray(answer)
    at = int(rng.integers(len(damaged)))
    damaged[at] ^= int(rng.integers(1, 256))
    if rng.random() < 0.3 and at + 1 < len(damaged):
        damaged[at + 1] ^= int(rng.integers(1, 256))
    return bytes(damaged)
