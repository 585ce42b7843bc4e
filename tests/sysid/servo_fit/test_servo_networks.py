"""Learned servo models: what they compute, that what was trained is what runs, and fitting them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from pupper_sysid.servo_models.delayed_pd import (
    AtControlRate,
    DelayedPD,
    DelayedPDParameters,
    substeps,
)
from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork
from pupper_sysid.sysid.servo_fit import networks as network_fit
from pupper_sysid.sysid.servo_fit.data import ServoData, look_up, servo_data
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.scores import tracks
from pupper_sysid.sysid.servo_fit.training import Checkpoint, Recipe, train
from pupper_sysid.sysid.servo_fit.windows import Samples, fit_linear, samples, training_sets
from support.refusals import assert_each_refused
from support.saved_servo_models import KINDS, TAPS, UNITS, arrays
from support.servo_recordings import everything, recording, trial

P = 0.04  # with fewer taps than at 50 Hz, the same claims cost less
JOINTS = ("LF_hip", "RB_calf")
HIP = JOINTS[:1]
LEARNED = KINDS[:5]

# ------------------------------------------------------------------------------- models


def network(kind: str, gain: float = 1.0, **changes) -> CommandNetwork | RecurrentNetwork:
    """A model of two joints with random weights, those of its network times `gain`."""
    own = {
        name: values[:2] * (gain if name.startswith(("weight", "bias")) else 1.0)
        for name, values in arrays(kind).items()
    }
    make = RecurrentNetwork if kind.startswith("lstm") else CommandNetwork
    return make(JOINTS, P, own | changes, "feedback" in kind)


def commands(*shape: int) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(*shape, 2))


def ran(model, moves, start) -> np.ndarray:
    """Positions of a rollout from rest at `start`."""
    model.reset(np.asarray(start, float))
    return model.rollout(moves)


def test_environments_steps_and_pieces_of_a_rollout_are_one_motion_and_a_reset_forgets_it():
    moves, start = commands(30, 3, 4), commands(3, 4)
    for kind in LEARNED:
        model = network(kind)
        together = ran(model, moves, start)
        assert together.shape == (30, 3, 4, 2), kind
        for place in ((0, 0), (2, 3)):
            alone = moves[:, *place]
            model.reset(start[place])
            pieces = [
                model.rollout(alone[:3]),
                model.step(alone[3])[None],
                model.rollout(alone[4:]),
            ]
            np.testing.assert_allclose(
                np.concatenate(pieces), together[:, *place], atol=2e-6, err_msg=kind
            )


def test_joints_do_not_see_each_other():
    moves, other = commands(20), commands(20)
    other[:, 1] = 5.0
    for kind in LEARNED:
        before, after = (ran(network(kind), m, np.zeros(2)) for m in (moves, other))
        np.testing.assert_allclose(after[:, 0], before[:, 0], atol=1e-6, err_msg=kind)
        assert np.abs(after[:, 1] - before[:, 1]).max() > 0.1, kind


def test_the_filter_weighs_the_newest_command_first_in_normalised_units():
    model = network("fir")
    p = model.parameters
    impulse = np.tile(p["command_center"], (TAPS + 2, 1))
    impulse[0] += p["command_scale"]
    answer = (ran(model, impulse, p["command_center"]) - p["position_center"]) / p["position_scale"]
    np.testing.assert_allclose(answer[:TAPS] - p["fir_bias"], p["fir"].T, atol=1e-6)
    np.testing.assert_allclose(answer[TAPS:], np.tile(p["fir_bias"], (2, 1)), atol=1e-6)


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_a_network_gone_wild_moves_the_position_by_no_more_than_its_bound(kind):
    wild, linear, moves = network(kind, 1e4), network(kind, 0.0), 10 * commands(40)
    p = wild.parameters
    moved = np.abs(ran(wild, moves, np.zeros(2)) - ran(linear, moves, np.zeros(2)))
    assert (moved <= p["bound"] * p["position_scale"] * (1 + 1e-4) + 1e-5).all()
    assert moved.max() > 0.05  # it does try


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_one_step_from_its_own_predictions_is_the_free_run(kind):
    model, moves, start = network(f"{kind} with feedback"), commands(25), np.array([0.1, -0.4])
    free = ran(model, moves, start)
    own = np.concatenate([start[None], free[:-1]])
    model.reset(start)
    np.testing.assert_allclose(model.one_step(moves, own), free, atol=2e-6)
    model.reset(start)
    assert np.abs(model.one_step(moves, own + 0.1) - free).max() > 1e-3


def test_the_lstm_is_that_of_torch():
    one = {
        name: values[:2, :1]
        for name, values in arrays("lstm").items()
        if name.startswith(("weight", "bias"))
    }
    flat = {"bound": np.full(2, np.inf), "fir": np.zeros((2, 1)), "fir_bias": np.zeros(2)}
    ours = network("lstm", **one, **flat)
    ours.warm_up = 0
    moves = commands(50)
    motion = ran(ours, moves, np.zeros(2))
    p = ours.parameters
    for j in range(2):
        theirs = torch.nn.LSTM(1, UNITS)
        with torch.no_grad():  # torch's gates are i, f, g, o as well, with two biases
            theirs.weight_ih_l0.copy_(torch.from_numpy(p["weight_input"][j, 0].T))
            theirs.weight_hh_l0.copy_(torch.from_numpy(p["weight_hidden"][j, 0].T))
            theirs.bias_ih_l0.copy_(torch.from_numpy(p["bias"][j, 0]))
            theirs.bias_hh_l0.zero_()
            x = (moves[:, j] - p["command_center"][j]) / p["command_scale"][j]
            hidden, _ = theirs(torch.from_numpy(x.astype(np.float32))[:, None])
        out = hidden.numpy() @ p["weight_out"][j, 0] + p["bias_out"][j, 0]
        expected = out * p["position_scale"][j] + p["position_center"][j]
        np.testing.assert_allclose(motion[:, j], expected, atol=1e-5)


def test_damaged_parameters_are_refused_by_name():
    """Arrays that are missing, of another shape or not finite: `test_servo_file.py`."""

    def changed(kind, **change):
        return lambda: network(kind, **change)

    cases = []
    for kind in ("mlp", "lstm"):
        cases += [
            (changed(kind, bound=np.full(2, np.nan)), "bound holds NaN"),
            (changed(kind, bound=np.zeros(2)), "bound must be positive"),
            (changed(kind, command_scale=np.array([1.0, 0.0])), "command_scale must be positive"),
            (changed(kind, **{k: v[:1] for k, v in network(kind).parameters.items()}), "2 joints"),
        ]
    for kind, name, said in (("mlp", "weight_1", "bias_1"), ("lstm",) + ("weight_hidden",) * 2):
        narrow = network(kind).parameters[name][..., :-1]
        cases.append((changed(kind, **{name: narrow}), said))
    for one in map(network, LEARNED):
        own, make = one.parameters, type(one)
        cases += [
            (lambda one=one: one.reset(np.zeros(3)), "last axis must be the joints"),
            (lambda own=own, make=make: make(JOINTS, 0.0, own), "time_step_s"),
        ]
    assert_each_refused(cases, lambda make: make())


def test_a_model_at_control_rate_is_the_model_under_held_commands_plus_the_offset_of_readings():
    parameters = DelayedPDParameters(40.0, 1.0, 0.5, 1.0, 30.0, 8.0, np.array([0.013, 0.031]))
    count = substeps(0.019)
    assert count == 10  # steps of 1.9 ms: the most that is no longer than 2 ms
    slow, fast = (DelayedPD(parameters, 0.019 / count) for _ in range(2))
    slow = AtControlRate(slow, count, offset_rad=0.02)
    assert slow.time_step_s == pytest.approx(0.019)
    moves, start = commands(30), np.full(2, 0.1)
    fast.reset(start)
    expected = np.array([[fast.step(c) for _ in range(count)][-1] for c in moves]) + 0.02
    np.testing.assert_allclose(ran(slow, moves, start), expected, atol=1e-12)
    slow.reset(start)
    np.testing.assert_allclose([slow.step(c) for c in moves], expected, atol=1e-12)
    assert_each_refused([(0, "at least 1")], lambda n: AtControlRate(DelayedPD(parameters), n))


# ------------------------------------------------------------------------------- training = running


def smooth_commands(seed: int, rows: int) -> np.ndarray:
    """Band-limited noise of about 0.35 rad."""
    raw = np.random.default_rng(seed).normal(size=rows + 4)
    return 0.7 * np.convolve(raw, np.full(5, 0.2), "valid") + 0.1


def nonlinear_servo(command: np.ndarray) -> np.ndarray:
    """At each tick: a filter of the commands before it, plus a push that saturates."""
    past = np.concatenate([[command[0]], command])
    slow = np.convolve(np.concatenate([np.full(8, past[0]), past]), np.full(4, 0.25), "valid")
    late = np.concatenate([np.full(3, past[0]), past])
    push = 0.08 * np.tanh((past - late[: len(past)]) / 0.1)
    return (slow[-len(past) :] + push)[: len(command)]


@cache
def loops(joints=JOINTS, count: int = 4, rows: int = 150) -> tuple[ServoData, Samples]:
    """A playback of different loops without pause; readings late by 10 ms."""
    parts = []
    for j, joint in enumerate(joints):
        command = smooth_commands(10 * j, count * rows)
        late = np.arange(len(command)) + 0.01 / P
        noise = 0.002 * np.random.default_rng(99 + j).normal(size=len(command))
        position = look_up(nonlinear_servo(command), late) + noise
        for n in range(count):
            own = slice(n * rows, (n + 1) * rows)
            parts.append(
                trial(n, n * rows * P, command[own], position[own], joint=joint, period_s=P,
                      read_after_s=0.01)
            )  # fmt: skip
    data = servo_data([recording(*parts, rest=None)], joints, "all")
    return data, samples(data, everything, past_ticks(P))


QUICK = Recipe(8, 2, (0.1, 1.0), 60, 1e-2, 20, 9)


def trained(kind: str, ready: Samples, sets, recipe: Recipe, spread: float = 1.0):
    """All checkpoints of a training whose bounds are `spread` times the usual, and the filter."""
    checkpoints: list[Checkpoint] = []
    linear = fit_linear(ready, sets, P, ridge=1e-3)
    linear = replace(linear, scale=spread * linear.scale)
    train(kind, recipe, P, ready, linear, sets, 0, lambda now: bool(checkpoints.append(now)))
    return checkpoints, linear


@pytest.mark.parametrize("kind", ["mlp", pytest.param("lstm", marks=pytest.mark.slow)])
def test_the_errors_that_choose_a_model_are_its_errors_in_free_run(kind):
    data, ready = loops()
    sets = training_sets([0, 1, 2, 3], nested=False)
    # the mean of bounded members is the bound of their mean, which runs, only for one member or
    # where the bound is far away
    for members, spread in ((1, 1.0), (3, 1e3)):
        recipe = replace(QUICK, members=members, steps=20)
        checkpoints, linear = trained(kind, ready, sets, recipe, spread)
        now = checkpoints[-1]
        weights = {k: w[:, 2, 1] for k, w in now.weights.items()}
        free_run = tracks(network_fit._build(JOINTS, P, ready, linear, 2, weights), data)
        for j, joint in enumerate(JOINTS):
            (run,) = data.runs[joint]
            scale = ready.normalisation["position_scale"][j]
            free = look_up(free_run[joint][0], run.tick) - run.position_rad
            judged = now.error[j, :, :, 2, 1][ready.used[j]] * scale
            # at a run's very ends the free run starts from the rest itself, and stops; and an LSTM
            # that runs remembers what was before a window, with half the weight from step to step
            memory = 0.5**ready.past if kind == "lstm" else 0.0
            close = 2e-5 + memory * float(linear.scale[j, 2] * scale)
            np.testing.assert_allclose(judged[2:-2], free[2:-2], atol=close)


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_a_network_never_sees_the_groups_it_leaves_out(kind):
    _, ready = loops(HIP, 3, 100)
    sets = training_sets([0, 1, 2], nested=True)
    recipe = Recipe(4, 2, (0.1, 1.0), 12, 1e-2, 12, 9)
    other = np.where(ready.group == 2, 1.0 - 2 * ready.target, ready.target).astype(np.float32)
    before, _ = trained(kind, ready, sets, recipe)
    after, _ = trained(kind, replace(ready, target=other), sets, recipe)
    for n, omitted in enumerate(sets):
        for name, weights in before[-1].weights.items():
            same = np.array_equal(weights[:, n], after[-1].weights[name][:, n])
            assert same == (2 in omitted), (name, omitted)


# ------------------------------------------------------------------------------- fitting


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(network_fit, "MLP", Recipe(16, 2, (0.1, 1.0), 200, 1e-2, 50, 9))
    monkeypatch.setattr(network_fit, "LSTM", QUICK)


def held_out_rms(fit, data: ServoData) -> dict[str, float]:
    """RMS of each group's own model on it, that is on what it has not seen [rad]."""
    squares = {j: [] for j in data.joints}
    for group, model in fit.held_out.items():
        motion = tracks(model, data)
        for joint in data.joints:
            for track, run in zip(motion[joint], data.runs[joint], strict=True):
                error = look_up(track, run.tick) - run.position_rad
                squares[joint].append(error[run.group[run.readings.rows] == group] ** 2)
    return {j: float(np.sqrt(np.mean(np.concatenate(s)))) for j, s in squares.items()}


def test_an_mlp_learns_what_a_filter_cannot(quick):
    data, ready = loops(HIP, rows=250)
    linear, network = (fit_network(kind, HIP, P, ready, seed=4) for kind in ("fir", "mlp"))
    baseline, better = held_out_rms(linear, data)["LF_hip"], held_out_rms(network, data)["LF_hip"]
    # a saturated push of 80 mrad: the best linear stand-in is off by a good part of it
    assert baseline > 0.008
    assert better < 0.7 * baseline
    assert better > 0.8 * 0.002  # and nothing beats the noise
    assert sorted(network.held_out) == [0, 1, 2, 3]


def test_a_fit_of_a_network_repeats_bit_for_bit_under_its_seed(monkeypatch):
    monkeypatch.setattr(network_fit, "MLP", Recipe(16, 2, (0.1, 1.0), 40, 1e-2, 20, 9))
    _, ready = loops(HIP, 3, 100)
    network, again, other = (fit_network("mlp", HIP, P, ready, seed=s) for s in (4, 4, 5))
    for name, value in network.model.parameters.items():
        np.testing.assert_array_equal(value, again.model.parameters[name])
    assert network.choices == again.choices
    weights = (fit.model.parameters["weight_0"] for fit in (network, other))
    assert not np.array_equal(*weights)


def test_a_nested_fit_of_a_group_does_not_depend_on_its_readings(monkeypatch):
    monkeypatch.setattr(network_fit, "MLP", Recipe(8, 2, (0.1, 1.0), 40, 1e-2, 20, 9))
    monkeypatch.setattr(network_fit.windows, "RIDGES", (1e-3,))
    _, ready = loops(HIP, 3, 100)
    other = np.where(ready.group == 1, 1.0 - 2 * ready.target, ready.target).astype(np.float32)
    first, second = (
        fit_network("mlp", HIP, P, d, seed=0, nested=True)
        for d in (ready, replace(ready, target=other))
    )
    for group in (0, 1, 2):
        mine, theirs = (f.held_out[group].parameters for f in (first, second))
        same = all(np.array_equal(mine[k], theirs[k]) for k in mine)
        assert same == (group == 1)


def test_an_lstm_is_fitted_to_the_end_and_run_with_the_memory_it_was_trained_with(monkeypatch):
    monkeypatch.setattr(network_fit, "LSTM", Recipe(8, 1, (0.1,), 120, 3e-2, 40, 9))
    data, ready = loops(HIP, 3)
    seen = []
    fit = fit_network("lstm", HIP, P, ready, 0, progress=lambda *done: seen.append(done))
    assert not fit.interrupted and seen == [(n, 120) for n in range(1, 121)]
    assert isinstance(fit.model, RecurrentNetwork) and fit.model.warm_up >= ready.past
    linear = held_out_rms(fit_network("fir", HIP, P, ready, seed=0), data)["LF_hip"]
    assert held_out_rms(fit, data)["LF_hip"] < linear


def interrupted(ready: Samples, at: int):
    """The fit that Ctrl-C leaves after `at` steps."""

    def progress(done: int, steps: int) -> None:
        if done == at:
            raise KeyboardInterrupt

    return fit_network("mlp", HIP, P, ready, 0, progress=progress)


def test_ctrl_c_keeps_the_best_so_far_be_it_a_network_or_the_linear_model(quick):
    _, ready = loops(HIP, 3)
    stopped = interrupted(ready, 120)
    assert stopped.interrupted and stopped.choices["steps"] in (50, 100)
    assert stopped.model.parameters["weight_0"].any()
    assert sorted(stopped.held_out) == [0, 1, 2]
    at_once, linear = interrupted(ready, 3), fit_network("fir", HIP, P, ready, 0)
    assert at_once.interrupted and "weight_0" not in at_once.model.parameters
    for group in (0, 1, 2):
        np.testing.assert_array_equal(
            at_once.held_out[group].parameters["fir"], linear.held_out[group].parameters["fir"]
        )
