"""Runs with the torque off, scored on models that were never fitted to any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sysid.fit.predict import ComparedRun, notes
from pupper_sysid.sysid.recordings.recording import Trial
from support.runs import PAD, run_of


def bench(off_steps: int) -> ComparedRun:
    """A run of 1 s whose torque is off at its end."""
    held = np.ones((3, PAD + 500))
    held[1, len(held[1]) - off_steps :] = 0.0
    nothing = np.zeros(1)
    trial = Trial("knee", 0, np.nan, nothing, nothing, nothing, nothing, None, 0.0, p_gain=400.0)
    run = replace(run_of(np.zeros(500)), held=held, p_gain=400.0)
    return ComparedRun(trial, run, 0, False)


def model(off_brake: bool):
    """A calibration under load that knows how the servo brakes with the torque off, or not."""
    made = load_card("xl330-m288").calibration()
    joint = made.joint("knee")
    assert joint.under_load is not None and joint.under_load.off_brake is not None
    if not off_brake:
        block = joint.under_load.model_copy(update={"off_brake": None})
        joint = joint.model_copy(update={"under_load": block})
    return made.model_copy(update={"joints": {"knee": joint}})


@pytest.mark.parametrize(
    ("off_steps", "known", "count"), [(100, False, 1), (100, True, 0), (0, False, 0)]
)
def test_a_run_with_the_torque_off_is_noted_where_braking_then_is_unknown(off_steps, known, count):
    runs = {"knee": [bench(off_steps), bench(0)]}
    made = [n for n in notes({"a.yaml": model(known)}, runs) if "torque is off" in n]
    assert len(made) == count
    assert all("off for 0.2 s" in note and "`off_brake`" in note for note in made)


def test_a_model_in_torque_has_no_such_number_and_the_comparison_says_so():
    runs = {"knee": [bench(100)]}
    fixed = load_card("sts3215-soarm100").calibration()
    assert any("`off_brake`" in note for note in notes({"card": fixed}, runs))
