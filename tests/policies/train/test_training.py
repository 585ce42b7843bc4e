"""Training runs: stopped and resumed as if they had not been, guarded, alone and together."""

from __future__ import annotations

import csv
import errno
import math
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
import yaml

from pupper_sysid.common.errors import InputError, PupperError
from pupper_sysid.common.results import plain
from pupper_sysid.policies.network.hyperparameters import Architecture, Hyperparameters, Imitation
from pupper_sysid.policies.network.policy_file import load_policy
from pupper_sysid.policies.train import training
from pupper_sysid.policies.train.checkpoint import read_checkpoint
from pupper_sysid.policies.train.curves import PROGRESS
from pupper_sysid.policies.train.learner import Learner
from pupper_sysid.policies.train.ranks import Ranks
from pupper_sysid.policies.train.run_file import RUN_FILE, load_run, preset, save_run
from pupper_sysid.policies.train.training import LAST, train
from support.checkpoints import different, stop_after
from support.tiny_training import ALL_KINDS, CALIBRATION, tiny_run

# ------------------------------------------------------------------------------ resuming


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Last checkpoint of each kind's run of two rounds of imitation and three updates."""
    known = {}

    def checkpoint(kind: str):
        if kind not in known:
            folder = tmp_path_factory.mktemp(kind) / "run"
            train(folder, tiny_run(kind))
            known[kind] = read_checkpoint(folder / LAST)
        return known[kind]

    return checkpoint


@pytest.mark.parametrize(
    ("kind", "phase", "done"),
    [
        *((kind, "imitation", 1) for kind in ("mlp", "lstm", "transformer")),
        *((kind, "ppo", 1) for kind in ("mlp", "lstm", "transformer")),
        ("gru", "ppo", 2),
        ("mlp-actions", "imitation", 2),
    ],
)
def test_a_run_that_was_stopped_and_resumed_is_bit_for_bit_the_run_that_was_not(
    tmp_path, uninterrupted, kind, phase, done
):
    train(tmp_path, tiny_run(kind), stop_after(phase, done))
    stopped = read_checkpoint(tmp_path / LAST)
    assert stopped["iteration"] == (done if phase == "ppo" else 0)
    assert stopped["more"]["imitated"] == (2 if phase == "ppo" else done)
    train(tmp_path, None)
    straight = uninterrupted(kind)
    assert different(straight, read_checkpoint(tmp_path / LAST)) == []
    # and the comparison sees what it should
    assert straight["iteration"] == 3
    for part in ("actor_state_dict", "optimizer_state_dict", "observations", "environment"):
        assert different(straight[part], stopped[part])


def test_a_resumed_run_can_be_extended_and_remembers_it(tmp_path, uninterrupted):
    train(tmp_path, tiny_run(iterations=2))
    train(tmp_path, None, iterations=3)
    assert load_run(tmp_path).iterations == 3
    assert different(uninterrupted("mlp"), read_checkpoint(tmp_path / LAST)) == []


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


def test_another_seed_is_another_run(tmp_path, uninterrupted):
    train(tmp_path, tiny_run(seed=1))
    other = different(uninterrupted("mlp"), read_checkpoint(tmp_path / LAST))
    assert any(d.startswith(".actor_state_dict") for d in other)
    assert any(d.startswith(".environment.batch.state") for d in other)


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


def test_after_a_power_cut_nothing_is_repeated_in_the_curves_and_the_best_stays_the_best(tmp_path):
    run = tiny_run(iterations=22)
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    train(straight, run)
    with pytest.raises(PowerCut):
        train(cut, run, cut_power_after("ppo", 13))
    kept = read_checkpoint(cut / LAST)
    assert kept["iteration"] == 10, "a checkpoint every ten updates"
    best = read_checkpoint(cut / "best.pt")
    assert kept["more"]["best"] == best["more"]["scores"]["score"]
    assert len(rows(cut / PROGRESS)) == 13
    with (cut / PROGRESS).open("a") as file:
        file.write("14,0.1")  # half a row: the power went while it was written
    train(cut, None)
    for name in (LAST, "best.pt"):
        assert different(read_checkpoint(straight / name), read_checkpoint(cut / name)) == []
    found = rows(cut / PROGRESS)
    assert [row["update"] for row in found] == [str(i + 1) for i in range(22)]
    expected = [row["reward"] for row in rows(straight / PROGRESS)]
    assert [row["reward"] for row in found] == expected
    assert [row["update"] for row in rows(cut / "imitation.csv")] == ["1", "2"]


def test_a_power_cut_in_imitation_loses_one_round(tmp_path):
    short = Imitation(iterations=4, rollouts=1, epochs=1, minibatches=2)
    run = tiny_run(imitation=short, iterations=1)
    with pytest.raises(PowerCut):
        train(tmp_path, run, cut_power_after("imitation", 3))
    assert read_checkpoint(tmp_path / LAST)["more"]["imitated"] == 2
    train(tmp_path, None)
    assert [row["update"] for row in rows(tmp_path / "imitation.csv")] == ["1", "2", "3", "4"]


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_a_run_that_dies_in_its_first_round_can_be_resumed(tmp_path, uninterrupted, kind):
    with pytest.raises(PowerCut):
        train(tmp_path, tiny_run(kind), cut_power_after("imitation", 1))
    assert read_checkpoint(tmp_path / LAST)["more"]["imitated"] == 0
    train(tmp_path, None)
    assert different(uninterrupted(kind), read_checkpoint(tmp_path / LAST)) == []


def test_resuming_a_finished_run_changes_nothing(tmp_path):
    train(tmp_path, tiny_run())
    before = read_checkpoint(tmp_path / LAST)
    train(tmp_path, None)
    assert different(before, read_checkpoint(tmp_path / LAST)) == []
    assert len(rows(tmp_path / PROGRESS)) == 3


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


def test_time_that_is_up_ends_a_run_with_everything_saved(tmp_path):
    train(tmp_path, tiny_run(minutes=0.001))
    found = read_checkpoint(tmp_path / LAST)
    assert found["iteration"] == 0 and found["more"]["imitated"] == 2


def test_a_run_is_not_begun_over_another(tmp_path):
    train(tmp_path, tiny_run(iterations=1))
    before = (tmp_path / LAST).read_bytes()
    with pytest.raises(InputError, match="holds a run already"):
        train(tmp_path, tiny_run(iterations=1))
    assert (tmp_path / LAST).read_bytes() == before


def test_a_watcher_is_told_where_the_run_stands(tmp_path):
    seen = []
    train(tmp_path, tiny_run(), seen.append)
    assert [(p.phase, p.done, p.total) for p in seen] == [
        ("imitation", 1, 2), ("imitation", 2, 2), ("ppo", 1, 3), ("ppo", 2, 3), ("ppo", 3, 3),
    ]  # fmt: skip
    assert all(a.elapsed_s < b.elapsed_s for a, b in pairwise(seen))
    assert seen[-1].left_s == 0.0 and all(p.left_s >= 0.0 for p in seen)
    samples = [p.row["samples"] for p in seen[2:]]
    assert samples == [4 * 6 * k for k in (1, 2, 3)]
    for p in seen[2:]:
        terms = [v for k, v in p.row.items() if k.startswith("reward.")]
        assert p.row["reward"] == pytest.approx(sum(terms))


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


@pytest.mark.parametrize("where", ["loss", "critic"])
@pytest.mark.parametrize("when", [0, 1])
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
    tmp_path, monkeypatch
):
    train(tmp_path, tiny_run(), stop_after("ppo", 1))
    before = (tmp_path / LAST).read_bytes()
    real = Learner.rollout

    def rollout(self, watch=None):
        real(self, watch)
        with torch.inference_mode():
            self.observations["policy"][0, 0] = math.nan

    monkeypatch.setattr(Learner, "rollout", rollout)
    with pytest.raises(PupperError, match="observations that are not numbers after update 1"):
        train(tmp_path, None)
    assert (tmp_path / LAST).read_bytes() == before


def test_a_full_disk_ends_a_run_in_a_sentence_and_keeps_the_checkpoint_before(
    tmp_path, monkeypatch
):
    train(tmp_path, tiny_run(), stop_after("ppo", 1))
    before = (tmp_path / LAST).read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"last\.pt cannot be written: No space left on device"):
        train(tmp_path, None)
    assert (tmp_path / LAST).read_bytes() == before
    assert not list(tmp_path.glob(".last*"))


@pytest.mark.parametrize("begun", [False, True])
def test_a_curve_that_cannot_be_written_is_said_in_a_sentence(tmp_path, begun):
    table = tmp_path / "imitation.csv"

    def block(now=None):
        table.unlink(missing_ok=True)
        table.mkdir()  # as good as a full disk: it cannot be opened

    if not begun:
        block()
    with pytest.raises(InputError, match=r"imitation\.csv (cannot be written|is not a file)"):
        train(tmp_path, tiny_run(), block)


def test_a_table_of_curves_of_a_million_lines_is_refused_at_once(tmp_path):
    train(tmp_path, tiny_run(), stop_after("imitation", 1))
    (tmp_path / PROGRESS).write_bytes(b"update\n" + b"\n" * 20_000_000)
    begun = time.process_time()
    with pytest.raises(InputError, match=r"progress\.csv .* rows"):
        train(tmp_path, None)
    assert time.process_time() - begun < 5


# ------------------------------------------------------------------------------ run.yaml


@pytest.mark.parametrize("kind", ALL_KINDS)
@pytest.mark.parametrize("name", ["fast", "paper", "release"])
def test_settings_are_read_back_as_they_were_written(tmp_path, name, kind):
    run = replace(preset(name, kind), minutes=7.5, seed=3)
    save_run(tmp_path, run)
    assert load_run(tmp_path) == run


def with_settings(folder: Path, *path_and_value) -> Path:
    """A run's folder with one setting changed, in the file."""
    *path, value = path_and_value
    save_run(folder, tiny_run())
    found = yaml.safe_load((folder / RUN_FILE).read_text())
    place = found["settings"]
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    (folder / RUN_FILE).write_text(yaml.safe_dump(found))
    return folder


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("colour", "blue"), "settings.colour is not a key of this file"),
        ((7, "blue"), "settings.7 is not a key of this file"),
        (("learner", "momentum", 0.9), "learner.momentum is not a key of this file"),
        (("environments", "many"), "environments is the text 'many'. Write the number"),
        (("environments", 4.5), "environments is 4.5. Write a whole number"),
        (("environments", True), "environments is True"),
        (("minutes", [1.0]), "minutes"),
        (("minutes", float("nan")), "minutes is nan"),
        (("learner", "normalise", 1), "normalise is 1. Write true or false"),
        (("learner", 5), "learner is 5 where a mapping"),
        (("learner", "minibatches", 0), "minibatches is 0"),
        (("architecture", "kind", "perceptron"), "Write 'mlp', 'lstm'"),
        (("architecture", "kind", ["mlp"]), "Write 'mlp', 'lstm'"),
        (("architecture", "hidden", [16, "x"]), "hidden[1] is the text 'x'"),
        (("architecture", "hidden", [0]), "at least 1"),
        (("architecture", "hidden", 16), "hidden is 16. Write a list"),
        (("task", "terrain", "lava"), "terrain is lava. Write"),
        (("task", "commands", "forward_m_s", [1.0]), "forward_m_s"),
        (("task", "control_step_s", 0.003), "whole multiple"),
        (("actuator", None), "actuator is null. Write text"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_by_name(tmp_path, change, words):
    with pytest.raises(InputError) as refused:
        load_run(with_settings(tmp_path, *change))
    assert words in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    ["", "a: [", "- 1", "schema: pupper-run", "\x00", "[" * 1200,
     "schema: pupper-run\nschema_version: 3\nsettings: {}",
     "schema: pupper-run\nschema_version: 1\nsettings: 3",
     "!!python/object/apply:os.mkdir [made]"],
)  # fmt: skip
def test_a_damaged_run_file_is_refused_and_nothing_in_it_is_run(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / RUN_FILE).write_text(text)
    with pytest.raises(InputError) as refused:
        load_run(tmp_path)
    assert RUN_FILE in str(refused.value) and "\n" not in str(refused.value)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "setting",
    [
        ("task", "observation", "privileged_critic", False),
        ("task", "curriculum", "stage_steps", 2400),
        ("learner", "initial_std", 0.015),
    ],
)
def test_a_setting_of_older_files_that_says_nothing_of_the_walk_is_passed_over(tmp_path, setting):
    assert load_run(with_settings(tmp_path, *setting)) == tiny_run()


@pytest.mark.parametrize(("name", "sees"), [("fast", True), ("paper", False), ("release", False)])
def test_whether_the_critic_sees_the_truth_is_the_architectures_alone(name, sees):
    assert preset(name, "mlp").architecture.privileged_critic is sees
    assert not hasattr(preset(name, "mlp").task.observation, "privileged_critic")


def test_a_newer_run_file_is_told_to_need_an_upgrade(tmp_path):
    (tmp_path / RUN_FILE).write_text("schema: pupper-run\nschema_version: 3\nsettings: {}")
    with pytest.raises(InputError, match="newer version.*Upgrade pupper-sysid"):
        load_run(tmp_path)


def test_settings_that_are_missing_take_their_defaults(tmp_path):
    (tmp_path / RUN_FILE).write_text("schema: pupper-run\nschema_version: 1\nsettings: {seed: 5}")
    assert plain(load_run(tmp_path)) == plain(replace(tiny_run().__class__(), seed=5))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Hyperparameters(minibatches=0),
        lambda: Hyperparameters(steps_per_environment=0),
        lambda: Architecture(memory=0),
        lambda: Architecture(critic_hidden=(8, -1)),
        lambda: Imitation(minibatches=0),
        lambda: Imitation(epochs=0),
    ],
)
def test_sizes_that_cannot_be_are_refused(make):
    with pytest.raises(InputError, match="at least 1"):
        make()


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


def test_two_processes_stop_at_the_same_update_though_one_alone_was_told_to(two):
    assert [c["iteration"] for c in two] == [2, 2]
    assert [c["more"]["imitated"] for c in two] == [2, 2]
    assert two[0]["more"]["best"] == two[1]["more"]["best"], "they agree on what is best"


def test_two_processes_learn_one_policy_from_different_robots(two):
    for part in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert different(two[0][part], two[1][part]) == []
    assert two[0]["learning_rate"] == two[1]["learning_rate"]
    for part in ("observations", "environment", "torch_rng"):
        assert different(two[0][part], two[1][part])


def test_alone_a_process_decides_for_itself():
    ranks = Ranks.join()
    assert ranks == Ranks(0, 1, 0)
    assert ranks.any(True) and not ranks.any(False) and ranks.mean(2.5) == 2.5


def test_a_run_from_a_folder_elsewhere_keeps_its_calibration(tmp_path):
    save_run(tmp_path, tiny_run())
    assert load_run(tmp_path).actuator == CALIBRATION
