"""A servo under load is found from runs of several gains, and predicts one it has not seen."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.calibration.parts import FittedServo, RecordedLoad
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.loaded_servo import Load, LoadedServo, LoadedServoParameters
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.fit.joint_fit import numbers_of
from pupper_sysid.sysid.fit.structure import Scales, servo_structure
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.report import report
from pupper_sysid.sysid.report.figures import tracks
from pupper_sysid.sysid.servo_fit.fit import fit_servo
from pupper_sysid.sysid.servo_fit.scores import LINEAR
from support.servo_recordings import trial
from support.undrawn import leave_undrawn

MASS_KG, LENGTH_M = 0.4, 0.12
TRUE = LoadedServoParameters(
    duty_per_rad=0.06, duty_s_per_rad=0.0, stall_torque=2.0, back_emf=0.28, armature=0.012,
    friction_loss=0.08, dead_time_s=0.014, off_brake=0.3,
)  # fmt: skip
STEP_S, LOOP_S = 0.0002, 0.01
READ_S = 0.002  # after its command


@cache
def recording(gain: float, seed: int = 0, steps: int = 300) -> Recording:
    """Random steps, then a drop, of the true servo; rows every 10 ms, readings in counts."""
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(-0.9, 0.9, steps // 30), 30)
    on = np.ones(steps)
    on[-60:] = 0.0
    load = Load(MASS_KG * LENGTH_M**2, MASS_KG * 9.81 * LENGTH_M, 0.0)
    servo = LoadedServo(TRUE, gain, load, STEP_S)
    servo.reset(0.0)
    per = round(LOOP_S / STEP_S)
    moved = servo.rollout(np.repeat(command, per), np.repeat(on, per))
    position = np.concatenate([[0.0], moved])[round(READ_S / STEP_S) :: per][:steps]
    count = 2 * np.pi / 4096
    table = trial(
        0, 0.0, command, np.round(position / count) * count, joint="knee", period_s=LOOP_S,
        read_after_s=READ_S,
    ).assign(torque_enabled=on)  # fmt: skip
    header = {
        "readings": "live", "joints": ["knee"], "start_pose_rad": {"knee": 0.0},
        "servos": {"knee": {"p_gain": gain}},
        "loads": {"knee": {"mass_kg": MASS_KG, "length_m": LENGTH_M}},
    }  # fmt: skip
    return Recording.from_frame(table, metadata=header, name=f"p{gain:g}")


def calibration(gains: tuple[float, ...] = (8.0, 32.0)) -> Calibration:
    """The true servo as a calibration file carries it."""

    def known(value: float) -> Quantity:
        return Quantity(value=value, low=value, high=value, identified="yes")

    preset = load_calibration("release")
    joint = next(iter(preset.joints.values()))
    pd_ = TRUE.delayed_pd(16.0).arrays()
    actuator = joint.actuator.model_copy(
        update={
            "stiffness_nm_per_rad": known(float(pd_["stiffness"])),
            "damping_nm_s_per_rad": known(0.0),
            "friction_loss_nm": known(0.08),
            "armature_kg_m2": known(0.012),
            "effort_limit_nm": known(2.0),
            "back_emf_nm_s_per_rad": known(0.28),
            "velocity_limit_rad_s": known(1000.0),
            "dead_time_s": known(0.014),
            "numbers_in": "continuous time",
        }
    )
    block = FittedServo(
        structure="base", known_load=True, p_gain=16.0, p_gains_tested=gains,
        loads_tested=(RecordedLoad(inertia_kg_m2=0.006, gravity_nm=0.47),),
        duty_per_rad=known(0.06), stall_torque_nm=known(2.0), back_emf_nm_s_per_rad=known(0.28),
        armature_kg_m2=known(0.012), friction_loss_nm=known(0.08), off_brake=known(0.3),
    )  # fmt: skip
    own = joint.model_copy(update={"actuator": actuator, "servo": block})
    return preset.model_copy(update={"joints": {"knee": own}})


def test_a_known_load_gives_numbers_in_newton_metres_and_left_out_runs_have_errors_of_their_own(
    tmp_path, monkeypatch
):
    def short(whole: Recording) -> Recording:
        return replace(whole, table=whole.table[whole.table.send_time_s < 1.5])

    recordings = [short(recording(8.0)), short(recording(32.0, 3))]
    fit = calibrate(recordings)
    result, joint = fit["knee"], fit.calibration.joint("knee")
    block = joint.servo
    assert block is not None
    for quantity, truth in (
        (block.stall_torque_nm, TRUE.stall_torque), (block.armature_kg_m2, TRUE.armature),
        (block.friction_loss_nm, TRUE.friction_loss), (block.back_emf_nm_s_per_rad, TRUE.back_emf),
    ):  # fmt: skip
        assert quantity.value == pytest.approx(truth, rel=0.05)
        assert quantity.low <= truth <= quantity.high
    dead_time = joint.actuator.dead_time_s
    assert dead_time.value == pytest.approx(TRUE.dead_time_s, abs=1e-3)
    assert dead_time.low <= TRUE.dead_time_s <= dead_time.high
    scores = result.delayed_pd.scores
    assert joint.scores.rmse_leave_one_frequency_out_rad is None
    assert np.isnan(scores.rmse_leave_one_frequency_out_rad)
    unseen = joint.scores.rmse_unseen_runs_rad
    assert unseen == scores.rmse_unseen_runs_rad == scores.rmse_unseen_rad
    models = {m.model: m for m in joint.selection.candidate_models}
    assert all(m.rmse_leave_one_frequency_out_rad is None for m in models.values())
    # the chosen structure's mean absolute error is below its RMS error on the same rows
    mean = models[joint.selection.model].mae_unseen_runs_rad
    assert mean is not None and unseen is not None and mean < unseen
    # a report draws the servo that was scored, and knows the scale of its torques
    errors = np.concatenate([track.fresh_error_rad for track in tracks(result)])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(scores.rmse_fresh_rad)
    monkeypatch.setattr(report, "calibrate", lambda *_, **__: fit)
    leave_undrawn(monkeypatch)
    page = report.write_report(recordings, tmp_path, calibration=fit.calibration).path.read_text()
    assert "from the known load" in page and "assumed stall torque" not in page


def test_a_calibration_predicts_a_gain_it_has_not_seen_and_one_of_a_single_gain_does_not(
    tmp_path: Path,
):
    known = calibration()
    alone = known.model_copy(
        update={"joints": {"knee": known.joint("knee").model_copy(update={"servo": None})}}
    )
    known.save(tmp_path / "any.yaml")
    alone.save(tmp_path / "one.yaml")
    found = compare(recording(24.0, 1), [tmp_path / "any.yaml", tmp_path / "one.yaml"], "knee")
    label = "servo under load (any.yaml)"
    assert list(found.models) == [label, "DelayedPD (one.yaml)", LINEAR]
    plain = found.to_dict()["models"][label]
    for part in (plain["mean"], plain["joints"]["knee"]):
        for name in ("mae_raw_rad", "mae_held_rad", "rmse_raw_rad", "rmse_held_rad"):
            assert part[name] < 1.5e-3, name  # a count is 1.5 mrad
    assert (
        plain["mean"]["mae_raw_rad"] < 0.1 * found.models["DelayedPD (one.yaml)"].mean.mae_raw_rad
    )
    assert any("lies between recorded gains, 8 and 32" in note for note in found.notes)


def test_a_network_stands_beside_a_servo_under_load_on_the_same_rows(tmp_path: Path):
    calibration().save(tmp_path / "knee.yaml")
    seen = [recording(16.0, 4), recording(16.0, 5)]
    fit_servo(seen, "knee", arch="fir").save(tmp_path / "fir")
    unseen = recording(16.0, 6)
    found = compare(unseen, [tmp_path / "knee.yaml", tmp_path / "fir"], "knee")
    physical, learned, linear = found.models.values()
    assert any("fir" in label.lower() for label in found.models)
    # the linear filter is fitted to other stretches of the same run, behind gaps
    rows = [len(m.errors["knee"].raw) for m in (physical, learned, linear)]
    assert rows[0] == rows[1] > rows[2]
    assert physical.mean.mae_raw_rad < 0.2 * learned.mean.mae_raw_rad, "it knows of the drop"
    assert any("neither the load nor the P gain" in note for note in found.notes)
    again = compare([unseen, seen[0]], [tmp_path / "fir"], "knee")
    assert any("too small" in note for note in again.notes)


def test_runs_of_several_rates_have_no_linear_filter_and_a_note_says_why(tmp_path: Path):
    calibration().save(tmp_path / "knee.yaml")
    slow = recording(16.0, 2)
    table = slow.table.assign(
        send_time_s=1.5 * slow.table["send_time_s"], read_time_s=1.5 * slow.table["read_time_s"]
    )
    slow = Recording.from_frame(table, metadata=slow.metadata, name="slow")
    found = compare([recording(16.0, 1), slow], [tmp_path / "knee.yaml"], "knee")
    assert LINEAR not in found.models
    assert any("No linear filter" in n and "different rates" in n for n in found.notes)


def test_the_file_keeps_the_servo_under_load(tmp_path: Path):
    calibration().save(tmp_path / "knee.yaml")
    read = load_calibration(tmp_path / "knee.yaml").joint("knee")
    assert read.servo is not None
    assert read.servo.parameters(0.014) == TRUE
    at_32 = read.at_p_gain(32.0)
    assert at_32.actuator.stiffness_nm_per_rad.value == pytest.approx(0.06 * 32 * 2.0)
    assert at_32.servo is not None and at_32.servo.p_gain == 32.0
    low, high = read.actuator.stiffness_nm_per_rad.low, at_32.actuator.stiffness_nm_per_rad.low
    assert high / low == pytest.approx(32.0 / read.servo.p_gain)
    with pytest.raises(InputError, match="p_gain"):
        read.at_p_gain(0.0)


def test_the_effort_limit_is_the_smaller_of_stall_torque_and_torque_limit():
    structure = servo_structure(("back-EMF", "torque limit"), Scales(free_air=False))
    values = structure.decode(np.mean(structure.box, axis=0)[None])
    share = structure.names.index("torque_limit_share")
    numbers = numbers_of(structure, values)
    assert numbers["effort_limit"] == pytest.approx(values[0, share] * numbers["stall_torque"])
