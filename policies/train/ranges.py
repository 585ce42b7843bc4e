"""Ranges of a training's settings: what is outside them is a misprint or fills the memory.

Settings come from the command line and from a run's file, which may be damaged or anybody's.
Ranges are far wider than anything that trains.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from pupper_sysid.common.errors import InputError

_LARGEST = 1e9
_MOST_LAYERS = 16
_RANGES: dict[str, tuple[float, float]] = {
    "environments": (1, 1_000_000),
    "iterations": (1, 10_000_000),
    "minutes": (1e-3, 1e8),
    "threads": (0, 4096),
    "architecture.hidden": (1, 8192),
    "architecture.critic_hidden": (1, 8192),
    "architecture.memory": (1, 8192),
    "task.episode_s": (1e-3, 3600),
    "task.physics_step_s": (1e-4, 0.1),
    "task.control_step_s": (1e-3, 1),
    "task.action_scale": (1e-3, 10),
    "learner.steps_per_environment": (1, 10_000),
    "learner.epochs": (1, 1000),
    "learner.learning_rate": (1e-12, 10),
    "learner.learning_rates": (1e-12, 10),
    "learner.critic_learning_rate": (1e-12, 10),
    "learner.discount": (0, 1),
    "learner.gae_lambda": (0, 1),
    "imitation.iterations": (0, 1_000_000),
    "imitation.rollouts": (1, 1_000),
    "imitation.epochs": (1, 10_000),
    "imitation.learning_rate": (1e-12, 10),
}
"""Smallest and largest value, by the dotted name of a setting."""


def refuse_impossible(run: Any) -> None:
    """Refuse settings outside their ranges.

    Parameters
    ----------
    run : Run
        `policies.train.run_file.Run`; `seed` is any whole number from 0 on.
    """
    for name, value in _numbers(run, ""):
        low, high = _RANGES.get(name, (-_LARGEST, _LARGEST))
        if name != "seed" and not low <= value <= high:  # NaN is in no range
            shown = str(value)[:20]
            raise InputError(f"{name} is {shown}; it must be from {low:g} to {high:g}.")
    if not 0 <= run.seed < 2**63:  # what torch's generators take
        raise InputError(f"seed is {str(run.seed)[:24]}; it must be 0 or more, below 2^63.")
    for name in ("hidden", "critic_hidden"):
        layers = len(getattr(run.architecture, name))
        if layers > _MOST_LAYERS:
            raise InputError(f"architecture.{name} has {layers} layers; at most {_MOST_LAYERS}.")
    samples = run.environments * run.learner.steps_per_environment
    if run.learner.minibatches > samples:
        raise InputError(
            f"learner.minibatches is {run.learner.minibatches}; an update has {samples} samples."
        )


def _numbers(settings: Any, before: str) -> Iterator[tuple[str, float]]:
    """Dotted names and values of all numbers."""
    for field in fields(settings):
        value, name = getattr(settings, field.name), f"{before}{field.name}"
        if is_dataclass(value):
            yield from _numbers(value, f"{name}.")
            continue
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, int | float) and not isinstance(one, bool):
                yield name, one
