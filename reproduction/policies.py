"""The published claims about policies, one by one: what the paper says, what is found, a verdict.

Each claim is a function of the evidence (`reproduction.evidence`), declared with
`reproduction.evidence.claim`; `judge` evaluates all. A verdict follows from thresholds given in the
claim's `how`. "Not testable here" means that the evidence cannot decide it, and names what could.
They are about training, about the gait, about the deployed stacks, and those that need another
experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.interval import Interval, mean_of
from pupper_sysid.policies.analysis.autonomy import DELAYS_MS, NUDGE_M_S, PUSH_M_S
from pupper_sysid.policies.analysis.gait import SHORTEST_S, null_r2, sine_fit_r2, sine_frequency
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.walks.rollouts import ERRORS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from reproduction.evidence import (
    Claim,
    Finding,
    NotTestable,
    PolicyEvidence,
    Training,
    Verdict,
    bounds,
    claim,
    holds,
    of_kind,
    of_kinds,
    several,
    span,
)

Policies = Sequence[PolicyEvidence]
Trainings = Sequence[Training]

TAUGHT = frozenset({"G2", "G3", "P1", "P2", "B1", "B2", "X1", "X2", "B3"})
"""Claims that the imitated trot decides, whatever the architecture: its action follows from the
command and the last two actions alone, so rhythm, indifference to joints, and walking on through
delays are what imitation asks for."""


@claim(
    "T1", "GRU and Transformer fail where MLP and LSTM learn",
    "reward MLP 271 (with curriculum), LSTM 271, GRU 72, Transformer −85.8",
    "Reward per second over the last updates, from random weights, in the published task.",
)  # fmt: skip
def reward(trainings: Trainings) -> Finding:
    rewards = _trained(trainings, lambda t: t.reward)
    lstm, rest = _lstm_and_newer(rewards)
    return Finding(
        several(rewards, 2), bounds(rewards), _learned(trainings, min(rest) < 0.5 * lstm),
        f"Holds if one has less than half of the LSTM's. {_progress(trainings)}",
    )  # fmt: skip


@claim(
    "T2", "GRU and Transformer never settle", "action noise 0.07, 0.07, 0.25, 1.13",
    "Standard deviation of the exploration, which is learned, in the last updates.",
)  # fmt: skip
def exploration(trainings: Trainings) -> Finding:
    noise = _trained([t for t in trainings if t.learned_noise], lambda t: t.std)
    lstm, rest = _lstm_and_newer(noise)
    return Finding(
        several(noise, 2), bounds(noise), _learned(trainings, max(rest) > 2 * lstm),
        f"It begins at 1; holds if one has twice the LSTM's. {_progress(trainings)}",
    )  # fmt: skip


@claim(
    "T3", "The MLP needs a curriculum", "MLP yes, LSTM no",
    "Duration of an episode in the last updates, trained from random weights without one.",
)  # fmt: skip
def curriculum(trainings: Trainings) -> Finding:
    without = [t for t in trainings if not t.curriculum]
    lasted = _trained(without, lambda t: t.lasted_s, "mlp", "lstm")
    fails = lasted["mlp"].value < 0.5 * lasted["lstm"].value
    return Finding(
        f"{several(lasted, 1)} s", bounds(lasted), _learned(without, fails),
        f"Holds if the MLP's last half as long as the LSTM's. {_progress(without)}",
    )  # fmt: skip


@claim(
    "T4", "A Transformer trains at a fifth of the MLP's speed",
    "30,000, 15,000–20,000, 15,000–20,000, 5,500 steps/s on an RTX 4090",
    "Steps per second of the trainings, on the machine they ran on.",
)  # fmt: skip
def throughput(trainings: Trainings) -> Finding:
    speeds = _trained(trainings, lambda t: t.steps_per_s, "mlp", "transformer")
    slower = speeds["transformer"].value < 0.4 * speeds["mlp"].value
    return Finding(
        several(speeds, 0), bounds(speeds), holds(slower),
        "Ours trains the Transformer on sequences, not on a window per sample.",
    )  # fmt: skip


_TRAINING = (reward, exploration, curriculum, throughput)
_STAYS_UP = 0.5  # of an episode: less is a robot that falls


def _trained(
    trainings: Trainings, value: Callable[[Training], float], *needed: str
) -> dict[str, Interval]:
    """Per kind, of trainings from random weights."""
    if not trainings:
        raise NotTestable(
            "Policies that imitated a gait do not tell. Give trainings from random weights with "
            "--from-nothing."
        )
    return of_kinds(trainings, value, *needed)


def _learned(trainings: Trainings, holds_: bool) -> Verdict:
    """A verdict on trainings of which one at least has learned to stay up."""
    up = any(t.lasted_s > _STAYS_UP * t.episode_s for t in trainings)
    return holds(holds_) if up else "not testable here"


def _progress(trainings: Trainings) -> str:
    """How far trainings came."""
    samples = span([t.million_samples for t in trainings], 1)
    longest = max(t.lasted_s for t in trainings)
    return (
        f"After {samples} million samples robots stay up for {longest:.1f} s of "
        f"{trainings[0].episode_s:g} s at most."
    )


def _lstm_and_newer(values: dict[str, Interval]) -> tuple[float, list[float]]:
    """The LSTM's value, and those of GRU and Transformer."""
    rest = [v.value for k, v in values.items() if k in ("gru", "transformer")]
    if "lstm" not in values or not rest:
        raise NotTestable("Give runs of an LSTM and of a GRU or Transformer.")
    return values["lstm"].value, rest


_SMALLEST_SHIFT = 0.02  # of a cycle; below, the slope of late on early shifts is noise


def _delay_frequency(kind: str, id_: str, text: str, paper: str) -> Callable[[Policies], Claim]:
    @claim(
        id_, text, paper,
        "Replay of recorded observations whose joints are late by 0 to 320 ms, as published, and "
        "closed loop with later servos (`pupper-analyze delay`).",
    )  # fmt: skip
    def judged(policies: Policies) -> Finding:
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
            f"replay {span(values['replay'], 2)} Hz, amplitude "
            f"{', '.join(f'{s:.2f}' for s in sizes)} rad at {_list(DELAYS_MS)} ms; closed loop "
            f"{span(values['fixed'], 2)} Hz, {', '.join(f'{100 * u:.0f} %' for u in up)} up"
        )
        # of each policy: two that walk at rates of their own are not erratic for it
        constant = [max(rates) / min(rates) - 1 < 0.05 for rates in values["replay"].T]
        wanted = [c if kind == "lstm" else not c for c in constant]
        return Finding(
            ours, None, holds(all(wanted), any(wanted)),
            "Constant if within 5 % in replay; partly if some of several policies are so.",
        )  # fmt: skip

    return judged


@claim(
    "P1", "Three components explain more of the LSTM's cell than of the MLP's hidden layer",
    "60.4 % against 56.9 %",
    "PCA of states in replay at 0, +160, +320 ms together (`pupper-analyze attractor`).",
)  # fmt: skip
def components(policies: Policies) -> Finding:
    share = of_kinds(policies, lambda e: 100 * _orbit(e, "hidden", "explained_3"), "mlp", "lstm")
    return Finding(
        f"{several(share, 0)} %", bounds(share),
        holds(share["lstm"].value > share["mlp"].value),
        "Variance explained says little of order: see P2.",
    )  # fmt: skip


@claim(
    "P2", "Under delay the LSTM's orbit stays an ellipse, the MLP's collapses into bands",
    "shown, not measured",
    "Orbits of actions in replay: closure (0 closed, 1 unrelated) and area left at +320 ms.",
)  # fmt: skip
def orbit(policies: Policies) -> Finding:
    closed = of_kinds(policies, lambda e: _orbit(e, "actions", "closure"), "mlp", "lstm")
    area = of_kinds(policies, lambda e: _orbit(e, "actions", "area_ratio"), "mlp", "lstm")
    lstm = closed["lstm"].value < 0.3 and area["lstm"].value > 0.5
    mlp = closed["mlp"].value > 0.3 or area["mlp"].value < 0.5
    return Finding(
        f"closure {several(closed, 2)}; area left {several(area, 2)}", bounds(closed),
        holds(lstm and mlp, lstm or mlp), "An ellipse: closure below 0.3, half of the area left.",
    )  # fmt: skip


@claim(
    "B1", "Without its joints' state the LSTM keeps more of its gait",
    "correlation of actions LSTM 0.826, MLP 0.698",
    "Observations 12 to 47 zeroed: correlation of actions in replay, survival in closed loop.",
)  # fmt: skip
def zeros(policies: Policies) -> Finding:
    correlation = of_kinds(policies, lambda e: _ablated(e, "zero", "correlation"), "mlp", "lstm")
    up = of_kinds(policies, lambda e: 100 * _ablated(e, "zero", "survival"))
    return Finding(
        f"{several(correlation, 2)}; still up {several(up, 0)} %", bounds(correlation),
        holds(correlation["lstm"].value > correlation["mlp"].value + 0.02), "Holds if 0.02 more.",
    )  # fmt: skip


@claim(
    "B2", "Noise in the joints' state is worse than none from σ ≈ 0.2 on", "σ ≈ 0.2 in both",
    "Noise in shares of each channel's own deviation; where replay correlates as with zeros.",
)  # fmt: skip
def crossover(policies: Policies) -> Finding:
    share = of_kinds(policies, _crossing, "mlp", "lstm")
    close = all(0.1 < share[k].value < 0.4 for k in ("mlp", "lstm"))
    return Finding(
        f"{several(share, 2)} of a deviation", bounds(share), holds(close),
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
    def survival(e: PolicyEvidence) -> float:
        return 100 * float(np.mean([r.survival for r in e.terrain if r.ground != "flat"]))

    flat = [p for p in policies if p.ground == "flat"]
    if not {"mlp", "lstm"} <= {p.kind for p in flat}:
        raise NotTestable(
            "Give runs, with their run.yaml, of the MLP and of the LSTM on flat ground."
        )
    still_up = of_kinds(flat, survival, "mlp", "lstm")
    more = still_up["lstm"].value > still_up["mlp"].value + 10
    fine = still_up["lstm"].value > 90
    return Finding(
        f"{several(still_up, 0)} % still up", bounds(still_up), holds(more and fine, fine),
        "Holds if the LSTM has 10 points more; partly if it walks, but the MLP, too.",
    )  # fmt: skip


@claim(
    "C1", "It walks forward, backward, sideways and turns as commanded", "shown, not measured",
    "Speed along the command over the commanded speed (0 of a robot that fell), six directions, "
    "worst and mean.",
)  # fmt: skip
def directions(policies: Policies) -> Finding:
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
    bend = of_kinds(
        policies,
        lambda e: next(r.arc_rad_m.value for r in e.compliance if r.direction == "forward"),
    )
    return Finding(
        f"{several(bend, 2)} rad/m", bounds(bend),
        holds(all(v.value < -0.05 for v in bend.values())),
        "A symmetric robot in simulation; theirs had servos of its own.",
    )  # fmt: skip


@claim(
    "D1", "At 25 Hz the policy walks at half the gait frequency",
    "5.3 Hz trained, 2.8 Hz at 25 Hz",
    "The policy of 50 Hz at 25 Hz, closed loop.",
)  # fmt: skip
def half_rate(policies: Policies) -> Finding:
    up = of_kinds(policies, lambda e: 100 * _at_rate(e, 25.0, "survival"))
    if not any(v.value for v in up.values()):
        return Finding(f"still up {several(up, 0)} %", bounds(up), holds(False), "It falls.")
    slow = of_kinds(policies, lambda e: _at_rate(e, 25.0, "frequency_hz"))
    usual = of_kinds(policies, lambda e: _at_rate(e, 50.0, "frequency_hz"))
    ratios = [slow[k].value / usual[k].value for k in slow if k in usual]
    halves = bool(ratios) and 0.4 < float(np.mean(ratios)) < 0.65
    return Finding(
        f"{several(usual, 2)} Hz at 50 Hz, {several(slow, 2)} at 25 Hz; still up "
        f"{several(up, 0)} %",
        bounds(slow), holds(halves), "Halves if 0.4 to 0.65 of it.",
    )  # fmt: skip


@claim(
    "D2", "The LSTM is deployed with a larger action scale",
    "0.60 to 0.75 rad (0.45 in the code)",
    "Scale of what is sent, instead of the trained one; survival and forward error.",
)  # fmt: skip
def scale(policies: Policies) -> Finding:
    mine = of_kind(policies, "lstm")
    rows = {
        scale: [r for p in mine for r in p.scale if r.scale_rad == scale]
        for scale in sorted({r.scale_rad for r in mine[0].scale})
    }
    errors = {s: float(np.mean([r.mae_vx_m_s for r in walked])) for s, walked in rows.items()}
    ours = ", ".join(
        f"{s:g} rad: {100 * np.mean([r.survival for r in walked]):.0f} % up, {errors[s]:.3f} m/s"
        for s, walked in rows.items()
    )
    best = min(errors, key=lambda s: errors[s] if np.isfinite(errors[s]) else np.inf)
    return Finding(ours, None, holds(best >= 0.6), "Holds if 0.6 rad or more is best.")


_GAIT = (
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


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _orbit(evidence: PolicyEvidence, states: str, key: str) -> float:
    """A number of an orbit, of more delays that at the longest; NaN if there is none."""
    value = getattr(evidence.orbits[states], key) if evidence.orbits else float("nan")
    return value[-1] if isinstance(value, list) else value


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


Played = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
_NULL_DRAWS = 100


def judge(
    policies: Policies, played: Played, stacks: Sequence[dict[str, Any]], trainings: Trainings = ()
) -> list[Claim]:
    """All claims about policies and their training.

    `played` is a playback: per joint times [s], commands and positions [rad]. `stacks` are those of
    `reproduction.walks.compare_stacks`, closed loop first. All may be empty.
    """
    return [
        *(one(trainings) for one in _TRAINING),
        *(one(policies) for one in _GAIT),
        hardware_sine(played),
        closed_loop(stacks),
        *_counts(),
        *_BEYOND,
    ]


@claim(
    "G1", "On hardware the gait is 2.8 Hz on all joints, and nearer to a sine than simulated",
    "2.8 Hz; R² 0.77 on hardware, 0.40 in simulation",
    "Playback: frequency and sine fit of commands and of what the joints did, per joint, beside "
    "the R² that 95 % of noise as slow, but without a rhythm, stays below.",
)  # fmt: skip
def hardware_sine(played: Played) -> Finding:
    if not played:
        raise NotTestable("Give a playback or walk with --recordings.")
    rng = np.random.default_rng(0)  # the same page for the same recording
    fits = []  # of each joint that moves: rate, R² of positions, of commands, of noise
    for time, command, position in played.values():
        step, good = float(np.median(np.diff(time))), np.isfinite(position)
        if len(time) * step < SHORTEST_S or not good.any():
            continue
        moved = np.interp(time, time[good], position[good])[:, None]
        sent = command[:, None]
        if min(moved.std(), sent.std()) < 1e-3:
            continue
        rate = sine_frequency(moved, step)
        noise = np.quantile(null_r2(moved, step, rng, _NULL_DRAWS), 0.95)
        command_r2 = sine_fit_r2(sent, step, sine_frequency(sent, step))[0]
        fits.append((rate, sine_fit_r2(moved, step, rate)[0], command_r2, noise))
    if not fits:
        raise NotTestable(
            f"The trials are shorter than {SHORTEST_S:g} s, or nothing was read or moves in them."
        )
    rhythmic = np.array([fit for fit in fits if fit[1] > fit[3]])
    if not len(rhythmic):
        _, moved_r2, command_r2, noise = np.mean(fits, axis=0)
        raise NotTestable(
            f"In no joint does a sine explain more than it explains of noise: R² {moved_r2:.2f} of "
            f"what the servos did, {command_r2:.2f} of commands, up to {noise:.2f} of noise. Give "
            "a recording of a steadier gait."
        )
    _, moved_r2, command_r2, noise = rhythmic.mean(axis=0)
    rates = rhythmic[:, 0]
    ours = (
        f"{np.median(rates):.2f} Hz in the middle of the {len(rates)} joints of {len(fits)} that "
        f"have a rhythm ({rates.min():.2f} to {rates.max():.2f}); R² of commands {command_r2:.2f}, "
        f"of what the servos made of them {moved_r2:.2f}, of noise up to {noise:.2f}"
    )
    uniform = len(rates) == len(fits) and np.ptp(rates) < 0.1
    nearer = moved_r2 > command_r2 + 0.02
    return Finding(
        ours, {"joints": Interval(*map(float, (np.median(rates), rates.min(), rates.max())))},
        holds(False, bool(nearer or uniform)), "Same servos in both; uniform if within 0.1 Hz.",
    )  # fmt: skip


@claim(
    "D3", "Closing the loop on the encoders is worse than a servo model's prediction",
    "worse, not measured",
    "One emulated robot walked by both under the same commands; difference round by round.",
)  # fmt: skip
def closed_loop(stacks: Sequence[dict[str, Any]]) -> Finding:
    other = next((s for s in stacks if "less_mae_vx_m_s" in s), None)
    if other is None:
        raise NotTestable("Give a servo model with --servo.")
    ours = "; ".join(
        f"{row['stack']} {' / '.join(f'{row[k].value:.3f}' for k in ERRORS)}, "
        f"falls {100 * row['falls']:.0f} %"
        for row in (stacks[0], other)
    )
    gains: dict[str, Interval] = {k: other[f"less_{k}"] for k in ERRORS}
    better = all(g.high < 0 for g in gains.values())
    worse = all(g.low > 0 for g in gains.values())
    return Finding(
        ours, gains, holds(better, not worse),
        "Intervals are of the prediction's error less the encoders'; partly if they are not all on "
        "one side of 0.",
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
            None, "does not hold here", "Counted in `policies.deploy.stacks` and `servo_models`.",
        ),
        Claim(
            "D5", "Of 60 observations 15 are measured in the MLP stack, 6 in the LSTM stack",
            "15/60, 6/60 (15 + 36 + 3 = 54)",
            "both: 6 measured (IMU), 36 predicted, 12 of its own last action, 3 of the command, "
            "3 of the trunk's speed that is not measured; closed loop: 42 measured",
            None, "holds partly", "Counted in `policies.deploy.controller`.",
        ),
    ]  # fmt: skip


_BEYOND = tuple(
    Claim(id_, text, paper, "–", None, "not testable here", why)
    for id_, text, paper, why in (
        (
            "N1", "Training takes 12 to 24 GiB of GPU memory", "~12, 12–24, 12–24, ~24 GiB",
            "Ours of half as many robots each (2,048) took 2 GiB, eight of them on one GPU.",
        ),
        (
            "N2", "The robot costs $300, a servo $8 instead of $200–500", "$300; $8",
            "Prices are the shops'.",
        ),
        ("N3", "Biological delays are as long", "100 to 160 ms", "Needs animals."),
        (
            "N4", "A GRU fails because it has no shift register", "explained so",
            "Whether it fails is not decided (T1), so there is nothing to explain.",
        ),
    )
)  # fmt: skip
