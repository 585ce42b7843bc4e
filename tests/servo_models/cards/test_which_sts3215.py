"""The page on STS3215 models shows what its benchmark printed, of the cards as they are."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.servo_models.cards.files import load_card

ROOT = Path(__file__).resolve().parents[3]
FOUND = json.loads((ROOT / "benchmarks" / "which_sts3215.json").read_text())
PAGE = (ROOT / "docs" / "which_sts3215.md").read_text()


def test_the_tables_of_the_page_are_those_that_the_benchmark_printed():
    for name, lines in FOUND["tables"].items():
        block = PAGE.split(f"<!-- table {name} -->")[1].split("<!-- end -->")[0]
        assert block.strip().splitlines() == lines, name


def test_the_mean_of_joints_in_the_table_follows_from_the_joints():
    rows = [line.strip("| ").split(" | ") for line in FOUND["tables"]["errors"]]
    row = next(r for r in rows if r[0] == "pupper-sysid")
    sweep = [
        j["models"]["pupper-sysid"]["errors"]["frequency_sweep"] for j in FOUND["joints"].values()
    ]
    assert float(row[1]) == pytest.approx(np.mean(sweep), abs=0.051)


def test_the_cards_are_those_that_were_scored():
    for name, expected in FOUND["cards"].items():
        numbers = load_card(name).model_dump(mode="json")["specimens"]
        found = hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()
        assert found == expected, f"{name}: run benchmarks/which_sts3215.py again"


def test_our_card_was_not_fitted_to_the_motion_that_is_scored():
    ours = {f.sha256 for f in load_card("sts3215-12v").data}
    assert FOUND["recordings"]["frequency_sweep"] not in ours
    assert FOUND["recordings"]["chirp_sweep"] in ours
