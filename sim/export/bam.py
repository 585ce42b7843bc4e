"""A servo card as a parameter file of "Better actuator models" (Rhoban/bam).

The reverse, a parameter file as a card, is `servo_models.cards.bam`.
"""

from __future__ import annotations

import json

from pupper_sysid.servo_models.cards.bam import not_in_bam, to_bam
from pupper_sysid.servo_models.cards.card import ServoCard

__all__ = ["not_in_bam", "to_bam_json"]


def to_bam_json(card: ServoCard, specimen: str | None = None) -> str:
    """Text of a parameter file, as BAM's `load_model(json_file=…)` reads it.

    Parameters
    ----------
    card : ServoCard
    specimen : str, optional
        Which of its numbers; by default the card's default.

    Raises
    ------
    InputError
        If the card states no position loop and motor, or BAM has no class for that servo.
    """
    return json.dumps(to_bam(card, specimen), indent=4) + "\n"
