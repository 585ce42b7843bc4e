"""A frozen hip is found where a model of its servo moves, and nothing is found where none does."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.data import SAMPLES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.policies.deploy.assembly import WINDOW_S, FrozenReadings, assemble
from pupper_sysid.policies.deploy.controller import Decision, Senses
from pupper_sysid.policies.deploy.deployment import Outcome, Tick, constant, deploy
from pupper_sysid.policies.deploy.stacks import STACKS, SyntheticPD, suited
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sim.walking.robot import WalkingBus
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.tiny_training import CALIBRATION

HIP = JOINT_NAMES.index("RF_hip")
PERIOD_S = 0.02


class Frozen(WalkingBus):
    """A robot whose hip reports one position from a time on."""

    def __init__(self, from_s: float):
        rng = np.random.default_rng(0)
        super().__init__(draw_robot(rng), rng)
        self.from_s, self.last = from_s, 0.0

    def read(self) -> BusSample:
        sample = super().read()
        if self.now() < self.from_s:
            self.last = float(sample.position_rad[HIP])
            return sample
        position = sample.position_rad.copy()
        position[HIP] = self.last
        return replace(sample, position_rad=position)


def walk(
    bus: WalkingBus, command: tuple[float, float, float], seconds: float, folder: Path, kind: str
) -> Outcome:
    policy = load_policy(SAMPLES / "policies" / kind)
    stack = STACKS[suited(policy.contract)]
    parts = assemble(policy, stack, load_joint_map("mini_pupper_2"), CALIBRATION, None)
    with closing(GuardedBus(bus)) as guard:
        return deploy(
            guard, bus, parts.controller, constant(command), seconds, folder / "walk.csv",
            parts.header, watchers=[parts.frozen_readings],
        )  # fmt: skip


@pytest.mark.parametrize(
    ("from_s", "command", "seconds", "kind", "found"),
    [
        # a second after the walk begins; in faster turns the guard finds it first
        (2.8, (0.0, 0.0, 0.35), 4.0, "lstm", True),
        pytest.param(99.0, (0.0, 0.0, 0.35), 4.0, "lstm", False, marks=pytest.mark.slow),
        # straight ahead hips move by a few hundredths of a radian, and the walk goes on
        pytest.param(3.3, (0.15, 0.0, 0.0), 7.0, "mlp", True, marks=pytest.mark.slow),
        pytest.param(99.0, (0.15, 0.0, 0.0), 7.0, "mlp", False, marks=pytest.mark.slow),
    ],
)
def test_a_hip_that_freezes_is_found_where_its_servo_must_move(
    tmp_path, from_s, command, seconds, kind, found
):
    bus = Frozen(from_s)
    outcome = walk(bus, command, seconds, tmp_path, kind)
    assert ("RF_hip has reported the same position for 2 s" in outcome.stop_reason) is found
    if found:
        assert bus.now() - from_s < WINDOW_S + 0.5
    else:
        assert outcome.stop_reason == "time is up"


def ticks(goals: np.ndarray, readings: np.ndarray) -> list[Tick]:
    """Ticks in which the hip is commanded and read so, and the other joints rest."""
    made = []
    for goal, reading in zip(goals, readings, strict=True):
        sent, position = np.zeros(12), np.zeros(12)
        sent[HIP], position[HIP] = goal, reading
        sample = BusSample(np.zeros(12), position, np.zeros(12))
        made.append(Tick(0.0, Senses(0.0, *[sent] * 5), Decision(*[sent] * 4), sent, sample))
    return made


def watched(made: list[Tick]) -> bool:
    """Whether they end in a stop."""
    servos = SyntheticPD(DelayedPDParameters(**servo_ranges(CALIBRATION).value), PERIOD_S)
    watch = FrozenReadings(servos, lambda angles: angles)
    try:
        for tick in made:
            watch(tick)
    except SafetyStop as stop:
        assert "RF_hip" in str(stop)
        return True
    return False


TIME = PERIOD_S * np.arange(200)


def test_less_than_the_guard_sees_is_found_and_friction_counts_and_late_commands_are_allowed_for():
    still, rows, nothing = np.zeros(len(TIME)), np.arange(len(TIME)), np.full(len(TIME), np.nan)
    goals = 0.045 * np.sin(2 * np.pi * 1.5 * TIME)  # below the guard's 0.1 rad
    alive = 0.0057 * (rows // 90 % 2)  # one step of the encoder in two seconds
    for asked, readings, found in (
        (goals, still, True), (0.012 / 0.045 * goals, still, False), (goals, alive, False),
        (goals, np.where(rows % 3, np.nan, alive), False),
        (goals, nothing, False),  # silence is the guard's business
        (np.where(rows < len(TIME) - 12, 0.0, 0.09), still, False),
    ):  # fmt: skip
        assert watched(ticks(asked, readings)) is found
