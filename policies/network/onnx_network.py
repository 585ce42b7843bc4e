"""A policy network from an ONNX file, of whichever trainer, run by onnx's reference evaluator.

The file is data from elsewhere: its size, its operators and the arrays that it makes are limited,
weights in other files are refused, and a network whose output is constant or no number is, too
(the gate of `policies.network.policy_file`). It maps one observation, and the state of a recurrent
network, to actions: `obs` and `<name>_in` to `actions` and `<name>_out`, as rsl_rl exports; the
names do not matter where there is one input and one output.

Needs the extra `onnx`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pupper_sysid.common.border import read_bytes
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.strict_yaml import printable
from pupper_sysid.sysid.export import onnx_library

_LARGEST_BYTES = 200_000_000
_MOST_NODES = 20_000
_MOST_VALUES = 20_000_000  # of one array, and of all inputs together
_LONGEST_TEXT = 200_000  # of one entry of the metadata
_PROBES = 64

OPERATORS = frozenset(
    """Abs Add Cast Clip Concat Constant Cos Div Dropout Elu Erf Exp Flatten Gather Gelu Gemm GRU
    HardSigmoid HardSwish Identity LayerNormalization LeakyRelu Log LogSoftmax LSTM MatMul Max Min
    Mish Mul Neg Pow PRelu Reciprocal ReduceMean ReduceSum Relu Reshape RNN Selu Shape Sigmoid Sin
    Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub Tanh Transpose Unsqueeze Where Equal
    Greater Less Not And Or Sign""".split()
)
"""Operators of ONNX that a policy may use: none that loops, or makes arrays of a size it states."""


class OnnxNetwork:
    """A network that acts for many robots at once, with the interface of `PolicyNetwork`.

    `metadata` are the file's own properties, `state_names` the parts of a recurrent network's
    state.
    """

    def __init__(self, path: Path):
        onnx = onnx_library()
        self.path = path
        data = read_bytes(path, _LARGEST_BYTES, "Export the policy again.")
        try:
            self._model = onnx.load_model_from_string(data)
        except Exception as error:  # protobuf raises its own kinds
            raise InputError(f"{path} is no ONNX file. Export the policy again.") from error
        self.metadata = self._metadata()
        self._refuse_hostile(onnx)
        self._name_ports()
        self._evaluator = self._new_evaluator()
        self._one_by_one = False
        self._gate()

    def __repr__(self) -> str:
        return f"OnnxNetwork {self.path.name}: {self.observation_size} numbers to {self.actions}"

    def __deepcopy__(self, memo: dict[int, Any]) -> OnnxNetwork:
        network = object.__new__(OnnxNetwork)
        network.__dict__.update(self.__dict__)
        network._evaluator = network._new_evaluator()  # evaluators are not made for several threads
        return network

    def eval(self) -> OnnxNetwork:
        """The network itself, which never trains."""
        return self

    def initial_state(self, count: int) -> tuple[torch.Tensor, ...]:
        """State at the start of an episode of `count` robots; all zeros."""
        return tuple(torch.zeros(layers, count, size) for layers, size in self._states)

    def __call__(self, observation: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """One step: actions, shape (n, actions), and the next state."""
        inputs = [observation.numpy(), *(s.numpy() for s in state)]
        return tuple(torch.from_numpy(np.array(x)) for x in self.run(inputs))

    def run(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """Actions and next state as arrays, of observations (n, size) and state (layers, n, k)."""
        if not self._one_by_one:
            return self._evaluate(inputs)
        rows = [
            self._evaluate([inputs[0][i : i + 1], *(s[:, i : i + 1] for s in inputs[1:])])
            for i in range(len(inputs[0]))
        ]
        actions, *states = zip(*rows, strict=True)
        return [np.concatenate(actions), *(np.concatenate(s, axis=1) for s in states)]

    # ------------------------------------------------------------------------- the file

    def _metadata(self) -> dict[str, str]:
        properties = {}
        for entry in self._model.metadata_props:
            if len(entry.value) > _LONGEST_TEXT or len(entry.key) > 200:
                raise InputError(
                    f"{self.path}: its metadata '{printable(entry.key[:40])}' are too long to be "
                    "those of a policy."
                )
            properties[entry.key] = entry.value
        return properties

    def _refuse_hostile(self, onnx: Any) -> None:
        path, graph = self.path, self._model.graph
        if self._model.functions:
            raise InputError(
                f"{path} has functions of its own. Export the policy with "
                "torch.onnx.export(..., dynamo=False)."
            )
        if len(graph.node) > _MOST_NODES:
            raise InputError(f"{path} has {len(graph.node)} operations, too many for a policy.")
        tensors = [*graph.initializer]
        for node in graph.node:
            if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
                name = printable(f"{node.domain}.{node.op_type}".lstrip(".")[:60])
                raise InputError(
                    f"{path} uses the operator {name}, which no policy needs that maps an "
                    "observation to actions. Export the actor alone."
                )
            tensors += [a.t for a in node.attribute if a.type == onnx.AttributeProto.TENSOR]
        for tensor in tensors:
            if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
                raise InputError(
                    f"{path} keeps its weights in another file, which is not read. Save it whole: "
                    "onnx.save(onnx.load('policy.onnx'), 'whole.onnx')."
                )
            if _size(tensor.dims) > _MOST_VALUES:
                raise InputError(f"{path} has an array of {_size(tensor.dims):.1e} numbers.")
        try:
            onnx.checker.check_model(self._model)
            shaped = onnx.shape_inference.infer_shapes(self._model, data_prop=True)
        except Exception as error:
            raise InputError(
                f"{path} is no valid ONNX file: {_line(error)}. Export the policy again."
            ) from error
        for value in shaped.graph.value_info:
            dims = [d.dim_value for d in value.type.tensor_type.shape.dim if d.dim_value > 0]
            if _size(dims) > _MOST_VALUES:
                raise InputError(
                    f"{path} makes an array of {_size(dims):.1e} numbers on its way to an action, "
                    "too many for a policy."
                )

    def _name_ports(self) -> None:
        """Find observation, actions and state among inputs and outputs."""
        graph = self._model.graph
        weights = {t.name for t in graph.initializer}
        inputs = {i.name: _dims(i) for i in graph.input if i.name not in weights}
        outputs = {o.name: _dims(o) for o in graph.output}
        self.state_names = tuple(
            n.removesuffix("_in") for n in inputs
            if n.endswith("_in") and f"{n.removesuffix('_in')}_out" in outputs
        )  # fmt: skip
        states = [f"{n}_in" for n in self.state_names]
        seen = [n for n in inputs if n not in states]
        acts = [n for n in outputs if n.removesuffix("_out") not in self.state_names]
        named = [n for n in acts if n in ("actions", "action")]
        acts = named if len(named) == 1 else acts
        for what, names, sizes in (("input", seen, inputs), ("output", acts, outputs)):
            if len(names) != 1:
                raise InputError(
                    f"{self.path} has {len(names)} {what}s beside the state "
                    f"({', '.join(map(printable, names[:6]))}); a policy has one observation and "
                    "one vector of actions. A recurrent state is named h_in and h_out."
                )
            dims = sizes[names[0]]
            if len(dims) != 2 or dims[1] < 1:
                raise InputError(
                    f"{self.path}: its {what} '{printable(names[0])}' has the shape {dims}; it "
                    "must be (robots, numbers), and the numbers stated."
                )
        for name in states:
            if len(inputs[name]) != 3 or min(inputs[name][0], inputs[name][2]) < 1:
                raise InputError(
                    f"{self.path}: the state '{printable(name)}' has the shape {inputs[name]}; it "
                    "must be (layers, robots, units)."
                )
        self.observation_size, self.actions = inputs[seen[0]][1], outputs[acts[0]][1]
        self._states = [(inputs[n][0], inputs[n][2]) for n in states]
        self._inputs = [seen[0], *states]
        self._outputs = [acts[0], *(f"{n}_out" for n in self.state_names)]
        total = self.observation_size + self.actions + sum(a * b for a, b in self._states)
        if total > _MOST_VALUES / _PROBES:
            raise InputError(f"{self.path} takes {total:.1e} numbers, too many for a policy.")

    # ------------------------------------------------------------------------- running it

    def _new_evaluator(self) -> Any:
        from onnx.reference import ReferenceEvaluator

        try:
            return ReferenceEvaluator(self._model)
        except Exception as error:
            raise InputError(f"{self.path} cannot be run: {_line(error)}.") from error

    def _evaluate(self, inputs: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        # saturated activations overflow in between; the gate refuses outputs that are no numbers
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._evaluator.run(self._outputs, dict(zip(self._inputs, inputs, strict=True)))

    def _gate(self) -> None:
        """Refuse a network whose actions are no numbers or constant; see if it takes many robots.

        Exported files often state a batch of one, and mostly work with any.
        """
        seen = np.random.default_rng(0).standard_normal((_PROBES, self.observation_size))
        inputs = [seen.astype(np.float32), *(s.numpy() for s in self.initial_state(_PROBES))]
        probe = [inputs[0][:1], *(s[:, :1] for s in inputs[1:])]
        try:
            single = self._evaluate(probe)
        except Exception as error:
            raise InputError(f"{self.path} cannot be run: {_line(error)}.") from error
        shapes = [(1, self.actions), *((a, 1, b) for a, b in self._states)]
        if [np.shape(x) for x in single] != shapes:
            raise InputError(
                f"{self.path} gives the shapes {[np.shape(x) for x in single]} for one robot, not "
                f"{shapes} as it states."
            )
        try:
            several = self._evaluate(inputs)
            same = [np.shape(x) for x in several] == [
                (_PROBES, self.actions), *((a, _PROBES, b) for a, b in self._states)
            ] and np.allclose(several[0][:1], single[0], atol=1e-4, equal_nan=True)  # fmt: skip
            self._one_by_one = not same
        except Exception:  # the evaluator passes on whatever NumPy raises at a batch
            self._one_by_one = True
        actions = self.run(inputs)[0]
        if not np.isfinite(actions).all():
            raise InputError(f"Actions of {self.path} are not numbers. Export the policy again.")
        if float(actions.std(axis=0).max()) < 1e-5:
            raise InputError(
                f"The output of {self.path} is constant (standard deviation below 1e-5 over "
                f"{_PROBES} random observations). It is no trained policy."
            )


def _dims(port: Any) -> tuple[int, ...]:
    """Shape of an input or output; 0 for what is not stated."""
    return tuple(int(d.dim_value) for d in port.type.tensor_type.shape.dim)


def _size(dims: Sequence[int]) -> float:
    return math.prod(float(d) for d in dims)


def _line(error: Exception) -> str:
    return printable(" ".join(str(error).split())[:200]).rstrip(".")
