"""Progress of long commands: it knows its end, and is told where there is no terminal."""

from __future__ import annotations

import io

import pytest

from pupper_sysid.cli import terminal
from pupper_sysid.sysid.fit import calibrate as module


@pytest.fixture
def lines(monkeypatch):
    """What goes to stderr, and a clock that a test sets."""
    text, clock = io.StringIO(), [100.0]
    monkeypatch.setattr(terminal.err, "_file", text)  # its property would keep the old one
    monkeypatch.setattr(terminal.time, "monotonic", lambda: clock[0])
    return text, clock


def test_without_a_terminal_there_is_a_line_each_ten_seconds(lines):
    text, clock = lines
    with terminal.progress("calibrating", 4) as advance:
        for name in ("a", "b", "c", "d"):
            clock[0] += 6.0
            advance(name)
    assert text.getvalue().splitlines() == [
        "calibrating b: 50 %, 12 s", "calibrating d: 100 %, 24 s",
    ]  # fmt: skip


def test_a_joint_is_done_after_all_its_stages(monkeypatch):
    monkeypatch.setattr(
        module, "prepare_joint", lambda joint, trials, seed, free_air, prior: "ready"
    )
    monkeypatch.setattr(module, "stages", lambda ready: module.STAGES[1:-1])
    monkeypatch.setattr(module, "fit_structures", lambda ready, name: name)
    monkeypatch.setattr(module, "conclude", lambda ready, fitted, presets: list(fitted))
    told = []
    made = module._one_by_one("LF_hip", (), True, 0, {}, lambda *stage: told.append(stage))
    assert told == [("LF_hip", stage) for stage in module.STAGES]
    assert made == list(module.STAGES[1:-1])
