"""Fits under load as servo cards: what sets the scale of torques, and what stays open."""

from __future__ import annotations

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.servo_models.cards.card import Source
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.cards.numbers import LoadedLoop, TorquePD
from pupper_sysid.servo_models.loaded_servo import LoadedServoParameters
from pupper_sysid.sysid.export.servo_card import to_card, to_drive_card
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.fit.joint_fit import LoadedFit, StructureFit
from pupper_sysid.sysid.recordings.recording import Recording

SOURCE = Source(title="a bench", url="https://example.org/bench", licence="MIT")
PER_INERTIA = {
    "dead_time_s": 0.01, "duty_per_rad": 0.2, "stall_torque": 100.0, "back_emf": 25.0,
    "friction_loss": 4.0, "stiffness_nm_per_rad": 320.0, "no_load_speed_rad_s": 4.0,
}  # fmt: skip


def fit() -> LoadedFit:
    """A joint whose load is unknown: torques per inertia, intervals of ±10 %."""
    time = 0.02 * np.arange(40)
    recording = Recording.from_arrays(
        time, {"j": np.sin(time)}, {"j": np.sin(time)}, metadata={"readings": "live"}
    )
    lattice = find_poll_lattice(recording.trials("j"), np.random.default_rng(0))
    names = ("duty_per_rad", "stall_torque", "back_emf", "friction_loss", "dead_time_s")
    servo = LoadedServoParameters(
        duty_s_per_rad=0.0, armature=1.0, **{n: PER_INERTIA[n] for n in names}
    )
    return LoadedFit(
        joint="j", structure="base", known_load=False, p_gain=16.0, p_gains=(16.0,),
        loads=((0.0, 0.0),), reference_voltage_v=float("nan"),
        numbers={n: Interval(v, 0.9 * v, 1.1 * v) for n, v in PER_INERTIA.items()},
        undecided={"friction_loss": "it cannot be distinguished from none"},
        structures=(StructureFit(
            name="base", parameters={}, mae_rad=0.002, rmse_rad=0.003,
            mae_unseen_rad=float("nan"), nats=0.0,
        ),),
        folds=(), mae_by_run_rad={}, motor_torque_nm=1.0, temperature=1.0, lattice=lattice,
        servo=servo, runs=(),
    )  # fmt: skip


def test_the_stall_torque_of_the_data_sheet_sets_the_scale_where_the_load_is_unknown():
    card = to_card("mine", "Feetech STS3215", {"j": fit()}, [], SOURCE, "an arm", supply_v=12.0)
    numbers = card.numbers
    assert isinstance(numbers, LoadedLoop)
    stall = 30 * 0.0980665  # kg·cm of its data sheet
    assert numbers.stall_torque_nm.value == pytest.approx(stall)
    # torques are per inertia in the fit, so the inertia is the scale
    assert numbers.armature_kg_m2.value == pytest.approx(stall / 100.0)
    assert numbers.armature_kg_m2.identified == "no"
    assert numbers.back_emf_nm_s_per_rad.value == pytest.approx(25.0 * stall / 100.0)
    assert numbers.duty_per_rad.value == 0.2  # no torque: no scale
    assert card.gains.p == 16.0 and not card.published


def test_gains_in_newton_metres_set_the_scale_of_a_drive(tmp_path):
    card = to_drive_card(
        "drive", "RobStride 04", {"j": fit()}, {"j": (150.0, 60.0)}, [], SOURCE, "a leg"
    )
    numbers = card.numbers
    assert isinstance(numbers, TorquePD)
    assert numbers.stiffness_nm_per_rad.value == 150.0
    assert numbers.armature_kg_m2.value == pytest.approx(150.0 / 320.0)
    damping = numbers.damping_nm_s_per_rad
    assert damping is not None and damping.value == pytest.approx(25.0 * 150.0 / 320.0)
    assert damping.low == pytest.approx(0.9 * damping.value) and damping.identified == "yes"
    assert numbers.friction_loss_nm.why == "it cannot be distinguished from none"
    assert numbers.effort_limit_nm.value == 60.0 and numbers.effort_limit_nm.identified == "no"


def test_a_card_without_a_fit_or_a_voltage_is_refused():
    with pytest.raises(InputError, match="needs a fit"):
        to_card("mine", "Feetech STS3215", {}, [], SOURCE, "an arm")
    with pytest.raises(InputError, match="no supply voltage"):
        to_card("mine", "Feetech STS3215", {"j": fit()}, [], SOURCE, "an arm")


def test_the_drives_measured_damping_agrees_with_the_gain_that_was_set():
    for name in ("robstride-02", "robstride-03", "robstride-04"):
        card = load_card(name)
        for specimen, numbers in card.specimens.items():
            (note,) = (n for n in card.notes if n.startswith(f"{specimen}:"))
            set_gain = float(note.split("D gain ")[1].split()[0])
            assert isinstance(numbers, TorquePD) and numbers.damping_nm_s_per_rad is not None
            assert numbers.damping_nm_s_per_rad.value == pytest.approx(set_gain, rel=0.25)
