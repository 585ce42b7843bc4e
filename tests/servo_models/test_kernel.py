"""The compiled simulation against its NumPy twin, against DelayedPD, and against itself."""

import numpy as np
import pytest
from reference.servo import columns, delayed, servo

from pupper_sysid.servo_models import kernel
from pupper_sysid.servo_models.sparse_equation import SparseEquation
from pupper_sysid.sysid.fit.run import at_steps
from pupper_sysid.sysid.fit.structure import candidate

STEP_S, PAD, STEPS = 0.002, 220, 900
NO_LOAD = np.zeros(3)
BASE = {
    "stiffness": 9000.0, "damping": 90.0, "friction_loss": 120.0, "effort_limit": 450.0,
    "back_emf": 20.0,
}  # fmt: skip
TERMS = {
    "slew": {"velocity_limit": 6.0},
    "profile": {"acceleration_limit": 80.0},
    "profile of limited speed": {"acceleration_limit": 120.0, "velocity_limit": 3.0},
    "dead zone and start duty": {"dead_zone_rad": 0.004, "start_duty": 0.02},
    "Stribeck": {"stribeck_friction": 60.0, "stribeck_speed": 0.3},
    "gravity": {"gravity_nm": 150.0, "hanging_rad": 0.4},
    "load friction": {
        "gravity_nm": 150.0, "load_friction_motor": 0.15, "load_friction_load": 0.1,
        "load_friction_static": 0.5, "load_friction_quadratic": 1e-4,
    },
    "torque limit": {"torque_limit": 250.0},
    "backlash": {"backlash_rad": 0.01},
    "integral": {"integral_per_s": 3.0},
    "flexible link": {"link_share": 0.3, "link_hz": 9.0, "link_damping_ratio": 0.06},
    "another inertia": {"armature": 2.5},
}  # fmt: skip


def held(rows: int = 1) -> np.ndarray:
    """A chirp and a jump from rest; for three rows the torque goes off and the voltage sags."""
    time = STEP_S * np.arange(STEPS)
    signal = np.ones((rows, PAD + STEPS))
    signal[0, :PAD] = 0.1
    signal[0, PAD:] = 0.1 + 0.4 * np.sin(9.0 * time**2) + 0.3 * (time > 1.3)
    if rows == 3:
        signal[1, PAD + 500 : PAD + 700] = 0.0
        signal[2, PAD:] = 1.0 - 0.1 * np.sin(5.0 * time)
    return signal


def edges(signal: np.ndarray) -> np.ndarray:
    """The command changes within each step, where it goes up after 0.3 of it."""
    return np.stack([signal[0], np.where(np.arange(signal.shape[1]) % 3 == 0, 0.3, 0.0)])


def compiled(rows, dead_time, signal, gain=1.0, load=NO_LOAD, start=0.1):
    return kernel.positions(
        kernel.SERVO, np.atleast_2d(rows), np.atleast_1d(dead_time), signal, edges(signal), gain,
        load, start, PAD, STEP_S,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["slew", "profile", "profile of limited speed"])
def test_the_set_point_moves_in_long_steps_as_in_short_ones(name):
    """Commands in stairs, as a loop of 50 Hz sends them. An error here is one of the dead time."""
    stairs = np.repeat(0.3 * np.sin(2.0 * np.arange(90) * 0.02), 10)

    def positions(times: int) -> np.ndarray:
        signal = np.concatenate([np.zeros(PAD * times), np.repeat(stairs, times)])[None]
        signals = (signal, kernel.edges_of(signal[0]))
        row, delay = columns(**BASE, **TERMS[name])[None], np.array([7.0 * times])
        return kernel.positions(
            kernel.SERVO, row, delay, *signals, 1.0, NO_LOAD, 0.0, PAD * times, STEP_S / times
        )[::times, 0]

    exact = positions(64)
    long, short = (np.sqrt(np.mean((positions(n) - exact) ** 2)) for n in (1, 4))
    assert long < 4e-5 and short < long / 3


@pytest.mark.parametrize("name", TERMS)
def test_every_term_moves_as_its_equation_says(name):
    row = columns(**BASE, **TERMS[name], offset_rad=0.03)
    expected = servo(row, 7.3, held(), edges(held()), 1.5, NO_LOAD, 0.1, PAD, STEP_S)
    assert np.abs(compiled(row, 7.3, held(), 1.5)[:, 0] - expected).max() < 1e-7
    without = compiled(columns(**BASE, offset_rad=0.03), 7.3, held(), 1.5)[:, 0]
    assert np.abs(without - expected).max() > 1e-3  # the motion shows the term


def test_all_terms_together_under_a_load_with_the_torque_off_and_a_sagging_supply():
    numbers = dict(BASE, off_brake=0.3)
    for more in TERMS.values():
        numbers |= more
    row, load = columns(**numbers), np.array([1.4, 90.0, -0.2])
    expected = servo(row, 4.6, held(3), edges(held(3)), 0.7, load, 0.1, PAD, STEP_S)
    assert np.abs(compiled(row, 4.6, held(3), 0.7, load)[:, 0] - expected).max() < 1e-7


def test_a_scaled_inertia_moves_alike():
    doubled = {name: 2.0 * value for name, value in BASE.items()}
    one = compiled(columns(**BASE, velocity_limit=6.0), 7.3, held())
    two = compiled(columns(**doubled, armature=2.0, velocity_limit=6.0), 7.3, held())
    assert np.abs(one - two).max() < 1e-9


def test_candidates_do_not_depend_on_their_neighbours():
    rows = np.array([columns(**BASE, **more) for more in TERMS.values()] * 2)
    dead_times = np.linspace(0.3, 20.0, len(rows))
    together = compiled(rows, dead_times, held())
    for k in (0, 3, 15, 16, len(rows) - 1):
        alone = compiled(rows[k], dead_times[k], held())[:, 0]
        np.testing.assert_allclose(together[:, k], alone, atol=1e-9)


def linear(kind: str, values: np.ndarray, command: np.ndarray, h: float) -> np.ndarray:
    """Motion of a linear model under a command that is delayed already."""
    y = v = 0.0
    out = [0.0]
    for c in command:
        if kind == "pure_delay":
            y = c
        elif kind == "fopdt":
            y += (1 - np.exp(-h / values[1])) * (c - y)
        else:  # backward Euler of y'' = w² (c - y) - 2 z w y'
            w, z = values[1:3]
            v = (v + h * w**2 * (c - y)) / (1 + 2 * h * z * w + (h * w) ** 2)
            y += h * v
        out.append(values[0] * y)
    return np.array(out)


@pytest.mark.parametrize(
    ("name", "values"), [("pure_delay", [0.9]), ("fopdt", [1.1, 0.03]), ("sopdt", [1.0, 70.0, 0.5])]
)
def test_linear_models_move_about_their_first_reading(name, values):
    row = np.array([*values, 0.02])
    rest = 0.1 - 0.02
    expected = rest + linear(name, row, delayed(held()[0], 5.5, PAD) - rest, STEP_S) + 0.02
    found = kernel.positions(
        candidate(name).kind, row[None], np.array([5.5]), held(), edges(held()), 1.0,
        NO_LOAD, 0.1, PAD, STEP_S,
    )  # fmt: skip
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)


def test_the_sparse_equation_is_that_of_the_servo_model():
    numbers = {
        "stiffness_per_s2": 3000.0, "saturated_stiffness_per_s2": 4000.0,
        "saturation_error_rad": 0.05, "damping_per_s": 60.0, "drag_per_rad": 3.0,
        "friction_rad_s2": 80.0,
    }  # fmt: skip
    own = SparseEquation(numbers, 5.5 * STEP_S, 0.0, STEP_S)
    own.reset(0.1)
    found = kernel.positions(
        kernel.SPARSE, np.array([[*numbers.values(), 0.0]]), np.array([5.5]), held(),
        edges(held()), 1.0, NO_LOAD, 0.1, PAD, STEP_S,
    )  # fmt: skip
    np.testing.assert_allclose(found[1:, 0], own.rollout(held()[0, PAD:]), atol=1e-9)


def test_readings_between_steps_lie_on_the_parabola_of_a_constant_torque():
    """At a torque limit the motion is a parabola, which a line misses by a h² / 8."""
    row = columns(stiffness=9000.0, effort_limit=450.0)[None]
    jump = np.concatenate([np.zeros(PAD), np.ones(60)])[None]
    simulated = (kernel.SERVO, row, np.zeros(1), jump, edges(jump) * [[1], [0]], 1.0, NO_LOAD, 0.0,
                 PAD, STEP_S)  # fmt: skip
    step = np.linspace(5.0, 20.0, 200)
    moved = kernel.residuals(*simulated, step=step, reading=np.zeros(200))[0]
    expected = 0.5 * 450.0 * (STEP_S * step) ** 2
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_residuals_costs_and_moments_are_of_the_same_motion():
    rng = np.random.default_rng(0)
    rows = np.array([columns(**BASE, **more, offset_rad=0.01) for more in TERMS.values()] * 2)
    step = np.sort(rng.uniform(0.0, STEPS, 60))
    reading = rng.uniform(-0.3, 0.6, 60)
    dead_time = rng.uniform(0.5, 30.0, len(rows))
    simulated = (
        kernel.SERVO, rows, dead_time, held(), edges(held()), 1.0, NO_LOAD, 0.1, PAD, STEP_S,
    )  # fmt: skip
    track = kernel.positions(*simulated)

    def at(time):
        return np.array([at_steps(t, time) for t in track.T])

    errors = at(step) - reading
    found = kernel.residuals(*simulated, step=step, reading=reading)
    np.testing.assert_allclose(found, errors, atol=1e-12)
    cost = np.sum(np.sqrt(1 + (errors / 0.02) ** 2) - 1, axis=1)
    found = kernel.costs(*simulated, step=step, reading=reading, noise=0.02)
    np.testing.assert_allclose(found, cost, rtol=1e-10)
    later = np.array([0.0, 2.0, 7.5])
    total, square = kernel.moments_if_later(*simulated, step=step, reading=reading, later=later)
    moved = np.array([at(np.maximum(step - d, 0.0)) - reading for d in later])
    np.testing.assert_allclose(total, moved.sum(axis=-1), atol=1e-10)
    np.testing.assert_allclose(square, (moved**2).sum(axis=-1), atol=1e-10)


def test_a_joint_whose_force_equals_its_friction_stands_still():
    """Its velocity and the one after the step are both 0, of which a share cannot be taken."""
    columns = np.tile(kernel.ABSENT, (1, 1))
    for name, value in {"stiffness": 100.0, "friction_loss": 10.0, "effort_limit": 1e3}.items():
        columns[0, kernel.COLUMNS.index(name)] = value
    held = np.full((1, 60), 0.1)
    still = kernel.positions(
        kernel.SERVO, columns, np.zeros(1), held, kernel.edges_of(held[0]), 1.0, np.zeros(3), 0.2,
        10, 0.002,
    )  # fmt: skip
    assert np.array_equal(still[:, 0], np.full(51, 0.2))
