"""The published claims about policies, one by one: what the paper says, what is found, a verdict.

Each claim is a function of the evidence (`reproduction.evidence`), declared with
`reproduction.claims.claim`; `judge` evaluates all. A verdict follows from thresholds given in the
claim's `how`. "Not testable here" means that the evidence cannot decide it, and names what could.
Claims about training and about the gait are in modules of their own; here are those about the
deployed stacks, and those that need another experiment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.interval import Interval
from pupper_sysid.policies.analysis.rhythm import (
    SHORTEST_S,
    null_r2,
    sine_fit_r2,
    sine_frequency,
)
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.policies.walks.tracking import ERRORS
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from reproduction import gait as gait_claims
from reproduction import training as training_claims
from reproduction.claims import Claim, Finding, NotTestable, claim, holds
from reproduction.evidence import PolicyEvidence

Played = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
_NULL_DRAWS = 100


def judge(
    policies: Sequence[PolicyEvidence], played: Played, stacks: Sequence[dict[str, Any]]
) -> list[Claim]:
    """All claims about policies.

    Parameters
    ----------
    policies : sequence of PolicyEvidence
    played : dict of str to (ndarray, ndarray, ndarray)
        Of a playback, per joint: times [s], commands and positions [rad]; may be empty.
    stacks : sequence of dict
        Of `reproduction.walks.compare_stacks`, closed loop first; may be empty.
    """
    about_policies = (*training_claims.CLAIMS, *gait_claims.CLAIMS)
    return [
        *(one(policies) for one in about_policies),
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
    """G1."""
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
    """D3."""
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
            "Training runs on processors; needs a GPU of that kind.",
        ),
        (
            "N2", "The robot costs $300, a servo $8 instead of $200–500", "$300; $8",
            "Prices are the shops'.",
        ),
        ("N3", "Biological delays are as long", "100 to 160 ms", "Needs animals."),
        (
            "N4", "A GRU fails because it has no shift register", "explained so",
            "The failure does not show here (T1), so there is nothing to explain.",
        ),
    )
)  # fmt: skip
