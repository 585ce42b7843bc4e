"""Fixtures: policies of every kind, made once, and their copies on disk."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pupper_sysid.policies.network.policy_file import Policy, load_policy, write_policy
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.tiny_training import ALL_KINDS, CALIBRATION, HISTORY, networks, tiny_run


def _write(folder: Path, kind: str, scale: float = 1.0) -> Path:
    weights = {k: v.clone() for k, v in networks(kind)[0].state_dict().items()}
    last = max(k for k in weights if k.startswith("mlp.") and k.endswith("weight"))
    weights[last] *= scale
    run = tiny_run(kind)
    run = replace(run, architecture=replace(run.architecture, hidden=(32, 16), memory=24))
    history = HISTORY if kind == "mlp-actions" else 0
    write_policy(folder, weights, run, servo_ranges(CALIBRATION), history, {"seed": 0})
    return folder


@pytest.fixture(scope="session")
def saved_policies(tmp_path_factory) -> dict[str, Path]:
    """Folder of a policy with random weights, by kind. Not to be changed: see `copied`."""
    root = tmp_path_factory.mktemp("saved")
    return {kind: _write(root / kind, kind) for kind in ALL_KINDS}


@pytest.fixture
def copied(saved_policies, tmp_path) -> Callable[..., Path]:
    """Copies of the saved policies, to be changed: `copied(kind)` is a folder of its own."""

    def copy(kind: str = "mlp", folder: Path | None = None) -> Path:
        folder = folder or tmp_path / "policy"
        shutil.rmtree(folder, ignore_errors=True)
        return Path(shutil.copytree(saved_policies[kind], folder))

    return copy


@pytest.fixture(scope="session")
def policies(tmp_path_factory) -> dict[str, Policy]:
    """A policy of each kind with random weights and small actions: robots stand and twitch."""
    root = tmp_path_factory.mktemp("twitching")
    return {kind: load_policy(_write(root / kind, kind, 0.03)) for kind in ALL_KINDS}
