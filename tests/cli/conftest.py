"""Fixtures: commands run in an empty folder, and drive robots in the process of the tests."""

from pathlib import Path

import pytest

from support.servo_servers import spare_this_process


@pytest.fixture(autouse=True)
def spared(monkeypatch) -> None:
    """No watchdog ends the tests."""
    spare_this_process(monkeypatch)


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder, the working directory of the test."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
