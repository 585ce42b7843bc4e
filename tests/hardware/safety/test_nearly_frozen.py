"""A reading stuck but for noise stops a robot; a healthy servo that moves little does not."""

from dataclasses import replace

import numpy as np
import pytest

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.safety.guard import GuardedBus, GuardLimits
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.pendulum import BenchSpec, Pendulum, PendulumBench, draw_bench
from pupper_sysid.sim.emulator.robot import RobotSpec, draw_robot
from support.following_bus import FollowingBus

PERIOD_S = 0.02
COARSE, FINE = 2 * np.pi / 1024, 2 * np.pi / 4096
STOPS = "its reading stayed within"


class Following(FollowingBus):
    """One servo that moves by a share of its command; its reading is noisy by whole steps."""

    def __init__(self, quantum: float | None, share: float, noise_steps: int):
        super().__init__(reach_rad=3.0)
        self.metadata = {} if quantum is None else {"command_quantum_rad": {"LF_hip": quantum}}
        self.quantum, self.share, self.noise = quantum or COARSE, share, noise_steps
        self.rng = np.random.default_rng(0)

    def read(self) -> BusSample:
        noise = self.rng.integers(-self.noise, self.noise + 1)
        count = np.round(self.share * self.goal / self.quantum) + noise
        return self.sample(count * self.quantum)


def sweep_of(bus: Following, amplitude: float, hz: float, seconds: float = 4.5) -> None:
    """Command a tone through a guard, which raises for a fault."""
    guard = GuardedBus(bus, GuardLimits(astray_rad=9.0))
    guard.torque(True)
    guard.write(guard.read().position_rad)
    start = guard.now()
    for k in range(round(seconds / PERIOD_S)):
        guard.sleep_until(start + (k + 1) * PERIOD_S)
        guard.write(np.full(1, amplitude * np.sin(2 * np.pi * hz * (guard.now() - start))))
        guard.read()


@pytest.mark.parametrize(
    ("quantum", "steps", "hz"),
    # a fine encoder may flicker by two steps to both sides
    [*((quantum, 1, hz) for quantum in (COARSE, FINE, None) for hz in (0.2, 1.0, 4.0)),
     (FINE, 2, 1.0)],
)  # fmt: skip
def test_a_reading_frozen_but_for_a_step_stops_a_tone_of_six_tenths_of_a_radian(quantum, steps, hz):
    bus = Following(quantum, share=0.0, noise_steps=steps)
    with pytest.raises(SafetyStop, match=f"LF_hip was commanded to move by .* {STOPS}"):
        sweep_of(bus, 0.3, hz)


@pytest.mark.parametrize(
    ("quantum", "share", "noise", "amplitude", "hz"),
    [
        # moves by more than a twenty-fifth of its command, or by more than four steps
        (COARSE, 0.05, 0, 0.3, 1.0), (FINE, 0.02, 0, 0.3, 4.0), (FINE, 0.05, 1, 0.3, 1.0),
        # the command itself moves little, so that friction may hold the servo
        (COARSE, 0.0, 1, 0.14, 2.0), (FINE, 0.0, 1, 0.14, 2.0),
    ],
)  # fmt: skip
def test_a_servo_that_moves_by_more_than_noise_or_is_commanded_little_goes_on(
    quantum, share, noise, amplitude, hz
):
    sweep_of(Following(quantum, share, noise), amplitude, hz)


@pytest.mark.parametrize(
    ("noise", "amplitude", "reading", "words"),
    [
        # an infinite reading is a missing one
        (0, 0.05, lambda time: {"position_rad": np.full(1, np.inf if time > 3.0 else 0.0)},
         "silent|did not change"),
        # a time that is NaN would make every comparison of times false
        (1, 0.3, lambda time: {"time_s": np.full(1, np.nan)}, STOPS),
    ],
)  # fmt: skip
def test_a_reading_that_is_no_number_or_of_no_time_is_monitored_all_the_same(
    noise, amplitude, reading, words
):
    bus = Following(FINE, share=0.0, noise_steps=noise)
    read = bus.read
    bus.read = lambda: replace(read(), **reading(bus.time))
    with pytest.raises(SafetyStop, match=words):
        sweep_of(bus, amplitude, 1.0)


def emulated(kind: str) -> EmulatedBus:
    rng = np.random.default_rng(3)
    if kind == "polled":
        return EmulatedBus(draw_robot(rng, RobotSpec(loss=0.6)), rng, keep_log=False)
    if kind == "sticky":  # half the published stiffness, more friction, a long dead time
        spec = RobotSpec(
            loss=0.6, dead_time_s=0.1, stiffness_per_inertia=6350, friction_per_inertia=250
        )
        return EmulatedBus(draw_robot(rng, spec), rng, keep_log=False)
    robot = draw_bench(rng, Pendulum(0.5, 0.15), BenchSpec(registers=(("p", 8),)))
    return EmulatedBus(robot, rng, plant=PendulumBench(robot), keep_log=False)


@pytest.mark.parametrize("kind", ["polled", "sticky", "heavy pendulum"])
def test_no_healthy_emulated_servo_is_stopped_at_any_tone(kind):
    """Each joint at a tone of its own, 0.2 to 10 Hz and 0.02 to 0.3 rad, below 7 rad/s."""
    bus = emulated(kind)
    rng, joints = np.random.default_rng(5), len(bus.joint_names)
    hz = np.geomspace(0.2, 10.0, joints) if joints > 1 else np.array([7.5])
    amplitude = rng.permutation(np.geomspace(0.02, 0.3, joints)) if joints > 1 else np.array([0.15])
    amplitude = np.minimum(amplitude, 7.0 / (2 * np.pi * hz))
    guard = GuardedBus(bus)
    guard.read()
    guard.sleep_until(0.5)
    guard.torque(True)
    home = bus.robot.joint_map.rest_pose()
    guard.write(home)
    start = guard.now()
    for k in range(round(5.0 / PERIOD_S)):
        guard.sleep_until(start + (k + 1) * PERIOD_S)
        guard.write(home + amplitude * np.sin(2 * np.pi * hz * (guard.now() - start)))
        guard.read()


def test_a_servo_that_reports_its_torque_off_stops_also_a_tone_of_two_tenths_of_a_radian():
    bus = Following(FINE, share=0.0, noise_steps=1)
    vars(bus)["has_lost_torque"] = lambda joint: True  # as after a reboot
    with pytest.raises(SafetyStop, match="LF_hip .* Its torque is off although"):
        sweep_of(bus, 0.1, 2.0)
