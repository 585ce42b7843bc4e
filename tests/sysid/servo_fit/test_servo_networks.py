"""Learned servo models: what they compute, that what was trained is what runs, and fitting them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.command_network import CommandNetwork
from pupper_sysid.servo_models.control_rate import AtControlRate, substeps
from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
from pupper_sysid.servo_models.recurrent_network import RecurrentNetwork
from pupper_sysid.sysid.servo_fit import networks as network_fit
from pupper_sysid.sysid.servo_fit import training as servo_training
from pupper_sysid.sysid.servo_fit.data import ServoData, look_up, servo_data
from pupper_sysid.sysid.servo_fit.linear import LinearFits, fading, fit_linear, taps
from pupper_sysid.sysid.servo_fit.networks import fit_network, past_ticks
from pupper_sysid.sysid.servo_fit.scores import tracks
from pupper_sysid.sysid.servo_fit.training import Checkpoint, Recipe, train
from pupper_sysid.sysid.servo_fit.windows import WINDOW, Samples, samples, training_sets
from support.servo_recordings import everything, recording, trial

P = 0.04  # with fewer taps than at 50 Hz, the same claims cost less
JOINTS = ("LF_hip", "RB_calf")
TAPS = 6

# ------------------------------------------------------------------------------- models


def linear_parameters(seed: int = 0, count: int = TAPS) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "command_center": rng.normal(size=2),
        "command_scale": rng.uniform(0.2, 0.6, 2),
        "position_center": rng.normal(size=2),
        "position_scale": rng.uniform(0.2, 0.6, 2),
        "bound": rng.uniform(0.2, 0.4, 2),
        "fir": 0.3 * rng.normal(size=(2, count)),
        "fir_bias": 0.1 * rng.normal(size=2),
    }


def mlp(feedback: bool = False, gain: float = 0.5, units: int = 9) -> CommandNetwork:
    rng = np.random.default_rng(1)
    layers = [(TAPS + feedback, units), (units, units), (units, 1)]
    network = {}
    for n, (a, b) in enumerate(layers):
        network |= {f"weight_{n}": gain * rng.normal(size=(2, a, b))}
        network |= {f"bias_{n}": gain * rng.normal(size=(2, b))}
    return CommandNetwork(JOINTS, P, linear_parameters() | network, feedback)


def lstm(
    feedback: bool = False, gain: float = 0.5, members: int = 3, **changes
) -> RecurrentNetwork:
    rng = np.random.default_rng(2)
    network = {
        "weight_input": gain * rng.normal(size=(2, members, 1 + feedback, 20)),
        "weight_hidden": gain * rng.normal(size=(2, members, 5, 20)),
        "bias": gain * rng.normal(size=(2, members, 20)),
        "weight_out": gain * rng.normal(size=(2, members, 5)),
        "bias_out": gain * rng.normal(size=(2, members)),
    }
    return RecurrentNetwork(JOINTS, P, linear_parameters() | network | changes, feedback)


def fir() -> CommandNetwork:
    return CommandNetwork(JOINTS, P, linear_parameters())


MODELS = {
    "fir": fir,
    "mlp": mlp,
    "mlp with feedback": lambda: mlp(feedback=True),
    "lstm": lstm,
    "lstm with feedback": lambda: lstm(feedback=True),
}
each_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())


def commands(*shape: int) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(*shape, 2))


@each_model
def test_many_environments_are_one_environment_many_times(make):
    model, given, start = make(), commands(30, 3, 4), commands(3, 4)
    model.reset(start)
    together = model.rollout(given)
    assert together.shape == (30, 3, 4, 2)
    for a, b in np.ndindex(3, 4):
        model.reset(start[a, b])
        np.testing.assert_allclose(model.rollout(given[:, a, b]), together[:, a, b], atol=2e-6)


@each_model
def test_a_rollout_is_repeated_steps_and_can_be_continued(make):
    model, given = make(), commands(30, 5)
    model.reset(np.zeros((5, 2)))
    stepped = np.stack([model.step(c) for c in given])
    model.reset(np.zeros((5, 2)))
    pieces = [model.rollout(given[:3]), model.step(given[3])[None], model.rollout(given[4:])]
    np.testing.assert_allclose(np.concatenate(pieces), stepped, atol=2e-6)


@each_model
def test_a_reset_sets_the_number_of_environments_and_forgets_all(make):
    model = make()
    model.reset(np.zeros(2))
    alone = model.step(np.ones(2))
    assert alone.shape == (2,)
    model.reset(np.ones((7, 2)))
    assert model.rollout(commands(10, 7)).shape == (10, 7, 2)
    model.reset(np.zeros((4, 2)))
    np.testing.assert_allclose(model.step(np.ones((4, 2))), np.tile(alone, (4, 1)), atol=1e-6)


@each_model
def test_joints_do_not_see_each_other(make):
    model, given = make(), commands(20)
    model.reset(np.zeros(2))
    before = model.rollout(given)
    other = given.copy()
    other[:, 1] = 5.0
    model.reset(np.zeros(2))
    np.testing.assert_allclose(model.rollout(other)[:, 0], before[:, 0], atol=1e-6)


def test_a_filter_at_rest_gives_the_sum_of_its_weights():
    p = linear_parameters()
    rest = np.array([0.3, -0.2])
    normal = (rest - p["command_center"]) / p["command_scale"]
    said = p["fir"].sum(1) * normal + p["fir_bias"]
    model = fir()
    model.reset(rest)
    expected = p["position_center"] + p["position_scale"] * said
    np.testing.assert_allclose(model.step(rest), expected, atol=1e-6)


def test_equal_weights_are_a_moving_average_with_the_newest_command_counted_at_once():
    zero, one = np.zeros(1), np.ones(1)
    p = {"command_center": zero, "command_scale": one, "position_center": zero}
    p |= {"position_scale": one, "bound": one, "fir_bias": zero, "fir": np.full((1, 4), 0.25)}
    model = CommandNetwork(("LF_hip",), P, p)
    model.reset([0.4])
    steps = model.rollout(np.full((5, 1), 1.2))
    np.testing.assert_allclose(steps[:, 0], [0.6, 0.8, 1.0, 1.2, 1.2], atol=1e-6)


def test_the_filter_weighs_the_newest_command_first():
    p = linear_parameters() | {"fir_bias": np.zeros(2), "position_center": np.zeros(2)}
    model = CommandNetwork(JOINTS, P, p)
    model.reset(p["command_center"])
    impulse = np.tile(p["command_center"], (TAPS + 2, 1))
    impulse[0] += p["command_scale"]
    answer = model.rollout(impulse) / p["position_scale"]
    np.testing.assert_allclose(answer[:TAPS], p["fir"].T, atol=1e-6)
    np.testing.assert_allclose(answer[TAPS:], 0, atol=1e-6)


@pytest.mark.parametrize("make", [mlp, lstm])
def test_a_network_gone_wild_moves_the_position_by_no_more_than_its_bound(make):
    p = linear_parameters()
    wild, linear, given = make(gain=1e4), fir(), 10 * commands(40)
    wild.reset(np.zeros(2))
    linear.reset(np.zeros(2))
    moved = np.abs(wild.rollout(given) - linear.rollout(given))
    assert (moved <= p["bound"] * p["position_scale"] * (1 + 1e-4) + 1e-5).all()
    assert moved.max() > 0.05  # it does try


@pytest.mark.parametrize("make", [mlp, lstm])
def test_one_step_from_its_own_predictions_is_the_free_run(make):
    model, given, start = make(feedback=True), commands(25), np.array([0.1, -0.4])
    model.reset(start)
    free = model.rollout(given)
    model.reset(start)
    own = np.concatenate([start[None], free[:-1]])
    np.testing.assert_allclose(model.one_step(given, own), free, atol=2e-6)
    model.reset(start)
    assert np.abs(model.one_step(given, own + 0.1) - free).max() > 1e-3


def test_the_lstm_is_that_of_torch():
    ours = lstm(members=1, bound=np.full(2, np.inf), fir=np.zeros((2, 1)), fir_bias=np.zeros(2))
    ours.warm_up = 0
    ours.reset(np.zeros(2))
    given = commands(50)
    found = ours.rollout(given)
    p = ours.parameters
    for j in range(2):
        theirs = torch.nn.LSTM(1, 5)
        with torch.no_grad():  # torch's gates are i, f, g, o as well, with two biases
            theirs.weight_ih_l0.copy_(torch.from_numpy(p["weight_input"][j, 0].T))
            theirs.weight_hh_l0.copy_(torch.from_numpy(p["weight_hidden"][j, 0].T))
            theirs.bias_ih_l0.copy_(torch.from_numpy(p["bias"][j, 0]))
            theirs.bias_hh_l0.zero_()
            x = (given[:, j] - p["command_center"][j]) / p["command_scale"][j]
            hidden, _ = theirs(torch.from_numpy(x.astype(np.float32))[:, None])
        out = hidden.numpy() @ p["weight_out"][j, 0] + p["bias_out"][j, 0]
        expected = out * p["position_scale"][j] + p["position_center"][j]
        np.testing.assert_allclose(found[:, j], expected, atol=1e-5)


def test_an_lstm_of_zero_weights_is_the_filter():
    silent, linear, given = lstm(gain=0.0), fir(), commands(20, 3)
    for model in (silent, linear):
        model.reset(np.full((3, 2), 0.2))
    np.testing.assert_allclose(silent.rollout(given), linear.rollout(given), atol=1e-6)


def test_members_are_averaged():
    p = lstm(members=3).parameters
    parts = []
    for m in range(3):
        alone = {
            k: v[:, m : m + 1] if k.startswith(("weight", "bias")) else v for k, v in p.items()
        }
        model = RecurrentNetwork(JOINTS, P, alone)
        model.reset(np.zeros(2))
        parts.append(model.rollout(commands(20)))
    whole = lstm(members=3)
    whole.reset(np.zeros(2))
    np.testing.assert_allclose(whole.rollout(commands(20)), np.mean(parts, axis=0), atol=2e-6)


@pytest.mark.parametrize("make", [mlp, lstm])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: {"fir": p["fir"] * np.nan}, "fir holds NaN"),
        (lambda p: {"fir_bias": np.full(2, np.inf)}, "fir_bias holds NaN or infinite"),
        (lambda p: {"bound": np.full(2, np.nan)}, "bound holds NaN"),
        (lambda p: {"bound": np.zeros(2)}, "bound must be positive"),
        (lambda p: {"command_scale": np.array([1.0, 0.0])}, "command_scale must be positive"),
        (lambda p: {"position_center": np.zeros(3)}, "position_center"),
        (lambda p: {"fir": p["fir"][0]}, "fir"),
        (lambda p: {k: v[:1] for k, v in p.items()}, "2 joints"),
        (lambda p: {k: v[..., :-1] for k, v in p.items() if k in ("weight_1", "weight_hidden")},
         "weight_hidden|bias_1"),
    ],
)  # fmt: skip
def test_damaged_parameters_are_refused(make, change, said):
    model = make()
    p = model.parameters
    with pytest.raises(InputError, match=said):
        type(model)(JOINTS, P, p | change(p))


@pytest.mark.parametrize("missing", ["fir", "bound", "position_scale", "bias_0"])
def test_missing_parameters_are_refused(missing):
    p = {k: v for k, v in mlp().parameters.items() if k != missing}
    with pytest.raises(InputError, match=missing):
        CommandNetwork(JOINTS, P, p)


@each_model
def test_other_joints_and_time_steps_of_zero_are_refused(make):
    model = make()
    with pytest.raises(InputError, match="last axis must be the joints"):
        model.reset(np.zeros(3))
    with pytest.raises(InputError, match="time_step_s"):
        type(model)(JOINTS, 0.0, model.parameters)
    with pytest.raises(InputError, match="3 joints"):
        type(model)((*JOINTS, "LB_hip"), P, model.parameters)


# ------------------------------------------------------------------------------- control rate


def test_a_model_at_control_rate_is_the_model_under_held_commands():
    parameters = DelayedPDParameters(40.0, 1.0, 0.5, 1.0, 30.0, 8.0, np.array([0.013, 0.031]))
    count = substeps(0.019)
    assert count == 10  # steps of 1.9 ms: the most that is no longer than 2 ms
    step = 0.019 / count
    slow, fast = AtControlRate(DelayedPD(parameters, step), count), DelayedPD(parameters, step)
    given = commands(30)
    slow.reset(np.full(2, 0.1))
    fast.reset(np.full(2, 0.1))
    expected = [[fast.step(c) for _ in range(count)][-1] for c in given]
    np.testing.assert_allclose(slow.rollout(given), expected, atol=1e-12)
    assert slow.time_step_s == pytest.approx(0.019)
    slow.reset(np.full(2, 0.1))
    np.testing.assert_allclose([slow.step(c) for c in given], expected, atol=1e-12)


def test_the_offset_of_readings_is_added_at_control_rate():
    parameters = DelayedPDParameters(40.0, 1.0, 0.0, 1.0, 30.0, 8.0, 0.01)
    model = AtControlRate(DelayedPD(parameters), 5, offset_rad=0.02)
    model.reset(0.3)
    assert model.step(0.3) == pytest.approx(0.32)
    with pytest.raises(InputError, match="at least 1"):
        AtControlRate(DelayedPD(parameters), 0)


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


def loops(seed: int = 0, joints=JOINTS, count: int = 4, rows: int = 150, read_after_s=0.01):
    """A playback of different loops without pause; readings late by `read_after_s`."""
    parts = []
    for j, joint in enumerate(joints):
        command = smooth_commands(seed + 10 * j, count * rows)
        late = np.arange(len(command)) + read_after_s / P
        noise = 0.002 * np.random.default_rng(seed + 99 + j).normal(size=len(command))
        position = look_up(nonlinear_servo(command), late) + noise
        for n in range(count):
            own = slice(n * rows, (n + 1) * rows)
            parts.append(
                trial(
                    n,
                    n * rows * P,
                    command[own],
                    position[own],
                    joint=joint,
                    period_s=P,
                    read_after_s=read_after_s,
                )
            )
    data = servo_data([recording(*parts, rest=None)], joints, "all")
    return data, samples(data, everything, past_ticks(P))


def random_weights(kind: str, data: Samples, sets: int) -> dict[str, torch.Tensor]:
    """Weights of (joints, sets, 2 decays, 3 members, …), none of them zero."""
    generator = torch.Generator().manual_seed(5)
    make = servo_training._mlp if kind == "mlp" else servo_training._lstm
    fade = torch.from_numpy(fading(taps(P), P).astype(np.float32))
    weights = make((len(data.command), sets, 2, 3), 7, fade, generator)
    return {k: w + 0.1 * torch.randn(w.shape, generator=generator) for k, w in weights.items()}


def trained_outputs(kind: str, data: Samples, linear: LinearFits, weights, n: int, decay: int):
    """What training computes [rad], shape (joints, windows, WINDOW + 3)."""
    forward = servo_training._mlp_forward if kind == "mlp" else servo_training._lstm_forward
    count = linear.fir.shape[-1]
    fade = torch.from_numpy(fading(count, P).astype(np.float32))
    out = forward(weights, torch.from_numpy(data.command), fade, data.past)
    assert out.shape[-1] == WINDOW + 3
    network = out[:, n, decay].numpy().astype(float)
    bound = linear.scale[:, n, None, None]
    view = np.lib.stride_tricks.sliding_window_view(data.command, count, axis=-1)
    history = view[:, :, data.past - count :, ::-1].astype(float)
    filtered = np.einsum("jwkt,jt->jwk", history, linear.fir[:, n]) + linear.bias[:, n, None, None]
    if kind == "mlp":  # one wide layer: bounded after the mean over members
        correction = bound * np.tanh(network.mean(1) / bound)
    else:
        correction = (bound[:, None] * np.tanh(network / bound[:, None])).mean(1)
    normal = filtered + correction
    scale = data.normalisation["position_scale"][:, None, None]
    return normal * scale + data.normalisation["position_center"][:, None, None]


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_what_is_trained_is_what_runs(kind):
    _, data = loops()
    sets = training_sets([0, 1, 2, 3], nested=False)
    linear = fit_linear(data, sets, P, ridge=1e-3)
    weights = random_weights(kind, data, len(sets))
    norm = {k: v[:, None, None] for k, v in data.normalisation.items()}
    given = np.moveaxis(data.command * norm["command_scale"] + norm["command_center"], 0, -1)
    for n, decay in ((0, 0), (3, 1)):
        now = {k: w[:, n, decay].numpy() for k, w in weights.items()}
        model = network_fit._build(JOINTS, P, data, linear, n, now)
        if isinstance(model, RecurrentNetwork):
            model.warm_up = 0  # a window's memory begins empty
        model.reset(np.zeros((data.windows, 2)))
        ran = model.rollout(np.moveaxis(given, 1, 0))  # windows are environments
        expected = trained_outputs(kind, data, linear, weights, n, decay)
        found = np.moveaxis(ran[data.past - 1 :], (0, 1, 2), (2, 1, 0))
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_a_run_from_rest_is_the_first_window_of_training(kind):
    data, ready = loops()
    linear = fit_linear(ready, [frozenset()], P, ridge=1e-3)
    weights = random_weights(kind, ready, 1)
    now = {k: w[:, 0, 1].numpy() for k, w in weights.items()}
    model = network_fit._build(JOINTS, P, ready, linear, 0, now)
    if isinstance(model, RecurrentNetwork):
        model.warm_up = ready.past + 1  # rows of the first window before the first command
    found = tracks(model, data)
    expected = trained_outputs(kind, ready, linear, weights, 0, 1)
    for j, joint in enumerate(JOINTS):  # output 2 is the position after the first command
        np.testing.assert_allclose(found[joint][0][1 : WINDOW + 2], expected[j, 0, 2:], atol=1e-5)


QUICK = Recipe(8, 2, (0.1, 1.0), 60, 1e-2, 20, 9)


def trained(kind: str, ready: Samples, sets, recipe: Recipe = QUICK):
    """All checkpoints of a training."""
    found: list[Checkpoint] = []
    linear = fit_linear(ready, sets, P, ridge=1e-3)
    train(kind, recipe, P, ready, linear, sets, 0, lambda now: bool(found.append(now)))
    return found, linear


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_the_errors_that_choose_a_model_are_its_errors_in_free_run(kind):
    data, ready = loops()
    sets = training_sets([0, 1, 2, 3], nested=False)
    # one member: the mean of bounded members is not quite the bound of their mean, which runs
    checkpoints, linear = trained(kind, ready, sets, replace(QUICK, members=1))
    now = checkpoints[-1]
    weights = {k: w[:, 2, 1] for k, w in now.weights.items()}
    model = network_fit._build(JOINTS, P, ready, linear, 2, weights)
    found = tracks(model, data)
    for j, joint in enumerate(JOINTS):
        (run,) = data.runs[joint]
        free = look_up(found[joint][0], run.tick) - run.position_rad
        judged = now.error[j, :, :, 2, 1][ready.used[j]] * ready.normalisation["position_scale"][j]
        # at a run's very ends the free run starts from the rest itself, and stops; and an LSTM
        # that runs remembers what was before a window, with half the weight from step to step
        memory = 0.5**ready.past if kind == "lstm" else 0.0
        close = 2e-5 + memory * float(linear.scale[j, 2] * ready.normalisation["position_scale"][j])
        np.testing.assert_allclose(judged[2:-2], free[2:-2], atol=close)


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_a_network_never_sees_the_groups_it_leaves_out(kind):
    _, ready = loops(joints=JOINTS[:1], count=3, rows=100)
    sets = training_sets([0, 1, 2], nested=True)
    recipe = Recipe(4, 2, (0.1, 1.0), 12, 1e-2, 12, 9)
    other = np.where(ready.group == 2, 1.0 - 2 * ready.target, ready.target).astype(np.float32)
    before, _ = trained(kind, ready, sets, recipe)
    after, _ = trained(kind, replace(ready, target=other), sets, recipe)
    for n, left_out in enumerate(sets):
        for name, weights in before[-1].weights.items():
            same = np.array_equal(weights[:, n], after[-1].weights[name][:, n])
            assert same == (2 in left_out), (name, left_out)


# ------------------------------------------------------------------------------- fitting


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(network_fit, "MLP", Recipe(16, 2, (0.1, 1.0), 200, 1e-2, 50, 9))
    monkeypatch.setattr(network_fit, "LSTM", QUICK)


def held_out_rms(fit, data: ServoData) -> dict[str, float]:
    """RMS of each group's own model on it, that is on what it has not seen [rad]."""
    squares = {j: [] for j in data.joints}
    for group, model in fit.held_out.items():
        found = tracks(model, data)
        for joint in data.joints:
            for track, run in zip(found[joint], data.runs[joint], strict=True):
                error = look_up(track, run.tick) - run.position_rad
                squares[joint].append(error[run.group[run.readings.rows] == group] ** 2)
    return {j: float(np.sqrt(np.mean(np.concatenate(s)))) for j, s in squares.items()}


def test_an_mlp_learns_what_a_filter_cannot_and_does_so_again_bit_for_bit(quick):
    data, ready = loops(rows=250)
    linear = fit_network("fir", JOINTS, P, ready, seed=0)
    network, again = (fit_network("mlp", JOINTS, P, ready, seed=4) for _ in range(2))
    baseline, better = held_out_rms(linear, data), held_out_rms(network, data)
    for joint in JOINTS:
        # a saturated push of 80 mrad: the best linear stand-in is off by a good part of it
        assert baseline[joint] > 0.008
        assert better[joint] < 0.7 * baseline[joint]
        assert better[joint] > 0.8 * 0.002  # and nothing beats the noise
    for name, value in network.model.parameters.items():
        np.testing.assert_array_equal(value, again.model.parameters[name])
    assert network.choices == again.choices
    assert sorted(network.held_out) == [0, 1, 2, 3]
    other = fit_network("mlp", JOINTS, P, ready, seed=5)
    assert not np.array_equal(
        network.model.parameters["weight_0"], other.model.parameters["weight_0"]
    )


def test_a_filter_is_enough_for_a_linear_servo(quick):
    """Where there is nothing more to learn, the network is about as good, not better than truth."""
    command = smooth_commands(3, 600)
    past = np.concatenate([np.full(5, command[0]), command])
    noise = 0.005 * np.random.default_rng(8).normal(size=600)
    position = np.convolve(past, np.full(4, 0.25), "valid")[1:601] + noise
    parts = [
        trial(n, n * 150 * P, command[r], position[r], period_s=P, read_after_s=0.0)
        for n, r in enumerate(slice(150 * n, 150 * n + 150) for n in range(4))
    ]
    data = servo_data([recording(*parts, rest=None)], JOINTS[:1], "all")
    ready = samples(data, everything, past_ticks(P))
    linear = held_out_rms(fit_network("fir", JOINTS[:1], P, ready, 0), data)["LF_hip"]
    network = held_out_rms(fit_network("mlp", JOINTS[:1], P, ready, 0), data)["LF_hip"]
    assert linear == pytest.approx(0.005, rel=0.15)
    assert network == pytest.approx(linear, rel=0.1)


def test_a_nested_fit_of_a_group_does_not_depend_on_its_readings(quick, monkeypatch):
    monkeypatch.setattr(network_fit, "RIDGES", (1e-3,))
    _, ready = loops(joints=JOINTS[:1], count=3)
    other = np.where(ready.group == 1, 1.0 - 2 * ready.target, ready.target).astype(np.float32)
    first, second = (
        fit_network("mlp", JOINTS[:1], P, d, seed=0, nested=True)
        for d in (ready, replace(ready, target=other))
    )
    for group in (0, 1, 2):
        mine, theirs = (f.held_out[group].parameters for f in (first, second))
        same = all(np.array_equal(mine[k], theirs[k]) for k in mine)
        assert same == (group == 1)


def test_an_lstm_is_fitted_and_run_with_the_memory_it_was_trained_with(monkeypatch):
    monkeypatch.setattr(network_fit, "LSTM", Recipe(8, 1, (0.1,), 120, 3e-2, 40, 9))
    data, ready = loops(joints=JOINTS[:1], count=3)
    fit = fit_network("lstm", JOINTS[:1], P, ready, seed=0)
    assert isinstance(fit.model, RecurrentNetwork)
    linear = held_out_rms(fit_network("fir", JOINTS[:1], P, ready, 0), data)["LF_hip"]
    assert held_out_rms(fit, data)["LF_hip"] < linear
    assert fit.model.warm_up >= ready.past


class _Interrupt:
    """A user who presses Ctrl-C after some steps."""

    def __init__(self, at: int):
        self.at = at

    def __call__(self, done: int, steps: int) -> None:
        if done == self.at:
            raise KeyboardInterrupt


def test_ctrl_c_keeps_the_best_network_so_far(quick):
    _, ready = loops(joints=JOINTS[:1], count=3)
    stopped = fit_network("mlp", JOINTS[:1], P, ready, 0, progress=_Interrupt(120))
    assert stopped.interrupted
    assert stopped.choices["steps"] in (50, 100)
    assert stopped.model.parameters["weight_0"].any()
    assert sorted(stopped.held_out) == [0, 1, 2]


def test_ctrl_c_before_the_first_comparison_keeps_the_linear_model(quick):
    _, ready = loops(joints=JOINTS[:1], count=3)
    stopped = fit_network("mlp", JOINTS[:1], P, ready, 0, progress=_Interrupt(3))
    linear = fit_network("fir", JOINTS[:1], P, ready, 0)
    assert stopped.interrupted
    assert "weight_0" not in stopped.model.parameters
    for group in (0, 1, 2):
        np.testing.assert_array_equal(
            stopped.held_out[group].parameters["fir"], linear.held_out[group].parameters["fir"]
        )


def test_progress_counts_to_the_end(quick):
    _, ready = loops(joints=JOINTS[:1], count=3)
    seen = []
    fit = fit_network(
        "lstm", JOINTS[:1], P, ready, 0, progress=lambda done, steps: seen.append((done, steps))
    )
    assert not fit.interrupted
    assert seen == [(n, 60) for n in range(1, 61)]
