"""What the claims about policies rest on: every analysis of each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pupper_sysid.common.errors import InputError
from pupper_sysid.policies.analysis.gait import GaitReport, describe
from pupper_sysid.policies.analysis.paths import compliance
from pupper_sysid.policies.analysis.phase_reset import push_response, rate_response
from pupper_sysid.policies.analysis.rhythm import Estimate, mean_of
from pupper_sysid.policies.analysis.robustness import (
    Trial,
    ablation,
    delay_curve,
    frozen,
    orbits,
    scales,
    terrain,
)
from pupper_sysid.policies.analysis.rollouts import Rollout
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.train.curves import PROGRESS
from pupper_sysid.policies.train.run_file import RUN_FILE, load_run
from reproduction.claims import Interval, NotTestable

KINDS = {"mlp": "MLP", "lstm": "LSTM", "gru": "GRU", "transformer": "Transformer"}
"""The architectures compared, and how they are called."""
DELAYS_MS = (0.0, 160.0, 320.0)
"""Of the published orbits."""
_EXTRA_DELAYS_MS = (0, 80, 160, 320)
_LAST_UPDATES = 10

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class PolicyEvidence:
    """All analyses of one policy; see the functions of the same names."""

    name: str
    kind: str
    trained: dict[str, float]
    """Last updates of its training: `reward` per second, `std`, `updates`, `steps_per_s`; empty if
    not known."""
    curriculum: bool | None
    """Whether it was trained with a curriculum; None if not known."""
    ground: str | None
    """Kind of ground it was trained on; None if not known."""
    walk: Rollout
    gait: GaitReport | None
    """None if no robot walked long enough."""
    orbits: dict[str, dict[str, Any]]
    delay: Rows
    ablation: Rows
    frozen: Rows
    push: Rows
    rate: Rows
    scale: Rows
    terrain: Rows
    compliance: Rows


def gather(
    name: str,
    policy: Policy,
    trial: Trial,
    run_folder: Path | None,
    say: Callable[[str], None] = lambda what: None,
) -> PolicyEvidence:
    """Run every analysis.

    Parameters
    ----------
    name : str
    policy : Policy
    trial : Trial
    run_folder : Path or None
        Where its training's curve and settings are.
    say : callable
        Told what is about to be done.
    """
    rng = np.random.default_rng(trial.seed)

    def step(what: str, made: Callable[[], Any]) -> Any:
        say(f"{name}: {what}")
        return made()

    walk = step("gait", lambda: trial.walk(policy))
    try:
        gait = describe(walk, rng)
    except InputError:
        gait = None
    task = load_run(run_folder).task if run_folder and (run_folder / RUN_FILE).is_file() else None
    return PolicyEvidence(
        name, policy.contract.kind, _trained(run_folder, trial.task.control_step_s),
        task.curriculum.on if task else None, task.terrain if task else None, walk, gait,
        step("orbits", lambda: orbits(policy, trial, DELAYS_MS)),
        step("delay", lambda: delay_curve(policy, trial, _EXTRA_DELAYS_MS)),
        step("ablation", lambda: ablation(policy, trial, ("all joints",))),
        step("frozen inputs", lambda: frozen(policy, trial)),
        step("pushes", lambda: push_response(policy, trial)),
        step("control rate", lambda: rate_response(policy, trial)),
        step("action scale", lambda: scales(policy, trial)),
        step("terrain", lambda: terrain(policy, trial)),
        step("directions", lambda: compliance(policy, trial)),
    )  # fmt: skip


def over(evidence: Sequence[PolicyEvidence], kind: str, value: Callable[[PolicyEvidence], float]):
    """Mean over the policies of a kind, with the interval over them (NaN for one policy).

    Those without a number (NaN) are left out; one infinite number is an infinite mean.
    """
    values = np.array([value(e) for e in evidence if e.kind == kind], float)
    if np.isposinf(values).any():
        return Estimate(float("inf"), float("nan"), float("nan"))
    return mean_of(values)


def of_kinds(
    evidence: Sequence[PolicyEvidence], value: Callable[[PolicyEvidence], float], *needed: str
) -> dict[str, Estimate]:
    """`over` for each of `KINDS` of which there is a number.

    Raises
    ------
    NotTestable
        If there is no policy of one of the kinds `needed` (of any), or no number for it.
    """
    given = [k for k in KINDS if any(e.kind == k for e in evidence)]
    if not given or not set(needed) <= set(given):
        wanted = " and of the ".join(KINDS[k] for k in needed or ("lstm",))
        raise NotTestable(f"Give a run of the {wanted}.")
    found = {k: over(evidence, k, value) for k in given}
    found = {k: v for k, v in found.items() if not np.isnan(v.value)}
    without = [KINDS[k] for k in needed or given if k not in found]
    if without and (needed or not found):
        raise NotTestable(
            f"Of the {' and of the '.join(without)} that was given there is no number for it: no "
            "robot stayed up and moved for long enough."
        )
    return found


def of_kind(evidence: Sequence[PolicyEvidence], kind: str) -> list[PolicyEvidence]:
    """Those of one kind.

    Raises
    ------
    NotTestable
        If there is none.
    """
    mine = [e for e in evidence if e.kind == kind]
    if not mine:
        raise NotTestable(f"Give a run of the {KINDS[kind]}.")
    return mine


def several(found: dict[str, Estimate], digits: int) -> str:
    """The values by architecture, in words."""
    return ", ".join(
        f"{KINDS[k]} " + (f"{v.value:,.{digits}f}" if np.isfinite(v.value) else "∞")
        for k, v in found.items()
    )


def bounds(found: dict[str, Estimate]) -> Interval:
    """Their intervals, where there are any."""
    known = {KINDS[k]: [v.low, v.high] for k, v in found.items() if np.isfinite(v.low)}
    return known or None


def _trained(folder: Path | None, step_s: float) -> dict[str, float]:
    """Means over the last updates of a training."""
    file = folder / PROGRESS if folder else None
    if file is None or not file.is_file():
        return {}
    table = pd.read_csv(file).tail(_LAST_UPDATES).astype(float)
    columns = {name: table[name].to_numpy() for name in table.columns}
    samples = np.gradient(columns["samples"]) if len(table) > 1 else np.full(len(table), np.nan)
    return {
        "reward": float(columns["reward"].mean()) / step_s,
        "std": float(columns["std"].mean()),
        "updates": float(columns["update"][-1]),
        "steps_per_s": float(np.nanmean(samples / (columns["collect_s"] + columns["update_s"]))),
    }
