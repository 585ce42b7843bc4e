"""Choice of the trials that narrow a joint's intervals most: greedy optimal design.

`propose` adds, one after the other, the trial that lowers the criterion most: the logarithm of the
dead time's expected interval, and with a smaller weight those of the other parameters. The
interval is the hull over the hypotheses that the recording cannot tell apart, so a trial may also
help by telling them apart. Where the servo is unknown, the criterion is its mean over servos drawn
from the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pupper_sysid.common.interval import LEVEL, Interval
from pupper_sysid.common.results import Result
from pupper_sysid.sysid.fit.posterior import STEPPING_SD_S
from pupper_sysid.sysid.plan.candidates import Candidate, Setup, candidates, trial_seconds
from pupper_sysid.sysid.plan.information import (
    Hypothesis,
    Noise,
    Response,
    pooled,
    respond,
    separation,
)

CLEAR_NATS = 5.0
"""Difference in log-likelihood from which two models count as told apart."""

SURE_NATS = 2 * CLEAR_NATS
"""What a plan aims at: the nats of a fit change with the next recording."""

DEAD_TIME = "dead_time_s"

SHORTEST_S = 3.0
"""Shortest trial without its lead-in [s]: a poll's phase needs as long."""

_OTHERS = 0.25  # weight of the other parameters' mean logarithm beside the dead time's
_FOLLOWED = 0.6  # of the command; `sysid.lag.lag_budget` leaves out what is below half
_MOST_OF_A_TONE = 2  # no model is right at every tone: a plan does not rest on one
_Z = float(ndtri((1 + LEVEL) / 2))

LEAST_HALF_WIDTH_S = _Z * STEPPING_SD_S
"""Half of a dead time's interval that no number of readings narrows [s]: the model's time step."""

_UNSEEN_SD = float(np.log(2)) / _Z  # of a logarithm: an interval from half to twice the value
_PRIOR_SHARE = 0.7  # of the prior's standard deviation: beyond, the prior decides
_TELLS = 0.1  # share of `CLEAR_NATS` that makes telling models apart a trial's purpose
_WORDS = {
    "dead_time_s": "dead time",
    "effort_rad_s2": "effort limit",
    "velocity_limit_rad_s": "speed limit",
    "no_load_speed_rad_s": "no-load speed",
}
_HELPS = 0.02  # a trial without which every interval stays within this share helps nothing


@dataclass(frozen=True)
class Servo:
    """One servo as it may be: its hypotheses, the likeliest first, and its readings' noise.

    Attributes
    ----------
    hypotheses : tuple of Hypothesis
    noise : Noise
    nats : tuple of float
        By how much the log-likelihood of each is below that of the best.
    inflation : float
        Variance of the fit's own interval over that of the information; at least 1. New trials
        are counted with it.
    doubt_s : float
        By how much all readings may be dated wrong: no trial reduces it.
    """

    hypotheses: tuple[Hypothesis, ...]
    noise: Noise
    nats: tuple[float, ...] = (0.0,)
    inflation: float = 1.0
    doubt_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PlannedTrial(Result):
    """One trial of a plan.

    Attributes
    ----------
    joint, kind : str
    frequency_hz, amplitude_rad : float
    duration_s : float
        Without the lead-in.
    purpose : str
        What it narrows most, or "structure" if it tells two candidate models apart.
    """

    joint: str
    kind: str
    frequency_hz: float
    amplitude_rad: float
    duration_s: float
    purpose: str


@dataclass(frozen=True, kw_only=True)
class Prediction(Result):
    """Interval of one quantity of a joint, now and after the planned sweep.

    Attributes
    ----------
    joint, quantity : str
    now, after : Interval
        The value stays; the ends are the expected ones.
    """

    joint: str
    quantity: str
    now: Interval
    after: Interval


@dataclass(frozen=True, kw_only=True)
class JointPlan(Result):
    """What to record of one joint.

    Attributes
    ----------
    trials : tuple of PlannedTrial
        Slowest first.
    predictions : tuple of Prediction
    notes : tuple of str
        What no trial within the limits can show.
    """

    trials: tuple[PlannedTrial, ...]
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]


def propose(joint: str, servos: Sequence[Servo], setup: Setup, seconds: float) -> JointPlan:
    """Trials of one joint, `seconds` long in all, and the intervals to expect.

    Parameters
    ----------
    joint : str
    servos : sequence of Servo
        What it may be: one fitted servo, or several drawn from the prior.
    setup : Setup
    seconds : float
        Recorded time, lead-ins included.
    """
    count = max(1, int(seconds / trial_seconds(SHORTEST_S) + 1e-9))
    duration = round(seconds / count - trial_seconds(0.0), 3)
    choice = candidates(setup, max(duration, SHORTEST_S))
    worlds = [_World(servo, choice, setup.seen) for servo in servos]
    tones = [(c.kind, c.frequency_hz) for c in choice]
    usable = [k for k in range(len(choice)) if _followed(worlds, choice[k], k)]
    chosen: list[int] = []
    for _ in range(count):
        used = [tones[k] for k in chosen]
        left = [k for k in usable if used.count(tones[k]) < _MOST_OF_A_TONE] or usable
        chosen.append(min(left, key=lambda k: _criterion(worlds, [*chosen, k])))
    purposes = [_purpose(worlds, chosen[:n], chosen[n]) for n in range(count)]
    trials = tuple(
        PlannedTrial(
            joint=joint,
            kind=choice[k].kind,
            frequency_hz=choice[k].frequency_hz,
            amplitude_rad=choice[k].amplitude_rad,
            duration_s=choice[k].duration_s,
            purpose=purpose,
        )
        for k, purpose in sorted(
            zip(chosen, purposes, strict=True),
            key=lambda pair: (choice[pair[0]].kind != "sine", choice[pair[0]].frequency_hz),
        )
    )
    predictions = tuple(_predictions(joint, worlds[0], chosen)) if len(worlds) == 1 else ()
    notes = tuple(_notes(joint, worlds[0], choice, chosen)) if len(worlds) == 1 else ()
    return JointPlan(trials=trials, predictions=predictions, notes=notes)


def now(servo: Servo) -> Interval:
    """Interval of the dead time [s] before any trial."""
    return _World(servo, (), 1.0).dead_time_s([])


class _World:
    """All candidates under the hypotheses of one servo."""

    def __init__(self, servo: Servo, choice: Sequence[Candidate], seen: float):
        self.servo = servo
        self.responses = [
            [respond(h, c.run, servo.noise, seen) for c in choice] for h in servo.hypotheses
        ]
        self.information = [[r.information for r in own] for own in self.responses]
        self.tones = [(c.kind, c.frequency_hz) for c in choice]

    def covariance(self, which: int, chosen: Sequence[int]) -> NDArray[np.float64]:
        """Expected covariance of a hypothesis' fitted coordinates after `chosen`."""
        hypothesis = self.servo.hypotheses[which]
        said = pooled((self.tones[k], self.information[which][k]) for k in chosen)
        known = hypothesis.known + said / self.servo.inflation
        return np.asarray(np.linalg.inv(known), float)

    def nats(self, which: int, chosen: Sequence[int]) -> float:
        """Expected preference for the first hypothesis to `which` after `chosen`."""
        if which == 0 or not chosen:
            return self.servo.nats[which]
        pair = [self._picked(0, chosen), self._picked(which, chosen)]
        known = [self.servo.hypotheses[k].known for k in (0, which)]
        ways = separation(pair[0], pair[1], known[1]), separation(pair[1], pair[0], known[0])
        return abs(self.servo.nats[which] - self.servo.nats[0]) + min(ways) / self.servo.inflation

    def dead_time_s(self, chosen: Sequence[int], smooth: bool = False) -> Interval:
        """Expected interval [s]: the hull over the hypotheses that are not told apart.

        With `smooth` its ends move from the hull to the first hypothesis' own interval as the nats
        grow to `SURE_NATS`, so that every trial that tells the two apart counts.
        """
        own = self.interval(0, 0, chosen)
        low, high = own.low, own.high
        for which in range(1, len(self.servo.hypotheses)):
            nats = self.nats(which, chosen)
            share = 1.0 - nats / SURE_NATS if smooth else float(nats <= CLEAR_NATS)
            if share > 0:
                rival = self.interval(which, 0, chosen)
                low = min(low, own.low + share * (rival.low - own.low))
                high = max(high, own.high + share * (rival.high - own.high))
        doubt = self.servo.doubt_s
        return Interval(own.value, max(low - doubt, 0.0), high + doubt)

    def interval(self, which: int, coordinate: int, chosen: Sequence[int]) -> Interval:
        """Expected interval of one parameter under one hypothesis, in its own unit."""
        hypothesis = self.servo.hypotheses[which]
        parameter = hypothesis.model.parameters[coordinate]
        sd = float(np.sqrt(self.covariance(which, chosen)[coordinate, coordinate]))
        value = float(hypothesis.values[coordinate])
        if coordinate == 0:  # in seconds, with the error that no reading reduces
            reach = _Z * float(np.hypot(value * sd, STEPPING_SD_S))
            return Interval(value, max(value - reach, 0.0), value + reach)
        centre = float(parameter.encode(value))
        box = float(parameter.encode(parameter.low)), float(parameter.encode(parameter.high))
        ends = np.clip([centre - _Z * sd, centre + _Z * sd], *box)
        return Interval(value, *(float(parameter.decode(e)) for e in ends))

    def _picked(self, which: int, chosen: Sequence[int]) -> list[Response]:
        return [self.responses[which][k] for k in chosen]


def _followed(worlds: Sequence[_World], candidate: Candidate, number: int) -> bool:
    """Whether most servos follow a tone at all: where a limit clips it, `delay` leaves it out."""
    if candidate.kind != "sine":
        return True
    commanded = np.std(candidate.run.command[len(candidate.run.command) // 4 :])
    moved = [
        min(np.std(own[number].position_rad[len(own[number].position_rad) // 4 :])
            for own in world.responses)
        for world in worlds
    ]  # fmt: skip
    return bool(np.median(moved) > _FOLLOWED * commanded)


def _criterion(worlds: Sequence[_World], chosen: Sequence[int]) -> float:
    """What a plan minimises: mean over the servos of the logarithms of expected widths."""
    total = 0.0
    for world in worlds:
        dead = world.dead_time_s(chosen, smooth=True)
        floor = 2 * (LEAST_HALF_WIDTH_S + world.servo.doubt_s)
        # without the part that no reading reduces, or nothing would seem to help near it
        width = np.sqrt(max((dead.high - dead.low) ** 2 - floor**2, 1e-12))
        variance = np.diag(world.covariance(0, chosen))[1:-1]
        total += float(np.log(width) + _OTHERS * np.mean(0.5 * np.log(variance)))
    return total / len(worlds)


def _purpose(worlds: Sequence[_World], before: Sequence[int], one: int) -> str:
    """What a trial is for: the quantities that it narrows most after those chosen before it."""
    chosen = [*before, one]
    names = [p.name for p in worlds[0].servo.hypotheses[0].model.parameters[:-1]]
    gain, told = np.zeros(len(names)), 0.0
    for world in worlds:
        with_, without = (np.diag(world.covariance(0, c)) for c in (chosen, before))
        gain += np.log(without / with_)[:-1]
        for which in range(1, len(world.servo.hypotheses)):
            least, most = (min(world.nats(which, c), CLEAR_NATS) for c in (before, chosen))
            told += (most - least) / CLEAR_NATS
    if told > _TELLS * len(worlds):
        return "structure"
    order = sorted(range(len(names)), key=lambda k: (k != 0, -gain[k]))
    most = [names[k] for k in order if gain[k] >= 0.6 * gain.max()]
    return ", ".join(word(name) for name in most[:2])


def word(parameter: str) -> str:
    """Name of a parameter in a sentence.

    Examples
    --------
    >>> word("velocity_limit_rad_s"), word("dead_time_s")
    ('speed limit', 'dead time')
    """
    return _WORDS.get(parameter, parameter.split("_")[0])


def _predictions(joint: str, world: _World, chosen: Sequence[int]) -> list[Prediction]:
    found = [
        Prediction(
            joint=joint, quantity=DEAD_TIME, now=world.dead_time_s([]),
            after=world.dead_time_s(chosen),
        )
    ]  # fmt: skip
    for k, parameter in enumerate(world.servo.hypotheses[0].model.parameters[1:-1], 1):
        now, after = world.interval(0, k, []), world.interval(0, k, chosen)
        found.append(Prediction(joint=joint, quantity=parameter.name, now=now, after=after))
    return found


def _notes(
    joint: str, world: _World, choice: Sequence[Candidate], chosen: Sequence[int]
) -> list[str]:
    """What stays unknown, and whether any of the candidates alone could show it."""
    found = []
    count = len(chosen)
    sd = np.sqrt(np.diag(world.covariance(0, chosen)))
    best = np.min(
        [np.sqrt(np.diag(world.covariance(0, [k] * count))) for k in range(len(choice))], axis=0
    )
    for k, parameter in enumerate(world.servo.hypotheses[0].model.parameters[1:-1], 1):
        name = word(parameter.name)
        most = min(_UNSEEN_SD, _PRIOR_SHARE * parameter.prior_sd)
        if best[k] > most:
            found.append(
                f"{joint}: {name} cannot be seen at any amplitude within the limits "
                f"(excursion {max(c.amplitude_rad for c in choice):g} rad): its interval would "
                f"span a factor of {np.exp(2 * _Z * best[k]):.1f} at best."
            )
        elif sd[k] > most:
            found.append(
                f"{joint}: {name} would still span a factor of {np.exp(2 * _Z * sd[k]):.1f}; more "
                "seconds would narrow it."
            )
    for which in range(1, len(world.servo.hypotheses)):
        nats = world.nats(which, chosen)
        if nats < CLEAR_NATS:
            names = [world.servo.hypotheses[i].model.name for i in (0, which)]
            found.append(
                f"{joint}: {names[0]} and {names[1]} would still explain the readings alike "
                f"(log Bayes factor {nats:.1f}, below {CLEAR_NATS:g}): the dead time's interval "
                "covers both."
            )
    if world.servo.doubt_s > 0:
        found.append(
            f"{joint}: the dates of the readings are in doubt by ± "
            f"{1e3 * world.servo.doubt_s:.1f} ms, and so is the dead time, whatever is recorded. "
            "A longer trial may show the poll; a header line `# readings` settles live readings."
        )
    now, after = world.dead_time_s([]), world.dead_time_s(chosen)
    if (after.high - after.low) > (1 - _HELPS) * (now.high - now.low):
        found.append(
            f"{joint}: no trial within the limits narrows the dead time's interval of "
            f"± {500 * (now.high - now.low):.1f} ms; ± {1e3 * LEAST_HALF_WIDTH_S:.1f} ms of it "
            "are the model's time step."
        )
    return found
