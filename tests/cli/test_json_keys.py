"""The keys of JSON objects are those of docs/formats.md."""

from __future__ import annotations

import json

import pytest

from support.command_line import run
from support.json_keys import DOCUMENTED, key_line
from support.package import ROOT

SAMPLE = ROOT / "data/samples/sweep.csv"
COMMANDS = {
    "sweep": ("--freqs", "4", "--joints", "LF_hip"),
    "plan": (SAMPLE.with_name("calibrated.yaml"), "--joints", "LF_hip"),
    "import": (SAMPLE,),
    "doctor": (SAMPLE,),
    "delay": (SAMPLE, "--joints", "LF_hip"),
    "bode": (SAMPLE, "--joints", "LF_hip"),
    "export": ("paper", "--to", "csv"),
    "compare": (SAMPLE, "--joints", "LF_hip", "--models", "paper"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_keys_of_an_object_are_the_documented_ones(capsys, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, command, *COMMANDS[command], "--json")
    assert code == 0, err
    assert key_line(json.loads(out)) == DOCUMENTED[command]


def test_an_objects_keys_in_one_line():
    found = {
        "joints": {"LF_hip": {"lag_s": {"value": 1, "low": 0, "high": 2}, "warnings": []}},
        "rows": [{"a": 1}, {"a": 1, "b": None}],
    }
    assert key_line(found) == "joints.<joint>.{lag_s: interval, warnings[]}, rows[].{a, b}"
