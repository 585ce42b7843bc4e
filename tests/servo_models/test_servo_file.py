"""Servo model files: what was saved is what runs, and what is not that model is refused."""

import hashlib
import json
import pickle
from functools import partial
from itertools import count, permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save as save_tensors

from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.servo_models.servo_file import (
    CONTRACT,
    WEIGHTS,
    load_servo_model,
    save_servo_model,
)
from support.refusals import assert_each_refused, refusal
from support.saved_servo_models import JOINTS, KINDS, Arrays, P, arrays, commands, contract, saved

refused = partial(refusal, load_servo_model)


def crafted(folder: Path, kind: str, parameters: Arrays | bytes, **changes: Any) -> Path:
    """A model whose hash fits its weights, whatever those are: made to mislead."""
    saved(folder, kind)
    data = parameters
    if not isinstance(data, bytes):
        data = save_tensors({k: np.ascontiguousarray(v) for k, v in data.items()})
    (folder / WEIGHTS).write_bytes(data)
    return edited(folder, weights_sha256=hashlib.sha256(data).hexdigest(), **changes)


def edited(folder: Path, **changes: Any) -> Path:
    path = folder / CONTRACT
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_moves_the_same_after_it_was_saved_and_read_also_some_joints_of_it(
    tmp_path: Path, kind: str
):
    parameters = arrays(kind)
    save_servo_model(tmp_path / "a", parameters, contract(kind, parameters))
    first = load_servo_model(tmp_path / "a", JOINTS, P)
    assert {k: v.tobytes() for k, v in first.parameters.items()} == {
        k: v.tobytes() for k, v in parameters.items()
    }
    written = first.contract.model_dump(mode="json", by_alias=True, exclude={"weights_sha256"})
    save_servo_model(tmp_path / "b", first.parameters, written)
    again = load_servo_model(tmp_path / "b")
    assert again.contract == first.contract and again.model.time_step_s == pytest.approx(P)
    runs = []
    for model in (first.model, again.model):
        model.reset(np.zeros(len(JOINTS)))
        runs.append(model.rollout(commands()))
    np.testing.assert_array_equal(*runs)
    assert np.ptp(runs[0], axis=0).min() > 1e-3, "the models compared do move"
    # joints in another order get their own models
    order = ["RF_thigh", "LF_hip"]
    index = [JOINTS.index(j) for j in order]
    part = load_servo_model(tmp_path / "a", order)
    assert list(part.contract.joints) == order
    part.model.reset(np.zeros(2))
    moved = part.model.rollout(commands()[:, index])
    np.testing.assert_allclose(moved, runs[0][:, index], atol=1e-6)
    assert np.abs(runs[0][:, index] - runs[0][:, index[::-1]]).max() > 1e-3, "a mix-up would show"


# ------------------------------------------------------------------------------- refusals


def test_a_folder_without_a_whole_model_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    none = "holds no servo model"
    cases = [("missing", none), ("", "Make one with `pupper-sysid fit-servo`"), ("file", none),
             ("long" * 100, none)]  # fmt: skip
    assert_each_refused(cases, lambda name: load_servo_model(tmp_path / name))
    saved(tmp_path / "a", seed=0)
    saved(tmp_path / "b", seed=1)
    path, folder = tmp_path / "a" / WEIGHTS, tmp_path / "a"
    data, other = path.read_bytes(), (tmp_path / "b" / WEIGHTS).read_bytes()
    flipped = data[:700] + bytes([data[700] ^ 1]) + data[701:]

    def read(weights):
        path.unlink(missing_ok=True)
        if weights is not None:
            path.write_bytes(weights)
        load_servo_model(folder)

    cases = [(w, "is not the file that contract.json describes") for w in (b"", flipped, other)]
    cases += [(data[:-3], "exchanged"), (None, "does not exist. Copy the whole folder")]
    assert_each_refused(cases, read, names=WEIGHTS)
    for text, said in (
        (b"{", "is not JSON"), (b"\xff\xfe\x00", "is not a text file"),
        (b"[1, 2]", "is no servo model's contract"), (b" " * 2_000_001, "at most 2.0 MB are read"),
    ):  # fmt: skip
        (folder / CONTRACT).write_bytes(text)
        assert said in refused(folder)


@pytest.mark.parametrize(
    "kind",
    [
        k if k in ("fir", "lstm", "delayed-pd") else pytest.param(k, marks=pytest.mark.slow)
        for k in KINDS
    ],
)
def test_arrays_that_are_not_the_models_are_refused_by_name_even_with_a_matching_hash(
    tmp_path: Path, kind: str
):
    folders = (tmp_path / str(n) for n in count())
    for name in arrays(kind):
        parameters = arrays(kind)
        parameters[name].flat[0] = np.nan
        said = refused(crafted(next(folders), kind, parameters))
        assert f"{name} holds NaN" in said and str(tmp_path) in said
        for change in (lambda v: v[:-1], lambda v: v[..., None], lambda v: v.astype(int)):
            parameters = arrays(kind) | {name: change(np.nan_to_num(arrays(kind)[name], posinf=9))}
            said = refused(crafted(next(folders), kind, parameters))
            assert "shape" in said or "axes" in said
        removed = (parameters := arrays(kind)).pop(name)
        said = refusal(
            load_servo_model, crafted(next(folders), kind, arrays(kind) | {"extra": removed})
        )
        assert "extra is none of its arrays" in said
        # a term may be absent from an equation, and files of earlier versions lack the back-EMF
        if name != "back_emf" and not (kind == "sindy" and name.startswith(("stiff", "damping"))):
            said = refused(crafted(next(folders), kind, parameters))
            assert f"{name} is missing" in said or "weights are not those" in said


def test_the_arrays_of_another_architecture_are_refused(tmp_path: Path):
    kinds = {"fir", "mlp", "lstm", "delayed-pd", "sindy"}
    for kind, other in permutations(kinds, 2):
        if other == "fir" and kind in ("mlp", "lstm"):
            continue  # a network whose training was ended at once
        said = refused(crafted(tmp_path / kind / other, kind, arrays(other)))
        assert f"not those of a model of type {kind}" in said


def test_numbers_that_no_servo_has_are_refused_before_they_take_all_memory(tmp_path: Path):
    parameters = arrays("lstm")
    parameters["bound"][1] = np.inf  # inf * tanh(x / inf) would be no number
    said = refused(crafted(tmp_path / "a", "lstm", parameters))
    assert "bound is infinite for some joints only" in said
    for kind in ("delayed-pd", "sindy"):
        for value in (-1.0, 1e12, np.inf):
            parameters = arrays(kind) | {"dead_time_s": np.full(len(JOINTS), value)}
            assert "dead_time_s" in refusal(
                load_servo_model, crafted(tmp_path / f"{kind} {value}", kind, parameters)
            )


def test_a_contract_is_refused_that_says_what_the_model_is_not(tmp_path: Path):
    changes: list[tuple[dict[str, Any], str]] = [
        ({"schema_version": 3}, "newer version"),
        ({"schema": "pupper-calibration"}, "is a calibration, not a fitted servo model"),
        ({"arch": "transformer"}, "arch"),
        ({"time_step_s": 0.0}, "time_step_s"),
        ({"time_step_s": float("nan")}, "time_step_s"),
        ({"joints": {}}, "joints"),
        ({"inputs": ["command_rad[t]"]}, "its arrays take command_rad[t], command_rad[t-1]"),
        ({"feedback": True}, "predicted_position_rad"),
    ]
    saved(tmp_path / "a")
    original = (tmp_path / "a" / CONTRACT).read_text()
    for change, phrase in changes:
        assert phrase in refused(edited(tmp_path / "a", **change)), change
        (tmp_path / "a" / CONTRACT).write_text(original)
    without = json.loads(original)
    del without["time_step_s"]
    (tmp_path / "a" / CONTRACT).write_text(json.dumps(without))
    assert "time_step_s is missing" in refused(tmp_path / "a")
    renamed = json.loads(original)
    renamed["joints"]["XY_hip"] = renamed["joints"].pop("LF_hip")
    (tmp_path / "a" / CONTRACT).write_text(json.dumps(renamed))
    assert "XY_hip is no joint" in refused(tmp_path / "a")


def test_another_rate_and_a_joint_without_a_model_are_refused_with_the_way_to_get_them(
    tmp_path: Path,
):
    saved(tmp_path / "a")
    rate, joints = {"time_step_s": 0.04}, {"joints": ["LF_hip", "LB_hip"]}
    cases = [
        (rate, "every 20.0 ms"),
        (rate, "every 40.0 ms"),
        (rate, "record at the new one"),
        (rate, "fit the architecture delayed-pd"),
        (joints, "no model for LB_hip"),
        (joints, "it has LF_hip, RB_calf, RF_thigh"),
        (joints, "fit one of its own"),
    ]
    assert_each_refused(cases, lambda wanted: load_servo_model(tmp_path / "a", **wanted))
    assert load_servo_model(tmp_path / "a", time_step_s=0.0203), "a clock may be off by 2 %"


class _Trap:
    def __reduce__(self):
        return (Path.touch, (Path("unpickled"),))


def test_nothing_is_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    folder = crafted(tmp_path / "a", "mlp", pickle.dumps({"fir": _Trap()}))
    assert "is no safetensors file" in refused(folder)
    assert not Path("unpickled").exists()


# ------------------------------------------------------------------------------- saving


def test_a_model_is_replaced_only_when_forced(tmp_path: Path):
    saved(tmp_path / "a", seed=0)
    before = (tmp_path / "a" / WEIGHTS).read_bytes()
    other = arrays("mlp", seed=1)
    with pytest.raises(FileExistsRefusal, match="force=True"):
        save_servo_model(tmp_path / "a", other, contract("mlp", other))
    assert (tmp_path / "a" / WEIGHTS).read_bytes() == before
    save_servo_model(tmp_path / "a", other, contract("mlp", other), force=True)
    assert load_servo_model(tmp_path / "a").parameters["fir"].tolist() == other["fir"].tolist()


def test_what_could_not_be_read_back_is_not_written_and_a_file_in_its_place_is_left(tmp_path: Path):
    good = arrays("fir")
    bad_arrays = good | {"fir": np.full_like(good["fir"], np.nan)}
    bad_contract = contract("fir", good) | {"choices": {"ridge": float("inf")}}
    for parameters, said in ((bad_arrays, contract("fir", good)), (good, bad_contract)):
        with pytest.raises(InputError, match=str(tmp_path / "a")):
            save_servo_model(tmp_path / "a", parameters, said)
    assert not (tmp_path / "a").exists()
    (tmp_path / "a").write_text("mine")
    with pytest.raises(InputError, match="is a file"):
        save_servo_model(tmp_path / "a", good, contract("fir", good), force=True)
    assert (tmp_path / "a").read_text() == "mine"


def test_a_model_of_version_1_has_its_dead_time_under_the_old_name(tmp_path: Path):
    for kind in ("delayed-pd", "sindy"):
        parameters = arrays(kind)
        old = {k.replace("dead_time_s", "delay_s"): v for k, v in parameters.items()}
        model = load_servo_model(crafted(tmp_path / kind, kind, old, schema_version=1))
        assert model.contract.schema_version == 2
        expected = parameters["dead_time_s"]
        np.testing.assert_array_equal(model.parameters["dead_time_s"], expected)
        assert "_s is missing" in refusal(
            load_servo_model, crafted(tmp_path / f"{kind} new", kind, old)
        )
