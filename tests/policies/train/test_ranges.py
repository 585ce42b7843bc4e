"""Settings of a training are refused before anything is built from them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.train.run_file import Run, load_run, preset, save_run
from support.tiny_training import tiny_run


@pytest.mark.parametrize(
    ("group", "changes"),
    [
        ("", {"environments": 10**30}), ("", {"environments": 0}), ("", {"minutes": float("nan")}),
        ("", {"minutes": 0.0}), ("", {"iterations": 0}), ("", {"threads": 10**6}),
        ("", {"seed": -1}), ("architecture", {"memory": 10**9}),
        ("architecture", {"hidden": (10**9,)}), ("architecture", {"hidden": (8,) * 17}),
        ("task", {"episode_s": float("inf")}), ("task", {"physics_step_s": 1e-12}),
        ("learner", {"learning_rate": float("nan")}), ("learner", {"learning_rate": -1.0}),
        ("learner", {"minibatches": 10**6}), ("learner", {"clip": float("inf")}),
        ("imitation", {"iterations": 10**9}),
    ],
)  # fmt: skip
def test_a_setting_out_of_its_range_is_named(group, changes):
    run = tiny_run()
    with pytest.raises(InputError, match=next(iter(changes)).split(".")[-1]):
        replace(run, **({group: replace(getattr(run, group), **changes)} if group else changes))


def test_a_file_with_a_setting_out_of_its_range_is_refused(tmp_path):
    save_run(tmp_path, tiny_run())
    path = tmp_path / "run.yaml"
    path.write_text(path.read_text().replace("environments: 4", f"environments: {10**18}"))
    with pytest.raises(InputError, match="environments is 1000"):
        load_run(tmp_path)


@pytest.mark.parametrize("name", ["fast", "paper", "release"])
@pytest.mark.parametrize("kind", ["mlp", "lstm", "gru", "transformer", "mlp-actions"])
def test_every_preset_is_within_the_ranges(name, kind):
    assert isinstance(preset(name, kind), Run)


def test_any_seed_from_0_on_is_one():
    assert replace(tiny_run(), seed=10**100).seed == 10**100
