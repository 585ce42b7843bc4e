"""Policy files: what is written is read back the same, and what is wrong is refused."""

from __future__ import annotations

import json
import resource
import shutil
import struct
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pupper_sysid.cli.policy_choice import chosen_actuator, policy_at, simulator, trained_actuator
from pupper_sysid.common.errors import FileExistsRefusal, InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.network.policy_export import write_policy
from pupper_sysid.policies.network.policy_file import CONTRACT, WEIGHTS, load_policy, refuse_bad
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.tiny_training import ALL_KINDS, CALIBRATION, HISTORY, networks, tiny_run


def write(folder, kind="mlp", change=None, force=True):
    """A policy of `kind`; `change(weights)` may spoil the weights before."""
    run = tiny_run(kind)
    run = replace(run, architecture=replace(run.architecture, hidden=(32, 16), memory=24))
    weights = {k: v.clone() for k, v in networks(kind)[0].state_dict().items()}
    if change:
        change(weights)
    history = HISTORY if kind == "mlp-actions" else 0
    write_policy(folder, weights, run, servo_ranges(CALIBRATION), history, {"seed": 0}, force)
    return weights


def rewrite_contract(folder, **changes):
    path = folder / CONTRACT
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def rewrite_weights(folder, change):
    """Change weights and make the contract's hash fit again."""
    weights = load_file(folder / WEIGHTS)
    change(weights)
    save_file(weights, folder / WEIGHTS)
    rewrite_contract(folder, weights_sha256=sha256(folder / WEIGHTS))


def refusal(folder) -> str:
    with pytest.raises(InputError) as refused:
        load_policy(folder)
    text = str(refused.value)
    assert "\n" not in text and str(folder) in text and text.endswith(".")
    return text


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_policy_that_was_written_is_read_back_bit_for_bit(tmp_path, kind):
    weights = write(tmp_path, kind)
    policy = load_policy(tmp_path)
    for name, tensor in policy.network.state_dict().items():
        assert torch.equal(tensor, weights[name])
    contract = policy.contract
    assert contract.kind == kind and contract.hidden == [32, 16]
    assert contract.observation_size == 60 + 36 * (kind == "mlp-actions")
    assert list(contract.default_pose_rad) == list(JOINT_NAMES)
    assert contract.actuator_sha256 == sha256(Path(CALIBRATION))


def test_a_policy_keeps_a_memory_and_forgets_it_at_a_reset(tmp_path):
    write(tmp_path, "lstm")
    policy, fresh = load_policy(tmp_path), load_policy(tmp_path)
    start = np.zeros((2, 12))
    policy.reset(start)
    fresh.reset(start)
    seen = np.random.default_rng(0).normal(size=(6, 2, 60))
    for row in seen[:5]:
        policy.act(row)
    assert np.abs(policy.act(seen[5]) - fresh.act(seen[5])).max() > 1e-3
    for one in (policy, fresh):
        one.reset(start)
    np.testing.assert_array_equal(policy.act(seen[5]), fresh.act(seen[5]))


def test_a_policy_with_past_actions_remembers_its_own(tmp_path):
    write(tmp_path, "mlp-actions")
    policy = load_policy(tmp_path)
    rng = np.random.default_rng(0)
    start = rng.normal(size=(2, 12))
    policy.reset(start)
    past = [start.astype(np.float32)] * HISTORY
    for row in rng.normal(size=(5, 2, 60)).astype(np.float32):
        flat = torch.from_numpy(np.concatenate([row, *past], axis=1))
        with torch.inference_mode():
            expected = policy.network(flat)[0].numpy()
        action = policy.act(row)
        np.testing.assert_allclose(action, expected, atol=1e-6)
        past = [action, *past[:-1]]


def test_a_policy_is_not_written_over_another_unless_asked(tmp_path):
    write(tmp_path)
    with pytest.raises(FileExistsRefusal):
        write(tmp_path, force=False)


def test_weights_that_were_tampered_with_are_refused(tmp_path):
    write(tmp_path)
    data = bytearray((tmp_path / WEIGHTS).read_bytes())
    data[-1] ^= 1
    (tmp_path / WEIGHTS).write_bytes(bytes(data))
    assert "is not the file that contract.json describes" in refusal(tmp_path)


def test_a_contract_of_version_1_has_its_dead_time_under_the_old_name(tmp_path):
    write(tmp_path)
    written = json.loads((tmp_path / CONTRACT).read_text())
    found = {k.replace("dead_time_s", "delay_s"): v for k, v in written.items()}
    (tmp_path / CONTRACT).write_text(json.dumps(found | {"schema_version": 1}))
    assert load_policy(tmp_path).contract.model_dump(mode="json", by_alias=True) == written


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": "pupper-servo"}, "schema"),
        ({"schema_version": 4}, "Upgrade pupper-sysid"),
        ({"schema_version": 0}, "schema_version"),
        ({"kind": "perceptron"}, "kind"),
        ({"hidden": []}, "does not fit"),
        ({"hidden": [32, 17]}, "does not fit"),
        ({"hidden": [32, -1]}, "hidden"),
        ({"kind": "gru"}, "does not fit"),
        ({"action_history": 1}, "does not fit"),
        ({"action_scale_rad": 0.0}, "action_scale_rad"),
        ({"control_step_s": "0.02"}, "control_step_s"),
        ({"base_velocity": "guessed"}, "base_velocity"),
        ({"extra": 1}, "extra"),
        ({"default_pose_rad": {"LF_hip": 0.0}}, "default_pose_rad"),
        ({"default_pose_rad": {"LF_hip": 50.0}}, "default_pose_rad"),
        ({"velocity_steps": 10**9}, "velocity_steps"),
        ({"control_step_s": 1e-9}, "control_step_s"),
        ({"dead_time_s": [0.01, float("nan")]}, "dead_time_s"),
        ({"dead_time_s": []}, "dead_time_s"),
        ({"weights_sha256": "0" * 63}, "weights_sha256"),
    ],
)
def test_a_contract_that_was_tampered_with_is_refused(tmp_path, change, words):
    write(tmp_path)
    rewrite_contract(tmp_path, **change)
    assert words in refusal(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"schema": NaN}', "\x00\xff"])
def test_a_contract_that_is_no_json_object_is_refused(tmp_path, text):
    write(tmp_path)
    (tmp_path / CONTRACT).write_text(text, encoding="latin-1")
    refusal(tmp_path)


@pytest.mark.parametrize("name", [CONTRACT, WEIGHTS])
def test_a_policy_without_one_of_its_files_is_refused(tmp_path, name):
    write(tmp_path)
    (tmp_path / name).unlink()
    assert f"no {name} in it" in refusal(tmp_path)


def narrower(weights):
    weights["mlp.0.weight"] = weights["mlp.0.weight"][:, 1:].contiguous()


def without_one(weights):
    del weights["mlp.2.bias"]


def not_a_number(weights):
    weights["mlp.2.bias"][3] = float("nan")


def infinite_normaliser(weights):
    weights["obs_normalizer._mean"][0, 3] = float("inf")


def constant(weights):
    weights["mlp.4.weight"].zero_()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (narrower, "does not fit"), (without_one, "does not fit"),
        (not_a_number, "not numbers"), (infinite_normaliser, "not numbers"),
        (constant, "is constant"),
    ],
)  # fmt: skip
def test_weights_that_cannot_walk_are_refused_when_read(tmp_path, change, words):
    write(tmp_path)
    rewrite_weights(tmp_path, change)
    assert words in refusal(tmp_path)


@pytest.mark.parametrize("change", [not_a_number, infinite_normaliser, constant])
def test_weights_that_cannot_walk_are_not_written(tmp_path, change):
    with pytest.raises(InputError):
        write(tmp_path, change=change)
    assert not (tmp_path / CONTRACT).exists() and not (tmp_path / WEIGHTS).exists()


def test_weights_that_are_no_safetensors_are_refused_without_unpickling(tmp_path):
    write(tmp_path)
    torch.save({"mlp.0.weight": torch.zeros(1)}, tmp_path / WEIGHTS)
    rewrite_contract(tmp_path, weights_sha256=sha256(tmp_path / WEIGHTS))
    assert "does not fit" in refusal(tmp_path)


def test_the_gate_refuses_actions_that_overflow():
    network = PolicyNetwork("mlp", 60, (4,), 1, False)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(3e38)
    with pytest.raises(InputError, match="Actions of .* are not 12 numbers"):
        refuse_bad(network, "It")


@pytest.mark.parametrize(
    "change",
    [
        {"velocity_steps": 1},
        {"observation": [{"name": "everything", "size": 60, "unit": "1"}]},
    ],
)
def test_a_policy_that_expects_another_observation_is_not_run(tmp_path, change):
    write(tmp_path)
    simulator(tmp_path, load_policy(tmp_path), None, CALIBRATION, None)
    rewrite_contract(tmp_path, **change)
    with pytest.raises(InputError, match="observation is not the one"):
        simulator(tmp_path, load_policy(tmp_path), None, CALIBRATION, None)


def test_the_actuator_of_the_training_is_found_beside_a_policy_and_known_by_its_hash(
    tmp_path, monkeypatch, capsys
):
    folder, elsewhere = tmp_path / "mine/policies/one", tmp_path / "elsewhere"
    write(folder)
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    policy = load_policy(folder)
    with pytest.raises(InputError, match=r"names the actuator calibrated\.yaml, which is not here"):
        chosen_actuator(folder, policy, None, None)
    original = Path(CALIBRATION).read_text()
    Path("calibrated.yaml").write_text(original + "# of another robot\n")
    assert trained_actuator(folder, policy, None) == ("calibrated.yaml", False)
    assert chosen_actuator(folder, policy, None, None) == "calibrated.yaml"
    assert "not the file with which" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "mine/calibrated.yaml").write_text(original)
    found = str(tmp_path / "mine/calibrated.yaml")
    assert trained_actuator(folder, policy, None) == (found, True)
    assert chosen_actuator(folder, policy, None, "paper") == "paper"
    assert simulator(folder, policy, None, None, None)[1].source == found
    assert "not the file with which" not in " ".join(capsys.readouterr().err.split())


def test_what_is_neither_run_nor_policy_is_refused(tmp_path):
    with pytest.raises(InputError, match="neither a run nor a policy"):
        policy_at(tmp_path)


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_policy_for_one_robot_acts_with_the_same_bits_and_keeps_its_own_state(kind, tmp_path):
    write(tmp_path, kind)
    policy = load_policy(tmp_path)
    own = policy.for_one()
    rng = np.random.default_rng(0)
    for robot in (policy, own):
        robot.reset(np.zeros((1, 12)))
    for _ in range(30):
        seen = rng.standard_normal((1, 60)).astype(np.float32)
        np.testing.assert_array_equal(own.act(seen), policy.act(seen))
    policy.reset(np.zeros((3, 12)))
    assert policy.act(np.zeros((3, 60), np.float32)).shape == (3, 12)
    assert own.act(seen).shape == (1, 12)


def test_a_contract_that_asks_for_much_memory_is_refused_before_it_is_given(tmp_path):
    folder = tmp_path / "policy"
    write(folder)
    rewrite_contract(folder, hidden=[8192] * 16)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="weights of another shape"):
        load_policy(folder)
    # 15 layers of 8192² weights would be 4 GB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


def test_a_list_of_a_million_tensors_is_refused_at_once(tmp_path):
    folder = tmp_path / "policy"
    write(folder)
    tensors = ",".join(
        f'"{k}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}' for k in range(10**6)
    )
    data = ("{" + tensors + "}").encode()
    (folder / WEIGHTS).write_bytes(struct.pack("<Q", len(data)) + data)
    rewrite_contract(folder, weights_sha256=sha256(folder / WEIGHTS))
    started = time.process_time()
    with pytest.raises(InputError, match="its list of tensors, has"):
        load_policy(folder)
    assert time.process_time() - started < 2


@pytest.mark.parametrize("kind", ["mlp", "lstm", "lstm_from_nothing", "mlp_from_nothing"])
def test_the_shipped_policies_find_their_servos_wherever_the_samples_are_copied(
    tmp_path, monkeypatch, kind
):
    shipped = Path(CALIBRATION).parent
    (tmp_path / "samples").mkdir()
    shutil.copy(CALIBRATION, tmp_path / "samples")
    shutil.copytree(shipped / "policies", tmp_path / "samples/policies")
    monkeypatch.chdir(tmp_path)
    folder = Path("samples/policies") / kind
    policy, run = policy_at(folder)
    found, same = trained_actuator(folder, policy, run)
    assert same and found == str(tmp_path / "samples/calibrated.yaml")
