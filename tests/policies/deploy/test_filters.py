"""Filters of deployment: the low-pass by its formula, attitude against bodies that really turn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pupper_sysid.policies.deploy.controller import ComplementaryFilter, LowPass, Rest, at_rest
from support.refusals import assert_each_refused

G = 9.80665
DOWN = np.array([0.0, 0.0, -1.0])

# ---------------------------------------------------------------------------------- low-pass


def test_impulse_response_obeys_the_published_coefficients_at_25_hz():
    # facts/paper.md 5.3: b .4347 .8695 .4347, a 1 .5193 .2197
    smooth = LowPass(8.0, 25.0, 1)
    y = [smooth([x])[0] for x in (1.0, 0.0, 0.0, 0.0)]
    b, a1, a2 = (0.4347, 0.8695, 0.4347), 0.5193, 0.2197
    expected = [b[0], b[1] - a1 * b[0]]
    expected.append(b[2] - a1 * expected[1] - a2 * expected[0])
    expected.append(-a1 * expected[2] - a2 * expected[1])
    assert y == pytest.approx(expected, abs=2e-4)


def test_phase_delay_at_the_gait_is_the_published_one():
    for rate_hz, delay_ms in ((25.0, 19.0), (50.0, 27.0)):
        smooth, angle = (
            LowPass(8.0, rate_hz, 1),
            2 * np.pi * 2.8 * np.arange(40 * rate_hz) / rate_hz,
        )
        out = np.array([smooth([x])[0] for x in np.sin(angle)])
        last = slice(len(angle) // 2, None)
        turned = 2j * np.mean(out[last] * np.exp(-1j * angle[last]))
        assert -1e3 * np.angle(turned) / (2 * np.pi * 2.8) == pytest.approx(delay_ms, abs=0.7)


def test_reset_is_the_steady_state_of_each_channel_so_a_constant_input_passes_unchanged():
    value = np.linspace(-2.0, 2.0, 12)
    smooth = LowPass(8.0, 25.0, 12)
    smooth([9.0] * 12)
    smooth.reset(value)
    for _ in range(50):
        assert smooth(value) == pytest.approx(value, abs=1e-14)


def test_cutoffs_that_cannot_be_are_refused():
    cutoffs = [(c, "half the rate, 12.5 Hz") for c in (12.5, 20.0, 0.0, -1.0, np.nan)]
    assert_each_refused(cutoffs, lambda cutoff_hz: LowPass(cutoff_hz, 25.0, 12))


# ---------------------------------------------------------------------------------- attitude


def start(gravity: list[float]) -> Rest:
    return Rest(np.array(gravity, float), np.zeros(3))


def tumble(steps: int, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Body rates of a tumbling trunk, and gravity in its frame after each step, both (n, 3)."""
    time = dt_s * np.arange(steps)
    rates = np.stack([1.3 * np.sin(5 * time), 0.9 * np.cos(3 * time), 0.7 + 0 * time], axis=1)
    attitude, gravity = Rotation.identity(), []
    for rate in rates:
        attitude = attitude * Rotation.from_rotvec(rate * dt_s)
        gravity.append(attitude.inv().apply(DOWN))
    return rates, np.array(gravity)


def errors(weight: float) -> np.ndarray:
    """Angles between the filter's gravity, 0.1 rad wrong at first, and that of a tumbling body."""
    dt_s, found = 0.02, []
    imu = ComplementaryFilter(weight)
    imu.reset(start([np.sin(0.1), 0, -np.cos(0.1)]))
    for rate, gravity in zip(*tumble(400, dt_s), strict=True):
        seen = imu.step(rate, -G * gravity, dt_s).gravity
        found.append(np.linalg.norm(np.cross(seen, gravity)) if seen @ gravity > 0 else 2.0)
    return np.array(found)


def test_the_gyro_turns_gravity_with_a_tumbling_body_and_the_accelerometer_corrects_its_start():
    assert errors(weight=0.0) == pytest.approx(np.full(400, np.sin(0.1)), abs=1e-9)
    # each sample keeps 1 - weight of a small angle: 400 of them leave 0.03 % of it
    assert errors(weight=0.02)[-1] == pytest.approx(0.1 * 0.98**400, rel=0.02)


def test_signs_of_the_body_frame_and_what_a_bias_and_a_clock_that_stood_still_do():
    for axis, gravity in (
        ([0, 1, 0], [np.sin(0.3), 0, -np.cos(0.3)]),  # nose down: gravity points forward
        ([1, 0, 0], [0, -np.sin(0.3), -np.cos(0.3)]),  # left side up: gravity points right
        ([0, 0, 1], [0, 0, -1]),  # a turn on the spot
    ):
        imu = ComplementaryFilter(weight=0.0)
        seen = [imu.step(np.array(axis) * 1.5, [0, 0, G], 0.02) for _ in range(10)][-1]
        assert seen.gravity == pytest.approx(gravity, abs=1e-12)
    imu = ComplementaryFilter(weight=0.0)
    found = imu.step([1.0, 0, 0], [0, 0, G], 0.0)  # counts as a millisecond
    assert found.gravity == pytest.approx([0, -np.sin(1e-3), -np.cos(1e-3)], abs=1e-12)
    imu.reset(Rest(DOWN, np.array([0.1, -0.2, 0.3])))
    found = imu.step([0.1, -0.2, 0.8], [0, 0, G], 0.02)
    assert found.rate_rad_s == pytest.approx([0, 0, 0.5])
    assert found.gravity == pytest.approx(DOWN) and not found.clipped


def test_clipped_samples_and_reads_of_zeros_move_gravity_by_the_gyro_alone():
    rate = [0.2, 0.4, -0.1]
    for force in ([2 * G, 0, G], [0, 0, -2 * G * 32767 / 32768], [0, 30.0, 0]):
        imu, gyro_only = ComplementaryFilter(weight=0.4), ComplementaryFilter(weight=0.0)
        seen = imu.step(rate, force, 0.02)
        assert seen.clipped
        assert seen.gravity == pytest.approx(gyro_only.step(rate, force, 0.02).gravity, abs=1e-15)
        assert not imu.step(rate, [0, 0, G], 0.02).clipped
    imu.reset(start([0.6, 0.0, -0.8]))
    assert imu.step([0, 0, 0], [0, 0, 0], 0.02).gravity == pytest.approx([0.6, 0, -0.8])


# ---------------------------------------------------------------------------------- at rest


def still(tilt: Rotation | None = None) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    up = np.array([0, 0, G]) if tilt is None else tilt.inv().apply([0, 0, G])
    rates = np.array([0.02, -0.05, 0.01]) + 0.003 * rng.standard_normal((50, 3))
    return rates, up + 0.05 * rng.standard_normal((50, 3))


def test_at_rest_finds_bias_and_gravity_to_the_noise_of_the_mean():
    tilt = Rotation.from_euler("xy", [4.0, -7.0], degrees=True)
    rest = at_rest(*still(tilt))
    assert rest.bias_rad_s == pytest.approx([0.02, -0.05, 0.01], abs=4 * 0.003 / np.sqrt(50))
    assert rest.gravity == pytest.approx(tilt.inv().apply(DOWN), abs=4 * 0.05 / G / np.sqrt(50))
    assert np.linalg.norm(rest.gravity) == pytest.approx(1)
    imu = ComplementaryFilter()
    imu.reset(rest)
    assert imu.step(rest.bias_rad_s, -G * rest.gravity, 0.02).gravity == pytest.approx(rest.gravity)


def test_at_rest_refuses_what_is_not_a_robot_at_rest():
    rates, forces = still()
    jerked, turning = rates.copy(), rates + np.array([0, 0, 0.5])
    jerked[20:25, 1] += 0.4
    cases = [
        ((jerked, forces), "moved"), ((turning, forces), "moved"),
        *(((rates, scale * forces), "not 9.81") for scale in (0.0, 0.8, 1 / G)),
        (still(Rotation.from_euler("x", 45, degrees=True)), "tilted by 4"),
        ((rates, -forces), "upside down"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda samples: at_rest(*samples))
