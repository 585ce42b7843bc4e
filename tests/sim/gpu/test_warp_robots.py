"""The robots on mujoco-warp are those of MuJoCo; compiling its kernels takes a minute at first."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.sim.gpu import warp_robots
from pupper_sysid.sim.gpu.warp_robots import WarpRobots
from pupper_sysid.sim.robot.mini_pupper import default_pose
from pupper_sysid.sim.robot.robot_batch import RobotBatch
from pupper_sysid.sim.robot.terrain import make_ground
from pupper_sysid.sim.robot.trot import Trot
from pupper_sysid.sim.walking.config import Walking
from pupper_sysid.sim.walking.env import PupperEnv
from pupper_sysid.sim.walking.servo_ranges import servo_ranges

SERVOS = servo_ranges(Path("data/samples/calibrated.yaml"))
EXACT = replace(Walking(), physics="evaluation")  # solved to the end: PGS is not in mujoco-warp
ROBOTS, STEPS = 4, 50
ON_WARP = pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="needs the extra `gpu`")


def walked(on_warp: bool, lift_m: float) -> np.ndarray:
    """Joint angles at each physics step of a second of four trots, of differing robots."""
    ground, rng = make_ground(EXACT.terrain, np.random.default_rng(0)), np.random.default_rng(2)
    if on_warp:
        robots = WarpRobots(EXACT, SERVOS, ground, ROBOTS, "cpu")
    else:
        robots = RobotBatch(EXACT, SERVOS, ground, ROBOTS, 1, None)
    everyone = np.arange(ROBOTS)
    robots.draw(everyone, rng)
    still = np.zeros((ROBOTS, 12))
    robots.place(everyone, still + default_pose(), still, 0.5, rng)
    robots.qpos[:, 2] += lift_m
    found = []
    for k in range(STEPS):
        phase = 0.7 * everyone + 2 * np.pi * Trot().frequency_hz * k * EXACT.control_step_s
        target = Trot().joints(phase, np.tile([0.15, 0.05, 0.4], (ROBOTS, 1)))
        found += [moved.qpos[..., 7:].copy() for moved in robots.step(target)]
    return np.concatenate(found, axis=1)


@ON_WARP
@pytest.mark.parametrize(("lift_m", "most_rad"), [(10.0, 1e-4), (0.0, 1e-3)])
def test_it_moves_as_mujoco_does(lift_m, most_rad):
    expected = walked(False, lift_m)
    assert np.ptp(expected, axis=1).min() > 0.05  # every joint moves
    np.testing.assert_allclose(walked(True, lift_m), expected, rtol=0, atol=most_rad)


@ON_WARP
def test_the_task_goes_on_exactly_from_a_saved_state_on_a_device():
    def make() -> PupperEnv:
        return PupperEnv(Walking(), SERVOS, 3, seed=1, device="cpu")

    action = np.random.default_rng(0).normal(0.0, 0.2, (3, 12))
    first, second = make(), make()
    for _ in range(4):
        first.step(action)
    assert second.restore(first.state)
    for _ in range(3):
        a, b = first.step(action), second.step(action)
        np.testing.assert_array_equal(a.observation, b.observation)
        np.testing.assert_array_equal(a.reward, b.reward)
    assert np.isfinite(a.observation).all()


@ON_WARP
def test_a_robot_that_becomes_nan_is_drawn_anew_and_the_others_walk_on():
    env = PupperEnv(Walking(), SERVOS, 3, seed=1, device="cpu")
    env.step(np.zeros((3, 12)))
    env.robots.qvel[1, 7] = np.nan
    result = env.step(np.zeros((3, 12)))
    np.testing.assert_array_equal(result.done, [False, True, False])
    assert env.nan_resets == 1 and np.isfinite(result.observation).all()
    assert np.isfinite(env.step(np.zeros((3, 12))).observation).all()


@ON_WARP
def test_a_device_that_is_not_there_is_answered_in_a_sentence():
    with pytest.raises(InputError, match="There is no device cuda:99 here"):
        PupperEnv(Walking(), SERVOS, 1, device="cuda:99")


def test_without_the_extra_the_command_that_installs_it_is_given(monkeypatch):
    def missing(name: str):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(warp_robots, "import_module", missing)
    warp_robots._engine.cache_clear()
    with pytest.raises(InputError, match=r'pip install "pupper-sysid\[gpu\]"'):
        PupperEnv(Walking(), SERVOS, 1, device="cpu")
    warp_robots._engine.cache_clear()
