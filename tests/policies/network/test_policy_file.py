"""Policy files: what is written is read back the same, and what is wrong is refused."""

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

from pupper_sysid.cli.policy_choice import (
    chosen_actuator,
    policy_at,
    simulator,
    trained_actuator,
    trained_commands,
)
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import sha256
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.policies.network.policy_file import (
    CONTRACT,
    WEIGHTS,
    Policy,
    load_policy,
    refuse_bad,
    write_policy,
)
from pupper_sysid.policies.network.policy_network import PolicyNetwork
from pupper_sysid.sim.walking.config import Commands
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.refusals import assert_each_refused
from support.tiny_training import ALL_KINDS, CALIBRATION, HISTORY, networks, tiny_run


def write(folder: Path, weights: dict[str, torch.Tensor]) -> None:
    """Write an MLP of `networks` with these weights."""
    run = tiny_run()
    run = replace(run, architecture=replace(run.architecture, hidden=(32, 16)))
    write_policy(folder, weights, run, servo_ranges(CALIBRATION), 0, {"seed": 0})


def rewrite_contract(folder: Path, **changes) -> None:
    path = folder / CONTRACT
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def commands(**changes) -> dict[str, list[float]]:
    """Command ranges of a contract."""
    ranges = {"forward_m_s": [-0.2, 0.2], "sideways_m_s": [-0.1, 0.1], "yaw_rad_s": [-0.5, 0.5]}
    return ranges | changes


def rewrite_weights(folder: Path, data: bytes | None = None) -> None:
    """Make the contract's hash fit the weights, or other ones."""
    if data is not None:
        (folder / WEIGHTS).write_bytes(data)
    rewrite_contract(folder, weights_sha256=sha256(folder / WEIGHTS))


# ------------------------------------------------------------------------------ written and read


def test_a_policy_that_was_written_is_read_back_bit_for_bit(saved_policies):
    for kind in ALL_KINDS:
        policy = load_policy(saved_policies[kind])
        weights = networks(kind)[0].state_dict()
        for name, tensor in policy.network.state_dict().items():
            assert torch.equal(tensor, weights[name]), (kind, name)
        contract = policy.contract
        assert contract.kind == kind and contract.hidden == [32, 16]
        assert contract.observation_size == 60 + 36 * (kind == "mlp-actions")
        assert list(contract.default_pose_rad) == list(JOINT_NAMES)
        assert contract.actuator_sha256 == sha256(Path(CALIBRATION))


def test_a_policy_keeps_its_memory_and_its_past_actions_and_forgets_them_at_a_reset(saved_policies):
    policy, fresh = (load_policy(saved_policies["lstm"]) for _ in range(2))
    start, seen = np.zeros((2, 12)), np.random.default_rng(0).normal(size=(6, 2, 60))
    for one in (policy, fresh):
        one.reset(start)
    for row in seen[:5]:
        policy.act(row)
    assert np.abs(policy.act(seen[5]) - fresh.act(seen[5])).max() > 1e-3
    for one in (policy, fresh):
        one.reset(start)
    np.testing.assert_array_equal(policy.act(seen[5]), fresh.act(seen[5]))
    policy = load_policy(saved_policies["mlp-actions"])
    policy.reset(start + 0.5)
    past = [(start + 0.5).astype(np.float32)] * HISTORY
    for row in seen.astype(np.float32):
        flat = torch.from_numpy(np.concatenate([row, *past], axis=1))
        with torch.inference_mode():
            expected = policy.network(flat)[0].numpy()
        action = policy.act(row)
        np.testing.assert_allclose(action, expected, atol=1e-6)
        past = [action, *past[:-1]]


@pytest.mark.parametrize("kind", ["mlp-actions", "lstm", "transformer"])
def test_a_policy_for_one_robot_acts_with_the_same_bits_and_keeps_its_own_state(
    kind, saved_policies
):
    policy = load_policy(saved_policies[kind])
    own = policy.for_one()
    rng = np.random.default_rng(0)
    for robot in (policy, own):
        robot.reset(np.zeros((1, 12)))
    for _ in range(20):
        seen = rng.standard_normal((1, 60)).astype(np.float32)
        np.testing.assert_array_equal(own.act(seen), policy.act(seen))
    policy.reset(np.zeros((3, 12)))
    assert policy.act(np.zeros((3, 60), np.float32)).shape == (3, 12)
    assert own.act(seen).shape == (1, 12)


def test_a_policy_states_the_commands_that_its_training_had_come_to(tmp_path):
    run = tiny_run()
    run = replace(
        run, architecture=replace(run.architecture, hidden=(32, 16)),
        task=replace(run.task, commands=Commands(forward_m_s=(-0.1, 0.3))),
    )  # fmt: skip
    weights = networks("mlp")[0].state_dict()
    servos = servo_ranges(CALIBRATION)
    write_policy(tmp_path, weights, run, servos, 0, {"seed": 0}, command_share=0.5)
    trained = load_policy(tmp_path).contract.commands
    assert trained is not None
    np.testing.assert_allclose(
        trained.clip(np.array([[9.0, 9, 9], [-9, -9, -9], [0.1, 0, 0]])),
        [[0.15, 0.05, 0.25], [-0.05, -0.05, -0.25], [0.1, 0, 0]],
    )


def test_an_older_policys_commands_are_those_of_its_run_or_else_a_stated_assumption(copied, capsys):
    policy = load_policy(copied())
    older = replace_contract(policy, commands=None)
    run = replace(tiny_run(), task=replace(tiny_run().task, commands=Commands((-0.1, 0.3))))
    assert trained_commands(policy, None).forward_m_s == [-0.2, 0.2]
    assert trained_commands(older, run).forward_m_s == [-0.1, 0.3]
    assert "Assumed" not in capsys.readouterr().err
    assert trained_commands(older, None).forward_m_s == [-0.2, 0.2]
    assert "Assumed are those of the preset fast" in " ".join(capsys.readouterr().err.split())
    published = replace_contract(older, base_velocity="true")
    assert trained_commands(published, None).forward_m_s == [-0.35, 0.35]


def replace_contract(policy: Policy, **changes) -> Policy:
    return Policy(policy.network, policy.contract.model_copy(update=changes))


# ------------------------------------------------------------------------------ refused


def test_a_contract_that_was_tampered_with_is_refused(copied):
    folder = copied()
    good = (folder / CONTRACT).read_text()

    def load(contract):
        text = contract if isinstance(contract, str) else json.dumps(json.loads(good) | contract)
        (folder / CONTRACT).write_text(text, encoding="latin-1")
        load_policy(folder)

    cases = [
        ({"schema": "pupper-servo"}, "schema"), ({"schema_version": 5}, "Upgrade pupper-sysid"),
        ({"schema_version": 0}, "schema_version"), ({"hidden": [32, 17]}, "does not fit"),
        ({"hidden": [32, -1]}, "hidden"), ({"kind": "gru"}, "does not fit"),
        ({"action_history": 1}, "does not fit"), ({"action_scale_rad": 0.0}, "action_scale_rad"),
        ({"control_step_s": 1e-9}, "control_step_s"),
        ({"default_pose_rad": {"LF_hip": 0.0}}, "default_pose_rad"),
        ({"default_pose_rad": {"LF_hip": 50.0}}, "default_pose_rad"),
        ({"velocity_steps": 10**9}, "velocity_steps"), ({"dead_time_s": []}, "dead_time_s"),
        ({"dead_time_s": [0.01, float("nan")]}, "dead_time_s"),
        ({"commands": commands(forward_m_s=[0.2, -0.2])}, "lower end"),
        ({"commands": commands(yaw_rad_s=[-0.5, float("inf")])}, "yaw_rad_s"),
        *((text, "") for text in ("", "{", "[]", "null", '{"schema": NaN}', "\x00\xff")),
    ]  # fmt: skip
    assert_each_refused(cases, load, names=folder)


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


def test_weights_that_cannot_walk_are_refused_when_read(copied):
    def load(change):
        folder = copied()
        weights = load_file(folder / WEIGHTS)
        change(weights)
        save_file(weights, folder / WEIGHTS)
        rewrite_weights(folder)
        load_policy(folder)

    cases = [
        (narrower, "does not fit"), (without_one, "does not fit"), (not_a_number, "not numbers"),
        (infinite_normaliser, "not numbers"), (constant, "is constant"),
    ]  # fmt: skip
    assert_each_refused(cases, load, names="/policy")


def test_weights_that_cannot_walk_are_not_written(tmp_path):
    for change in (not_a_number, infinite_normaliser, constant):
        weights = {k: v.clone() for k, v in networks("mlp")[0].state_dict().items()}
        change(weights)
        with pytest.raises(InputError):
            write(tmp_path, weights)
        assert not list(tmp_path.iterdir()), change
    network = PolicyNetwork("mlp", 60, (4,), 1, False)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.fill_(3e38)
    with pytest.raises(InputError, match="Actions of .* are not 12 numbers"):
        refuse_bad(network, "It")


def test_files_that_are_absent_altered_or_of_another_kind_are_refused(copied):
    """Weights that are no safetensors are not unpickled."""
    pickled = copied(folder=copied().parent / "pickled")
    torch.save({"mlp.0.weight": torch.zeros(1)}, pickled / WEIGHTS)

    def load(spoil):
        folder = copied()
        spoil(folder)
        load_policy(folder)

    def altered(folder):
        data = bytearray((folder / WEIGHTS).read_bytes())
        data[-1] ^= 1
        (folder / WEIGHTS).write_bytes(bytes(data))

    cases = [
        (altered, "is not the file that contract.json describes"),
        (lambda folder: (folder / CONTRACT).unlink(), f"no {CONTRACT} in it"),
        (lambda folder: (folder / WEIGHTS).unlink(), f"no {WEIGHTS} in it"),
        (lambda f: rewrite_weights(f, (pickled / WEIGHTS).read_bytes()), "does not fit"),
    ]
    assert_each_refused(cases, load, names="/policy")


def test_files_that_ask_for_much_memory_or_time_are_refused_before_they_get_it(copied):
    folder = copied()
    rewrite_contract(folder, hidden=[8192] * 16)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="weights of another shape"):
        load_policy(folder)
    # 15 layers of 8192² weights would be 4 GB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000

    folder, entry = copied(), '{"dtype":"F32","shape":[0],"data_offsets":[0,0]}'
    tensors = ("{" + ",".join(f'"{k}":{entry}' for k in range(10**6)) + "}").encode()
    rewrite_weights(folder, struct.pack("<Q", len(tensors)) + tensors)
    started = time.process_time()
    with pytest.raises(InputError, match="its list of tensors, has"):
        load_policy(folder)
    assert time.process_time() - started < 2


def test_a_policy_that_expects_another_observation_is_not_run(copied):
    for change in (
        {"velocity_steps": 1},
        {"observation": [{"name": "everything", "size": 60, "unit": "1"}]},
    ):
        folder = copied()
        simulator(folder, load_policy(folder), None, CALIBRATION, None)
        rewrite_contract(folder, **change)
        with pytest.raises(InputError, match="observation is not the one"):
            simulator(folder, load_policy(folder), None, CALIBRATION, None)


# ------------------------------------------------------------------------------ its servos


def test_the_actuator_of_the_training_is_found_beside_a_policy_and_known_by_its_hash(
    tmp_path, copied, monkeypatch, capsys
):
    folder, elsewhere = copied(folder=tmp_path / "mine/policies/one"), tmp_path / "elsewhere"
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
    beside = str(tmp_path / "mine/calibrated.yaml")
    assert trained_actuator(folder, policy, None) == (beside, True)
    assert chosen_actuator(folder, policy, None, "paper") == "paper"
    assert simulator(folder, policy, None, None, None)[1].source == beside
    assert "not the file with which" not in " ".join(capsys.readouterr().err.split())


def test_the_shipped_policies_find_their_servos_wherever_the_samples_are_copied(here):
    shipped = Path(CALIBRATION).parent
    (here / "samples").mkdir()
    shutil.copy(CALIBRATION, here / "samples")
    shutil.copytree(shipped / "policies", here / "samples/policies")
    for folder in sorted(Path("samples/policies").iterdir()):
        policy, run = policy_at(folder)
        servos = str(here / "samples/calibrated.yaml")
        assert trained_actuator(folder, policy, run) == (servos, True)
