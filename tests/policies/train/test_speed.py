"""Both sides of a speed ratio do the same work in turns, and need no calibration at hand."""

import numpy as np
import pytest

from pupper_sysid.policies.train import speed
from pupper_sysid.policies.train.learner import Ranks
from pupper_sysid.policies.train.training import make_env
from pupper_sysid.sim.walking.config import Walking, for_robot
from support.legged import legged
from support.tiny_training import tiny_run


@pytest.fixture
def paces(monkeypatch):
    monkeypatch.setattr(speed, "SLICE_S", 0.001)
    # no episode ends and no push comes in so few steps: the environment adds nothing to the physics
    return speed.Paces(make_env(tiny_run(task=Walking()), Ranks()))


@pytest.mark.parametrize("bare_first", [False, True])
def test_bare_physics_takes_the_steps_of_the_environment_and_leaves_it_where_it_was(
    paces, bare_first
):
    batch = paces.env.robots.batch
    ends, controls, own = [], [], paces._stepped
    take = paces._bare

    def bare(given):
        found = take(given)
        ends.append(batch.bind("qpos").copy())
        controls.append(given[-1])
        return found

    def environment(actions):
        found = own(actions)
        ends.append(batch.bind("qpos").copy())
        controls.append(batch.bind("ctrl").copy())
        return found

    paces._bare, paces._stepped = bare, environment
    times = paces.slice(bare_first)
    np.testing.assert_array_equal(controls[0], controls[1])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    environment_end = ends[1 if bare_first else 0]
    np.testing.assert_array_equal(batch.bind("qpos"), environment_end)
    assert (np.array(times) > 0).all()


def test_a_robot_of_other_joints_is_timed_as_well(monkeypatch, tmp_path):
    monkeypatch.setattr(speed, "SLICE_S", 0.001)
    hexapod = tmp_path / "hexapod.xml"
    hexapod.write_text(legged({f"{s}{k}": (1 - k, s) for s in (1, -1) for k in range(3)}))
    paces = speed.Paces(make_env(tiny_run(task=for_robot(Walking(), hexapod, None)), Ranks()))
    assert (paces.slices(1) > 0).all() and paces.env.action.shape[1] == 18


def test_a_ratio_is_the_median_over_slices_with_their_middle_half():
    own, bare = np.array([2.0, 4.0, 10.0, 4.0, 4.0]), np.array([1.0, 3.0, 5.0, 3.0, 3.0])
    times = np.stack([np.stack([own, own], 1), np.stack([bare, 0.5 * bare], 1)], axis=1)
    found = speed.ratios(times)
    quartiles = (found["env_ratio_low"], found["env_ratio"], found["env_ratio_high"])
    assert quartiles == (0.5, 0.75, 0.75)
    assert found["env_processor_ratio"] == 0.375
    assert found["env_steps_per_s"] == pytest.approx(1 / 4)
