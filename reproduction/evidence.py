"""Evidence for the claims about policies, and how a published claim is judged.

A claim is a function of evidence under `claim`, which returns a `Finding`, or raises `NotTestable`:
one row of the report, beside what the paper says. `gather` makes every analysis of a policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from math import nan
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.interval import Interval
from pupper_sysid.common.reading.csv_table import read_table
from pupper_sysid.common.results import Result
from pupper_sysid.policies.analysis.autonomy import Autonomy, Orbits, autonomy, orbits
from pupper_sysid.policies.analysis.gait import GaitReport, describe
from pupper_sysid.policies.analysis.trial import (
    AblationPoint,
    DelayPoint,
    DirectionWalk,
    GroundPoint,
    Outcome,
    Trial,
    ablation,
    compliance,
    delay_curve,
    outcome,
    terrain,
)
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.train.run_file import PROGRESS, RUN_FILE, TROT, Run, load_run
from pupper_sysid.policies.walks.rollouts import Rollout
from pupper_sysid.sim.walking.config import Curriculum

Verdict = Literal["holds", "holds partly", "does not hold here", "not testable here"]
Evidence = TypeVar("Evidence")


@dataclass(frozen=True)
class Claim(Result):
    """One row of the report."""

    id: str
    claim: str
    paper: str
    ours: str
    interval: dict[str, Interval] | None
    """90 % intervals of the numbers in `ours`: over policies of a kind where there are several,
    else over robots or stretches of time."""
    verdict: Verdict
    how: str
    """How it was measured and judged."""


@dataclass(frozen=True)
class Finding:
    """Finding on a claim: `ours`, `interval` and `verdict` of `Claim`."""

    ours: str
    interval: dict[str, Interval] | None
    verdict: Verdict
    note: str
    """The threshold, and its meaning; appended to the claim's `how`."""


class NotTestable(Exception):
    """The evidence cannot decide the claim; the message names what could."""


def claim(
    id: str, text: str, paper: str, how: str
) -> Callable[[Callable[[Evidence], Finding]], Callable[[Evidence], Claim]]:
    """Decorate a function of evidence so that it returns a row of the report.

    `how` says how it is measured; the others are those of `Claim`.
    """

    def decorate(look: Callable[[Evidence], Finding]) -> Callable[[Evidence], Claim]:
        @wraps(look)
        def row(evidence: Evidence) -> Claim:
            try:
                seen = look(evidence)
            except NotTestable as missing:
                return Claim(id, text, paper, "–", None, "not testable here", f"{how} {missing}")
            return Claim(
                id, text, paper, seen.ours, seen.interval, seen.verdict, f"{how} {seen.note}"
            )

        return row

    return decorate


def holds(wholly: bool, partly: bool = False) -> Verdict:
    """The verdict of evidence that could decide."""
    return "holds" if wholly else "holds partly" if partly else "does not hold here"


_COLUMNS = ("id", "ours", "verdict")


def differences(claims: Sequence[Claim], beside: Path) -> list[dict[str, str]]:
    """Claims that another page judges otherwise.

    Each has `id`, `claim`, `here`, `verdict`, `there` and `verdict_there`.
    """
    text = read_text(beside)
    header = text.split("\n", 1)[0].strip().split(",")
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise InputError(
            f"{beside} has no column `{missing[0]}`. Give the tables/claims.csv of a page that "
            "`python -m reproduction` wrote."
        )
    table = read_table(beside, text, header)
    rows = zip(*(table.texts[name] for name in _COLUMNS), strict=True)
    there = {id: (ours, verdict) for id, ours, verdict in rows}
    for id, (_, verdict) in there.items():
        if verdict not in get_args(Verdict):
            raise InputError(f"{beside}: the verdict of {id} is {verdict!r}, which is none.")
    return [
        {
            "id": c.id, "claim": c.claim, "here": c.ours, "verdict": c.verdict,
            "there": there[c.id][0], "verdict_there": there[c.id][1],
        }
        for c in claims
        if c.id in there and there[c.id][1] != c.verdict
    ]  # fmt: skip


KINDS = {"mlp": "MLP", "lstm": "LSTM", "gru": "GRU", "transformer": "Transformer"}
"""Names of the architectures compared."""
A_TROT = "a trot"
"""What a policy imitated, where that was the open-loop gait."""
SCALES_RAD = (0.45, 0.6, 0.75)
"""Of the published deployments."""
_EXTRA_DELAYS_MS = (0, 80, 160, 320)
_LAST_UPDATES = 10


@dataclass(frozen=True, kw_only=True)
class ScalePoint(Outcome):
    """A walk with another scale of what is sent than that of the training."""

    scale_rad: float


@dataclass(frozen=True)
class Training:
    """A training from random weights, by means over its last updates."""

    name: str
    kind: str
    reward: float
    """Per second."""
    std: float
    """Standard deviation of the exploration."""
    steps_per_s: float
    million_samples: float
    lasted_s: float
    """Duration of an episode: until a fall, or `episode_s`."""
    episode_s: float
    learned_noise: bool
    """Whether the exploration is learned, as in the publication, not scheduled."""
    curriculum: bool
    curve: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    """Of every update: millions of samples, reward per second, duration of an episode [s]."""


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
    first_gait: str | None
    """What it imitated before PPO; None if nothing, or not known."""
    walk: Rollout
    gait: GaitReport | None
    """None if no robot walked long enough."""
    orbits: dict[str, Orbits]
    delay: Sequence[DelayPoint]
    ablation: Sequence[AblationPoint]
    autonomy: Autonomy
    scale: Sequence[ScalePoint]
    terrain: Sequence[GroundPoint]
    compliance: Sequence[DirectionWalk]


def gather(
    name: str,
    policy: Policy,
    trial: Trial,
    run_folder: Path | None,
    progress: Callable[[str], None] = lambda what: None,
) -> PolicyEvidence:
    """Run every analysis.

    The run's folder has its training's curve and settings; `progress` is called with the name of
    the next analysis.
    """
    rng = np.random.default_rng(trial.seed)

    def step(what: str, compute: Callable[[], Any]) -> Any:
        progress(f"{name}: {what}")
        return compute()

    walk = step("gait", lambda: trial.walk(policy))
    try:
        gait = describe(walk, rng)
    except InputError:
        gait = None
    run = load_run(run_folder) if run_folder and (run_folder / RUN_FILE).is_file() else None
    task = run.task if run else None
    return PolicyEvidence(
        name, policy.contract.kind, _trained(run_folder, trial.task.control_step_s),
        task.curriculum != Curriculum() if task else None,
        task.terrain if task else None, imitated(run) if run else None, walk, gait,
        step("orbits", lambda: orbits(policy, trial)),
        step("delay", lambda: delay_curve(policy, trial, _EXTRA_DELAYS_MS)),
        step("ablation", lambda: ablation(policy, trial, ("all joints",))),
        step("frozen inputs, pushes, control rates", lambda: autonomy(policy, trial)),
        step("action scale", lambda: scales(policy, trial)),
        step("terrain", lambda: terrain(policy, trial)),
        step("directions", lambda: compliance(policy, trial)),
    )  # fmt: skip


def training(folder: Path) -> Training:
    """The training in a run's folder, which must not have begun with the imitation of a gait."""
    run = load_run(folder)
    if first := imitated(run):
        raise InputError(
            f"{folder} imitated {first} before PPO, so that it says nothing about what is learned "
            "from random weights. Give runs of `pupper-train --preset paper`."
        )
    if not (folder / PROGRESS).is_file():
        raise InputError(f"{folder} has no {PROGRESS}: nothing was trained yet.")
    step_s, columns = run.task.control_step_s, _columns(folder / PROGRESS)
    reward, std, steps = (columns[name] for name in ("reward", "std", "episode_steps"))
    samples = 1e-6 * columns["samples"]
    spent_s = float(columns["collect_s"].sum() + columns["update_s"].sum())
    recent = slice(-_LAST_UPDATES, None)
    return Training(
        folder.name, run.architecture.kind, float(reward[recent].mean()) / step_s,
        float(std[recent].mean()), 1e6 * float(samples[-1]) / spent_s, float(samples[-1]),
        float(steps[recent].mean()) * step_s, run.task.episode_s, run.learner.exploration.learned,
        run.task.curriculum != Curriculum(), (samples, reward / step_s, steps * step_s),
    )  # fmt: skip


def imitated(run: Run) -> str | None:
    """What a run's policy imitated before PPO; None if nothing."""
    if not run.imitation.iterations:
        return None
    return A_TROT if run.imitation.teacher == TROT else "a teacher that learned from nothing"


def scales(policy: Policy, trial: Trial) -> list[ScalePoint]:
    """Walks with other scales of what is sent, as deployed robots had."""
    scales_rad = sorted({*SCALES_RAD, trial.task.action_scale})
    walks = trial.walks(policy, [trial.condition(action_scale=scale) for scale in scales_rad])
    return [
        ScalePoint(scale_rad=scale, **outcome(walked))
        for scale, walked in zip(scales_rad, walks, strict=True)
    ]


def over(evidence: Sequence[Any], kind: str, value: Callable[[Any], float]) -> Interval:
    """Mean over the policies or trainings of a kind, and their range (NaN for one).

    Those without a number (NaN) are left out; one infinite number is an infinite mean. Two or three
    say nothing of a distribution, so that no interval is computed from them.
    """
    values = np.array([value(e) for e in evidence if e.kind == kind], float)
    if np.isposinf(values).any():
        return Interval(float("inf"), float("nan"), float("nan"))
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return Interval(float(values[0]) if len(values) else nan, nan, nan)
    return Interval(float(values.mean()), float(values.min()), float(values.max()))


def of_kinds(
    evidence: Sequence[Any], value: Callable[[Any], float], *needed: str
) -> dict[str, Interval]:
    """`over` for each of `KINDS` of which there is a number."""
    kinds = [k for k in KINDS if any(e.kind == k for e in evidence)]
    if not kinds or not set(needed) <= set(kinds):
        wanted = " and of the ".join(KINDS[k] for k in needed or ("lstm",))
        raise NotTestable(f"Give a run of the {wanted}.")
    values = {k: over(evidence, k, value) for k in kinds}
    values = {k: v for k, v in values.items() if not np.isnan(v.value)}
    without = [KINDS[k] for k in needed or kinds if k not in values]
    if without and (needed or not values):
        raise NotTestable(
            f"Of the {' and of the '.join(without)} that was given there is no number for it: no "
            "robot stayed up and moved for long enough."
        )
    return values


def of_kind(evidence: Sequence[PolicyEvidence], kind: str) -> list[PolicyEvidence]:
    """Those of one kind."""
    mine = [e for e in evidence if e.kind == kind]
    if not mine:
        raise NotTestable(f"Give a run of the {KINDS[kind]}.")
    return mine


def several(values: dict[str, Interval], digits: int) -> str:
    """The values by architecture, in words."""
    return ", ".join(
        f"{KINDS[k]} " + (f"{v.value:,.{digits}f}" if np.isfinite(v.value) else "∞")
        for k, v in values.items()
    )


def span(values: Sequence[float] | NDArray[np.float64], digits: int) -> str:
    """Smallest to largest; one number where these look alike, a dash where there is none."""
    known = np.asarray(values, float)[np.isfinite(values)]
    if not len(known):
        return "–"
    low, high = (f"{end:.{digits}f}" for end in (known.min(), known.max()))
    return low if low == high else f"{low} to {high}"


def bounds(values: dict[str, Interval]) -> dict[str, Interval] | None:
    """Those with an interval, by the architecture's name; None if there are none."""
    return {KINDS[k]: v for k, v in values.items() if np.isfinite(v.low)} or None


def _trained(folder: Path | None, step_s: float) -> dict[str, float]:
    """Means over the last updates of a training."""
    file = folder / PROGRESS if folder else None
    if file is None or not file.is_file():
        return {}
    columns = {name: x[-_LAST_UPDATES:] for name, x in _columns(file).items()}
    samples = columns["samples"]
    samples = np.gradient(samples) if len(samples) > 1 else np.full(len(samples), np.nan)
    return {
        "reward": float(columns["reward"].mean()) / step_s,
        "std": float(columns["std"].mean()),
        "updates": float(columns["update"][-1]),
        "steps_per_s": float(np.nanmean(samples / (columns["collect_s"] + columns["update_s"]))),
    }


def _columns(file: Path) -> dict[str, NDArray[np.float64]]:
    """Curves of a training, by column of its file."""
    table = pd.read_csv(file).astype(float)
    return {name: table[name].to_numpy() for name in table.columns}
