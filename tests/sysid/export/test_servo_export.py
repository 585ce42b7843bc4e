"""Exported servo models: other runtimes compute what the model computes, tables hold every number.

Each export is driven as its metadata says: the caller shifts the history and feeds back what comes
back, with several environments at once.
"""

import io
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pandas as pd
import pytest
import torch
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.common.errors import FileExistsRefusal, PupperError
from pupper_sysid.servo_models.networks import RecurrentNetwork
from pupper_sysid.servo_models.servo_file import SavedModel, load_servo_model, save_servo_model
from pupper_sysid.sysid.export import ENDINGS, export_servo_model, parameter_table
from support.command_line import ran, refused
from support.refusals import assert_each_refused
from support.saved_servo_models import JOINTS, KINDS, P, arrays, commands, contract, saved

LEARNED = [kind for kind in KINDS if kind not in ("delayed-pd", "sindy")]
STEPS, ENVIRONMENTS = 30, 4
CLOSE_RAD = 1e-5

Call = Callable[[dict[str, NDArray]], Any]


def given() -> tuple[NDArray, NDArray]:
    """Positions of rest (environments, joints), and commands (steps, environments, joints)."""
    rest = np.linspace(-0.4, 0.5, ENVIRONMENTS * len(JOINTS)).reshape(ENVIRONMENTS, -1)
    moves = commands(STEPS, ENVIRONMENTS * len(JOINTS)).reshape(STEPS, *rest.shape)
    return rest.astype(np.float32), (rest + moves).astype(np.float32)


def driven(call: Call, names: Sequence[Any], model: SavedModel) -> NDArray:
    """Positions (steps, environments, joints) of an export, reset and stepped as documented."""
    rest, given_commands = given()
    taps = model.parameters["fir"].shape[1]
    state = {"command_history_rad": np.repeat(rest[..., None], taps, axis=-1)}
    warm_up = 0
    if isinstance(model.model, RecurrentNetwork):
        members, units = model.parameters["weight_out"].shape[1:]
        zeros = np.zeros((*rest.shape, members, units), np.float32)
        state |= {"hidden": zeros, "cell": zeros}
        warm_up = model.contract.warm_up
    if model.contract.feedback:
        state["position_rad"] = rest
    assert names == list(state)
    out = []
    for k, command in enumerate([rest] * warm_up + list(given_commands)):
        history = state["command_history_rad"]
        state["command_history_rad"] = np.concatenate(
            [command[..., None], history[..., :-1]], axis=-1
        )
        position, *memory = call(state)
        state |= dict(zip(("hidden", "cell"), memory, strict=False))
        if k >= warm_up:
            out.append(position)
            state |= {"position_rad": position} if "position_rad" in state else {}
    return np.stack(out)


def own(model: SavedModel) -> NDArray:
    rest, given_commands = given()
    model.model.reset(rest)
    return np.stack([model.model.step(c) for c in given_commands])


def read_onnx(model: SavedModel, path: Path) -> onnx.ModelProto:
    export_servo_model(model, "onnx", path)
    return onnx.load(str(path))


def read_torchscript(path: Path) -> tuple[Any, dict, dict]:
    extra: dict = {"contract.json": "", "metadata.json": ""}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit.load is deprecated, too
        module = torch.jit.load(path, _extra_files=extra)
    return module, json.loads(extra["contract.json"]), json.loads(extra["metadata.json"])


@pytest.mark.parametrize(
    "kind",
    [k if k in ("mlp", LEARNED[-1]) else pytest.param(k, marks=pytest.mark.slow) for k in LEARNED],
)
def test_onnx_and_torchscript_compute_what_the_model_computes(tmp_path: Path, kind: str):
    model = saved(tmp_path / "a", kind)
    expected = own(model)
    # a model that stands still would not pass for equal, nor would the filter without a network
    assert np.ptp(expected, axis=0).min() > 100 * CLOSE_RAD
    if kind in ("mlp", "lstm"):
        linear = own(saved_linear(tmp_path / "fir", kind))
        assert np.abs(expected - linear).max() > 100 * CLOSE_RAD
    runtime = ReferenceEvaluator(read_onnx(model, tmp_path / "a.onnx"))
    by_onnx = driven(lambda state: runtime.run(None, state), runtime.input_names, model)
    np.testing.assert_allclose(by_onnx, expected, rtol=0, atol=CLOSE_RAD)

    export_servo_model(model, "torchscript", tmp_path / "a.pt")
    module, _, metadata = read_torchscript(tmp_path / "a.pt")
    names = [a.name for a in module.forward.schema.arguments][1:]
    assert names == json.loads(metadata["inputs"])

    def call(state: dict[str, NDArray]) -> list[NDArray]:
        with torch.no_grad():
            found = module(*(torch.from_numpy(state[n].copy()) for n in names))
        return [f.numpy() for f in (found if isinstance(found, tuple) else (found,))]

    np.testing.assert_allclose(driven(call, names, model), expected, rtol=0, atol=CLOSE_RAD)


def saved_linear(folder: Path, kind: str) -> SavedModel:
    """The linear filter of `saved(folder, kind)` alone."""
    everything = arrays(kind)
    linear = {n: everything[n] for n in arrays("fir")}
    save_servo_model(folder, linear, contract("fir", linear))
    return load_servo_model(folder)


def test_an_export_says_what_it_is_and_takes_any_number_of_environments(tmp_path: Path):
    model = saved(tmp_path / "a", "lstm")
    written = json.loads((tmp_path / "a" / "contract.json").read_text())
    made = read_onnx(model, tmp_path / "a.onnx")
    assert made.opset_import[0].version <= 17 and made.ir_version <= 8  # for old runtimes
    for port in [*made.graph.input, *made.graph.output]:
        first, second = port.type.tensor_type.shape.dim[:2]
        assert (first.dim_param, second.dim_value) == ("environments", len(JOINTS))
    assert [o.name for o in made.graph.output] == ["position_rad_next", "hidden_next", "cell_next"]
    onnx_says = {p.key: p.value for p in made.metadata_props}
    export_servo_model(model, "torchscript", tmp_path / "a.pt")
    _, in_archive, torch_says = read_torchscript(tmp_path / "a.pt")
    assert onnx_says == torch_says and in_archive == json.loads(onnx_says["contract"]) == written
    assert json.loads(onnx_says["joints"]) == list(JOINTS)
    assert float(onnx_says["time_step_s"]) == P and "radians" in onnx_says["units"]
    assert json.loads(onnx_says["input_order"])[:2] == ["command_rad[t]", "command_rad[t-1]"]
    assert "run 8 steps" in onnx_says["reset"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_gives_every_number_back(tmp_path: Path, kind: str):
    model = saved(tmp_path / "a", kind)
    text = parameter_table(model)
    table = pd.read_csv(io.StringIO(text), comment="#", dtype={"value": str})
    axes = [c for c in table if c.startswith("index_")]
    assert not table.duplicated(["joint", "parameter", *axes]).any()
    assert len(table) == sum(v.size for v in model.parameters.values())
    for name, expected in model.parameters.items():
        found = np.full_like(expected, np.nan)
        for row in table.query(f"parameter == '{name}'").to_dict("records"):
            place = [int(row[a]) for a in axes if not np.isnan(row[a])]
            found[(JOINTS.index(row["joint"]), *place)] = float(row["value"])
        np.testing.assert_array_equal(found, expected)
    lines = [line[2:] for line in text.splitlines() if line.startswith("# ")]
    assert lines[0] == "pupper-sysid servo model table"
    said = {key: json.loads(value) for key, _, value in (s.partition(": ") for s in lines[1:])}
    assert said.pop("versions_when_exported")["pupper-sysid"]
    assert said == json.loads((tmp_path / "a" / "contract.json").read_text())


# ------------------------------------------------------------------------------- refusals


def test_physical_models_become_no_network_and_without_onnx_it_is_said_what_to_install(
    tmp_path: Path, monkeypatch
):
    cases = [
        ((kind, to), f"{kind} model, which integrates")
        for kind in ("delayed-pd", "sindy") for to in ("onnx", "torchscript")
    ]  # fmt: skip
    cases += [(("mlp", "onnx"), "pip install 'pupper-sysid[onnx]'")]
    models = {kind: saved(tmp_path / kind, kind) for kind in ("delayed-pd", "sindy", "mlp")}
    for name in [n for n in sys.modules if n.split(".")[0] == "onnx"]:
        monkeypatch.setitem(sys.modules, name, None)
    assert_each_refused(cases, lambda c: export_servo_model(models[c[0]], c[1], tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("to", ["onnx", "torchscript"])
def test_a_file_that_computes_something_else_is_not_written(tmp_path: Path, monkeypatch, to):
    model = saved(tmp_path / "a")
    own_step = model.model.step
    monkeypatch.setattr(model.model, "step", lambda command: own_step(command) + 1e-4)
    with pytest.raises(PupperError, match=rf"{to} file differs .* by 1.0e-04"):
        export_servo_model(model, to, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten_unless_forced(tmp_path: Path):
    model = saved(tmp_path / "a")
    for to in ENDINGS:
        path = tmp_path / to
        path.write_text("mine")
        with pytest.raises(FileExistsRefusal, match="force=True"):
            export_servo_model(model, to, path)
        assert path.read_text() == "mine"
        export_servo_model(model, to, path, force=True)
        assert path.stat().st_size > 500


# ------------------------------------------------------------------------------- command line


def test_the_command_names_its_output_after_the_folder(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "servo-0.5")
    for to, ending in ENDINGS.items():
        out, err = ran(capsys, "export", "servo-0.5/", "--to", to, "--json")
        assert json.loads(out) == {"written": f"servo-0.5{ending}"}
        assert Path(f"servo-0.5{ending}").stat().st_size > 500
        assert "warning" not in err.lower(), "torch's deprecations are not the user's concern"
    assert "--force" in refused(capsys, pupper_sysid, "export", "servo-0.5", "--to", "onnx")


def test_what_is_no_network_is_refused_in_a_sentence(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "servo")
    Path("empty").mkdir()
    for arguments, said in (
        (("paper", "--to", "onnx"), "only a learned servo model can"),
        (("a.csv", "--to", "torchscript"), "only a learned servo model can"),
        (("a.yaml", "--to", "onnx"), "only a learned servo model can"),
        (("servo/contract.json", "--to", "onnx"), "give its folder"),
        (("empty", "--to", "onnx"), "holds no servo model"),
        (("missing/", "--to", "onnx"), "neither a calibration"),
    ):
        assert said in refused(capsys, pupper_sysid, "export", *arguments), arguments
    assert not [p for ending in (".onnx", ".pt") for p in Path().glob(f"*{ending}")]
