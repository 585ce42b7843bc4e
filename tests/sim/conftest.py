"""Fixture: models of robots are read in this process."""

import pytest

from pupper_sysid.sim.export import foreign, mjcf
from pupper_sysid.sim.robot import hinges, replay, robot_map


@pytest.fixture
def read_here(monkeypatch):
    """Read models in this process; one that cannot be read here is left to a process of its own."""
    apart = hinges.hinges_of

    def hinges_of(path):
        try:
            return hinges._read(str(path))
        except Exception:
            return apart(path)

    monkeypatch.setattr(hinges, "_limit_this_process", lambda: None)
    for module in (foreign, mjcf, robot_map, replay):
        monkeypatch.setattr(module, "hinges_of", hinges_of)
