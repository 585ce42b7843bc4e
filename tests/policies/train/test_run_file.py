"""Settings of a training: read back as written, and refused by name before anything is built."""

import json
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from pupper_sysid.common.results import plain
from pupper_sysid.policies.train.run_file import (
    RUN_FILE,
    Exploration,
    Run,
    load_run,
    preset,
    save_run,
)
from pupper_sysid.sim.walking.config import Curriculum
from support.refusals import assert_each_refused
from support.tiny_training import ALL_KINDS, CALIBRATION, tiny_run


def with_settings(folder: Path, *path_and_value) -> Path:
    """A run's folder with one setting changed, in the file."""
    *path, value = path_and_value
    whole = deepcopy(_tiny_file())
    place = whole["settings"]
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    (folder / RUN_FILE).write_text(json.dumps(whole))  # which is YAML
    return folder


@cache
def _tiny_file() -> dict[str, Any]:
    with TemporaryDirectory() as folder:
        save_run(Path(folder), tiny_run())
        return yaml.safe_load((Path(folder) / RUN_FILE).read_text())


def test_settings_of_every_preset_and_kind_are_read_back_as_they_were_written(tmp_path):
    chosen = [("fast", kind) for kind in ALL_KINDS] + [("paper", "mlp"), ("release", "lstm")]
    runs = [replace(preset(*names), minutes=7.5, seed=3) for names in chosen]
    for k, run in enumerate([*runs, tiny_run()]):
        save_run(tmp_path / str(k), run)
        assert load_run(tmp_path / str(k)) == run
    assert load_run(tmp_path / str(len(runs))).actuator == CALIBRATION, "from a folder elsewhere"


def test_a_setting_that_makes_no_sense_is_refused_by_name(tmp_path):
    cases = [
        (("colour", "blue"), "settings.colour is not a key of this file"),
        (("learner", "momentum", 0.9), "learner.momentum is not a key of this file"),
        (("environments", "many"), "environments is the text 'many'"),
        (("environments", 4.5), "environments is 4.5"),
        (("environments", 10**18), "environments is 1000"),
        (("minutes", [1.0]), "minutes"), (("minutes", float("nan")), "minutes is nan"),
        (("learner", "normalise", 1), "normalise is 1. Write true or false"),
        (("learner", 5), "learner is 5"), (("learner", "minibatches", 0), "minibatches is 0"),
        (("architecture", "kind", "perceptron"), "Write 'mlp', 'lstm'"),
        (("architecture", "hidden", [16, "x"]), "hidden[1] is the text 'x'"),
        (("task", "terrain", "lava"), "terrain is lava. Write"),
        (("task", "commands", "forward_m_s", [1.0]), "forward_m_s"),
        (("task", "control_step_s", 0.003), "whole multiple"), (("actuator", None), "actuator"),
    ]  # fmt: skip
    assert_each_refused(cases, lambda change: load_run(with_settings(tmp_path, *change)))


def test_a_setting_out_of_its_range_is_refused_by_name():
    run, nan, infinite = tiny_run(), float("nan"), float("inf")
    settings = [
        ("", "environments", 10**30), ("", "environments", 0), ("", "minutes", nan),
        ("", "minutes", 0.0), ("", "iterations", 0), ("", "threads", 10**6), ("", "seed", -1),
        ("architecture", "memory", 10**9), ("architecture", "hidden", (10**9,)),
        ("architecture", "hidden", (8,) * 17), ("task", "episode_s", infinite),
        ("task", "physics_step_s", 1e-12), ("learner", "learning_rate", nan),
        ("learner", "learning_rate", -1.0), ("learner", "minibatches", 10**6),
        ("learner", "clip", infinite), ("imitation", "iterations", 10**9),
        ("learner", "minibatches", 0), ("learner", "steps_per_environment", 0),
        ("learner", "exploration", Exploration((0.0, 0.1))),
        ("architecture", "memory", 0), ("architecture", "critic_hidden", (8, -1)),
        ("architecture", "hidden", ()), ("imitation", "minibatches", 0), ("imitation", "epochs", 0),
    ]  # fmt: skip

    def change(setting):
        group, name, value = setting
        own = replace(getattr(run, group) if group else run, **{name: value})
        replace(run, **{group: own} if group else {})

    assert_each_refused([(setting, setting[1]) for setting in settings], change)


def test_missing_settings_take_their_defaults_and_older_ones_are_passed_over(tmp_path):
    (tmp_path / RUN_FILE).write_text("schema: pupper-run\nschema_version: 1\nsettings: {seed: 5}")
    assert plain(load_run(tmp_path)) == plain(Run(seed=5))
    for older in (
        ("task", "observation", "privileged_critic", False),
        ("task", "curriculum", "stage_steps", 2400), ("learner", "initial_std", 0.015),
    ):  # fmt: skip
        assert load_run(with_settings(tmp_path, *older)) == tiny_run()
    (tmp_path / RUN_FILE).write_text(
        "schema: pupper-run\nschema_version: 2\nsettings:\n task:\n  curriculum:\n   stages: 3\n"
        "   delay: {first: 0.5}\n   push: {first: 0.0, begin: 1.5, end: 5.0}"
    )
    assert load_run(tmp_path).task.curriculum == Curriculum(push=(0.0, 1.0, 1.5, 5.0))
    (tmp_path / RUN_FILE).write_text(
        "schema: pupper-run\nschema_version: 2\nsettings: {task: {trot: {lift_m: 0.011}}}"
    )
    trot = load_run(tmp_path).task.trot
    assert (trot.back_gain, trot.side_gain) == (1.0, 1.0), "as it was trained"
    (tmp_path / RUN_FILE).write_text("schema: pupper-run\nschema_version: 4\nsettings: {}")
    assert_each_refused([(tmp_path, "Upgrade pupper-sysid")], load_run, names="newer version")
