"""Which P gain, armature and load a calibration is for, and that its files say so."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.sim.export.export import exported_text
from pupper_sysid.sim.export.targets import TARGETS
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.fit.operating_point import reference_gain, with_operating_points
from pupper_sysid.sysid.fit.preparation import scales_of
from pupper_sysid.sysid.fit.run import prepare
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad, ServoSetup
from pupper_sysid.sysid.report.tables import tidy_table

NAN = float("nan")
POINT = "P gain 32 (the servo's own by the recording's header)"


def trial(gain: float = NAN, **header) -> Trial:
    """A trial at a P gain, with what its header says of the servo."""
    still = np.zeros(3)
    return Trial("knee", 0, NAN, still, still, still, still, None, 0.0, p_gain=gain,
                 servo=ServoSetup(**header))  # fmt: skip


def test_the_reference_is_the_gain_that_the_header_states_whatever_was_recorded_beside_it():
    runs = [trial(g, p_gain=32, model="STS3215") for g in (8.0, 8.0, 8.0, 16.0)]
    for count in range(1, 5):
        for some in itertools.permutations(runs, count):
            gain = reference_gain(some)
            assert gain.value == 32.0 and not gain.assumed


def test_without_a_header_it_is_the_gain_that_all_runs_share():
    assert reference_gain([trial(16.0), trial(16.0, model="STS3215")]).value == 16.0


def test_else_the_factory_setting_of_the_named_servo_and_else_the_largest():
    named = reference_gain([trial(8.0, model="STS3215"), trial(16.0, model="STS3215")])
    assert named.value == 32.0 and named.assumed and "factory" in named.source
    differing = [trial(g, p_gain=g, model="xl330") for g in (100.0, 200.0, 800.0)]
    assert reference_gain(differing).value == 400.0
    plain = reference_gain([trial(8.0), trial(16.0), trial(12.0)])
    assert plain.value == 16.0 and plain.assumed and "largest" in plain.source
    assert reference_gain([trial()]).value is None


@pytest.mark.parametrize("counts", [(1, 9), (9, 1), (5, 5)])
def test_how_many_runs_came_at_each_gain_does_not_move_the_reference(counts):
    few, many = counts
    assert reference_gain([*few * [trial(8.0)], *many * [trial(16.0)]]).value == 16.0


def calibration():
    """A card as the calibration of a bench: known load, header at P 32, runs at P 16."""
    card = load_card("sts3215-bam-m1").calibration()
    load = PendulumLoad(mass_kg=0.1, length_m=0.12)
    runs = [replace(trial(16.0, p_gain=32), load=load)]
    made = card.model_copy(update={"joints": {"knee": card.joint("knee")}})
    return with_operating_points(made, {"knee": runs})


@pytest.mark.parametrize("target", TARGETS)
def test_every_export_states_gain_armature_and_load(target):
    text = " ".join(exported_text(calibration(), target, 0.002)[0].split())
    for words in (POINT, "without link and load", "0.1 kg at 0.12 m"):
        assert words in text or words.replace("'", "\\'") in text, words


def test_the_table_the_file_and_a_card_state_them_too(tmp_path):
    made = calibration()
    assert "0.1 kg at 0.12 m" in tidy_table(made)
    made.save(tmp_path / "a.yaml")
    point = load_calibration(tmp_path / "a.yaml").joint("knee").holds_at
    assert (point.p_gain, point.armature, point.load) == (32.0, "servo", "0.1 kg at 0.12 m")
    card = load_card("sts3215-12v").calibration().joint("elbow").holds_at
    assert card.p_gain == 16.0 and card.armature == "servo and load"


def test_in_free_air_the_gain_is_that_of_the_runs_and_the_armature_holds_the_link():
    made = calibration()
    joint = made.joint("knee").model_copy(update={"servo": None})
    made = made.model_copy(update={"joints": {"knee": joint}})
    made = with_operating_points(made, {"knee": [trial(16.0, p_gain=32)]})
    point = made.joint("knee").holds_at
    assert point.p_gain == 16.0 and point.armature == "servo and load"
    assert "counts their inertia twice" in " ".join(exported_text(made, "mjcf", 0.002)[0].split())


def test_a_gain_that_was_assumed_is_noted():
    made = with_operating_points(calibration(), {"knee": [trial(8.0), trial(16.0)]})
    assert any("P 8, 16" in note and "for P 16" in note for note in made.notes)


def test_another_gain_is_said_to_be_a_prediction():
    point = calibration().at_p_gain(8.0).joint("knee").holds_at
    assert point.p_gain == 8.0 and "predicted from 32" in point.p_gain_source


def test_a_run_whose_torque_is_always_on_tells_nothing_of_braking_with_the_torque_off():
    time = 0.2 + np.array([0.010017 * n for n in range(200)])
    position = 0.3 * np.sin(7 * time)
    on = np.ones(len(time), bool)
    own = Trial("knee", 0, NAN, time, time + 5e-4, position, position, None, 0.0, readings="live",
                p_gain=16.0, torque_enabled=on)  # fmt: skip
    for trials, off in (((own,), False), ((replace(own, torque_enabled=time < 1.5),), True)):
        lattice = find_poll_lattice(trials, np.random.default_rng(0))
        assert scales_of(trials, [prepare(t, lattice) for t in trials]).torque_off is off
