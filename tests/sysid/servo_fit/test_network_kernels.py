"""Compiled networks against PyTorch's own operations."""

import pytest
import torch

from pupper_sysid.sysid.servo_fit.training import Lstm, Mlp

ROUNDING = 1e-5  # of 32 bits, summed over some hundred terms


def equal(ours, theirs) -> None:
    """Equal up to rounding of the largest number."""
    torch.testing.assert_close(
        ours, theirs, rtol=0, atol=ROUNDING * float(theirs.detach().abs().max())
    )


def drawn(*shape: int) -> torch.Tensor:
    """Standard normal numbers, those of a shape always the same."""
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(*shape, generator=generator)


@pytest.mark.parametrize("taps", [3, 10])
def test_the_compiled_mlp_and_its_gradients_are_those_of_torch(taps):
    joints, networks, units, samples = 2, 3, 5, 61
    weights = [drawn(joints, networks, taps, units), drawn(joints, networks, units),
               drawn(joints, networks, units) + 0.5]  # fmt: skip
    weights = [w.requires_grad_(True) for w in weights]
    inputs, pull = drawn(joints, taps, samples), drawn(joints, networks, samples)

    ours = Mlp.apply(*weights, inputs)
    first, bias, second = weights
    hidden = torch.relu(torch.einsum("jqtu,jtn->jqun", first, inputs) + bias[..., None])
    theirs = torch.einsum("jqun,jqu->jqn", hidden, second)

    equal(ours, theirs)
    found = torch.autograd.grad((ours * pull).sum(), weights)
    for one, other in zip(found, torch.autograd.grad((theirs * pull).sum(), weights), strict=True):
        equal(one, other)


@pytest.mark.parametrize("units", [3, 4])
def test_the_compiled_lstm_and_its_gradients_are_those_of_torch(units):
    windows, steps, past = 3, 40, 25
    torch.manual_seed(0)
    module = torch.nn.LSTM(1, units, batch_first=True)
    last = torch.randn(units, requires_grad=True)
    inputs, pull = drawn(windows, steps), drawn(windows, steps - past)
    leaves = [module.weight_ih_l0, module.weight_hh_l0, module.bias_ih_l0, last]

    theirs = (module(inputs[..., None])[0] @ last)[:, past:]
    own = [
        module.weight_ih_l0[:, 0][None, None],
        module.weight_hh_l0.T.contiguous()[None, None],  # as they are trained
        (module.bias_ih_l0 + module.bias_hh_l0)[None, None],
        last[None, None],
    ]
    ours = Lstm.apply(*own, inputs[None], past)[0, 0]

    equal(ours, theirs)
    found = torch.autograd.grad((ours * pull).sum(), leaves)
    for one, other in zip(found, torch.autograd.grad((theirs * pull).sum(), leaves), strict=True):
        equal(one, other)


def test_gates_far_beyond_saturation_stay_finite():
    units = 2
    weights = [1e4 * drawn(1, 1, 4 * units), 1e4 * drawn(1, 1, units, 4 * units),
               drawn(1, 1, 4 * units), drawn(1, 1, units)]  # fmt: skip
    weights = [w.requires_grad_(True) for w in weights]
    out = Lstm.apply(*weights, drawn(1, 1, 30), 5)
    assert torch.isfinite(out).all()
    assert all(torch.isfinite(g).all() for g in torch.autograd.grad(out.sum(), weights))
