"""One step of a servo network as a PyTorch module without state, for ONNX and TorchScript.

The arithmetic is that of `servo_models.networks` and `servo_models.networks`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from pupper_sysid.servo_models.networks import CommandNetwork, RecurrentNetwork


class ServoStep(nn.Module):
    """Position after one time step, of N environments and all joints at once.

    Parameters
    ----------
    model : CommandNetwork or RecurrentNetwork
    """

    def __init__(self, model: CommandNetwork | RecurrentNetwork):
        super().__init__()
        self._bounded = not bool(np.isinf(model.parameters["bound"]).all())
        self._depth = sum(f"weight_{n}" in model.parameters for n in range(len(model.parameters)))
        for name, value in model.parameters.items():
            self.register_buffer(name, torch.tensor(value))

    def forward(
        self,
        command_history_rad: Tensor,
        hidden: Tensor | None = None,
        cell: Tensor | None = None,
        position_rad: Tensor | None = None,
    ) -> Tensor | tuple[Tensor, Tensor, Tensor]:
        """One step.

        Parameters
        ----------
        command_history_rad : Tensor, shape (N, joints, taps)
            Newest first [rad].
        hidden, cell : Tensor, shape (N, joints, members, units), optional
            Memory of an LSTM.
        position_rad : Tensor, shape (N, joints), optional
            Position predicted last [rad], of a model with feedback.

        Returns
        -------
        Tensor, shape (N, joints)
            Position after the step [rad]; of an LSTM, followed by the next `hidden` and `cell`.
        """
        p = dict(self.named_buffers())
        history = command_history_rad - p["command_center"][:, None]
        history = history / p["command_scale"][:, None]
        normal = (history * p["fir"]).sum(2) + p["fir_bias"]
        seen = history if self._depth else history[:, :, :1]
        if position_rad is not None:
            last = (position_rad - p["position_center"]) / p["position_scale"]
            seen = torch.cat([seen, last[:, :, None]], 2)
        if hidden is not None and cell is not None:
            gates = torch.matmul(seen[:, :, None, None], p["weight_input"])
            gates = gates + torch.matmul(hidden[:, :, :, None], p["weight_hidden"])
            i, f, g, o = (gates.squeeze(3) + p["bias"]).chunk(4, -1)
            cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
            hidden = torch.sigmoid(o) * torch.tanh(cell)
            out = (hidden * p["weight_out"]).sum(3) + p["bias_out"]
            normal = normal + self._limited(out, p["bound"][:, None]).mean(2)
        elif self._depth:
            h = seen[:, :, None]  # (N, joints, 1, inputs): a matrix per joint
            for n in range(self._depth):
                h = torch.relu(h) if n else h
                h = torch.matmul(h, p[f"weight_{n}"]) + p[f"bias_{n}"][:, None]
            normal = normal + self._limited(h[:, :, 0, 0], p["bound"])
        position = normal * p["position_scale"] + p["position_center"]
        return (position, hidden, cell) if hidden is not None and cell is not None else position

    def _limited(self, value: Tensor, bound: Tensor) -> Tensor:
        return bound * torch.tanh(value / bound) if self._bounded else value
