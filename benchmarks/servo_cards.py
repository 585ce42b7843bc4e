"""Servo cards of this project's own fits, from public recordings of servos under load.

    .venv/bin/python benchmarks/servo_cards.py
    .venv/bin/python benchmarks/servo_cards.py --only xl330-m288

The recordings are those of `$PUPPER_REAL_DATA`, else `../shared/real`: a Dynamixel XL330 on a
pendulum (Rhoban/bam, Apache-2.0) and the STS3215 of an SO-101 arm (isaac-sim2real/sage,
Apache-2.0). Each card is written to `servo_models/cards/data`, with hashes of its recordings.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pupper_sysid.servo_models.cards.card import Gains, ServoCard, Source
from pupper_sysid.sysid.export.servo_card import to_card
from pupper_sysid.sysid.loaded.joint_fit import fit_loaded_joint
from pupper_sysid.sysid.recordings.files import load

ROOT = Path(__file__).resolve().parents[1]
REAL = Path(os.environ.get("PUPPER_REAL_DATA") or ROOT.parent / "shared" / "real")
OUT = ROOT / "servo_models" / "cards" / "data"


def xl330(seed: int) -> ServoCard:
    """Dynamixel XL330-M288 on a pendulum, four P gains."""
    recordings = [load(path) for path in sorted((REAL / "bam_xl330").glob("*.json"))]
    (joint,) = recordings[0].joints
    fit = fit_loaded_joint(joint, [t for r in recordings for t in r.trials(joint)], seed)
    return to_card(
        "xl330-m288", "Dynamixel XL330-M288", {"servo": fit}, recordings,
        Source(
            title="Pendulum recordings of an XL330-M288, Rhoban",
            url="https://github.com/Rhoban/bam", file="bam/data.bak",
            commit="af2260462471ff45ac18af159b1327ea51d8db15", licence="Apache-2.0",
        ),
        "pendulum of 0.49 kg at 0.1 m, P 100 to 800", supply_v=7.4, gains=Gains(i=0.0, d=0.0),
    )  # fmt: skip


def so101(seed: int) -> ServoCard:
    """STS3215 of an SO-101 arm at P 16, five joints."""
    motions = ("chirp_sweep", "prbs_excitation", "step_response")
    recordings = [load(REAL / "sage_so101" / name) for name in motions]
    joints = [j for j in recordings[0].joints if j != "Jaw"]  # its readings are no radians
    fits = {
        joint: fit_loaded_joint(joint, [t for r in recordings for t in r.trials(joint)], seed)
        for joint in joints
    }
    return to_card(
        "sts3215-12v", "Feetech STS3215", fits, recordings,
        Source(
            title="SAGE, motions of an SO-101 arm", url="https://github.com/isaac-sim2real/sage",
            file="output/real/so101/custom", commit="4ffd2627df9d23e279b35712a67e629ce0c0dfa7",
            licence="Apache-2.0",
        ),
        "the arm itself, one joint at a time", supply_v=12.0, gains=Gains(i=0.0, d=32.0),
        notes=("frequency_sweep of the same source is left out, for scores.",),
    )  # fmt: skip


CARDS: dict[str, Callable[[int], ServoCard]] = {"xl330-m288": xl330, "sts3215-12v": so101}


def main() -> None:
    """Fit and write the cards."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--only", choices=CARDS, help="one card")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    for name in [given.only] if given.only else CARDS:
        begun = time.monotonic()
        card = CARDS[name](given.seed)
        card.save(given.out / f"{name}.yaml", force=True)
        print(f"{name}: {time.monotonic() - begun:.0f} s")
        for score in card.scores:
            print(f"  {1e3 * score.value:6.1f} mrad  {score.what}")


if __name__ == "__main__":
    main()
