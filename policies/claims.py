"""The published claims, one by one: what the paper says, what we find, and whether it holds here.

Each claim is a small function of the evidence (`policies.evidence`); `judge` asks them all. A
verdict follows from thresholds that stand in the claim's `how`. "Not testable here" means that
nothing this evidence contains could decide it, and says what could.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from common.claims import Claim, Interval, Verdict, untested
from policies.evidence import DELAYS_MS, PolicyEvidence, over
from policies.phase_reset import NUDGE_M_S, PUSH_M_S, rate_exponent
from policies.rhythm import Estimate, sine_fit_r2, sine_frequency
from policies.stacks import STACKS
from servo_models.delayed_pd import DelayedPDParameters

KINDS = ("mlp", "lstm", "gru", "transformer")
_SMALLEST_SHIFT = 0.02  # of a cycle; below, the slope of late on early shifts is noise
_NAMES = {"mlp": "MLP", "lstm": "LSTM", "gru": "GRU", "transformer": "Transformer"}


Policies = Sequence[PolicyEvidence]
Played = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def judge(policies: Policies, played: Played, stacks: Sequence[dict[str, Any]]) -> list[Claim]:
    """All claims about policies.

    Parameters
    ----------
    policies : sequence of PolicyEvidence
    played : dict of str to (ndarray, ndarray, ndarray)
        Of a playback, per joint: times [s], commands and positions [rad]; may be empty.
    stacks : sequence of dict
        Of `policies.stack_trials.compare_stacks`, closed loop first; may be empty.
    """
    return [
        *(claim(policies) for claim in _OF_POLICIES),
        _hardware_sine(played),
        _closed_loop(stacks),
        *_BEYOND,
    ]


# --------------------------------------------------------------------------------- the servos


def _hardware_sine(played: Played) -> Claim:
    about = (
        "G1", "On hardware the gait is 2.8 Hz on all joints, and nearer to a sine than simulated",
        "2.8 Hz; R² 0.77 on hardware, 0.40 in simulation",
    )  # fmt: skip
    how = "Playback: frequency and sine fit of commands and of what the joints did, per joint."
    if not played:
        return untested(about, f"{how} Give a playback or walk with --recordings.")
    rates, r2 = [], {"command_rad": [], "position_rad": []}
    for time, command, position in played.values():
        step = float(np.median(np.diff(time)))
        good = np.isfinite(position)
        moved = np.interp(time, time[good], position[good])
        for name, signal in (("position_rad", moved[:, None]), ("command_rad", command[:, None])):
            if len(signal) * step < 5.0 or signal.std() < 1e-3:
                continue
            rate = sine_frequency(signal, step)
            r2[name].append(float(sine_fit_r2(signal, step, rate)[0]))
            if name == "position_rad":
                rates.append(rate)
    if not rates:
        return untested(about, f"{how} The trials are shorter than 5 s.")
    mean = {k: float(np.mean(v)) for k, v in r2.items()}
    ours = (
        f"{np.median(rates):.2f} Hz in the middle of the joints ({min(rates):.2f} to "
        f"{max(rates):.2f}); R² of commands {mean['command_rad']:.2f}, of what the servos made of "
        f"them {mean['position_rad']:.2f}"
    )
    uniform = max(rates) - min(rates) < 0.1
    return Claim(
        *about, ours, {"joints": [min(rates), max(rates)]},
        "holds partly" if mean["position_rad"] > mean["command_rad"] + 0.02 or uniform
        else "does not hold here",
        f"{how} Same servos in both; uniform if within 0.1 Hz.",
    )  # fmt: skip


# --------------------------------------------------------------------------------- training


def _rewards(policies: Policies) -> Claim:
    about = (
        "T1", "GRU and Transformer fail where MLP and LSTM learn",
        "reward MLP 271 (with curriculum), LSTM 271, GRU 72, Transformer −85.8",
    )  # fmt: skip
    how = (
        "Reward per second over the last updates, one task and critic; budgets differ, see Table I."
    )
    known = [p for p in policies if p.trained]
    found = {k: over(known, k, lambda e: e.trained["reward"]) for k in KINDS}
    there = {k: v for k, v in found.items() if np.isfinite(v.value)}
    rest = [v.value for k, v in there.items() if k in ("gru", "transformer")]
    if "lstm" not in there or not rest:
        return untested(about, f"{how} Give runs of an LSTM and of a GRU or Transformer.")
    fails = min(rest) < 0.5 * there["lstm"].value
    return Claim(
        *about, _several(there, 2), _bounds(there), "holds" if fails else "does not hold here",
        f"{how} Holds if one has less than half of the LSTM's.",
    )  # fmt: skip


def _exploration(policies: Policies) -> Claim:
    about = (
        "T2", "GRU and Transformer never settle", "action noise 0.07, 0.07, 0.25, 1.13",
    )  # fmt: skip
    how = "Standard deviation of the exploration in the last updates."
    known = [p for p in policies if p.trained]
    found = {k: over(known, k, lambda e: e.trained["std"]) for k in KINDS}
    there = {k: v for k, v in found.items() if np.isfinite(v.value)}
    rest = [v.value for k, v in there.items() if k in ("gru", "transformer")]
    if "lstm" not in there or not rest:
        return untested(about, f"{how} Give runs of an LSTM and of a GRU or Transformer.")
    grows = max(rest) > 2 * there["lstm"].value
    return Claim(
        *about, _several(there, 4), _bounds(there), "holds" if grows else "does not hold here",
        f"{how} Ours starts small, after imitation; holds if one has twice the LSTM's.",
    )  # fmt: skip


def _curriculum(policies: Policies) -> Claim:
    about = ("T3", "The MLP needs a curriculum", "MLP yes, LSTM no")
    how = "Survival of policies that were trained without one."
    found = _of_kinds(policies, lambda e: float(e.walk.alive[-1].mean()))
    if "mlp" not in found:
        return untested(about, f"{how} Give a run of an MLP.")
    fails = found["mlp"].value < 0.9
    return Claim(
        *about, _several(found, 2), _bounds(found), "holds" if fails else "does not hold here",
        f"{how} Imitation of a trot came first, for all alike.",
    )  # fmt: skip


def _throughput(policies: Policies) -> Claim:
    about = (
        "T4", "A Transformer trains at a fifth of the MLP's speed",
        "30,000, 15,000–20,000, 15,000–20,000, 5,500 steps/s on an RTX 4090",
    )  # fmt: skip
    how = "Steps per second of the trainings, on the machine they ran on."
    known = [p for p in policies if p.trained]
    found = {k: over(known, k, lambda e: e.trained["steps_per_s"]) for k in KINDS}
    there = {k: v for k, v in found.items() if np.isfinite(v.value)}
    if "mlp" not in there or "transformer" not in there:
        return untested(about, f"{how} Give runs of an MLP and a Transformer.")
    slower = there["transformer"].value < 0.4 * there["mlp"].value
    return Claim(
        *about, _several(there, 0), _bounds(there), "holds" if slower else "does not hold here",
        f"{how} Ours trains the Transformer on sequences, not on a window per sample.",
    )  # fmt: skip


# --------------------------------------------------------------------------------- the gait


def _delay_frequency(kind: str, id_: str, claim: str, paper: str) -> Callable[[Policies], Claim]:
    def made(policies: Policies) -> Claim:
        how = (
            "Replay of recorded observations whose joints are late by 0 to 320 ms, as published, "
            "and closed loop with later servos (`pupper-analyze delay`)."
        )
        mine = [p for p in policies if p.kind == kind]
        if not mine:
            return untested((id_, claim, paper), f"{how} Give a run of the {_NAMES[kind]}.")
        values = {
            mode: np.array([_delayed(p, d, "frequency_hz", mode) for d in DELAYS_MS for p in mine])
            for mode in ("replay", "fixed")
        }
        sizes = [
            np.mean([_delayed(p, d, "amplitude_rad", "replay") for p in mine]) for d in DELAYS_MS
        ]
        up = [np.mean([_delayed(p, d, "survival") for p in mine]) for d in DELAYS_MS]
        ours = (
            f"replay {_range(values['replay'], 2)} Hz, amplitude "
            f"{', '.join(f'{s:.2f}' for s in sizes)} rad at {_list(DELAYS_MS)} ms; closed loop "
            f"{_range(values['fixed'], 2)} Hz, {', '.join(f'{100 * u:.0f} %' for u in up)} up"
        )
        spread = np.nanmax(values["replay"]) / np.nanmin(values["replay"]) - 1
        constant = bool(spread < 0.05 and np.isfinite(values["replay"]).all())
        if kind == "lstm":
            verdict: Verdict = "holds" if constant else "does not hold here"
        else:
            verdict = "does not hold here" if constant else "holds"
        return Claim(
            id_, claim, paper, ours, None, verdict, f"{how} Constant if within 5 % in replay."
        )

    return made


def _pca(policies: Policies) -> Claim:
    about = (
        "P1", "Three components explain more of the LSTM's cell than of the MLP's hidden layer",
        "60.4 % against 56.9 %",
    )  # fmt: skip
    how = "PCA of states in replay at 0, +160, +320 ms together (`pupper-analyze attractor`)."
    found = _of_kinds(policies, lambda e: 100 * _hidden(e, "explained_3"))
    if "mlp" not in found or "lstm" not in found:
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    more = found["lstm"].value > found["mlp"].value
    return Claim(
        *about, f"{_several(found, 0)} %", _bounds(found),
        "holds" if more else "does not hold here",
        f"{how} Variance explained says little of order: see P2.",
    )  # fmt: skip


def _orbit(policies: Policies) -> Claim:
    about = (
        "P2", "Under delay the LSTM's orbit stays an ellipse, the MLP's collapses into bands",
        "shown, not measured",
    )  # fmt: skip
    how = "Orbits of actions in replay: closure (0 closed, 1 unrelated) and area left at +320 ms."
    closed = _of_kinds(policies, lambda e: _acted(e, "closure")[-1])
    left = _of_kinds(policies, lambda e: _acted(e, "area_ratio")[-1])
    if "mlp" not in closed or "lstm" not in closed:
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    lstm = closed["lstm"].value < 0.3 and left["lstm"].value > 0.5
    mlp = closed["mlp"].value > 0.3 or left["mlp"].value < 0.5
    verdict: Verdict = (
        "holds" if lstm and mlp else "holds partly" if lstm or mlp else "does not hold here"
    )
    return Claim(
        *about, f"closure {_several(closed, 2)}; area left {_several(left, 2)}", _bounds(closed),
        verdict, f"{how} An ellipse: closure below 0.3, half of the area left.",
    )  # fmt: skip


def _zeros(policies: Policies) -> Claim:
    about = (
        "B1", "Without its joints' state the LSTM keeps more of its gait",
        "correlation of actions LSTM 0.826, MLP 0.698",
    )  # fmt: skip
    how = "Observations 12 to 47 zeroed: correlation of actions in replay, survival in closed loop."
    found = _of_kinds(policies, lambda e: _ablated(e, "zero", "correlation"))
    up = _of_kinds(policies, lambda e: 100 * _ablated(e, "zero", "survival"))
    if "mlp" not in found or "lstm" not in found:
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    more = found["lstm"].value > found["mlp"].value + 0.02
    return Claim(
        *about, f"{_several(found, 2)}; still up {_several(up, 0)} %", _bounds(found),
        "holds" if more else "does not hold here", f"{how} Holds if 0.02 more.",
    )  # fmt: skip


def _crossover(policies: Policies) -> Claim:
    about = (
        "B2", "Noise in the joints' state is worse than none from σ ≈ 0.2 on", "σ ≈ 0.2 in both",
    )  # fmt: skip
    how = "Noise in shares of each channel's own deviation; where replay correlates as with zeros."
    found = _of_kinds(policies, _crossing)
    if "mlp" not in found or "lstm" not in found:
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    close = all(0.1 < found[k].value < 0.4 for k in ("mlp", "lstm"))
    return Claim(
        *about, f"{_several(found, 2)} of a deviation", _bounds(found),
        "holds" if close else "does not hold here",
        f"{how} One σ for radians, rad/s and efforts has no unit; ours is relative (0.1 to 0.4).",
    )  # fmt: skip


def _autonomous(policies: Policies) -> Claim:
    about = (
        "X1",
        "The LSTM is a central pattern generator: its rhythm is its own",
        "argued from P and G",
    )
    how = (
        "Replay with inputs frozen (amplitude left), pushes of "
        f"{PUSH_M_S:g} m/s (phase shift kept: 1, 0 it returns; nudges of {NUDGE_M_S:g} m/s beside "
        "it), and other control rates (exponent 1: counted in steps, 0: in seconds)."
    )
    mine = [p for p in policies if p.kind == "lstm"]
    if not mine:
        return untested(about, f"{how} Give a run of the LSTM.")
    share = {
        test: float(np.mean([r["share"] for p in mine for r in p.frozen if r["test"] == test]))
        for test in (r["test"] for r in mine[0].frozen)
    }
    with_action = share["senses frozen, its own last action"]
    without = share["senses and last action frozen"]
    kept = [r["kept"] for p in mine for r in p.push if r["push_m_s"] == PUSH_M_S]
    size = [r["shift_late"] for p in mine for r in p.push if r["push_m_s"] == PUSH_M_S]
    nudged = [r["shift_late"] for p in mine for r in p.push if r["push_m_s"] == NUDGE_M_S]
    exponent = float(np.mean([rate_exponent(p.rate) for p in mine]))
    keeps = f"{100 * np.mean(kept):.0f} % of it kept"
    if np.mean(size) < _SMALLEST_SHIFT:
        keeps = "too little to say whether it is kept"
    ours = (
        f"amplitude left: {with_action:.2f} with senses frozen, {without:.2f} with its last action "
        f"frozen, too; a push shifts the phase by {np.mean(size):.2f} of a cycle (a nudge "
        f"{np.mean(nudged):.2f}), {keeps}; rate exponent {exponent:.2f}"
    )
    alone, with_own = without > 0.5, with_action > 0.5
    verdict: Verdict = "holds" if alone else "holds partly" if with_own else "does not hold here"
    return Claim(
        *about, ours, None, verdict,
        f"{how} Holds if half of the amplitude is left with all frozen, partly if it needs its own "
        "last action: then the loop through the action is the oscillator, not the cell.",
    )  # fmt: skip


def _adapts(policies: Policies) -> Claim:
    about = (
        "X2", "The MLP adapts better to +160 ms (the repository, against the paper)",
        "adaptation MLP 0.66, LSTM 0.47",
    )  # fmt: skip
    how = "Closed loop, servos 160 ms later: survival and forward error."
    late = {
        key: _of_kinds(policies, lambda e, k=key: _delayed(e, 160, k))
        for key in ("survival", "mae_vx_m_s")
    }
    if not {"mlp", "lstm"} <= set(late["survival"]):
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    up, error = late["survival"], late["mae_vx_m_s"]
    better = up["mlp"].value - up["lstm"].value > 0.05 or (
        abs(up["mlp"].value - up["lstm"].value) <= 0.05
        and error["mlp"].value < 0.9 * error["lstm"].value
    )
    return Claim(
        *about, f"up {_several(up, 2)}; error {_several(error, 3)} m/s", _bounds(up),
        "holds" if better else "does not hold here",
        f"{how} Their score mixes periodicity and symmetry; here: survival, then error (10 %).",
    )  # fmt: skip


def _ground(policies: Policies) -> Claim:
    about = ("B3", "Only the LSTM walks on other ground", "MLP no, LSTM yes")
    how = "Trained on flat ground; survival on rough ground, slopes, troughs and steps."
    found = _of_kinds(
        policies,
        lambda e: 100 * float(np.mean([r["survival"] for r in e.terrain if r["ground"] != "flat"])),
    )
    if "mlp" not in found or "lstm" not in found:
        return untested(about, f"{how} Give runs of an MLP and an LSTM.")
    more = found["lstm"].value > found["mlp"].value + 10
    fine = found["lstm"].value > 90
    verdict: Verdict = (
        "holds" if more and fine else "holds partly" if fine else "does not hold here"
    )
    return Claim(
        *about, f"{_several(found, 0)} % still up", _bounds(found), verdict,
        f"{how} Holds if the LSTM has 10 points more; partly if it walks, but the MLP, too.",
    )  # fmt: skip


def _directions(policies: Policies) -> Claim:
    about = ("C1", "It walks forward, backward, sideways and turns as told", "shown, not measured")
    how = "Speed along the command over the speed asked for, six directions, worst and mean."
    worst = _of_kinds(policies, lambda e: min(r["share"].value for r in e.compliance))
    mean = _of_kinds(policies, lambda e: float(np.mean([r["share"].value for r in e.compliance])))
    low = min(v.value for v in worst.values())
    verdict: Verdict = (
        "holds" if low > 0.8 else "holds partly" if low > 0.4 else "does not hold here"
    )
    return Claim(
        *about, f"mean {_several(mean, 2)}; worst {_several(worst, 2)}", _bounds(mean), verdict,
        f"{how} Holds if the worst is above 0.8, partly above 0.4.",
    )  # fmt: skip


def _arc(policies: Policies) -> Claim:
    about = ("C2", "Forward walks bend a little clockwise", "slight clockwise arc")
    how = "Change of heading per metre, forward; to the left is positive."
    found = _of_kinds(
        policies,
        lambda e: next(r["arc_rad_m"].value for r in e.compliance if r["direction"] == "forward"),
    )
    bends = [v for v in found.values() if v.value < -0.05]
    return Claim(
        *about, f"{_several(found, 2)} rad/m", _bounds(found),
        "holds" if len(bends) == len(found) else "does not hold here",
        f"{how} A symmetric robot in simulation; theirs had servos of its own.",
    )  # fmt: skip


def _quarter_rate(policies: Policies) -> Claim:
    about = (
        "D1",
        "At 25 Hz the policy walks at half the gait frequency",
        "5.3 Hz trained, 2.8 Hz at 25 Hz",
    )
    how = "The policy of 50 Hz asked 25 times a second, closed loop."
    found = _of_kinds(policies, lambda e: _at_rate(e, 25.0, "frequency_hz"))
    usual = _of_kinds(policies, lambda e: _at_rate(e, 50.0, "frequency_hz"))
    up = _of_kinds(policies, lambda e: 100 * _at_rate(e, 25.0, "survival"))
    ratios = [found[k].value / usual[k].value for k in found if np.isfinite(found[k].value)]
    halves = bool(ratios) and 0.4 < float(np.mean(ratios)) < 0.65
    return Claim(
        *about, f"{_several(usual, 2)} Hz at 50 Hz, {_several(found, 2)} at 25 Hz; still up "
        f"{_several(up, 0)} %", _bounds(found), "holds" if halves else "does not hold here",
        f"{how} Halves if 0.4 to 0.65 of it.",
    )  # fmt: skip


def _scale(policies: Policies) -> Claim:
    about = (
        "D2",
        "The LSTM is deployed with a larger action scale",
        "0.60 to 0.75 rad (0.45 in the code)",
    )
    how = "Scale of what is sent, instead of the trained one; survival and forward error."
    mine = [p for p in policies if p.kind == "lstm"]
    if not mine:
        return untested(about, f"{how} Give a run of the LSTM.")
    rows = {
        scale: [r for p in mine for r in p.scale if r["scale_rad"] == scale]
        for scale in sorted({r["scale_rad"] for r in mine[0].scale})
    }
    errors = {s: float(np.mean([r["mae_vx_m_s"] for r in found])) for s, found in rows.items()}
    ours = ", ".join(
        f"{s:g} rad: {100 * np.mean([r['survival'] for r in found]):.0f} % up, {errors[s]:.3f} m/s"
        for s, found in rows.items()
    )
    best = min(errors, key=lambda s: errors[s])
    return Claim(
        *about, ours, None, "holds" if best >= 0.6 else "does not hold here",
        f"{how} Holds if 0.6 rad or more is best.",
    )  # fmt: skip


# --------------------------------------------------------------------------------- the stacks


def _closed_loop(stacks: Sequence[dict[str, Any]]) -> Claim:
    about = (
        "D3", "Closing the loop on the encoders is worse than a servo model's prediction",
        "worse, not measured",
    )  # fmt: skip
    how = "One emulated robot walked by both under the same commands; difference round by round."
    other = next((s for s in stacks if "less_mae_vx_m_s" in s), None)
    if other is None:
        return untested(about, f"{how} Give a servo model with --servo.")
    keys = ("mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s")
    first = stacks[0]
    parts = [f"{first['stack']} {_errors(first, keys)}, falls {100 * first['falls']:.0f} %"]
    parts.append(f"{other['stack']} {_errors(other, keys)}, falls {100 * other['falls']:.0f} %")
    gains: list[Estimate] = [other[f"less_{k}"] for k in keys]
    better, worse = all(g.high < 0 for g in gains), all(g.low > 0 for g in gains)
    verdict: Verdict = "holds" if better else "does not hold here" if worse else "holds partly"
    bounds = {k: [other[f"less_{k}"].low, other[f"less_{k}"].high] for k in keys}
    return Claim(
        *about, "; ".join(parts), bounds, verdict,
        f"{how} Intervals are of the prediction's error less the encoders'; partly if they are not "
        "all on one side of 0.",
    )  # fmt: skip


def _counts() -> list[Claim]:
    fields = len(DelayedPDParameters.__dataclass_fields__)
    smooth = sum(1 for s in (STACKS["lstm-servo"].lowpass_hz, STACKS["lstm-servo"].fade_in_s) if s)
    return [
        Claim(
            "D4", "The LSTM stack has one hardware parameter, the MLP stack more than six",
            "1 against 6+",
            f"simulated PD: {fields} numbers per joint, from the calibration; both stacks: rate, "
            f"scale and {smooth} of smoothing; LSTM stack: 12 servo networks beside",
            None, "does not hold here", "Counted in `policies.stacks` and `servo_models`.",
        ),
        Claim(
            "D5", "Of 60 observations 15 are measured in the MLP stack, 6 in the LSTM stack",
            "15/60, 6/60 (15 + 36 + 3 = 54)",
            "both: 6 measured (IMU), 36 predicted, 12 of its own last action, 3 of the command, "
            "3 of the trunk's speed that nobody measures; closed loop: 42 measured",
            None, "holds partly", "Counted in `policies.controller`.",
        ),
    ]  # fmt: skip


_OF_POLICIES: tuple[Callable[[Policies], Claim], ...] = (
    _rewards, _exploration, _curriculum, _throughput,
    _delay_frequency(
        "lstm", "G2", "The LSTM's gait is the same under 0, +160 and +320 ms",
        "5.3 Hz, actions ±0.30 (0.49 at +320 ms)",
    ),
    _delay_frequency(
        "mlp", "G3", "The MLP's gait is erratic under delay",
        "6.6 to 7.5 Hz, ±0.1 (0.16 at +320 ms)",
    ),
    _pca, _orbit, _zeros, _crossover, _autonomous, _adapts, _ground, _directions, _arc,
    _quarter_rate, _scale,
)  # fmt: skip
_BEYOND = (
    *_counts(),
    Claim(
        "N1", "Training takes 12 to 24 GiB of GPU memory", "~12, 12–24, 12–24, ~24 GiB", "–", None,
        "not testable here", "Training runs on processors; needs a GPU of that kind.",
    ),
    Claim(
        "N2", "The robot costs $300, a servo $8 instead of $200–500", "$300; $8", "–", None,
        "not testable here", "Prices are the shops'.",
    ),
    Claim(
        "N3", "Biological delays are as long", "100 to 160 ms", "–", None, "not testable here",
        "Needs animals.",
    ),
    Claim(
        "N4", "A GRU fails because it has no shift register", "explained so", "–", None,
        "not testable here", "The failure does not show here (T1), so there is nothing to explain.",
    ),
    Claim(
        "N5", "The policy transfers to the physical robot", "shown in a video", "–", None,
        "not testable here", "Needs the robot; the emulated one is walked by `pupper-deploy`.",
    ),
)  # fmt: skip


# --------------------------------------------------------------------------------- parts


def _of_kinds(policies: Policies, value: Callable[[PolicyEvidence], float]) -> dict[str, Estimate]:
    found = {k: over(policies, k, value) for k in KINDS}
    return {k: v for k, v in found.items() if np.isfinite(v.value)}


def _several(found: dict[str, Estimate], digits: int) -> str:
    return ", ".join(f"{_NAMES[k]} {v.value:,.{digits}f}" for k, v in found.items())


def _bounds(found: dict[str, Estimate]) -> Interval:
    known = {_NAMES[k]: [v.low, v.high] for k, v in found.items() if np.isfinite(v.low)}
    return known or None


def _range(values: np.ndarray, digits: int) -> str:
    """Smallest to largest."""
    return f"{np.nanmin(values):.{digits}f} to {np.nanmax(values):.{digits}f}"


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _errors(row: dict[str, Any], keys: Sequence[str]) -> str:
    return " / ".join(f"{row[k].value:.3f}" for k in keys)


def _hidden(evidence: PolicyEvidence, key: str) -> float:
    return evidence.orbits["hidden"][key] if evidence.orbits else float("nan")


def _acted(evidence: PolicyEvidence, key: str) -> list[float]:
    return evidence.orbits["actions"][key] if evidence.orbits else [float("nan")]


def _ablated(evidence: PolicyEvidence, kind: str, key: str) -> float:
    return next(r[key] for r in evidence.ablation if r["kind"] == kind)


def _crossing(evidence: PolicyEvidence) -> float:
    """Share of noise from which replay correlates no better than with zeros; NaN if none."""
    floor = _ablated(evidence, "zero", "correlation")
    noise = [(r["level"], r["correlation"]) for r in evidence.ablation if r["kind"] == "noise"]
    return next((level for level, r in noise if r < floor), float("nan"))


def _delayed(evidence: PolicyEvidence, extra_ms: float, key: str, mode: str = "fixed") -> float:
    return next(
        r[key] for r in evidence.delay if r["mode"] == mode and r["extra_delay_ms"] == extra_ms
    )


def _at_rate(evidence: PolicyEvidence, rate: float, key: str) -> float:
    return next(r[key] for r in evidence.rate if abs(r["rate_hz"] - rate) < 0.5)
