"""Clearance of swings and effort of servos, from made-up motion whose answer is known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from pupper_sysid.sim.robot.body import mini_pupper
from pupper_sysid.sim.robot.mini_pupper import MASS_KG
from pupper_sysid.sim.robot.motion import Moved
from pupper_sysid.sim.walking.effort import EffortMeter, by_kind

STEP_S, SUBSTEPS = 0.02, 10


class Made:
    """One robot whose feet rise and sink together, whose servos turn and push as commanded."""

    def __init__(self, limit_nm: float = 0.5):
        fields = {
            "actuator_forcerange": np.tile([-limit_nm, limit_nm], (1, 12, 1)),
            "body_mass": np.full((1, 2), MASS_KG / 2),
        }
        robots: Any = SimpleNamespace(
            environments=1, body=mini_pupper(),
            field=fields.__getitem__, to_servo=lambda joints: joints,
            sole_heights=lambda feet: feet[..., 2],
        )  # fmt: skip
        self._meter = EffortMeter(robots, STEP_S)

    def step(self, heights_m, contact, contact_s=0.0, last_air_s=0.0, torque_nm=0.0,
             turned_rad=0.0):  # fmt: skip
        """One control step; `heights_m` are those of the soles at each physics step."""
        feet = np.zeros((1, SUBSTEPS, 4, 3))
        feet[0, :, :, 2] = np.asarray(heights_m)[:, None]
        qpos = np.zeros((1, SUBSTEPS, 19))
        qpos[0, :, 7:] = np.linspace(0, turned_rad, SUBSTEPS + 1)[1:, None]
        load = np.broadcast_to(torque_nm, (1, SUBSTEPS, 12))
        moved = Moved(slice(0, 1), np.zeros((1, 12)), qpos, load, np.zeros((1, 4)), feet)
        four = np.ones((1, 4))
        facts = {
            "contact": four * contact > 0, "contact_s": four * contact_s,
            "last_air_s": four * last_air_s, "swing_ended": np.zeros((1, 4), bool),
            "clearance_m": np.empty((1, 4)), "saturated": np.empty((1, 12)),
            "torque_square": np.empty((1, 12)), "power_w": np.empty(1), "weight_n": np.empty(1),
        }  # fmt: skip
        self._meter.advance(moved, facts)
        return SimpleNamespace(**facts)


def test_the_clearance_of_a_swing_is_its_highest_point_between_two_control_steps():
    made = Made()
    made.step(np.full(SUBSTEPS, 0.05), contact=True, contact_s=0.2)  # carried: no swing
    arc = 0.006 * np.sin(np.pi * np.arange(1, 31) / 31)
    for part in np.split(arc, 3)[:2]:
        assert np.isnan(made.step(part, contact=False).clearance_m).all()
    landed = made.step(np.split(arc, 3)[2], True, contact_s=STEP_S, last_air_s=0.04)
    assert landed.swing_ended.all()
    np.testing.assert_allclose(landed.clearance_m, arc.max(), atol=1e-9)
    # what was before is forgotten, and a flicker of one step is no swing
    made.step(np.full(SUBSTEPS, 0.001), contact=False)
    flicker = made.step(np.zeros(SUBSTEPS), True, contact_s=STEP_S, last_air_s=0.02)
    assert not flicker.swing_ended.any() and np.isnan(flicker.clearance_m).all()


def test_only_positive_work_counts_and_saturation_is_by_kind_of_joint():
    made, still = Made(limit_nm=0.5), np.zeros(SUBSTEPS)
    torque = np.zeros((SUBSTEPS, 12))
    torque[:, 2::3] = -0.25  # calves brake
    torque[:4, 1::3] = 0.5  # thighs drive, at their limit for 4 of 10 physics steps
    done = made.step(still, True, torque_nm=torque, turned_rad=0.1)
    np.testing.assert_allclose(by_kind(mini_pupper(), done.saturated), [[0.0, 0.4, 0.0]])
    np.testing.assert_allclose(by_kind(mini_pupper(), done.torque_square), [[0.0, 0.4, 0.25]])
    np.testing.assert_allclose(done.power_w, 4 * 0.5 * 0.04 / STEP_S)
    np.testing.assert_allclose(done.weight_n, 9.80665 * MASS_KG)
