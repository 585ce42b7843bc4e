"""Reward terms by hand: tiny examples, and the weights that were published."""

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pupper_sysid.common.joints import LEGS
from pupper_sysid.sim.robot.body import mini_pupper
from pupper_sysid.sim.robot.mini_pupper import (
    MASS_KG,
    SIDE,
    default_pose,
    foot_position,
    joint_angles,
)
from pupper_sysid.sim.robot.robot_batch import Moved
from pupper_sysid.sim.walking import rewards as wr
from pupper_sysid.sim.walking.config import (
    DEFAULT_REWARDS,
    PAPER_REWARDS,
    PRESETS,
    RELEASE_REWARDS,
    Rewards,
    narrowed,
)
from pupper_sysid.sim.walking.rewards import TERMS, EffortMeter, Strides, by_kind, weighted
from pupper_sysid.sim.walking.step import Step, empty_facts

SIZES = dict.fromkeys(
    ["command", "linear_velocity", "angular_velocity", "gravity", "stride_velocity", "clock"], 3
) | dict.fromkeys(
    ["contact", "air_s", "contact_s", "last_air_s", "last_contact_s", "landed", "lifted",
     "foot_height_m", "foot_speed_m_s", "swing_ended", "clearance_m"], 4
)  # fmt: skip
ARRAYS = [f for f in fields(Step) if f.name != "body"]
P = Rewards()
E1 = np.exp(-1.0)


def step(**known) -> Step:
    """One robot, all zeros but what is given."""
    values: dict[str, Any] = {f.name: np.zeros((1, SIZES.get(f.name, 12))) for f in ARRAYS}
    flags = ("contact", "landed", "lifted", "swing_ended")
    values |= {name: np.zeros((1, 4), bool) for name in flags}
    values |= {"power_w": np.zeros(1), "weight_n": np.full(1, 5.0)}
    for name, value in known.items():
        values[name][:] = value
    return Step(body=mini_pupper(), **values)


def joints(**known: float) -> np.ndarray:
    """Twelve zeros but `j<index>`."""
    values = np.zeros(12)
    for name, value in known.items():
        values[int(name[1:])] = value
    return values


FORWARD = (0.2, 0.0, 0.0)
EXPONENTIAL = {
    "tracking_shape": "exponential", "linear_sigma": 0.1, "angular_sigma": 0.2, "fast_bonus": 0.0
}  # fmt: skip
GAUSSIAN = EXPONENTIAL | {"tracking_shape": "gaussian"}
GAIT = {"gait_sigma": 0.08, "gait_most": 0.15}
F, T = False, True
TROT = {"air_s": (0.1, 0, 0, 0.1), "contact_s": (0, 0.1, 0.1, 0)}
POSE = joints(j1=0.3, j2=-0.4)
ACTIONS = {"action": joints(j0=3.0, j5=4.0), "earlier_action": joints(j0=1.0)}
STEADY = {"action": 3.0, "last_action": 2.0, "earlier_action": 1.0}
STRIDE = {"stride_velocity": (0.17, 0.04, 0.2), "linear_velocity": (9.0, 9.0, 9.0)}
BY_HAND = [
    # nearer to the command than standing
    ("progress", {}, {"command": (0.12, -0.16, 0), "stride_velocity": (0.06, -0.08, 9)},
     0.1 / np.hypot(0.2, 0.05)),
    ("progress", {}, {"command": FORWARD, "stride_velocity": (-1.0, 0, 0)}, -1.0),
    ("progress", {}, {"command": FORWARD}, 0.0),
    ("progress", {}, {"stride_velocity": (1.0, 0, 0)}, 0.0),
    ("turn_progress", {}, {"command": (0, 0, -0.4), "stride_velocity": (0, 0, -0.1)},
     0.1 / np.hypot(0.4, 0.15)),
    ("turn_progress", {}, {"stride_velocity": (0, 0, 1.0)}, 0.0),
    # fewer than two feet on the ground, short swings, short stances
    ("unsupported", {}, {}, 1.0),
    ("unsupported", {}, {"contact": (F, T, F, F)}, 0.5),
    ("unsupported", {}, {"contact": (F, T, T, F)}, 0.0),
    ("unsupported", {}, {"contact": True}, 0.0),
    ("short_swing", {"shortest_swing": 0.1},
     {"landed": (T, T, F, T), "last_air_s": (0.025, 0.2, 0.0, 0.05)}, 0.75 + 0.5),
    ("short_stance", {"shortest_stance": 0.2},
     {"lifted": (T, T, F, F), "last_contact_s": (0.05, 0.3, 0.0, 0.05)}, 0.75),
    # speed by its horizontal error (0.06, 0.08) → 0.1 = σ; the vertical speed does not count
    ("base_linear_velocity", EXPONENTIAL,
     {"command": FORWARD, "linear_velocity": (0.14, -0.08, 5.0)}, E1),
    ("base_linear_velocity", EXPONENTIAL, {"command": FORWARD}, np.exp(-2)),
    ("base_linear_velocity", GAUSSIAN, {"command": FORWARD}, np.exp(-4)),
    # linear: falls by the error over its width down to minus one
    *(("base_linear_velocity", {"tracking_shape": "linear", "linear_sigma": 0.1},
       {"command": FORWARD, "linear_velocity": (speed, 0, 0)}, earns)
      for speed, earns in ((0.2, 1.0), (0.15, 0.5), (0.1, 0.0), (0.05, -0.5), (-0.3, -1.0))),
    # a bonus for fast commands, nothing less for slow ones
    *(("base_linear_velocity", EXPONENTIAL | {"fast_bonus": 0.5, "fast_above": 0.15},
       {"command": (speed, 0, 0), "linear_velocity": (speed, 0, 0)}, earns)
      for speed, earns in ((0.35, 1 + 0.5 * 0.2), (0.05, 1.0))),
    # turning about the vertical; strides look at the average
    *(("base_angular_velocity", shape,
       {"command": (0, 0, 0.3), "angular_velocity": (9.0, 9.0, 0.5)}, E1)
      for shape in (EXPONENTIAL, GAUSSIAN)),
    ("stride_linear_velocity", EXPONENTIAL | {"stride_linear_sigma": 0.05},
     {"command": (0.2, 0, 0.4), **STRIDE}, E1),
    ("stride_angular_velocity", EXPONENTIAL | {"stride_angular_sigma": 0.2},
     {"command": (0.2, 0, 0.4), **STRIDE}, E1),
    # 0.1 + 0.2; a swing of 0.3 and a stance of 0.25 are too long to count
    ("air_time", {"air_time_most": 0.25},
     {"command": FORWARD, "air_s": (0.1, 0, 0.3, 0), "contact_s": (0, 0.2, 0, 0.25)}, 0.3),
    ("air_time", {"air_time_most": 0.25},
     {"air_s": (0.1, 0, 0.9, 0), "contact_s": (0, 0.2, 0, 5.0)}, -0.1 + 0.2 - 0.25 + 0.25),
    ("alive", {}, {}, 1.0),
    # LF and RB in the air for as long as RF and LB have been on the ground
    ("gait", {}, {"command": FORWARD, **TROT}, 1.0),
    # a bound: two pairs that should be together: (0.1² + 0.1²) each; of the four that should
    # alternate, the two sides do, the two ends (LF-RF, RB-LB) differ by 0.1² + 0.1² each
    ("gait", GAIT, {"command": FORWARD, "air_s": (0.1, 0.1, 0, 0), "contact_s": (0, 0, 0.1, 0.1)},
     np.exp(-4 * 0.02 / 0.08)),
    # times beyond the longest do not count more: LF against RB, RF and LB: 0.15² in each pair
    ("gait", GAIT, {"command": FORWARD, "air_s": (9.0, 0, 0, 0)}, np.exp(-3 * 0.15**2 / 0.08)),
    # a robot that stands as commanded earns nothing, one that moves without a command does
    ("gait", {}, TROT, 0.0),
    ("gait", {"gait_threshold": 0.1}, {**TROT, "linear_velocity": (0.0, 0.16, 0.0)}, 1.0),
    # the error of moving feet; what a swing lacks
    ("foot_clearance", {"clearance_height": 0.03, "clearance_sigma": 0.05, "clearance_speed": 2.0},
     {"foot_height_m": (0.03, 0.0, 0.0, 0.13), "foot_speed_m_s": (9.0, 0.0, 0.5, 1e6)},
     np.exp(-(0.03**2 * np.tanh(1.0) + 0.1**2) / 0.05)),
    ("swing_height", {"clearance_height": 0.015},
     {"foot_height_m": (0.005, 0.015, 0.1, 0.0), "foot_speed_m_s": (0.5, 1.0, 1.0, 2.0)},
     0.01**2 * 0.5 + 0.015**2 * 2.0),
    # changes of the action: norm, square, second difference
    ("action_smoothness", {}, ACTIONS, 5.0),
    ("action_rate", {}, ACTIONS, 25.0),
    ("action_jerk", {}, ACTIONS, (3 + 1) ** 2 + 4**2),
    ("action_jerk", {}, STEADY, 0.0),
    ("action_rate", {}, STEADY, 12.0),
    # of times up to 0.5 s: mean 0.2, four deviations of 0.1, divided by three (sample variance)
    ("air_time_variance", {},
     {"last_air_s": (0.1, 0.3, 0.1, 0.3), "last_contact_s": (0.5, 9.0, 0.5, 0.5)}, 4 * 0.1**2 / 3),
    # bouncing and rocking; the sine of the tilt; the speed of rise or fall
    ("base_motion", {}, {"linear_velocity": (9.0, 9.0, 0.5), "angular_velocity": (1.0, -2.0, 9.0)},
     0.8 * 0.25 + 0.2 * 3.0),
    ("base_orientation", {}, {"gravity": (0.5, 0.0, -np.cos(np.radians(30)))}, 0.5),
    *(("bounce", {}, {"linear_velocity": (0.3, 0.2, rise)}, 0.05) for rise in (-0.05, 0.05)),
    # only feet on the ground slip
    ("foot_slip", {}, {"contact": (T, F, T, F), "foot_speed_m_s": (0.1, 0.2, 0.4, 0.8)}, 0.5),
    ("joint_position", {"standing_factor": 10.0}, {"position_relative": POSE}, 5.0),
    ("joint_position", {"standing_factor": 10.0},
     {"position_relative": POSE, "command": FORWARD}, 0.5),
    ("hip_abduction", {}, {"position_relative": joints(j0=0.3, j9=0.4, j1=9.0, j11=9.0)}, 0.5),
    *((term, {}, {name: joints(j2=6.0, j7=-8.0)}, 10.0)
      for term, name in (("joint_torques", "torque"), ("joint_acceleration", "acceleration"),
                         ("joint_velocity", "velocity"))),
    # what the highest point of a swing lacked, once, when it ends
    ("low_swing", {"least_clearance": 0.008},
     {"swing_ended": (T, T, T, F), "clearance_m": (0.006, 0.020, -0.004, np.nan)}, 0.25 + 1.5),
    ("low_swing", {}, {"clearance_m": np.nan}, 0.0),
    # means of all servos; power over the weight
    ("torque_saturation", {}, {"saturated": joints(j2=0.6, j5=0.6)}, 0.1),
    ("torque_share", {}, {"torque_square": joints(j2=1.0, j3=0.2)}, 0.1),
    ("mechanical_power", {}, {"power_w": 4.0}, 0.8),
]  # fmt: skip


def test_terms_are_those_worked_out_by_hand():
    wrong = []
    for term, rewards, known, expected in BY_HAND:
        earned = TERMS[term](step(**known), replace(P, **rewards))[0]
        if earned != pytest.approx(expected, abs=1e-12):
            wrong.append(f"{term} {rewards} {known}: {earned}, by hand {expected}")
    assert not wrong, "\n".join(wrong)


def on_paths(command, turns: float, **moved):
    """A step at so many turns of the clock, with some feet moved from the default pose [m]."""
    angle, pose, away = 2 * np.pi * turns, default_pose(), np.zeros(12)
    for i, leg in enumerate(LEGS):
        own = slice(3 * i, 3 * i + 3)
        foot = foot_position(leg, *pose[own]) + np.array(moved.get(leg, (0.0, 0.0, 0.0)))
        away[own] = joint_angles(leg, foot) - pose[own]
    clock = (np.cos(angle), np.sin(angle), 0.0)
    return step(command=command, clock=clock, position_relative=away)


LF, RF, LB, RB = LEGS


def test_feet_are_paid_to_rise_in_their_half_of_the_clock():
    p = replace(P, clock_duty=0.6, clock_height=0.006, foot_paths_sigma=0.024)
    up = (0.0, 0.0, 0.006)
    in_time = {"command": FORWARD, "turns": 0.25, LF: up, RB: up}
    assert wr.foot_paths(on_paths(**in_time), p)[0] == pytest.approx(1.0)
    # all four 6 mm off
    late = wr.foot_paths(on_paths(**in_time | {"turns": 0.75}), p)[0]
    assert late == pytest.approx(1.0 - 4 * 0.006**2 / 0.024**2)
    assert late < wr.foot_paths(on_paths(FORWARD, 0.25), p)[0] < 1.0
    assert wr.foot_paths(on_paths((0, 0, 0), 0.25), p)[0] == 0.0
    assert wr.foot_paths(on_paths(FORWARD, 0.25, LF=(0.0, 0.0, 1.0)), p)[0] == -2.0


def test_feet_are_paid_to_touch_down_ahead_by_half_of_what_they_pass_and_to_go_around_in_a_turn():
    # with the feet down for half of the time, the first pair touches down at half a turn
    p = replace(P, clock_duty=0.5, clock_hz=4.0)
    for command, stroke in (
        ((0.2, 0, 0), (1, 0, 0)), ((-0.2, 0, 0), (-1, 0, 0)), ((0, 0.2, 0), (0, 1, 0))
    ):  # fmt: skip
        ahead = 0.2 * 0.5 / (2 * 4.0) * np.array(stroke)
        moved = {LF: ahead, RB: ahead, RF: -ahead, LB: -ahead}
        assert wr.foot_paths(on_paths(command, 0.5, **moved), p)[0] == pytest.approx(1.0)
        assert wr.foot_paths(on_paths(command, 0.0, **moved), p)[0] < -1.0
        # where all are, and how far to their sides, is free
        wide = {leg: at + np.array([0.01, 0.005 * SIDE[leg], -0.01]) for leg, at in moved.items()}
        assert wr.foot_paths(on_paths(command, 0.5, **wide), p)[0] == pytest.approx(1.0)
    moved = {}
    for sign, legs in ((1, (LF, RB)), (-1, (RF, LB))):
        for leg in legs:
            own = slice(3 * LEGS.index(leg), 3 * LEGS.index(leg) + 3)
            x, y, _ = foot_position(leg, *default_pose()[own])
            moved[leg] = sign * 0.5 * 0.5 / 8.0 * np.array([-y, x, 0.0])
    assert wr.foot_paths(on_paths((0, 0, 0.5), 0.5, **moved), p)[0] == pytest.approx(1.0)
    assert wr.foot_paths(on_paths((0, 0, -0.5), 0.5, **moved), p)[0] < 1.0


def test_a_gait_that_sways_is_paid_for_its_mean_speed_and_may_lean_to_the_side():
    pace = replace(mini_pupper(), offsets=np.array([0.0, 0.5, 0.0, 0.5]))
    assert pace.sways
    leaning = dict.fromkeys(LEGS, (0.0, 0.01, 0.0))
    costs = {}
    for name, moved in (("none", {}), ("lean", leaning), ("spread", {LF: leaning[LF]})):
        steps = on_paths((1e-9, 0, 0), 0.0, **moved)
        costs[name] = [wr.foot_paths(replace(steps, body=b), P)[0] for b in (mini_pupper(), pace)]
    assert costs["lean"][0] < costs["none"][0] and costs["spread"][1] < costs["none"][1]
    assert costs["lean"][1] == pytest.approx(costs["none"][1])
    swaying = step(
        command=FORWARD, linear_velocity=(0.2, 0.3, 0), angular_velocity=(0, 0, 0.5),
        stride_velocity=FORWARD,
    )  # fmt: skip
    for term in (wr.base_linear_velocity, wr.base_angular_velocity):
        assert term(swaying, P)[0] < term(replace(swaying, body=pace), P)[0] == 1.0


def test_the_stride_of_a_robot_of_four_times_the_height_lasts_twice_as_long():
    own = mini_pupper()
    tall = replace(own, standing_height_m=4 * own.standing_height_m)
    gained = []
    for body in (own, tall):
        strides, actions = Strides(body, 1, 0.02, P), np.zeros((1, 12))
        facts = empty_facts(body, np.zeros((1, 3)), actions, actions, actions)
        feet = np.zeros((1, 4, 2)), np.zeros((1, 4))
        strides.advance(slice(None), np.ones((1, 4)), feet, np.ones((1, 3)), facts)
        gained.append(strides.velocity[0, 0])
    assert gained == pytest.approx([0.02 / 0.2, 0.01 / 0.2])


def test_a_stance_costs_as_far_as_it_is_from_a_crouch_and_a_spread():
    p = replace(P, crouch=0.02, spread=0.007)
    assert wr.stance(on_paths(FORWARD, 0.25), p)[0] == pytest.approx(0.027)
    low = {leg: np.array([0.03, 0.01 * SIDE[leg], 0.015]) for leg in LEGS}
    assert wr.stance(on_paths(FORWARD, 0.25, **low), p)[0] == pytest.approx(0.005 + 0.003)
    # the mean counts: one foot may rise, and all may lean to one side
    asked = {leg: np.array([0.0, 0.007 * SIDE[leg] + 0.004, 0.02]) for leg in LEGS}
    asked[LF] += [0.0, 0.0, 0.004]
    asked[RB] -= [0.0, 0.0, 0.004]
    assert wr.stance(on_paths(FORWARD, 0.25, **asked), p)[0] == pytest.approx(0.0, abs=1e-9)
    assert wr.stance(on_paths((0, 0, 0), 0.25), p)[0] == 0.0


def test_a_curriculum_fades_guides_and_progress_and_widens_what_tracks():
    s = step(command=FORWARD, stride_velocity=(0.2, 0, 0), action=1.0, clock=(0.0, 1.0, 0.0))
    s = replace(s, foot_height_m=np.array([[0.01, 0.0, 0.0, 0.0]]))
    p = replace(P, progress=2.0, foot_paths=1.0)
    whole = weighted(s, p)
    assert whole["foot_paths"][0] and whole["progress"][0]
    for faded, names in (
        (weighted(s, p, guides=0.5), wr.GUIDES), (weighted(s, p, progress=0.5), wr.PROGRESS)
    ):  # fmt: skip
        assert {k: v[0] for k, v in faded.items()} == {
            k: (0.5 if k in names else 1.0) * v[0] for k, v in whole.items()
        }
    wide = narrowed(p, 2.0, 3.0)
    assert (wide.linear_sigma, wide.stride_linear_sigma) == (
        2 * p.linear_sigma, 2 * p.stride_linear_sigma
    )  # fmt: skip
    assert wide.angular_sigma == 3 * p.angular_sigma and wide.progress == p.progress


def test_every_robot_is_judged_by_its_own_numbers():
    one, other = step(command=FORWARD), step(foot_height_m=0.1, linear_velocity=(0.3, 0.0, 0.1))
    both = Step(
        body=mini_pupper(),
        **{f.name: np.concatenate([getattr(one, f.name), getattr(other, f.name)]) for f in ARRAYS},
    )
    for name, term in TERMS.items():
        np.testing.assert_allclose(
            term(both, RELEASE_REWARDS),
            [term(one, RELEASE_REWARDS)[0], term(other, RELEASE_REWARDS)[0]],
            err_msg=name,
        )


# --------------------------------------------------------------------------------------- weights


def only(**given: Any) -> Rewards:
    none: dict[str, Any] = dict.fromkeys(TERMS, 0.0)
    return Rewards(**(none | given))


def test_a_term_counts_with_its_weight_penalties_with_their_factor_and_none_without():
    assert set(TERMS) <= {field.name for field in fields(DEFAULT_REWARDS)}
    assert weighted(step(), only()) == {}
    assert list(weighted(step(), only(alive=0.5))) == ["alive"]
    assert set(weighted(step(), RELEASE_REWARDS)) == {
        k for k, v in weights(RELEASE_REWARDS).items() if v
    }
    s = step(action=joints(j0=2.0))
    found = weighted(s, only(alive=0.5, action_rate=-0.1), penalties=0.25)
    assert found["alive"][0] == 0.5
    assert found["action_rate"][0] == pytest.approx(-0.1 * 0.25 * 4.0)
    assert weighted(s, only(action_rate=-0.1))["action_rate"][0] == pytest.approx(-0.4)


def weights(rewards: Rewards) -> dict[str, float]:
    return {name: getattr(rewards, name) for name in TERMS}


# facts/paper.md section 3: weights of the released training configuration
PUBLISHED = {
    "base_linear_velocity": 15.0, "base_angular_velocity": 10.0, "air_time": 5.0,
    "foot_clearance": 1.0, "gait": 10.0, "action_smoothness": -2.0, "air_time_variance": -1.0,
    "base_motion": -2.0, "base_orientation": -5.0, "foot_slip": -0.5, "joint_position": -3.0,
    "hip_abduction": -2.5, "joint_torques": -5e-4, "joint_acceleration": -2.5e-4,
    "joint_velocity": -1e-2,
}  # fmt: skip
PARAMETERS = {
    "tracking_shape": "exponential", "linear_sigma": 0.1, "angular_sigma": 0.2, "fast_bonus": 0.5,
    "fast_above": 0.15, "air_time_most": 0.25, "clearance_height": 0.03, "clearance_sigma": 0.05,
    "clearance_speed": 2.0, "gait_sigma": 0.08, "gait_most": 0.15, "standing_factor": 10.0,
    "moving_threshold": 0.15, "gait_threshold": 0.1,
}  # fmt: skip
# the paper's text: smoothness -1.0, joint position -0.7 (orientation and slip as released)
PAPERS_OWN = {"action_smoothness": -1.0, "joint_position": -0.7}


def test_presets_have_the_released_weights_but_those_of_the_paper_where_it_states_any():
    for rewards, published in (
        (RELEASE_REWARDS, PUBLISHED),
        (PAPER_REWARDS, PUBLISHED | PAPERS_OWN),
    ):
        assert {k: v for k, v in weights(rewards).items() if v} == published
        assert {k: getattr(rewards, k) for k in PARAMETERS} == PARAMETERS
    assert PRESETS["paper"].rewards == PAPER_REWARDS
    assert PRESETS["release"].rewards == RELEASE_REWARDS
    assert PRESETS["fast"].rewards == DEFAULT_REWARDS


# ----- clearance of swings and effort of servos, from made-up motion whose answer is known

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


# ----- strides: times of swings and stances, mean velocities, and the clock that follows the feet

SPAN = 0.02
WHOLE = slice(None)
REWARDS = replace(Rewards(), clock_hz=3.6, clock_pull_hz=0.5, clock_height=0.012)


def steps_of(rates: np.ndarray, seconds: float, start: float = 0.0) -> tuple[Strides, np.ndarray]:
    """Feet that step as a trot at these rates; the strides, and `in_time` of the last 2 s."""
    strides, n = Strides(mini_pupper(), len(rates), SPAN, REWARDS), len(rates)
    none = np.zeros((n, 12))
    seen = []
    for k in range(round(seconds / SPAN)):
        x = np.sin(2 * np.pi * (rates * k * SPAN + start))
        first, second = 0.012 * np.maximum(x, 0), 0.012 * np.maximum(-x, 0)
        height = np.column_stack([first, second, second, first])
        facts = empty_facts(mini_pupper(), np.zeros((n, 3)), none, none, none)
        touch = np.where(height > 0, 0.0, 1.0)
        strides.advance(WHOLE, touch, (np.zeros((n, 4, 2)), height), np.zeros((n, 3)), facts)
        seen.append(facts["clock"][:, 2].copy())
    return strides, np.array(seen[-100:])


def test_the_clock_falls_into_step_with_a_trot_of_its_rate_and_other_rates_are_not_in_time():
    for start in (0.0, 0.2, 0.4, 0.7):
        _, in_time = steps_of(np.array([3.6, 3.4, 3.8]), 8.0, start)
        assert (in_time.mean(axis=0) > [0.95, 0.7, 0.7]).all()
    _, in_time = steps_of(np.array([0.0, 1.8, 2.5, 4.7, 6.0, 8.0]), 20.0)
    assert (in_time.mean(axis=0) < 0.45).all()


def test_swings_and_stances_are_counted_and_begin_anew_with_an_episode():
    strides, _ = steps_of(np.array([2.5, 2.5]), 1.0)
    assert strides.air_s.max() <= 0.2 and strides.stance_s.max() <= 0.22
    assert ((strides.air_s > 0) != (strides.stance_s > 0)).all()
    velocity = np.array([[0.1, 0.2, 0.3]])
    strides.reset(np.array([1]), np.zeros((1, 4, 2)), velocity)
    assert not strides.air_s[1].any() and strides.air_s[0].any()
    assert strides.phase[1] == strides.in_time[1] == 0.0
    np.testing.assert_array_equal(strides.velocity[1:], velocity)
