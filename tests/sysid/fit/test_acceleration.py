"""A limit on the set-point's acceleration is found in the recordings that have it."""

import numpy as np
import pytest

from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.cards.numbers import LoadedLoop, stated
from pupper_sysid.servo_models.loaded_servo import LoadedServo, LoadedServoParameters
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.doctor.checks import usable_trials
from pupper_sysid.sysid.fit import choice
from pupper_sysid.sysid.fit.calibrate import calibrate, lag
from pupper_sysid.sysid.fit.choice import Fitted
from pupper_sysid.sysid.fit.preparation import prepare_joint
from pupper_sysid.sysid.fit.search import Fit
from pupper_sysid.sysid.fit.structure import servo_structure
from pupper_sysid.sysid.recordings.recording import Recording

LIMIT_RAD_S2, STEP_S, LOOP_S, ROWS = 40.0, 0.0004, 0.02, 450
JUMPS, CHIRP = "jumps", "chirp"


def random_servo(limit: float, seed: int) -> LoadedServoParameters:
    """A servo with friction that the fitted structure lacks."""
    rng = np.random.default_rng(seed)
    return LoadedServoParameters(
        duty_per_rad=rng.uniform(0.1, 0.4), duty_s_per_rad=0.0, stall_torque=rng.uniform(2.4, 5),
        back_emf=rng.uniform(0.6, 1.0), armature=0.02, friction_loss=rng.uniform(0.04, 0.12),
        dead_time_s=rng.uniform(0.004, 0.02), stribeck_friction=rng.uniform(0.02, 0.08),
        acceleration_limit=limit,
    )  # fmt: skip


def recording(
    motion: str, limit: float, seed: int = 0, registers: dict[str, int] | None = None
) -> Recording:
    """What a random servo does, in counts; no load is stated."""
    time = LOOP_S * np.arange(ROWS)
    if motion == CHIRP:
        command = 0.1 * np.sin(2 * np.pi * np.cumsum(np.linspace(0.2, 3.2, ROWS)) * LOOP_S)
    else:
        rng = np.random.default_rng(seed)
        command = np.repeat(rng.choice([-0.12, 0.12], ROWS // 30), 30)
    servo = LoadedServo(random_servo(limit, seed), 16.0, time_step_s=STEP_S)
    servo.reset(command[0])
    per = round(LOOP_S / STEP_S)
    moved = servo.rollout(np.repeat(command, per))[per - 6 :: per]
    count = 2 * np.pi / 4096
    setup = {"p_gain": 16.0, "registers": registers or {}}
    header = {
        "readings": "live", "joints": ["j"], "start_pose_rad": {"j": float(command[0])},
        "servos": {"j": setup},
    }  # fmt: skip
    return Recording.from_arrays(
        time, {"j": command}, {"j": np.round(moved / count) * count},
        read_time_s=time + LOOP_S - 5 * STEP_S, metadata=header, name=motion,
    )  # fmt: skip


@pytest.mark.slow
def test_a_limit_of_the_servo_is_found_in_fast_motion():
    fit = calibrate([recording(CHIRP, LIMIT_RAD_S2, 2), recording(JUMPS, LIMIT_RAD_S2, 2)])
    limit = fit.calibration.joint("j").servo.acceleration_limit_rad_s2
    assert limit.identified == "yes" and limit.value == pytest.approx(LIMIT_RAD_S2, rel=0.05)
    assert limit.low <= LIMIT_RAD_S2 <= limit.high


@pytest.mark.slow
def test_no_limit_is_found_where_there_is_none():
    block = calibrate([recording(CHIRP, np.inf, 3), recording(JUMPS, np.inf, 3)])
    block = block.calibration.joint("j").servo
    assert block is None or block.acceleration_limit_rad_s2 is None


def test_a_model_with_a_limit_predicts_with_it_unless_the_header_says_otherwise(tmp_path):
    servo = random_servo(LIMIT_RAD_S2, 6).arrays()
    numbers = LoadedLoop(
        model="loaded_servo", duty_per_rad=stated(float(servo["duty_per_rad"])),
        stall_torque_nm=stated(float(servo["stall_torque"])),
        back_emf_nm_s_per_rad=stated(float(servo["back_emf"])), armature_kg_m2=stated(0.02),
        friction_loss_nm=stated(float(servo["friction_loss"])),
        stribeck_friction_nm=stated(float(servo["stribeck_friction"])),
        stribeck_speed_rad_s=stated(0.1), dead_time_s=stated(float(servo["dead_time_s"])),
        acceleration_limit_rad_s2=stated(LIMIT_RAD_S2),
    )  # fmt: skip
    card = load_card("xl330-m288").model_copy(update={"specimens": {"servo": numbers}})
    card.save(tmp_path / "servo.yaml")

    def error(*recordings: Recording) -> float:
        found = compare(recordings, [tmp_path / "servo.yaml"], "j")
        (model,) = (m for name, m in found.models.items() if "servo.yaml" in name)
        return model.mean.rmse_raw_rad

    assert error(recording(CHIRP, LIMIT_RAD_S2, 6)) < 1.5e-3  # a count
    free = recording(JUMPS, np.inf, 6)
    assert error(free) > 10e-3, "readings choose no limit for the model that they score"
    assert error(recording(JUMPS, np.inf, 6, {"acceleration": 0})) < 1.5e-3


def a_fit(features: tuple[str, ...], cost: float) -> Fitted:
    structure = servo_structure(features)
    return Fitted(structure, Fit(structure.prior[0], cost))


def test_the_likelihood_decides_between_structures_of_as_many_parameters():
    """Errors on unseen motion scatter by more over searches; they decide on further parameters."""
    slew, back_emf = a_fit(("slew",), 10.0), a_fit(("back-EMF",), 14.0)
    more = a_fit(("slew", "backlash"), 9.0)
    names = [f.structure.name for f in (slew, back_emf, more)]
    nats = dict(zip(names, (0.0, 4.0, 0.5), strict=True))
    for unseen, wanted in (
        ((0.017, 0.016, 0.017), slew), ((0.017, 0.016, 0.010), more),
        ((np.nan, np.nan, np.nan), slew),
    ):  # fmt: skip
        errors = dict(zip(names, unseen, strict=True))
        assert choice.simplest((more, back_emf, slew), nats, errors) is wanted


@pytest.mark.slow
@pytest.mark.parametrize("limit", [LIMIT_RAD_S2, np.inf])
def test_a_profile_competes_in_free_air_before_a_misfit_asks_for_it(limit):
    """Damping imitates a profile within the noise; the likelihood tells the two apart."""
    trials = usable_trials([recording(JUMPS, limit, 5)])["j"]
    ready = prepare_joint("j", trials, 0, free_air=True)
    stages = {stage: choice.fit_structures(ready, stage) for stage in choice.stages(ready)}
    exported = choice.choose(ready, choice.joined(stages)).exported
    profiled, gained = choice.with_profile(ready, exported)
    assert (gained > choice._PROFILE_NATS) == np.isfinite(limit)
    if np.isfinite(limit):
        place = profiled.structure.names.index("acceleration_limit")
        assert profiled.values[place] == pytest.approx(limit, rel=0.1)


@pytest.mark.slow
def test_delay_and_calibrate_have_one_dead_time_where_a_profile_is_found():
    jumps = recording(JUMPS, LIMIT_RAD_S2, 5)
    dead_time = lag(jumps)["j"].dead_time_s
    assert dead_time == calibrate(jumps)["j"].lag.dead_time_s


def test_the_noise_is_that_of_the_fit_which_explains_the_motion():
    """A noise that is a motion leaves fits to their priors, and finds coarse steps fine enough."""
    trials = usable_trials([recording(CHIRP, 8.0, 5)])["j"]
    ready = prepare_joint("j", trials, 0, free_air=True)
    servo = random_servo(8.0, 5).arrays()
    inertia = float(servo["armature"])
    numbers = {
        "dead_time_s": servo["dead_time_s"],
        "stiffness_per_s2": 16.0 * servo["duty_per_rad"] * servo["stall_torque"] / inertia,
        "friction_rad_s2": servo["friction_loss"] / inertia,
        "effort_rad_s2": servo["stall_torque"] / inertia,
        "no_load_speed_rad_s": servo["stall_torque"] / servo["back_emf"],
        "acceleration_limit": 8.0, "offset_rad": 0.0,
    }  # fmt: skip
    structure = servo_structure(("back-EMF", "acceleration"))
    point = structure.encode(np.array([float(numbers[name]) for name in structure.names]))
    quieter = ready.with_noise_of(structure, Fit(point, 0.0))
    assert max(quieter.noise_rad) < 0.7 * min(ready.noise_rad)
    assert quieter.runs[0].step_s <= ready.runs[0].step_s
    assert quieter.with_noise_of(*ready.first["delayed_pd"]).noise_rad == quieter.noise_rad
