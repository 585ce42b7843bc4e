"""How many files an addition touches, as `docs/contributing.md` says.

Each test makes its new module and edits the one table that a developer would, and uses it through
the command: whatever else had to be edited would fail here.
"""

import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError

from pupper_sysid.hardware.address import KINDS, BusKind
from pupper_sysid.policies.network.policy_file import joints_of
from pupper_sysid.servo_models.calibration.parts import PARAMETER_KEYS
from pupper_sysid.servo_models.delayed_pd import TORQUES, DelayedPDParameters
from pupper_sysid.sim.export.targets import TARGETS, Target
from pupper_sysid.sim.walking.servo_ranges import IDEAL, servo_ranges
from pupper_sysid.sysid.recordings.importers import columns
from pupper_sysid.sysid.recordings.importers.columns import COMMAND, STATE, WORDS
from support.command_line import json_of, ran
from support.following_bus import FollowingBus

PROJECT = Path(__file__).parents[1]


def new_module(monkeypatch, name: str, **content) -> None:
    """A module of the package that is on no disk."""
    module = ModuleType(f"pupper_sysid.{name}")
    vars(module).update(content)
    monkeypatch.setitem(sys.modules, module.__name__, module)


def test_an_export_target_is_a_module_and_an_entry(capsys, monkeypatch, here):
    new_module(
        monkeypatch, "sim.export.gazebo",
        to_gazebo=lambda servos: f"<servos>{' '.join(servos.calibration.joint_names)}</servos>",
    )  # fmt: skip
    monkeypatch.setitem(TARGETS, "gazebo", Target("gazebo", "gazebo", "to_gazebo", ".sdf"))
    # as in a new process: the command's choices are those of the table
    monkeypatch.delitem(sys.modules, "pupper_sysid.cli.commands.export", raising=False)
    assert "gazebo" in ran(capsys, "export", "--help")[0]
    ran(capsys, "export", "paper", "--to", "gazebo")
    assert Path("paper.sdf").read_text().startswith("<servos>LF_hip")


def test_a_bus_is_a_module_and_an_entry(capsys, monkeypatch):
    opened: list[FollowingBus] = []

    class Rope(FollowingBus):
        name = "rope"

        @classmethod
        def open_address(cls, address, joint_map, joints, exclusive):
            opened.append(cls())
            return opened[-1]

        @classmethod
        def limp_address(cls, address, ids):
            pass

    new_module(monkeypatch, "hardware.rope", RopeBus=Rope)
    kind = BusKind("rope", "Servos on a rope", "hardware.rope", "RopeBus", "/tmp/rope")
    monkeypatch.setitem(KINDS, "rope", kind)
    found = json_of(capsys, "monitor", "--bus", "rope")
    assert [joint["position_rad"] for joint in found["joints"]] == [0.0]
    ran(capsys, "park", "--bus", "rope")
    assert opened[-1].log == ["torque False", "close"]


def test_a_log_in_other_words_is_words_of_one_table(capsys, monkeypatch, here):
    monkeypatch.setitem(WORDS, "beordret", COMMAND)
    monkeypatch.setitem(WORDS, "faktisk", STATE)
    time_s = 0.02 * np.arange(200)
    positions = {
        f"knee_{word}_rad": 0.4 * np.sin(2 * np.pi * (time_s - late_s))
        for word, late_s in (("beordret", 0.0), ("faktisk", 0.06))
    }
    pd.DataFrame({"time_s": time_s} | positions).to_csv("arm.csv", index=False)
    try:
        assert json_of(capsys, "doctor", "arm.csv")["joints"].keys() == {"knee"}
    finally:
        for known in (columns._column, columns._compound):  # of names with these words
            known.cache_clear()


def test_a_term_of_the_servo_that_simulators_run_is_listed_in_two_tables(monkeypatch):
    """Draws, policies and exports take the terms from `TORQUES` and `PARAMETER_KEYS`.

    The third file is `sim/robot/servo_mjcf.py`, which writes the term into MuJoCo's model.
    """
    terms = {field.name for field in fields(DelayedPDParameters)}
    assert terms == set(PARAMETER_KEYS) and set(TORQUES) < terms
    lists = re.compile(r'"friction_loss",\s*"effort_limit",\s*"back_emf"')
    rooms = ("servo_models", "sim", "policies", "sysid", "cli")
    sources = [p for room in rooms for p in (PROJECT / room).rglob("*.py")]
    assert [p.name for p in sources if lists.search(p.read_text())] == ["delayed_pd.py"]
    # a policy's file keeps a term that older ones lack, and refuses what is none
    servos = servo_ranges(IDEAL)
    spring = {"spring": np.full(len(servos.joints), 0.5)}
    low, value, high = (n | spring for n in (servos.low, servos.value, servos.high))
    servos = replace(servos, low=low, value=value, high=high)
    with pytest.raises(ValidationError, match="spring is no number of a servo"):
        joints_of(servos)
    monkeypatch.setitem(PARAMETER_KEYS, "spring", "spring_nm_per_rad")
    assert joints_of(servos)["LF_hip"].model_dump()["spring"]["value"] == 0.5
