"""Figures of the frozen recordings, held to 1 %; `renew.py` is the command that renews them.

A part is quick: the lag of one emulated recording of every bus and of a real sweep, and the
calibration of one servo. The rest is slow: everything, the SO-101's joints by
minutes each.
"""

from __future__ import annotations

import copy
from functools import partial

import pytest

from support import golden
from support.golden_recordings import EMULATED, REAL

QUICK = (  # every bus once
    "proxy_scs0009_walk", "serial_sts3250_steps", "pendulum_sts3215_gains", "mini_pupper_hip",
)  # fmt: skip


def changes_of(name: str, *stages: str) -> str:
    """The table of what differs from the frozen figures; empty where nothing does."""
    if golden.is_absent(name):
        pytest.skip(f"{name} is not here (set PUPPER_REAL_DATA)")
    after, before = golden.figures_of(name, stages), golden.read()[name]
    found = golden.differences({key: before.get(key) for key in after}, after, place=name)
    return f"\n{golden.table(found)}" if found else ""


@pytest.mark.parametrize("name", QUICK)
def test_the_lag_of_a_recording_is_the_frozen_one(name):
    assert not changes_of(name, "lag")


def test_the_calibration_of_a_recording_is_the_frozen_one():
    assert not changes_of("proxy_scs0009_tones", "calibrate")


@pytest.mark.slow
@pytest.mark.parametrize("name", [*EMULATED, *REAL])
def test_every_figure_of_a_recording_is_the_frozen_one(name):
    assert not changes_of(name, *golden.STAGES)


def test_every_recording_has_figures_of_every_stage():
    figures = golden.read()
    assert list(figures) == [*EMULATED, *REAL]
    assert all(set(own) == {"recording", *golden.STAGES} for own in figures.values())


def test_two_percent_are_a_difference_and_half_a_percent_is_none():
    frozen = {"a": {"lag_ms": {"value": 40.0, "low": 38.0}, "stiffness_per_s2": 12_000.0}}
    near, far = copy.deepcopy(frozen), copy.deepcopy(frozen)
    near["a"]["lag_ms"]["value"] *= 1.005
    far["a"]["lag_ms"]["value"] *= 1.02
    far["a"]["stiffness_per_s2"] *= 0.98
    assert golden.differences(frozen, near) == []
    found = golden.differences(frozen, far)
    assert [each.place for each in found] == ["a / lag_ms / value", "a / stiffness_per_s2"]
    assert [round(each.percent) for each in found] == [2, -2]
    assert len(golden.differences(frozen, near, exact=True)) == 1


def test_a_figure_near_zero_is_held_to_the_floor_of_its_unit():
    # 0.05 ms and 0.05 mrad: far above 1 % of either
    for unit in ("ms", "mrad"):
        frozen = {f"stale_{unit}": {"value": 0.01}}
        assert golden.differences(frozen, {f"stale_{unit}": {"value": 0.05}}) == []
        assert golden.differences(frozen, {f"stale_{unit}": {"value": 0.08}})


def test_words_must_be_the_same_and_numbers_in_them_may_round_otherwise():
    frozen = {"findings": ["the bus reads every 26.85 ms and 42 % fail"]}
    rounded = {"findings": ["the bus reads every 26.86 ms and 43 % fail"]}
    moved = {"findings": ["the bus reads every 26.85 ms and 48 % fail"]}
    reworded = {"findings": ["the bus polls every 26.85 ms and 42 % fail"]}
    assert golden.differences(frozen, rounded) == []
    assert golden.differences(frozen, moved) and golden.differences(frozen, reworded)


def test_a_figure_that_is_lost_is_a_difference():
    for after in (None, "refused", {"value": 1.0}):
        assert golden.differences({"a_ms": 1.0}, {"a_ms": after}), after
        assert golden.differences({"a_ms": after}, {"a_ms": 1.0}), after


def test_the_command_says_what_changed_and_renews_it(tmp_path, monkeypatch, capsys):
    name, stages = "serial_scs0009_tones", ["--stages", "lag"]
    figures = golden.read()
    frozen = copy.deepcopy(figures[name])
    lag = figures[name]["lag"]["RF_thigh"]["lag_ms"]
    lag["value"] *= 1.1
    monkeypatch.setattr(golden, "FIGURES", tmp_path / "figures.yaml")
    # what the command does with figures is the matter: none is computed
    places = [("recording",), *(("lag", joint) for joint in frozen["lag"])]
    known = [(p, partial(copy.deepcopy, golden._at(frozen, p))) for p in places]
    monkeypatch.setattr(golden, "pieces", lambda *_: known)
    golden.write(figures)
    assert golden.main(["--only", name, *stages]) == 1
    (line,) = capsys.readouterr().out.splitlines()[1:]
    assert line.startswith(f"{name} / lag / RF_thigh / lag_ms / value") and line.endswith("-9.1")
    assert golden.main(["--only", name, *stages, "--renew"]) == 0
    assert golden.read()[name] == frozen
    assert golden.main(["--only", name, *stages, "--exact"]) == 0
