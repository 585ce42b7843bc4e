"""Fixtures: commands drive robots in the process of the tests."""

import pytest

from support.servo_servers import spare_this_process


@pytest.fixture(autouse=True)
def spared(monkeypatch) -> None:
    """No watchdog ends the tests."""
    spare_this_process(monkeypatch)
