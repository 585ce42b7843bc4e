"""A limit on the set-point's acceleration is found in the recordings that have it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pupper_sysid.servo_models.cards.files import load_card
from pupper_sysid.servo_models.cards.numbers import LoadedLoop, stated
from pupper_sysid.servo_models.loaded_servo import LoadedServo, LoadedServoParameters
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.feedback.poll_lattice import find_poll_lattice
from pupper_sysid.sysid.loaded import search
from pupper_sysid.sysid.loaded.preparation import scales_of
from pupper_sysid.sysid.loaded.ramps import EitherWay, settled
from pupper_sysid.sysid.loaded.runs import Run, prepare
from pupper_sysid.sysid.loaded.structures import Structure
from pupper_sysid.sysid.recordings.recording import Recording

LIMIT_RAD_S2, STEP_S, LOOP_S, ROWS = 40.0, 0.002, 0.02, 600
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
        command = 0.15 * np.sin(2 * np.pi * np.cumsum(np.linspace(0.2, 4.0, ROWS)) * LOOP_S)
    else:
        rng = np.random.default_rng(seed)
        command = np.repeat(rng.choice([-0.12, 0.12], ROWS // 30), 30)
    servo = LoadedServo(random_servo(limit, seed), 16.0, time_step_s=STEP_S)
    servo.reset(command[0])
    per = round(LOOP_S / STEP_S)
    moved = servo.rollout(np.repeat(command, per))[per - 2 :: per]
    count = 2 * np.pi / 4096
    table = pd.DataFrame(
        {
            "send_time_s": time, "read_time_s": time + LOOP_S - STEP_S, "trial": 0, "joint": "j",
            "frequency_hz": np.nan, "command_rad": command,
            "position_rad": np.round(moved / count) * count,
        }
    )  # fmt: skip
    setup = {"p_gain": 16.0, "registers": registers or {}}
    header = {
        "readings": "live", "joints": ["j"], "start_pose_rad": {"j": float(command[0])},
        "servos": {"j": setup},
    }  # fmt: skip
    return Recording.from_frame(table, metadata=header, name=motion)


def found(*recordings: Recording) -> tuple[float, tuple[Run, ...]]:
    """Limit and runs as `fit_loaded_joint` settles them."""
    trials = tuple(t for r in recordings for t in r.trials("j"))
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    runs = tuple(r for t in trials if (r := prepare(t, lattice)) is not None)
    structure, noise = Structure(("load friction",), scales_of(trials, runs)), (0.01,) * len(runs)
    rng = np.random.default_rng(1)
    rough = search.search(search.Problem(structure, runs, noise), rng)[0]
    scales, runs, _ = settled(rough, structure, runs, noise, 5e-4, rng)
    return scales.acceleration_rad_s2, runs


@pytest.mark.parametrize("seed", [2, pytest.param(6, marks=pytest.mark.slow)])
def test_a_limit_is_found_in_the_chirp_that_has_it_and_not_in_jumps_without(seed: int):
    limit, (chirp, jumps) = found(
        recording(CHIRP, LIMIT_RAD_S2, seed), recording(JUMPS, np.inf, seed)
    )
    assert limit == pytest.approx(LIMIT_RAD_S2, rel=0.05)
    assert chirp.ramp_share == 1.0 and np.isinf(jumps.ramp_share)


@pytest.mark.slow
def test_a_recording_with_a_larger_limit_gets_a_share_of_its_own():
    limit, (chirp, jumps) = found(
        recording(CHIRP, LIMIT_RAD_S2, 6), recording(JUMPS, 8 * LIMIT_RAD_S2, 6)
    )
    assert limit == pytest.approx(LIMIT_RAD_S2, rel=0.05)
    assert chirp.ramp_share == 1.0 and jumps.ramp_share == 8.0


@pytest.mark.slow
def test_no_limit_is_found_where_there_is_none():
    limit, runs = found(recording(CHIRP, np.inf, 3), recording(JUMPS, np.inf, 3))
    assert np.isnan(limit)
    assert all(r.ramp_share == 1.0 for r in runs)


def test_a_register_that_the_recording_states_decides():
    recordings = (
        recording(CHIRP, LIMIT_RAD_S2, 4),
        recording(JUMPS, LIMIT_RAD_S2, 4, {"acceleration": 0}),
    )
    trials = tuple(t for r in recordings for t in r.trials("j"))
    lattice = find_poll_lattice(trials, np.random.default_rng(0))
    runs = tuple(r for t in trials if (r := prepare(t, lattice)) is not None)
    assert [r.ramp_known for r in runs] == [False, True]
    structure = Structure(("acceleration",), scales_of(trials, runs))
    point = structure.encode(structure.decode(structure.prior[0]))
    given = EitherWay(structure, runs, (0.01,) * 2).settle(search.Fit(point, 0.0))
    assert np.isinf(given[1].ramp_share)  # though the motion of this run says otherwise


def test_a_model_with_a_limit_moves_without_it_where_the_readings_say_so(tmp_path):
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
    limited, free = recording(CHIRP, LIMIT_RAD_S2, 6), recording(JUMPS, np.inf, 6)
    both = compare([limited, free], [tmp_path / "servo.yaml"], "j")
    (model,) = (m for name, m in both.models.items() if "servo.yaml" in name)
    assert model.mean.rmse_raw_rad < 1.5e-3  # a count
    assert any("acceleration is raised or taken out in runs of j" in note for note in both.notes)
    stated_limit = recording(JUMPS, np.inf, 6, {"acceleration": 254})
    kept = compare(stated_limit, [tmp_path / "servo.yaml"], "j")
    (model,) = (m for name, m in kept.models.items() if "servo.yaml" in name)
    assert model.mean.rmse_raw_rad > 10e-3  # the register says otherwise than the motion
