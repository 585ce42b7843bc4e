"""Where the physics and the networks of a training are computed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.train.ranks import Ranks
from pupper_sysid.policies.train.training import learner_device, train
from pupper_sysid.sim.gpu.warp_robots import WarpRobots
from support.tiny_training import tiny_run


@pytest.mark.parametrize(
    ("device", "learner", "expected"),
    [("cpu", "as-device", "cpu"), ("cpu", "cuda", "cuda"), ("cuda", "as-device", "cuda"),
     ("cuda", "cpu", "cpu"), ("warp-cpu", "as-device", "cpu")],
)  # fmt: skip
def test_networks_learn_where_the_physics_is_unless_told_otherwise(
    monkeypatch, device, learner, expected
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    run = tiny_run(device=device, learner_device=learner)
    assert learner_device(run, Ranks()) == expected
    several = learner_device(run, Ranks(rank=5, size=8, local_rank=1))
    assert several == ("cuda:1" if expected == "cuda" else "cpu")


def test_a_device_that_torch_does_not_find_is_answered_in_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no CUDA device here. Leave `device`"):
        train(tmp_path / "run", tiny_run(learner_device="cuda"))


@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="needs the extra `gpu`")
def test_a_policy_is_trained_on_a_warp_device(tmp_path):
    learner = train(tmp_path / "run", tiny_run(device="warp-cpu"))
    assert isinstance(learner.env.env.robots, WarpRobots)
    assert learner.finite and (tmp_path / "run/policy_last/contract.json").exists()
