"""The published claims about the gait: what delay, missing senses, ground and rate do to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pupper_sysid.policies.analysis.attractor import DELAYS_MS
from pupper_sysid.policies.analysis.autonomy import NUDGE_M_S, PUSH_M_S
from pupper_sysid.policies.analysis.rhythm import mean_of
from reproduction.claims import Claim, Finding, NotTestable, claim, holds
from reproduction.evidence import (
    PolicyEvidence,
    bounds,
    of_kind,
    of_kinds,
    several,
)

Policies = Sequence[PolicyEvidence]
_SMALLEST_SHIFT = 0.02  # of a cycle; below, the slope of late on early shifts is noise


def _delay_frequency(kind: str, id_: str, text: str, paper: str) -> Callable[[Policies], Claim]:
    @claim(
        id_, text, paper,
        "Replay of recorded observations whose joints are late by 0 to 320 ms, as published, and "
        "closed loop with later servos (`pupper-analyze delay`).",
    )  # fmt: skip
    def made(policies: Policies) -> Finding:
        mine = of_kind(policies, kind)
        values = {  # a row per delay, a column per policy
            mode: np.array(
                [[_delayed(p, d, "frequency_hz", mode) for p in mine] for d in DELAYS_MS]
            )
            for mode in ("replay", "fixed")
        }
        still = [p.name for p, r in zip(mine, values["replay"].T, strict=True) if np.isnan(r).any()]
        if still:
            raise NotTestable(
                f"{', '.join(still)}: no rhythm in replay to compare at {_list(DELAYS_MS)} ms. "
                "Give a policy that walks."
            )
        sizes = [
            np.mean([_delayed(p, d, "amplitude_rad", "replay") for p in mine]) for d in DELAYS_MS
        ]
        up = [np.mean([_delayed(p, d, "survival") for p in mine]) for d in DELAYS_MS]
        ours = (
            f"replay {_range(values['replay'], 2)} Hz, amplitude "
            f"{', '.join(f'{s:.2f}' for s in sizes)} rad at {_list(DELAYS_MS)} ms; closed loop "
            f"{_range(values['fixed'], 2)} Hz, {', '.join(f'{100 * u:.0f} %' for u in up)} up"
        )
        # of each policy: two that walk at rates of their own are not erratic for it
        constant = [max(rates) / min(rates) - 1 < 0.05 for rates in values["replay"].T]
        wanted = [c if kind == "lstm" else not c for c in constant]
        return Finding(
            ours, None, holds(all(wanted), any(wanted)),
            "Constant if within 5 % in replay; partly if some of several policies are so.",
        )  # fmt: skip

    return made


@claim(
    "P1", "Three components explain more of the LSTM's cell than of the MLP's hidden layer",
    "60.4 % against 56.9 %",
    "PCA of states in replay at 0, +160, +320 ms together (`pupper-analyze attractor`).",
)  # fmt: skip
def components(policies: Policies) -> Finding:
    """P1."""
    found = of_kinds(policies, lambda e: 100 * _hidden(e, "explained_3"), "mlp", "lstm")
    return Finding(
        f"{several(found, 0)} %", bounds(found), holds(found["lstm"].value > found["mlp"].value),
        "Variance explained says little of order: see P2.",
    )  # fmt: skip


@claim(
    "P2", "Under delay the LSTM's orbit stays an ellipse, the MLP's collapses into bands",
    "shown, not measured",
    "Orbits of actions in replay: closure (0 closed, 1 unrelated) and area left at +320 ms.",
)  # fmt: skip
def orbit(policies: Policies) -> Finding:
    """P2."""
    closed = of_kinds(policies, lambda e: _acted(e, "closure")[-1], "mlp", "lstm")
    left = of_kinds(policies, lambda e: _acted(e, "area_ratio")[-1], "mlp", "lstm")
    lstm = closed["lstm"].value < 0.3 and left["lstm"].value > 0.5
    mlp = closed["mlp"].value > 0.3 or left["mlp"].value < 0.5
    return Finding(
        f"closure {several(closed, 2)}; area left {several(left, 2)}", bounds(closed),
        holds(lstm and mlp, lstm or mlp), "An ellipse: closure below 0.3, half of the area left.",
    )  # fmt: skip


@claim(
    "B1", "Without its joints' state the LSTM keeps more of its gait",
    "correlation of actions LSTM 0.826, MLP 0.698",
    "Observations 12 to 47 zeroed: correlation of actions in replay, survival in closed loop.",
)  # fmt: skip
def zeros(policies: Policies) -> Finding:
    """B1."""
    found = of_kinds(policies, lambda e: _ablated(e, "zero", "correlation"), "mlp", "lstm")
    up = of_kinds(policies, lambda e: 100 * _ablated(e, "zero", "survival"))
    return Finding(
        f"{several(found, 2)}; still up {several(up, 0)} %", bounds(found),
        holds(found["lstm"].value > found["mlp"].value + 0.02), "Holds if 0.02 more.",
    )  # fmt: skip


@claim(
    "B2", "Noise in the joints' state is worse than none from σ ≈ 0.2 on", "σ ≈ 0.2 in both",
    "Noise in shares of each channel's own deviation; where replay correlates as with zeros.",
)  # fmt: skip
def crossover(policies: Policies) -> Finding:
    """B2."""
    found = of_kinds(policies, _crossing, "mlp", "lstm")
    close = all(0.1 < found[k].value < 0.4 for k in ("mlp", "lstm"))
    return Finding(
        f"{several(found, 2)} of a deviation", bounds(found), holds(close),
        "One σ for radians, rad/s and efforts has no unit; ours is relative (0.1 to 0.4); ∞ if one "
        "of the policies was never worse with noise than with zeros.",
    )  # fmt: skip


@claim(
    "X1", "The LSTM is a central pattern generator: its rhythm is its own", "argued from P and G",
    f"Replay with inputs frozen (amplitude left), pushes of {PUSH_M_S:g} m/s (phase shift kept: "
    f"1, 0 it returns; nudges of {NUDGE_M_S:g} m/s beside it), and other control rates (exponent "
    "1: counted in steps, 0: in seconds).",
)  # fmt: skip
def autonomous(policies: Policies) -> Finding:
    """X1."""
    mine = of_kind(policies, "lstm")
    share = {
        test: float(np.mean([r.share for p in mine for r in p.autonomy.frozen if r.test == test]))
        for test in (r.test for r in mine[0].autonomy.frozen)
    }
    with_action = share["senses frozen, its own last action"]
    without = share["senses and last action frozen"]
    if not np.isfinite([with_action, without]).all():
        raise NotTestable("No robot of one of the LSTMs walked long enough. Give one that walks.")

    def pushed(speed: float, key: str) -> float:
        rows = [r for p in mine for r in p.autonomy.push if r.push_m_s == speed]
        return mean_of(np.array([getattr(r, key) for r in rows], float)).value

    size = pushed(PUSH_M_S, "shift_late")
    exponent = float(np.mean([p.autonomy.rate_exponent for p in mine]))
    keeps = f"{100 * pushed(PUSH_M_S, 'kept'):.0f} % of it kept"
    if not size >= _SMALLEST_SHIFT:
        keeps = "too little to say whether it is kept"
    ours = (
        f"amplitude left: {with_action:.2f} with senses frozen, {without:.2f} with its last action "
        f"frozen, too; a push shifts the phase by {size:.2f} of a cycle (a nudge "
        f"{pushed(NUDGE_M_S, 'shift_late'):.2f}), {keeps}; rate exponent {exponent:.2f}"
    )
    return Finding(
        ours, None, holds(without > 0.5, with_action > 0.5),
        "Holds if half of the amplitude is left with all frozen, partly if it needs its own last "
        "action: then the loop through the action is the oscillator, not the cell.",
    )  # fmt: skip


@claim(
    "X2", "The MLP adapts better to +160 ms (the repository, against the paper)",
    "adaptation MLP 0.66, LSTM 0.47",
    "Closed loop, servos 160 ms later: survival and forward error.",
)  # fmt: skip
def adapts(policies: Policies) -> Finding:
    """X2."""
    up = of_kinds(policies, lambda e: _delayed(e, 160, "survival"), "mlp", "lstm")
    error = of_kinds(policies, lambda e: _delayed(e, 160, "mae_vx_m_s"))
    ahead = up["mlp"].value - up["lstm"].value
    close = abs(ahead) <= 0.05 and {"mlp", "lstm"} <= set(error)
    nearer = close and error["mlp"].value < 0.9 * error["lstm"].value
    return Finding(
        f"up {several(up, 2)}; error {several(error, 3)} m/s", bounds(up),
        holds(ahead > 0.05 or nearer),
        "Their score mixes periodicity and symmetry; here: survival, then error (10 %).",
    )  # fmt: skip


@claim(
    "B3", "Only the LSTM walks on other ground", "MLP no, LSTM yes",
    "Trained on flat ground; survival on rough ground, slopes, troughs and steps.",
)  # fmt: skip
def ground(policies: Policies) -> Finding:
    """B3."""

    def survival(e: PolicyEvidence) -> float:
        return 100 * float(np.mean([r.survival for r in e.terrain if r.ground != "flat"]))

    flat = [p for p in policies if p.ground == "flat"]
    if not {"mlp", "lstm"} <= {p.kind for p in flat}:
        raise NotTestable(
            "Give runs, with their run.yaml, of the MLP and of the LSTM on flat ground."
        )
    found = of_kinds(flat, survival, "mlp", "lstm")
    more = found["lstm"].value > found["mlp"].value + 10
    fine = found["lstm"].value > 90
    return Finding(
        f"{several(found, 0)} % still up", bounds(found), holds(more and fine, fine),
        "Holds if the LSTM has 10 points more; partly if it walks, but the MLP, too.",
    )  # fmt: skip


@claim(
    "C1", "It walks forward, backward, sideways and turns as commanded", "shown, not measured",
    "Speed along the command over the commanded speed (0 of a robot that fell), six directions, "
    "worst and mean.",
)  # fmt: skip
def directions(policies: Policies) -> Finding:
    """C1."""
    worst = of_kinds(policies, lambda e: float(np.min([r.share.value for r in e.compliance])))
    mean = of_kinds(policies, lambda e: float(np.mean([r.share.value for r in e.compliance])))
    low = min(v.value for v in worst.values())
    return Finding(
        f"mean {several(mean, 2)}; worst {several(worst, 2)}", bounds(mean),
        holds(low > 0.8, low > 0.4), "Holds if the worst is above 0.8, partly above 0.4.",
    )  # fmt: skip


@claim(
    "C2", "Forward walks bend a little clockwise", "slight clockwise arc",
    "Change of heading per metre, forward; to the left is positive.",
)  # fmt: skip
def arc(policies: Policies) -> Finding:
    """C2."""
    found = of_kinds(
        policies,
        lambda e: next(r.arc_rad_m.value for r in e.compliance if r.direction == "forward"),
    )
    return Finding(
        f"{several(found, 2)} rad/m", bounds(found),
        holds(all(v.value < -0.05 for v in found.values())),
        "A symmetric robot in simulation; theirs had servos of its own.",
    )  # fmt: skip


@claim(
    "D1", "At 25 Hz the policy walks at half the gait frequency",
    "5.3 Hz trained, 2.8 Hz at 25 Hz",
    "The policy of 50 Hz at 25 Hz, closed loop.",
)  # fmt: skip
def half_rate(policies: Policies) -> Finding:
    """D1."""
    up = of_kinds(policies, lambda e: 100 * _at_rate(e, 25.0, "survival"))
    if not any(v.value for v in up.values()):
        return Finding(f"still up {several(up, 0)} %", bounds(up), holds(False), "It falls.")
    found = of_kinds(policies, lambda e: _at_rate(e, 25.0, "frequency_hz"))
    usual = of_kinds(policies, lambda e: _at_rate(e, 50.0, "frequency_hz"))
    ratios = [found[k].value / usual[k].value for k in found if k in usual]
    halves = bool(ratios) and 0.4 < float(np.mean(ratios)) < 0.65
    return Finding(
        f"{several(usual, 2)} Hz at 50 Hz, {several(found, 2)} at 25 Hz; still up "
        f"{several(up, 0)} %",
        bounds(found), holds(halves), "Halves if 0.4 to 0.65 of it.",
    )  # fmt: skip


@claim(
    "D2", "The LSTM is deployed with a larger action scale",
    "0.60 to 0.75 rad (0.45 in the code)",
    "Scale of what is sent, instead of the trained one; survival and forward error.",
)  # fmt: skip
def scale(policies: Policies) -> Finding:
    """D2."""
    mine = of_kind(policies, "lstm")
    rows = {
        scale: [r for p in mine for r in p.scale if r.scale_rad == scale]
        for scale in sorted({r.scale_rad for r in mine[0].scale})
    }
    errors = {s: float(np.mean([r.mae_vx_m_s for r in found])) for s, found in rows.items()}
    ours = ", ".join(
        f"{s:g} rad: {100 * np.mean([r.survival for r in found]):.0f} % up, {errors[s]:.3f} m/s"
        for s, found in rows.items()
    )
    best = min(errors, key=lambda s: errors[s] if np.isfinite(errors[s]) else np.inf)
    return Finding(ours, None, holds(best >= 0.6), "Holds if 0.6 rad or more is best.")


CLAIMS = (
    _delay_frequency(
        "lstm", "G2", "The LSTM's gait is the same under 0, +160 and +320 ms",
        "5.3 Hz, actions ±0.30 (0.49 at +320 ms)",
    ),
    _delay_frequency(
        "mlp", "G3", "The MLP's gait is erratic under delay",
        "6.6 to 7.5 Hz, ±0.1 (0.16 at +320 ms)",
    ),
    components, orbit, zeros, crossover, autonomous, adapts, ground, directions, arc, half_rate,
    scale,
)  # fmt: skip


def _range(values: np.ndarray, digits: int) -> str:
    """Smallest to largest; a dash if there are none."""
    known = values[np.isfinite(values)]
    return f"{known.min():.{digits}f} to {known.max():.{digits}f}" if len(known) else "–"


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _hidden(evidence: PolicyEvidence, key: str) -> float:
    return getattr(evidence.orbits["hidden"], key) if evidence.orbits else float("nan")


def _acted(evidence: PolicyEvidence, key: str) -> list[float]:
    return getattr(evidence.orbits["actions"], key) if evidence.orbits else [float("nan")]


def _ablated(evidence: PolicyEvidence, kind: str, key: str) -> float:
    return next(getattr(r, key) for r in evidence.ablation if r.kind == kind)


def _crossing(evidence: PolicyEvidence) -> float:
    """Share of noise from which replay correlates less than with zeros.

    Infinite if it never does, NaN if nothing correlates because no robot walked.
    """
    floor = _ablated(evidence, "zero", "correlation")
    noise = [(r.level, r.correlation) for r in evidence.ablation if r.kind == "noise"]
    if not np.isfinite([floor, *(r for _, r in noise)]).all():
        return float("nan")
    return next((level for level, r in noise if r < floor), float("inf"))


def _delayed(evidence: PolicyEvidence, extra_ms: float, key: str, mode: str = "fixed") -> float:
    rows = (r for r in evidence.delay if r.mode == mode and r.extra_delay_ms == extra_ms)
    return getattr(next(rows), key)


def _at_rate(evidence: PolicyEvidence, rate: float, key: str) -> float:
    return next(getattr(r, key) for r in evidence.autonomy.rate if abs(r.rate_hz - rate) < 0.5)
