"""The keys of JSON objects are those of docs/formats.md."""

from __future__ import annotations

import json

from support.command_line import run
from support.json_keys import DOCUMENTED, key_line
from support.package import ROOT

SAMPLE = ROOT / "data/samples/sweep.csv"
HIP = object()  # the fixture of that name
COMMANDS = {
    "sweep": ("--freqs", "4", "--joints", "LF_hip"),
    "plan": (SAMPLE.with_name("calibrated.yaml"), "--joints", "LF_hip"),
    "import": (HIP,),
    "export": ("paper", "--to", "csv"),
    "compare": (HIP, "--models", "paper"),
}


def test_keys_of_an_object_are_the_documented_ones(capsys, tmp_path, monkeypatch, hip):
    monkeypatch.chdir(tmp_path)
    for command, words in COMMANDS.items():
        words = [hip if word is HIP else word for word in words]
        code, out, err = run(capsys, command, *words, "--json")
        assert code == 0, f"{command}: {err}"
        assert key_line(json.loads(out)) == DOCUMENTED[command], command


def test_an_objects_keys_in_one_line():
    found = {
        "joints": {"LF_hip": {"lag_s": {"value": 1, "low": 0, "high": 2}, "warnings": []}},
        "rows": [{"a": 1}, {"a": 1, "b": None}],
    }
    assert key_line(found) == "joints.<joint>.{lag_s: interval, warnings[]}, rows[].{a, b}"
