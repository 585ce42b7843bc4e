"""A load that the header claims is checked against the weight that the recording shows."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.loaded_servo import Load, LoadedServo, LoadedServoParameters
from pupper_sysid.sysid.fit.preparation import prepare_joint
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad, ServoSetup
from support.real_recordings import real_folder

STS3215 = LoadedServoParameters(
    duty_per_rad=0.17, duty_s_per_rad=0.0, stall_torque=1.8, back_emf=0.33, armature=0.013,
    friction_loss=0.05, dead_time_s=0.012,
)  # fmt: skip
WEAK = replace(STS3215, stall_torque=0.5, back_emf=0.06, armature=0.002, friction_loss=0.02)
STEP_S, LOOP_S, COUNT_RAD = 0.002, 0.01, 2 * np.pi / 4096
PENDULUM = PendulumLoad(mass_kg=0.2, length_m=0.12)


def trials(
    servo: LoadedServoParameters, there: PendulumLoad | None, claimed: PendulumLoad,
    motion: str = "steps", rows: int = 400, **setup,
) -> tuple[Trial, ...]:  # fmt: skip
    """Runs at P 16 and 32 of a servo with one load, whose header claims another."""
    made = []
    for number, gain in enumerate((16.0, 32.0)):
        rng = np.random.default_rng(number)
        time = LOOP_S * np.arange(rows)
        command = np.repeat(rng.uniform(-1, 1, rows // 40), 40)
        if motion == "chirp":
            command = 0.9 * np.sin(1.2 * time**2)
        load = Load(there.inertia_kg_m2, there.gravity_nm, 0.0) if there else Load()
        model = LoadedServo(servo, gain, load, STEP_S)
        model.reset(0.0)
        per = round(LOOP_S / STEP_S)
        moved = np.concatenate([[0.0], model.rollout(np.repeat(command, per))])[1::per]
        reading = COUNT_RAD * np.round(moved[: len(time)] / COUNT_RAD)
        made.append(
            Trial("knee", number, np.nan, time, time + STEP_S, command, reading, None, 0.0,
                  readings="live", p_gain=gain, servo=ServoSetup(**setup), load=claimed)
        )  # fmt: skip
    return tuple(made)


def notes_of(recorded: tuple[Trial, ...]) -> tuple[str, ...]:
    """Notes of the check, without the fit behind it."""
    return prepare_joint("knee", recorded, 0).load_notes


SERVOS = {"STS3215": STS3215, "weak": WEAK}


def servos_and_motions(quick: tuple[str, str]):
    """Cases of both servos and both motions, one of them quick."""
    cases = [(servo, motion) for servo in SERVOS for motion in ("steps", "chirp")]
    return pytest.mark.parametrize(
        ("servo", "motion"),
        [c if c == quick else pytest.param(*c, marks=pytest.mark.slow) for c in cases],
    )


@servos_and_motions(("STS3215", "steps"))
def test_a_pendulum_that_is_not_there_is_refused_in_a_sentence(servo, motion):
    with pytest.raises(InputError) as refused:
        notes_of(trials(SERVOS[servo], None, PENDULUM, motion, rows=200))
    for words in ("knee", "0.2 kg at 0.12 m", "shows none", "Take `loads` out"):
        assert words in str(refused.value)


@servos_and_motions(("weak", "chirp"))
def test_a_pendulum_that_is_there_is_accepted_without_a_note(servo, motion):
    assert notes_of(trials(SERVOS[servo], PENDULUM, PENDULUM, motion)) == ()


def test_a_load_whose_weight_is_a_fraction_of_the_friction_is_not_refused():
    tiny = PendulumLoad(mass_kg=0.02, length_m=0.05)
    assert tiny.gravity_nm < STS3215.friction_loss / 5
    notes = notes_of(trials(STS3215, tiny, tiny, model="STS3215"))
    assert len(notes) <= 1 and all("neither shows" in note for note in notes)


def claiming(factor: float) -> tuple[Trial, ...]:
    """Runs of a named servo whose header claims a multiple of the mass."""
    claimed = PENDULUM.model_copy(update={"mass_kg": factor * PENDULUM.mass_kg})
    return trials(STS3215, PENDULUM, claimed, model="STS3215", supply_voltage_v=7.4)


@pytest.mark.slow
def test_a_load_of_ten_times_the_claim_is_noted_where_the_servo_is_named():
    (note,) = notes_of(claiming(0.1))
    assert "too small" in note and "stall torque" in note


@pytest.mark.slow
def test_a_load_of_a_tenth_of_the_claim_is_refused_where_the_servo_is_named():
    with pytest.raises(InputError, match=r"2 kg at 0\.12 m.*is not there.*at most \d+ %"):
        notes_of(claiming(10.0))


@pytest.mark.slow
@pytest.mark.parametrize("gain", [100, 800])
def test_a_real_pendulum_is_accepted(gain):
    from pupper_sysid.sysid.recordings.files import load

    files = sorted(real_folder("bam_xl330").glob("*.json"))
    every = [load(path) for path in files]
    recorded = [t for r in every for t in r.trials(r.joints[0]) if t.p_gain == gain]
    assert recorded and notes_of(tuple(recorded)) == ()
