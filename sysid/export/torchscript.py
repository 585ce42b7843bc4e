"""Servo networks as TorchScript: the arithmetic of `servo_models`, as LibTorch runs it.

`sysid.export.servo_networks` says what goes in and out. The classes differ in their inputs only;
what they compute is in the methods of their bases. All but `archive` are compiled by
`torch.jit.script`, hence their plain style.
"""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from pupper_sysid.servo_models.command_network import CommandNetwork
from pupper_sysid.servo_models.recurrent_network import RecurrentNetwork


def archive(model: CommandNetwork | RecurrentNetwork, extra_files: dict[str, str]) -> bytes:
    """A TorchScript archive of a servo network, with text files by name beside it."""
    if isinstance(model, RecurrentNetwork):
        module = _LstmFeedback(model) if model.feedback else _Lstm(model)
    elif "weight_0" in model.parameters:
        module = _MlpFeedback(model) if model.feedback else _Mlp(model)
    else:
        module = _Linear(model)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # deprecated in favour of torch.export, whose files an older LibTorch cannot load
        warnings.filterwarnings("ignore", message=".*torch.jit", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*torch.jit", category=FutureWarning)
        torch.jit.save(torch.jit.script(module.eval()), buffer, _extra_files=extra_files)
    return buffer.getvalue()


class _Layer(nn.Module):
    """One layer of all joints: (N, joints, 1, inputs) to (N, joints, 1, units)."""

    if TYPE_CHECKING:  # TorchScript itself cannot read annotations of buffers
        weight: Tensor
        bias: Tensor

    def __init__(self, weight: NDArray, bias: NDArray):
        super().__init__()
        self.register_buffer("weight", torch.tensor(weight))
        self.register_buffer("bias", torch.tensor(bias[:, None]))

    def forward(self, x: Tensor) -> Tensor:
        return torch.matmul(x, self.weight) + self.bias


class _Servo(nn.Module):
    """What all exported networks share: normalisation, the linear filter, the bound."""

    if TYPE_CHECKING:
        command_center: Tensor
        command_scale: Tensor
        position_center: Tensor
        position_scale: Tensor
        bound: Tensor
        fir: Tensor
        fir_bias: Tensor

    def __init__(self, model: CommandNetwork | RecurrentNetwork):
        super().__init__()
        self.limited = not bool(np.isinf(model.parameters["bound"]).all())
        for name, value in model.parameters.items():
            if not name[-1].isdigit():  # layers hold their own
                self.register_buffer(name, torch.tensor(value))

    def normal(self, command_history_rad: Tensor) -> Tensor:
        shift, scale = self.command_center.unsqueeze(1), self.command_scale.unsqueeze(1)
        return (command_history_rad - shift) / scale

    def normal_position(self, position_rad: Tensor) -> Tensor:
        return ((position_rad - self.position_center) / self.position_scale).unsqueeze(2)

    def linear(self, history: Tensor) -> Tensor:
        return (history * self.fir).sum(2) + self.fir_bias

    def bounded(self, value: Tensor, bound: Tensor) -> Tensor:
        return bound * torch.tanh(value / bound) if self.limited else value

    def leave(self, normal: Tensor) -> Tensor:
        return normal * self.position_scale + self.position_center


class _Linear(_Servo):
    def forward(self, command_history_rad: Tensor) -> Tensor:
        return self.leave(self.linear(self.normal(command_history_rad)))


class _Feedforward(_Servo):
    def __init__(self, model: CommandNetwork):
        super().__init__(model)
        p = model.parameters
        self.layers = nn.ModuleList(
            _Layer(p[f"weight_{n}"], p[f"bias_{n}"])
            for n in range(sum(name.startswith("weight_") for name in p))
        )

    def network(self, seen: Tensor) -> Tensor:
        h = seen.unsqueeze(2)
        for n, layer in enumerate(self.layers):
            h = layer(torch.relu(h) if n > 0 else h)
        return self.bounded(h.squeeze(3).squeeze(2), self.bound)


class _Mlp(_Feedforward):
    def forward(self, command_history_rad: Tensor) -> Tensor:
        history = self.normal(command_history_rad)
        return self.leave(self.linear(history) + self.network(history))


class _MlpFeedback(_Feedforward):
    def forward(self, command_history_rad: Tensor, position_rad: Tensor) -> Tensor:
        history = self.normal(command_history_rad)
        seen = torch.cat([history, self.normal_position(position_rad)], 2)
        return self.leave(self.linear(history) + self.network(seen))


class _Recurrent(_Servo):
    if TYPE_CHECKING:
        weight_input: Tensor
        weight_hidden: Tensor
        bias: Tensor
        weight_out: Tensor
        bias_out: Tensor

    def advance(
        self, history: Tensor, seen: Tensor, hidden: Tensor, cell: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        gates = torch.matmul(seen.unsqueeze(2).unsqueeze(2), self.weight_input)
        gates = gates + torch.matmul(hidden.unsqueeze(3), self.weight_hidden)
        i, f, g, o = (gates.squeeze(3) + self.bias).chunk(4, -1)
        cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
        hidden = torch.sigmoid(o) * torch.tanh(cell)
        out = (hidden * self.weight_out).sum(3) + self.bias_out
        correction = self.bounded(out, self.bound.unsqueeze(1)).mean(2)
        return self.leave(self.linear(history) + correction), hidden, cell


class _Lstm(_Recurrent):
    def forward(
        self, command_history_rad: Tensor, hidden: Tensor, cell: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        history = self.normal(command_history_rad)
        return self.advance(history, history[:, :, :1], hidden, cell)


class _LstmFeedback(_Recurrent):
    def forward(
        self, command_history_rad: Tensor, hidden: Tensor, cell: Tensor, position_rad: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        history = self.normal(command_history_rad)
        seen = torch.cat([history[:, :, :1], self.normal_position(position_rad)], 2)
        return self.advance(history, seen, hidden, cell)
