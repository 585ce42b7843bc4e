"""The published claims about training: reward, exploration, curriculum, throughput."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pupper_sysid.common.interval import Interval
from reproduction.claims import Finding, NotTestable, claim, holds
from reproduction.evidence import PolicyEvidence, bounds, of_kinds, several

Policies = Sequence[PolicyEvidence]


@claim(
    "T1", "GRU and Transformer fail where MLP and LSTM learn",
    "reward MLP 271 (with curriculum), LSTM 271, GRU 72, Transformer −85.8",
    "Reward per second over the last updates, one task and critic; budgets differ, see Table I.",
)  # fmt: skip
def reward(policies: Policies) -> Finding:
    """T1."""
    found = _trained(policies, lambda e: e.trained["reward"])
    lstm, rest = _lstm_and_newer(found)
    fails = min(rest) < 0.5 * lstm
    return Finding(
        several(found, 2), bounds(found), holds(fails),
        "Holds if one has less than half of the LSTM's.",
    )  # fmt: skip


@claim(
    "T2", "GRU and Transformer never settle", "action noise 0.07, 0.07, 0.25, 1.13",
    "Standard deviation of the exploration in the last updates.",
)  # fmt: skip
def exploration(policies: Policies) -> Finding:
    """T2."""
    found = _trained(policies, lambda e: e.trained["std"])
    lstm, rest = _lstm_and_newer(found)
    grows = max(rest) > 2 * lstm
    return Finding(
        several(found, 4), bounds(found), holds(grows),
        "Ours starts small, after imitation; holds if one has twice the LSTM's.",
    )  # fmt: skip


@claim(
    "T3", "The MLP needs a curriculum", "MLP yes, LSTM no",
    "Survival of policies that were trained without one.",
)  # fmt: skip
def curriculum(policies: Policies) -> Finding:
    """T3."""
    without = [p for p in policies if p.curriculum is False]
    if not any(p.kind == "mlp" for p in without):
        raise NotTestable("Give a run, with its run.yaml, of an MLP without a curriculum.")
    found = of_kinds(without, lambda e: float(e.walk.alive[-1].mean()), "mlp")
    first = " or ".join(sorted({p.first_gait for p in without if p.first_gait}))
    return Finding(
        several(found, 2), bounds(found), holds(found["mlp"].value < 0.9),
        f"Imitation of {first} came first." if first else "",
    )  # fmt: skip


@claim(
    "T4", "A Transformer trains at a fifth of the MLP's speed",
    "30,000, 15,000–20,000, 15,000–20,000, 5,500 steps/s on an RTX 4090",
    "Steps per second of the trainings, on the machine they ran on.",
)  # fmt: skip
def throughput(policies: Policies) -> Finding:
    """T4."""
    found = _trained(policies, lambda e: e.trained["steps_per_s"], "mlp", "transformer")
    slower = found["transformer"].value < 0.4 * found["mlp"].value
    return Finding(
        several(found, 0), bounds(found), holds(slower),
        "Ours trains the Transformer on sequences, not on a window per sample.",
    )  # fmt: skip


CLAIMS = (reward, exploration, curriculum, throughput)


def _trained(
    policies: Policies, value: Callable[[PolicyEvidence], float], *needed: str
) -> dict[str, Interval]:
    """Per kind, of policies whose training is known."""
    return of_kinds([p for p in policies if p.trained], value, *needed)


def _lstm_and_newer(found: dict[str, Interval]) -> tuple[float, list[float]]:
    """The LSTM's value, and those of GRU and Transformer."""
    rest = [v.value for k, v in found.items() if k in ("gru", "transformer")]
    if "lstm" not in found or not rest:
        raise NotTestable("Give runs of an LSTM and of a GRU or Transformer.")
    return found["lstm"].value, rest
