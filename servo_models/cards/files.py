"""Read servo cards: files, the ones that are shipped, and parameter files of BAM.

card = load_card("sts3215-bam-m1")         # shipped, see `card_names`
card = load_card("my_servo.yaml")
card = load_card("params/m6.json")         # as BAM's fit writes it
"""

from __future__ import annotations

import difflib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from pupper_sysid.common.border import (
    read_json,
    read_text,
    read_yaml,
    refuse_other_version,
    validated,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.cards.bam import load_bam
from pupper_sysid.servo_models.cards.card import SCHEMA, SCHEMA_VERSION, ServoCard


def _folder() -> Traversable:
    return resources.files("pupper_sysid.servo_models.cards") / "data"


def card_names() -> tuple[str, ...]:
    """Names of the cards that are shipped."""
    files = (f.name for f in _folder().iterdir())
    return tuple(sorted(f.removesuffix(".yaml") for f in files if f.endswith(".yaml")))


def is_card(path: Path | str) -> bool:
    """Whether this is the name of a shipped card, the file of one, or a parameter file of BAM."""
    if str(path) in card_names():
        return True
    file = Path(path)
    if not file.is_file():
        return False
    if file.suffix.lower() == ".json":
        data = read_json(file)
        return isinstance(data, dict) and {"kt", "R"} <= data.keys()
    if file.suffix.lower() not in (".yaml", ".yml"):
        return False
    if SCHEMA not in read_text(file):  # most files are calibrations, which are long
        return False
    data, _ = read_yaml(file)
    return isinstance(data, dict) and data.get("schema") == SCHEMA


def load_card(path_or_name: Path | str) -> ServoCard:
    """Read a servo card from a file, a shipped one by its name, or a parameter file of BAM.

    Parameters
    ----------
    path_or_name : Path or str
        A YAML file, one of `card_names()`, or a JSON file that BAM's `fit` wrote (`cards.bam`).

    Returns
    -------
    ServoCard

    Examples
    --------
    >>> card = load_card("sts3215-bam-m1-early")
    >>> card.servo, card.supply_v, round(card.pd().stiffness_nm_per_rad.value, 1)
    ('Feetech STS3215', 7.4, 17.8)
    """
    names = card_names()
    if str(path_or_name) in names:
        with resources.as_file(_folder() / f"{path_or_name}.yaml") as file:
            return _load(file)
    path = Path(path_or_name)
    if not path.exists():
        near = difflib.get_close_matches(str(path_or_name), names, n=1)
        hint = f"Did you mean {near[0]}?" if near else "`pupper-sysid servo list` shows the cards."
        raise InputError(f"{path} is neither a file nor a servo card of this tool. {hint}")
    return _load(path)


def _load(path: Path) -> ServoCard:
    if path.suffix.lower() == ".json":
        return load_bam(path)
    data, lines = read_yaml(path)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(
            f"{path} is not a servo card: it does not say `schema: {SCHEMA}` at the top. "
            "`pupper-sysid servo show sts3215-bam-m1 --yaml` prints one as an example."
        )
    refuse_other_version(path, data.get("schema_version"), SCHEMA_VERSION)
    return validated(ServoCard, data, path, lines)


def card_calibration(path_or_name: Path | str) -> Calibration:
    """A card as a calibration; what `load_calibration` does with the name or file of one."""
    return load_card(path_or_name).calibration()
