"""Training runs: stopped and resumed as if they had not been, guarded, alone and together."""

import csv
import errno
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pupper_sysid.cli.policy_choice import policy_at
from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.train import training
from pupper_sysid.policies.train.imitation import imitate
from pupper_sysid.policies.train.learner import Learner, Ranks, read_checkpoint
from pupper_sysid.policies.train.run_file import Imitation, load_run
from pupper_sysid.policies.train.training import LAST, PROGRESS, learner_device, train
from pupper_sysid.sim.gpu.warp_robots import WarpRobots
from support.checkpoints import different, stop_after
from support.tiny_training import CALIBRATION, tiny_run

# ------------------------------------------------------------------------------ resuming


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Folder of each kind's run of two rounds of imitation and three updates; not to be changed."""
    folders: dict[str, Path] = {}

    def folder(kind: str = "mlp") -> Path:
        if kind not in folders:
            folders[kind] = tmp_path_factory.mktemp(kind) / "run"
            train(folders[kind], tiny_run(kind))
        return folders[kind]

    return folder


@pytest.fixture
def finished(uninterrupted, tmp_path) -> Path:
    """A copy of that of an MLP."""
    return Path(shutil.copytree(uninterrupted(), tmp_path / "run"))


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory) -> Path:
    """A run that was stopped after its first update; not to be changed."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    train(folder, tiny_run(), stop_after("ppo", 1))
    return folder


@pytest.fixture
def stopped(stopped_once, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(stopped_once, tmp_path / "run"))


@pytest.mark.parametrize(
    "kind",
    ["mlp", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("lstm", "transformer"))],
)
def test_a_run_that_was_stopped_and_resumed_is_bit_for_bit_the_run_that_was_not(
    tmp_path, uninterrupted, kind
):
    train(tmp_path, tiny_run(kind), stop_after("imitation", 1))
    checkpoint = read_checkpoint(tmp_path / LAST)
    assert (checkpoint["iteration"], checkpoint["more"]["imitated"]) == (0, 1)
    train(tmp_path, None, stop_after("ppo", 2))
    checkpoint = read_checkpoint(tmp_path / LAST)
    assert (checkpoint["iteration"], checkpoint["more"]["imitated"]) == (2, 2)
    train(tmp_path, None)
    straight = read_checkpoint(uninterrupted(kind) / LAST)
    assert different(straight, read_checkpoint(tmp_path / LAST)) == []
    # and the comparison sees what it should
    assert straight["iteration"] == 3
    for part in ("actor_state_dict", "optimizer_state_dict", "observations", "environment"):
        assert different(straight[part], checkpoint[part])


@pytest.mark.slow
def test_a_resumed_run_can_be_extended_and_remembers_it(tmp_path, uninterrupted):
    train(tmp_path, tiny_run(iterations=2))
    train(tmp_path, None, iterations=3)
    assert load_run(tmp_path).iterations == 3
    straight = read_checkpoint(uninterrupted() / LAST)
    assert different(straight, read_checkpoint(tmp_path / LAST)) == []


def test_a_run_is_not_resumed_with_another_actuator_file(tmp_path):
    actuator = tmp_path / "calibrated.yaml"
    actuator.write_text(Path(CALIBRATION).read_text())
    train(tmp_path / "run", tiny_run(actuator=str(actuator), iterations=1))
    actuator.write_text(Path(CALIBRATION).read_text() + "# another\n")
    with pytest.raises(InputError, match="no longer the file"):
        train(tmp_path / "run", None, iterations=2)
    actuator.unlink()
    with pytest.raises(InputError, match="is not there"):
        train(tmp_path / "run", None, iterations=2)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class PowerCut(Exception):
    """Nothing is saved any more."""


def cut_power_after(phase: str, done: int):
    def watch(now):
        if (now.phase, now.done) == (phase, done):
            raise PowerCut

    return watch


@pytest.mark.slow
def test_after_a_power_cut_nothing_is_repeated_in_the_curves_and_the_best_stays_the_best(tmp_path):
    run = tiny_run(iterations=12)
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    train(straight, run)
    with pytest.raises(PowerCut):
        train(cut, run, cut_power_after("ppo", 11))
    kept = read_checkpoint(cut / LAST)
    assert kept["iteration"] == 10, "a checkpoint every ten updates"
    best = read_checkpoint(cut / "best.pt")
    assert kept["more"]["best"] == best["more"]["scores"]["score"]
    assert len(rows(cut / PROGRESS)) == 11
    with (cut / PROGRESS).open("a") as file:
        file.write("12,0.1")  # half a row: the power went while it was written
    train(cut, None)
    for name in (LAST, "best.pt"):
        assert different(read_checkpoint(straight / name), read_checkpoint(cut / name)) == []
    found = rows(cut / PROGRESS)
    assert [row["update"] for row in found] == [str(i + 1) for i in range(12)]
    expected = [row["reward"] for row in rows(straight / PROGRESS)]
    assert [row["reward"] for row in found] == expected
    assert [row["update"] for row in rows(cut / "imitation.csv")] == ["1", "2"]


def test_resuming_a_finished_run_changes_nothing_and_none_is_begun_over_it(finished):
    before = (finished / LAST).read_bytes()
    with pytest.raises(InputError, match="holds a run already"):
        train(finished, tiny_run(iterations=1))
    assert (finished / LAST).read_bytes() == before
    checkpoint = read_checkpoint(finished / LAST)
    train(finished, None)
    assert different(checkpoint, read_checkpoint(finished / LAST)) == []
    assert len(rows(finished / PROGRESS)) == 3


def test_a_run_keeps_the_policy_of_imitation_alone_beside_what_ppo_made_of_it(tmp_path):
    """Without imitation there is none to keep."""
    hyper = replace(tiny_run().learner, learning_rate=1e-3, desired_kl=1e9)
    train(tmp_path / "run", tiny_run(learner=hyper, iterations=1))
    imitated, last = (load_policy(tmp_path / "run" / f"policy_{n}") for n in ("imitated", "last"))
    assert imitated.contract.training["iteration"] == 0
    assert last.contract.training["iteration"] == 1
    before, after = (policy.network.mlp.state_dict() for policy in (imitated, last))
    assert all((before[name] != after[name]).any() for name in before)
    train(tmp_path / "alone", tiny_run(imitation=Imitation(iterations=0), iterations=1))
    assert not (tmp_path / "alone" / "policy_imitated").exists()


def test_a_termination_signal_saves_too_and_handlers_are_put_back(tmp_path):
    before = signal.getsignal(signal.SIGTERM)

    def watch(now):
        if now.phase == "ppo":
            signal.raise_signal(signal.SIGTERM)

    train(tmp_path, tiny_run(), watch)
    assert read_checkpoint(tmp_path / LAST)["iteration"] == 1
    assert signal.getsignal(signal.SIGTERM) is before
    load_policy(tmp_path / "policy_last")


HANGS = """
import signal, sys, time
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from support.tiny_training import tiny_run
from pupper_sysid.policies.train.training import train

def watch(now):
    if now.phase == "ppo":
        print("terminated", flush=True)
        signal.raise_signal(signal.SIGTERM)
        time.sleep(60)  # an update that takes long

train(Path(sys.argv[1]), tiny_run(), watch)
"""


@pytest.mark.slow
def test_a_termination_signal_ends_a_long_update_within_a_second(tmp_path):
    tests = Path(__file__).resolve().parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", HANGS, str(tmp_path / "run"), str(tests)], cwd=tests.parent,
        stdout=subprocess.PIPE,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"terminated"
        assert process.wait(timeout=1.0) == -signal.SIGTERM
    assert read_checkpoint(tmp_path / "run" / LAST)["iteration"] == 0  # the last one is whole
    train(tmp_path / "run", None)


def test_time_that_is_up_ends_a_run_within_its_first_gait_with_a_policy_that_plays(tmp_path):
    train(tmp_path / "short", tiny_run(minutes=0.001))
    found = read_checkpoint(tmp_path / "short" / LAST)
    assert found["iteration"] == 0 and found["more"]["imitated"] < 2
    policy, _ = policy_at(tmp_path / "short")
    policy.reset(np.zeros((1, 12)))
    assert np.isfinite(policy.act(np.zeros((1, 60)))).all()
    # the time before a run counts
    train(tmp_path / "late", tiny_run(minutes=60.0), spent_s=3600.0)
    late = read_checkpoint(tmp_path / "late" / LAST)["more"]
    assert late["imitated"] == 0 and late["elapsed_s"] >= 3600.0


def test_a_round_that_was_left_is_repeated_and_the_run_is_that_without_a_stop(
    tmp_path, uninterrupted, monkeypatch
):
    def left_in_the_second_round(learner, teacher, how, round_, ends):
        steps = count()
        late = round_ == 1
        return imitate(learner, teacher, how, round_, lambda: late and next(steps) > 6)

    with monkeypatch.context() as patched:
        patched.setattr(training, "imitate", left_in_the_second_round)
        train(tmp_path, tiny_run())
    assert read_checkpoint(tmp_path / LAST)["more"]["imitated"] == 1
    # seven steps: the rollout was whole, and one minibatch was learned from
    weights = load_policy(tmp_path / "policy_last").network.state_dict()
    kept = read_checkpoint(tmp_path / LAST)["actor_state_dict"]
    assert not torch.equal(weights["mlp.0.weight"], kept["mlp.0.weight"])
    train(tmp_path, None)
    straight = read_checkpoint(uninterrupted() / LAST)
    assert different(straight, read_checkpoint(tmp_path / LAST)) == []


def test_rounds_that_do_not_fit_the_time_are_left_out_and_the_rate_falls_to_zero_with_the_last(
    tmp_path, monkeypatch
):
    rates, said, clock = [], [], SimpleNamespace(now_s=1000.0)

    def slow(learner, teacher, how, round_, ends):
        rates.append(how.iterations)
        clock.now_s += 10.0
        return imitate(learner, teacher, how, round_, ends)

    monkeypatch.setattr(training, "imitate", slow)
    ticking = SimpleNamespace(monotonic=lambda: clock.now_s, perf_counter=time.perf_counter)
    monkeypatch.setattr(training, "time", ticking)
    run = tiny_run(imitation=Imitation(40, rollouts=1, epochs=1, minibatches=2), minutes=1.0)
    train(tmp_path, run, stop_after("imitation", 2), notice=said.append)
    # of the 50 s after the first round three quarters are enough for three of 10 s
    assert read_checkpoint(tmp_path / LAST)["more"]["rounds"] == 4 and rates == [40, 4]
    assert len(said) == 1 and "4 of 40 are made within 1 minutes" in said[0]
    train(tmp_path, None, stop_after("imitation", 4), minutes=60.0)
    assert rates == [40, 4, 4, 4]


def test_updates_that_are_all_taken_back_are_said_and_end_the_run_with_what_helps(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(training, "_UNDONE_WARNS", 2)
    monkeypatch.setattr(training, "_UNDONE_END", 4)
    hyper = replace(tiny_run().learner, desired_kl=1e-12, learning_rates=(1e-3, 1e-3))
    said = []
    run = tiny_run(learner=hyper, iterations=10, imitation=Imitation(iterations=0))
    learner = train(tmp_path, run, notice=said.append)
    assert learner.iteration == 4 and read_checkpoint(tmp_path / LAST)["iteration"] == 4
    assert "The last 2 updates" in said[0] and "ends after 4" in said[0]
    assert "The last 4 updates" in said[1] and "`learner.desired_kl` 2e-12" in said[1]
    # with the weights, Adam's memory goes back, but for that of its first update
    steps = [s["step"] for s in learner.ppo.optimizer.state_dict()["state"].values()]
    each = run.learner.epochs * run.learner.minibatches
    assert min(steps) == each and max(steps) == 4 * each, "of the policy, and of the critic"


# ------------------------------------------------------------------------------ guards


def spoil(monkeypatch, when: int, where: str):
    """Make the update after `when` go wrong; returns the weights it began with."""
    real, began = Learner.update, []

    def update(self):
        if self.iteration != when:
            return real(self)
        began.append({k: v.clone() for k, v in self.actor.state_dict().items()})
        losses = real(self)
        if where == "loss":
            return losses | {"value": math.nan}
        with torch.no_grad():
            next(self.ppo.critic.parameters()).view(-1)[0] = math.nan
        return losses

    monkeypatch.setattr(Learner, "update", update)
    return began


@pytest.mark.parametrize(
    ("when", "where"), [pytest.param(0, "loss", marks=pytest.mark.slow), (1, "critic")]
)
def test_when_numbers_stop_being_numbers_the_networks_before_are_saved_and_go_on(
    tmp_path, monkeypatch, when, where
):
    began = spoil(monkeypatch, when, where)
    with pytest.raises(PupperError, match=f"are not finite after update {when}") as said:
        train(tmp_path, tiny_run())
    assert f"`resume={tmp_path}`" in str(said.value) and "\n" not in str(said.value)
    found = read_checkpoint(tmp_path / LAST)
    assert found["iteration"] == when
    assert different(found["actor_state_dict"], began[0]) == []
    assert all(torch.isfinite(t).all() for t in found["critic_state_dict"].values())
    monkeypatch.undo()
    train(tmp_path, None)
    assert read_checkpoint(tmp_path / LAST)["iteration"] == 3


def test_imitation_is_guarded_as_well(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "imitate", lambda *_: math.nan)
    with pytest.raises(PupperError, match="are not finite"):
        train(tmp_path, tiny_run())
    assert read_checkpoint(tmp_path / LAST)["more"]["imitated"] == 0


def test_a_checkpoint_is_not_replaced_by_one_whose_observations_are_no_numbers(
    stopped, monkeypatch
):
    before = (stopped / LAST).read_bytes()
    real = Learner.rollout

    def rollout(self, watch=None):
        real(self, watch)
        with torch.inference_mode():
            self.observations["policy"][0, 0] = math.nan

    monkeypatch.setattr(Learner, "rollout", rollout)
    with pytest.raises(PupperError, match="observations that are not numbers after update 1"):
        train(stopped, None)
    assert (stopped / LAST).read_bytes() == before


def test_a_full_disk_ends_a_run_in_a_sentence_and_keeps_the_checkpoint_before(stopped, monkeypatch):
    before = (stopped / LAST).read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"last\.pt cannot be written: No space left on device"):
        train(stopped, None)
    assert (stopped / LAST).read_bytes() == before
    assert not list(stopped.glob(".last*"))


def test_a_curve_that_cannot_be_written_is_said_in_a_sentence(tmp_path):
    table = tmp_path / "imitation.csv"

    def block(now=None):
        table.unlink(missing_ok=True)
        table.mkdir()  # as good as a full disk: it cannot be opened

    with pytest.raises(InputError, match=r"imitation\.csv cannot be written"):
        train(tmp_path, tiny_run(), block)
    assert table.is_dir()
    with pytest.raises(InputError, match=r"imitation\.csv is not a file"):
        train(tmp_path, None)


def test_a_table_of_curves_of_a_million_lines_is_refused_at_once(stopped):
    (stopped / PROGRESS).write_bytes(b"update\n" + b"\n" * 20_000_000)
    begun = time.process_time()
    with pytest.raises(InputError, match=r"progress\.csv .* rows"):
        train(stopped, None)
    assert time.process_time() - begun < 5


# ------------------------------------------------------------------------------ imitation


def test_ppo_begins_with_its_own_learning_rate_and_no_momentum_of_imitation(tmp_path):
    run = tiny_run()
    train(tmp_path, run, stop_after("imitation", 2))
    found = read_checkpoint(tmp_path / LAST)
    assert found["optimizer_state_dict"]["state"] == {}
    assert found["learning_rate"] == run.learner.learning_rate
    assert found["optimizer_state_dict"]["param_groups"][0]["lr"] == run.learner.learning_rate


# ------------------------------------------------------------------------------ two processes

TWO = """
import signal, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from support.tiny_training import tiny_run
from pupper_sysid.policies.train.training import train

def stop_after(*where):
    def watch(now):  # of the first process alone: only it is told to stop
        if (now.phase, now.done) == where:
            signal.raise_signal(signal.SIGINT)
    return watch

folder = Path(sys.argv[1])
train(folder, tiny_run(iterations=1000), stop_after("imitation", 1))
train(folder, None, stop_after("ppo", 2))
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Checkpoints of two processes that trained, stopped, resumed and stopped together.

    Only the first was told to stop: in its first round of imitation, then after two updates.
    """
    folder = tmp_path_factory.mktemp("two") / "run"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    tests = Path(__file__).resolve().parents[2]
    common = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", TWO, str(folder), str(tests)], cwd=tests.parent,
            env=os.environ | common | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE, text=True,
        )
        for rank in range(2)
    ]  # fmt: skip
    try:
        for process in processes:
            _, said = process.communicate(timeout=120)  # a deadlock would wait for ever
            assert process.returncode == 0, said
    finally:
        for process in processes:
            process.kill()
    return [read_checkpoint(folder / name) for name in (LAST, "last.rank1.pt")]


@pytest.mark.slow
def test_two_processes_learn_one_policy_from_different_robots_and_stop_at_the_same_update(two):
    """Though one alone was told to stop."""
    assert [c["iteration"] for c in two] == [2, 2]
    assert [c["more"]["imitated"] for c in two] == [2, 2]
    assert two[0]["more"]["best"] == two[1]["more"]["best"], "they agree on what is best"
    for part in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert different(two[0][part], two[1][part]) == []
    assert two[0]["learning_rate"] == two[1]["learning_rate"]
    for part in ("observations", "environment", "torch_rng"):
        assert different(two[0][part], two[1][part])


# ------------------------------------------------------------------------------ devices


def test_networks_learn_where_the_physics_is_unless_the_run_names_another_device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for device, learner, expected in (
        ("cpu", "as-device", "cpu"), ("cpu", "cuda", "cuda"), ("cuda", "as-device", "cuda"),
        ("cuda", "cpu", "cpu"), ("warp-cpu", "as-device", "cpu"),
    ):  # fmt: skip
        run = tiny_run(device=device, learner_device=learner)
        assert learner_device(run, Ranks()) == expected
        for local_rank in (1, 3):  # processes share two devices
            several = learner_device(run, Ranks(rank=5, size=8, local_rank=local_rank))
            assert several == ("cuda:1" if expected == "cuda" else "cpu")


def test_a_device_that_torch_does_not_find_is_answered_in_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no CUDA device here. Leave `device`"):
        train(tmp_path / "run", tiny_run(learner_device="cuda"))


@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="needs the extra `gpu`")
def test_a_policy_is_trained_on_a_warp_device(tmp_path):
    learner = train(tmp_path / "run", tiny_run(device="warp-cpu"))
    assert isinstance(learner.env.env.robots, WarpRobots)
    assert learner.finite and (tmp_path / "run/policy_last/contract.json").exists()
