"""A loaded bench: gains and drops are recorded, the mass is handled gently, all is undone."""

from itertools import pairwise

import numpy as np
import pytest

from pupper_sysid.common.errors import BusError, InputError, SafetyStop
from pupper_sysid.hardware.safety.guard import GuardedBus
from pupper_sysid.sim.emulator.bus import EmulatedBus
from pupper_sysid.sim.emulator.pendulum import BenchSpec, Pendulum, PendulumBench, draw_bench
from pupper_sysid.sim.emulator.robot import draw_robot
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.servo_setup import PendulumLoad
from pupper_sysid.sysid.sweep import recorder
from pupper_sysid.sysid.sweep.bench import LIFT_RAD, LIFT_RAD_S, bench_plan, parse_gains, parse_load
from pupper_sysid.sysid.sweep.excitation import Plan, prbs, strokes
from pupper_sysid.sysid.sweep.recorder import record
from support.refusals import assert_each_refused

PERIOD = 0.01
LOAD = PendulumLoad(mass_kg=0.1, length_m=0.1)


def bench(hanging: float = 0.0, **spec: float) -> EmulatedBus:
    rng = np.random.default_rng(3)
    robot = draw_bench(rng, Pendulum(0.1, 0.1, 0.0, hanging), BenchSpec(**spec))
    return EmulatedBus(robot, rng, plant=PendulumBench(robot))


def trials(kind: str, gains=(8, 16), carried: PendulumLoad | None = LOAD, **more) -> Plan:
    given = {"loop_period_s": PERIOD, "start_rad": 0.0, "margin_rad": 2.6} | more
    return bench_plan("bench", carried, gains, kind, **given)


def test_a_load_is_named_by_mass_and_length_and_everything_else_is_refused():
    assert parse_load("none") is None
    named = parse_load("pendulum:0.25kg@0.08m,arm=0.02kg,hanging=-0.1rad")
    assert named == PendulumLoad(mass_kg=0.25, length_m=0.08, arm_mass_kg=0.02, hanging_rad=-0.1)
    loads = ("pendulum:0.1@0.1", "0.1kg@0.1m", "pendulum:0kg@0.1m", "pendulum:0.1kg@0.1m,arm=2",
             "pendulum:0.1kg@0.1m,leg=2kg", "pendulum:1.2.3kg@0.1m", "")  # fmt: skip
    assert_each_refused([(text, "is no load") for text in loads], parse_load)
    assert parse_gains("8, 16") == [8, 16]
    gains = ("0", "8,8", "-3", "1e1", "300", "8,,16")
    assert_each_refused([(text, "are no P gains") for text in gains], parse_gains)


def test_a_load_that_no_servo_holds_is_refused_and_one_that_sags_is_said():
    with pytest.raises(InputError, match="would overheat"):
        trials("bench", carried=PendulumLoad(mass_kg=1.0, length_m=0.2))
    heavy = PendulumLoad(mass_kg=0.4, length_m=0.15)
    warnings = trials("drop", gains=[4, 32], carried=heavy).warnings
    assert len(warnings) == 1 and "P gain 4" in warnings[0]


def test_a_lift_never_steps_and_is_slow():
    (trial, down) = trials("drop", gains=[8]).trials
    time = np.arange(0.0, trial.duration_s, 0.001)
    way = trial.offset(time)
    assert way.max() == pytest.approx(LIFT_RAD) and down.offset(time).min() == -way.max()
    speed = np.diff(way) / 0.001
    assert np.abs(speed).max() == pytest.approx(LIFT_RAD_S, rel=1e-3)
    # minimum jerk over T: the acceleration peaks at 10 / sqrt(3) · height / T²
    rise = 1.875 * LIFT_RAD / LIFT_RAD_S
    largest = np.abs(np.diff(speed)).max() / 0.001
    assert largest == pytest.approx(10 / np.sqrt(3) * LIFT_RAD / rise**2, rel=0.01)
    assert trial.release_s > rise


def test_a_bench_has_every_motion_at_every_gain():
    made = trials("bench", gains=[8, 16, 32])
    assert {t.p_gain for t in made.trials} == {8.0, 16.0, 32.0}
    for gain in (8, 16, 32):
        own = [t for t in made.trials if t.p_gain == gain]
        assert sum(np.isfinite(t.release_s) for t in own) == 2
        assert [t.frequency_hz for t in own if np.isfinite(t.frequency_hz)] == [0.5, 1.0, 2.0, 4.0]
        assert len(own) == 9
    free = trials("bench", gains=[], carried=None)
    assert all(np.isnan(t.p_gain) and np.isinf(t.release_s) for t in free.trials)
    with pytest.raises(InputError, match="without a load nothing drops"):
        trials("drop", carried=None)


def test_a_pseudo_random_sequence_is_balanced_and_white():
    bits = prbs(1.0)(0.11 * np.arange(127) + 0.01)
    assert set(bits) == {-1.0, 1.0} and abs(bits.sum()) == 1  # a maximal-length sequence
    spectrum = np.abs(np.fft.rfft(bits))[1:]
    np.testing.assert_allclose(spectrum, np.sqrt(128), rtol=1e-9)


def test_strokes_go_up_and_down_at_each_speed():
    offset, duration = strokes(0.2, [0.05, 0.1], 3)
    time = np.arange(0.0, duration, 0.01)
    speed = np.abs(np.diff(offset(time))) / 0.01
    assert offset(np.array([0.0, duration])).tolist() == [0.0, 0.0]
    assert offset(time).max() == pytest.approx(0.2, abs=1e-3)
    assert sorted({round(v, 3) for v in np.round(speed, 3)} - {0.0})[-1] == 0.1
    assert np.mean(np.isclose(speed, 0.05)) == pytest.approx(2 / 3, abs=0.05)


def test_gain_and_torque_of_every_row_are_recorded_and_the_gain_is_set_back(tmp_path):
    bus = bench()
    path = record(bus, trials("drop"), tmp_path / "a.csv", loop_period_s=PERIOD,
                  metadata={"loads": {"bench": LOAD.model_dump()}})  # fmt: skip
    assert bus._plant.register(0, "p") == 32
    recording = load(path)
    assert recording.metadata["servos"]["bench"]["p_gain"] == 32
    found = recording.trials("bench")
    assert [t.p_gain for t in found] == [8.0, 8.0, 16.0, 16.0]
    for trial in found:
        assert trial.load == LOAD
        off = ~trial.torque_enabled
        assert 0.2 < off.mean() < 0.6 and not off[: np.argmax(off)].any() and off[-1]
        # nothing is commanded while it swings, and it ends near the bottom
        assert np.ptp(trial.command_rad[off]) == 0.0
        assert abs(trial.position_rad[off][0]) > 1.2 and abs(trial.position_rad[-1]) < 0.5


def test_the_torque_comes_back_only_at_rest_and_the_way_back_is_slow(tmp_path):
    bus = bench(friction_nm=0.02)  # swings for long
    switched: list[tuple[float, bool, float]] = []
    written: list[tuple[float, float]] = []
    torque, write = bus.torque, bus.write

    def watched(on: bool) -> bool:
        ahead = [bus._plant.angle(0, bus.now() + k * 1e-3) for k in (0, 1)]
        switched.append((bus.now(), on, (ahead[1] - ahead[0]) / 1e-3))
        return torque(on)

    def noted(position):
        written.append((bus.now(), float(position[0])))
        return write(position)

    bus.torque, bus.write = watched, noted
    record(bus, trials("drop", gains=[16]), tmp_path / "a.csv", loop_period_s=PERIOD)
    caught = [s for before, s in pairwise(switched)
              if s[1] and not before[1]]  # fmt: skip
    assert len(caught) == 2 and all(abs(speed) < 0.1 for _, _, speed in caught)
    times, goals = np.array(written).T
    steps = np.abs(np.diff(goals))
    held = np.diff(times) < 0.05
    assert steps[held].max() <= 1.1 * 0.021  # 1 rad/s at 10 to 20 ms
    # across a drop: it is caught where it is, which is not where it was held
    assert (steps[~held] > 0.5).sum() == 2


def test_a_load_that_never_rests_stays_limp(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "REST_WITHIN_S", 1.0)
    bus = bench(friction_nm=0.0005)
    with pytest.raises(SafetyStop, match="still swings"):
        record(bus, trials("drop", gains=[16]), tmp_path / "a.csv", loop_period_s=PERIOD)
    assert bus._plant._servos[0]._limp and bus._plant.register(0, "p") == 32


@pytest.mark.parametrize("raises", [KeyboardInterrupt(), BusError("cable out")])
def test_the_gain_is_set_back_whatever_ends_the_recording(tmp_path, raises):
    bus = bench()
    write, count = bus.write, 0

    def failing(position):
        nonlocal count
        count += 1
        if count == 120:
            raise raises
        return write(position)

    bus.write = failing
    with pytest.raises(type(raises)):
        record(bus, trials("sine"), tmp_path / "a.csv", loop_period_s=PERIOD)
    assert bus._plant.register(0, "p") == 32 and bus._plant._servos[0]._limp


def test_a_register_that_cannot_be_set_back_is_kept_in_mind():
    bus = bench()
    guard = GuardedBus(bus)
    guard.set_register("bench", "p", 8)

    def refuses(joint: str, name: str, value: int) -> None:
        raise BusError("cable out")

    bus.set_register = refuses
    guard.close()
    assert guard.registers.originals == {"bench": {"p": 32}}


def test_a_load_that_does_not_hang_is_not_moved_and_a_bus_without_registers_has_no_gains(tmp_path):
    bus, path = bench(), tmp_path / "a.csv"
    with pytest.raises(InputError, match="rad from where its load hangs"):
        record(bus, trials("sine", start_rad=1.5, margin_rad=1.0), path, loop_period_s=PERIOD)
    assert bus._log and not path.exists()
    rng = np.random.default_rng(1)
    made = bench_plan("LF_hip", None, [8], "sine", loop_period_s=PERIOD, start_rad=0.0,
                      margin_rad=0.4)  # fmt: skip
    with pytest.raises(BusError, match="have no registers"):
        record(EmulatedBus(draw_robot(rng), rng), made, path, loop_period_s=PERIOD)
