"""Choice of the trials that narrow a joint's intervals most: greedy optimal design.

`propose` adds, one after the other, the trial that lowers the criterion most: the logarithm of the
dead time's expected interval, and with a smaller weight those of the other parameters. The
interval is the hull over the hypotheses that the recording cannot tell apart, so a trial may also
help by telling them apart. Where the servo is unknown, the criterion is its mean over servos drawn
from the prior.

A trial is simulated under the present fit. Its readings y have the sensitivities
J = ∂y/∂θ to the fitted coordinates θ (logarithms of the parameters) and an uncorrelated error of
variance floor² + (speed · jitter)²: commands and polls come early or late at random, which moves a
fast joint further than a slow one. With W the inverse variances, JᵀWJ is what the trial says about
θ; its inverse, with what is known already, is the covariance to expect (Fedorov, Theory of Optimal
Experiments, 1972). One shift in time of all readings of a tone is a nuisance coordinate: no model
is exact at every tone, and the dates of a polled bus are not. So no tone can say everything.

Two models that fit equally well are told apart by a trial in which they still differ after each has
been fitted again (T-optimality: Atkinson and Fedorov, Biometrika 62, 1975).

`candidates` are the trials that a plan can choose from: tones and square waves within a joint's
margin, the speed limit and the loop's rate, each on the physics clock as the recorder and the guard
would send it and a polled bus would read it.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from scipy.optimize import nnls

from pupper_sysid.common.border import Part
from pupper_sysid.common.interval import HALF_WIDTH_SD, Interval
from pupper_sysid.common.results import Result
from pupper_sysid.common.signals import robust_sd
from pupper_sysid.hardware.safety.monitor import GuardLimits
from pupper_sysid.servo_models.calibration.quantity import Number
from pupper_sysid.sysid.feedback.poll_lattice import Readings
from pupper_sysid.sysid.fit.posterior import PHASE_SD_S, STEPPING_SD_S
from pupper_sysid.sysid.fit.run import Run, at_steps, free_run, prepare, residuals
from pupper_sysid.sysid.fit.structure import Structure
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.sweep import excitation
from pupper_sysid.sysid.sweep.excitation import HIGHEST_HZ, PLANS_S

LARGEST_RAD = 0.3  # largest excursion of a plan by default [rad]

Kind = Literal["sine", "square"]

_TONES_HZ = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0)
_TONES_RAD = (0.05, 0.08, 0.12, 0.2, 0.3)
_SQUARES_HZ = (0.7, 1.2, 2.0, 3.0)
_SQUARES_RAD = (0.05, 0.1, 0.2)
_HARDEST_SQUARE_RAD_HZ = 0.25  # amplitude · frequency: gentler on gears than what a gait does
_COMMANDS_A_PERIOD = 4  # below, a tone is held so coarsely that it is another motion
_STEPS_OF_A_READING = 4  # a motion of fewer quantisation steps drowns in them
_POLL_PHASE = 0.3


@dataclass(frozen=True)
class Setup:
    """What a joint is recorded with."""

    loop_period_s: float = excitation.LOOP_PERIOD_S
    """Time between commands."""
    poll_period_s: float = 1 / excitation.POLL_RATE_HZ
    """Time between two polls of the servo; 0 where readings are live."""
    loss: float = 0.42
    """Share of the polls that fail."""
    quantum_rad: float = 0.0057
    """Quantisation step of a reading."""
    speed_limit_rad_s: float = 7.5
    """Of the servo, by its data sheet."""
    margin_rad: float = LARGEST_RAD
    """Largest excursion to either side of the start pose."""

    @property
    def poll_rate_hz(self) -> float:
        """Polls per second, 0 where readings are live."""
        return 1 / self.poll_period_s if self.poll_period_s > 0 else 0.0

    @property
    def seen(self) -> float:
        """Share of the instants of `read_times` that bring a new reading."""
        if self.poll_period_s >= self.loop_period_s:
            return 1 - self.loss
        each = self.loop_period_s / max(self.poll_period_s, 1e-9)
        return 1 - self.loss**each

    def read_times(self, duration_s: float) -> NDArray[np.float64]:
        """When a trial's readings are measured [s]: at the polls, or the loop's reads."""
        period = max(self.poll_period_s, self.loop_period_s)
        return np.arange(_POLL_PHASE * period, duration_s, period)


@dataclass(frozen=True)
class Candidate:
    """A trial to choose."""

    kind: Kind
    frequency_hz: float
    amplitude_rad: float
    duration_s: float
    """Without the lead-in."""
    run: Run
    """Its command, and the times of its readings."""


def candidates(setup: Setup, duration_s: float) -> list[Candidate]:
    """Trials of `duration_s` without the lead-in [s] that a joint may execute."""
    trials = []
    for kind, frequency, amplitude in _choices(setup, duration_s):
        planned = excitation.plan(
            kind, ["joint"], [frequency], amplitude, duration_s, setup.loop_period_s,
            setup.speed_limit_rad_s, setup.poll_rate_hz,
        )  # fmt: skip
        run = recorded(planned.trials[0], setup)
        trials.append(Candidate(kind, frequency, amplitude, duration_s, run))
    return trials


def recorded(trial: excitation.TrialPlan, setup: Setup) -> Run:
    """A trial on the physics clock, as the recorder and the guard would send it; it reads zeros."""
    sent_s = np.arange(0.0, trial.duration_s, setup.loop_period_s)
    wanted = trial.offset(sent_s)
    farthest = GuardLimits().speed_rad_s * setup.loop_period_s
    command, last = np.empty_like(wanted), 0.0
    for k, goal in enumerate(wanted):
        last += float(np.clip(goal - last, -farthest, farthest))
        command[k] = last
    read_s = setup.read_times(trial.duration_s)
    nothing = np.zeros(len(sent_s))
    as_trial = Trial(
        trial.joints[0], 0, trial.frequency_hz, sent_s, sent_s, command, nothing, None, 0.0
    )
    return prepare(
        as_trial, Readings(np.arange(len(read_s)), read_s, np.zeros(len(read_s)), nothing, 0.0)
    )


def _choices(setup: Setup, duration_s: float) -> Iterator[tuple[Kind, float, float]]:
    """Kind, frequency [Hz] and amplitude [rad]."""
    rates = (1 / setup.loop_period_s, setup.poll_rate_hz)
    highest = min(excitation.HIGHEST_HZ, 1 / (_COMMANDS_A_PERIOD * setup.loop_period_s))
    largest = min(setup.margin_rad, LARGEST_RAD)
    least = _STEPS_OF_A_READING * setup.quantum_rad
    pace = excitation.Pace(setup.speed_limit_rad_s)
    shapes: tuple[tuple[Kind, Sequence[float], Sequence[float], Any], ...] = (
        ("sine", _TONES_HZ, _TONES_RAD, pace.largest_rad),
        ("square", _SQUARES_HZ, _SQUARES_RAD, lambda hz: _HARDEST_SQUARE_RAD_HZ / hz),
    )
    for kind, frequencies, amplitudes, largest_at in shapes:
        for wanted in frequencies:
            frequency = excitation.off_harmonics(wanted, rates, duration_s)
            if frequency <= highest and frequency * duration_s >= 1:
                most = min(largest, float(largest_at(frequency)))
                most = float(np.floor(1e3 * most + 1e-9) / 1e3)
                for amplitude in sorted({a for a in amplitudes if a < 0.9 * most} | {most}):
                    if amplitude >= least:
                        yield kind, frequency, amplitude


def trial_seconds(duration_s: float) -> float:
    """Recorded seconds of a trial of `duration_s`: with its lead-in."""
    return excitation.LEAD_IN_S + duration_s


CLEAR_NATS = 5.0  # difference in log-likelihood from which two models count as told apart
SURE_NATS = 2 * CLEAR_NATS  # what a plan aims at: the nats of a fit change with the next recording

DEAD_TIME = "dead_time_s"

SHORTEST_S = 3.0  # shortest trial without its lead-in [s]: a poll's phase needs as long
_OTHERS = 0.25  # weight of the other parameters' mean logarithm beside the dead time's
_FOLLOWED = 0.6  # of the command; `sysid.lag.lag_budget` leaves out what is below half
_MOST_OF_A_TONE = 2  # no model is right at every tone: a plan does not rest on one

LEAST_HALF_WIDTH_S = HALF_WIDTH_SD * STEPPING_SD_S
"""Half of a dead time's interval that no number of readings narrows [s]: the model's time step."""

# of a logarithm: an interval from half to twice the value
_UNSEEN_SD = float(np.log(2)) / HALF_WIDTH_SD
_PRIOR_SHARE = 0.7  # of the prior's standard deviation: beyond, the prior decides
_TELLS = 0.1  # share of `CLEAR_NATS` that makes telling models apart a trial's purpose
_WORDS = {
    "dead_time_s": "dead time", "effort_rad_s2": "effort limit",
    "velocity_limit_rad_s": "speed limit", "no_load_speed_rad_s": "no-load speed",
}  # fmt: skip
_HELPS = 0.02  # a trial without which every interval stays within this share helps nothing


@dataclass(frozen=True)
class Servo:
    """One servo as it may be: its hypotheses, the likeliest first, and its readings' noise."""

    hypotheses: tuple[Hypothesis, ...]
    noise: Noise
    nats: tuple[float, ...] = (0.0,)
    """By how much the log-likelihood of each is below that of the best."""
    inflation: float = 1.0
    """Variance of the fit's own interval over that of the information; at least 1. New trials are
    counted with it."""
    doubt_s: float = 0.0
    """By how much all readings may be dated wrong: no trial reduces it."""


class PlannedTrial(Part):
    """One trial of a plan, as its file has it."""

    joint: str
    """Joint that moves."""
    kind: Kind
    """Shape of the motion."""
    frequency_hz: Annotated[Number, Field(gt=0, le=HIGHEST_HZ)]
    """Frequency [Hz]."""
    amplitude_rad: Annotated[Number, Field(gt=0, le=float(np.pi))]
    """Largest excursion from the start pose [rad]."""
    duration_s: Annotated[Number, Field(gt=0, le=PLANS_S[1])]
    """Duration without the lead-in [s]."""
    purpose: str = ""
    """What it narrows most, or "structure" if it tells two candidate models apart."""


class Ends(Part):
    """A value with its 90 % interval, from an `Interval` or from a file."""

    model_config = ConfigDict(from_attributes=True)

    value: Number
    """The number, in the unit at the end of the quantity's name."""
    low: Number
    """Lower end."""
    high: Number
    """Upper end."""


class Prediction(Part):
    """Interval of one quantity, now and after the sweep, as the plan's file has it."""

    joint: str
    """Its joint."""
    quantity: str
    """Its name, which ends in the unit."""
    now: Ends
    """Interval at present."""
    after: Ends
    """Interval to expect: the value stays."""


@dataclass(frozen=True, kw_only=True)
class JointPlan(Result):
    """What to record of one joint."""

    trials: tuple[PlannedTrial, ...]
    """Slowest first."""
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]
    """What no trial within the limits can show."""


def propose(joint: str, servos: Sequence[Servo], setup: Setup, seconds: float) -> JointPlan:
    """Trials of one joint, `seconds` long in all (lead-ins too), and the intervals to expect.

    `servos` is what the joint may be: one fitted servo, or several drawn from the prior.
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
        allowed = [k for k in usable if used.count(tones[k]) < _MOST_OF_A_TONE] or usable
        chosen.append(min(allowed, key=lambda k: _criterion(worlds, [*chosen, k])))
    purposes = [_purpose(worlds, chosen[:n], chosen[n]) for n in range(count)]
    trials = [
        PlannedTrial(
            joint=joint, kind=c.kind, frequency_hz=c.frequency_hz, amplitude_rad=c.amplitude_rad,
            duration_s=c.duration_s, purpose=purpose,
        )
        for c, purpose in zip([choice[k] for k in chosen], purposes, strict=True)
    ]  # fmt: skip
    trials = tuple(sorted(trials, key=lambda t: (t.kind != "sine", t.frequency_hz)))
    if len(worlds) > 1:
        return JointPlan(trials=trials, predictions=(), notes=())
    (world,) = worlds
    expected = {DEAD_TIME: (world.dead_time_s([]), world.dead_time_s(chosen))}
    for k, parameter in enumerate(servos[0].hypotheses[0].model.parameters[1:-1], 1):
        expected[parameter.name] = world.interval(0, k, []), world.interval(0, k, chosen)
    predictions = tuple(
        Prediction(joint=joint, quantity=name, now=Ends.model_validate(now),
                   after=Ends.model_validate(after))
        for name, (now, after) in expected.items()
    )  # fmt: skip
    notes = tuple(_notes(joint, world, choice, chosen))
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
        self.information = [[r.information for r in responses] for responses in self.responses]
        self.tones = [(c.kind, c.frequency_hz) for c in choice]

    def covariance(self, which: int, chosen: Sequence[int]) -> NDArray[np.float64]:
        """Expected covariance of a hypothesis' fitted coordinates after `chosen`."""
        hypothesis = self.servo.hypotheses[which]
        gained = pooled((self.tones[k], self.information[which][k]) for k in chosen)
        known = hypothesis.known + gained / self.servo.inflation
        return np.asarray(np.linalg.inv(known), float)

    def nats(self, which: int, chosen: Sequence[int]) -> float:
        """Expected preference for the first hypothesis to `which` after `chosen`."""
        if which == 0 or not chosen:
            return self.servo.nats[which]
        pair = [[self.responses[n][k] for k in chosen] for n in (0, which)]
        known = [self.servo.hypotheses[k].known for k in (0, which)]
        ways = separation(pair[0], pair[1], known[1]), separation(pair[1], pair[0], known[0])
        return abs(self.servo.nats[which] - self.servo.nats[0]) + min(ways) / self.servo.inflation

    def dead_time_s(self, chosen: Sequence[int], smooth: bool = False) -> Interval:
        """Expected interval [s]: the hull over the hypotheses that are not told apart.

        With `smooth` its ends move from the hull to the first hypothesis' own interval as the nats
        grow to `SURE_NATS`, so that every trial that tells the two apart counts.
        """
        now = self.interval(0, 0, chosen)
        low, high = now.low, now.high
        for which in range(1, len(self.servo.hypotheses)):
            nats = self.nats(which, chosen)
            share = 1.0 - nats / SURE_NATS if smooth else float(nats <= CLEAR_NATS)
            if share > 0:
                rival = self.interval(which, 0, chosen)
                low = min(low, now.low + share * (rival.low - now.low))
                high = max(high, now.high + share * (rival.high - now.high))
        doubt = self.servo.doubt_s
        return Interval(now.value, max(low - doubt, 0.0), high + doubt)

    def interval(self, which: int, coordinate: int, chosen: Sequence[int]) -> Interval:
        """Expected interval of one parameter under one hypothesis, in its own unit."""
        hypothesis = self.servo.hypotheses[which]
        parameter = hypothesis.model.parameters[coordinate]
        sd = float(np.sqrt(self.covariance(which, chosen)[coordinate, coordinate]))
        value = float(hypothesis.values[coordinate])
        if coordinate == 0:  # in seconds, with the error that no reading reduces
            reach = HALF_WIDTH_SD * float(np.hypot(value * sd, STEPPING_SD_S))
            return Interval(value, max(value - reach, 0.0), value + reach)
        centre = float(parameter.encode(value))
        box = float(parameter.encode(parameter.low)), float(parameter.encode(parameter.high))
        ends = np.clip([centre - HALF_WIDTH_SD * sd, centre + HALF_WIDTH_SD * sd], *box)
        return Interval(value, *(float(parameter.decode(e)) for e in ends))


def _followed(worlds: Sequence[_World], candidate: Candidate, number: int) -> bool:
    """Whether most servos follow a tone at all: where a limit clips it, `delay` leaves it out."""
    if candidate.kind != "sine":
        return True
    commanded = np.std(candidate.run.command[len(candidate.run.command) // 4 :])
    moved = []
    for world in worlds:
        positions = [responses[number].position_rad for responses in world.responses]
        moved.append(min(np.std(position[len(position) // 4 :]) for position in positions))
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
    gain, separated = np.zeros(len(names)), 0.0
    for world in worlds:
        with_, without = (np.diag(world.covariance(0, c)) for c in (chosen, before))
        gain += np.log(without / with_)[:-1]
        for which in range(1, len(world.servo.hypotheses)):
            least, most = (min(world.nats(which, c), CLEAR_NATS) for c in (before, chosen))
            separated += (most - least) / CLEAR_NATS
    if separated > _TELLS * len(worlds):
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


def _notes(
    joint: str, world: _World, choice: Sequence[Candidate], chosen: Sequence[int]
) -> list[str]:
    """What stays unknown, and whether any of the candidates alone could show it."""
    notes = []
    count = len(chosen)
    sd = np.sqrt(np.diag(world.covariance(0, chosen)))
    best = np.min(
        [np.sqrt(np.diag(world.covariance(0, [k] * count))) for k in range(len(choice))], axis=0
    )
    for k, parameter in enumerate(world.servo.hypotheses[0].model.parameters[1:-1], 1):
        name = word(parameter.name)
        most = min(_UNSEEN_SD, _PRIOR_SHARE * parameter.prior_sd)
        if best[k] > most:
            notes.append(
                f"{joint}: {name} cannot be seen at any amplitude within the limits "
                f"(excursion {max(c.amplitude_rad for c in choice):g} rad): its interval would "
                f"span a factor of {np.exp(2 * HALF_WIDTH_SD * best[k]):.1f} at best."
            )
        elif sd[k] > most:
            notes.append(
                f"{joint}: {name} would still span a factor of "
                f"{np.exp(2 * HALF_WIDTH_SD * sd[k]):.1f}; more seconds would narrow it."
            )
    for which in range(1, len(world.servo.hypotheses)):
        nats = world.nats(which, chosen)
        if nats < CLEAR_NATS:
            names = [world.servo.hypotheses[i].model.name for i in (0, which)]
            notes.append(
                f"{joint}: {names[0]} and {names[1]} would still explain the readings alike "
                f"(log Bayes factor {nats:.1f}, below {CLEAR_NATS:g}): the dead time's interval "
                "covers both."
            )
    if world.servo.doubt_s > 0:
        notes.append(
            f"{joint}: the dates of the readings are in doubt by ± "
            f"{1e3 * world.servo.doubt_s:.1f} ms, and so is the dead time, whatever is recorded. "
            "A longer trial may show the poll; a header line `# readings` settles live readings."
        )
    now, after = world.dead_time_s([]), world.dead_time_s(chosen)
    if (after.high - after.low) > (1 - _HELPS) * (now.high - now.low):
        notes.append(
            f"{joint}: no trial within the limits narrows the dead time's interval of "
            f"± {500 * (now.high - now.low):.1f} ms; ± {1e3 * LEAST_HALF_WIDTH_S:.1f} ms of it "
            "are the model's time step."
        )
    return notes


_STEP = 0.03  # of the sensitivities: the slope over a likely error, not of one kink
_LINEAR_STEP = 3e-4


@dataclass(frozen=True)
class Noise:
    """Error of the readings of a trial."""

    floor_rad: float
    """Standard deviation at rest: sensor noise and quantisation."""
    jitter_s: float
    """Standard deviation of the times of commands and readings."""

    def weights(self, speed_rad_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse variances [1/rad²] of readings of a joint at these speeds."""
        return 1.0 / (self.floor_rad**2 + (speed_rad_s * self.jitter_s) ** 2)


@dataclass(frozen=True)
class Hypothesis:
    """A servo model with the parameters that explain what is known."""

    model: Structure
    values: NDArray[np.float64]
    """Shape (parameters,)."""
    known: NDArray[np.float64]
    """Information about the fitted coordinates so far, the prior included, shape (parameters,
    parameters)."""


@dataclass(frozen=True)
class Response:
    """A trial as one hypothesis predicts it."""

    position_rad: NDArray[np.float64]
    weights: NDArray[np.float64]
    """`position_rad` and `weights`: readings, and their inverse variances [1/rad²], shape
    (samples,)."""
    sensitivity: NDArray[np.float64]
    """Of the readings to the fitted coordinates, and to the shift in time of the tone, shape
    (samples, parameters + 1)."""

    def inner(self, a: NDArray, b: NDArray) -> NDArray[np.float64]:
        """Weighted inner product aᵀWb, shape (columns of a, columns of b)."""
        return (a.T * self.weights) @ b

    @property
    def information(self) -> NDArray[np.float64]:
        """Of the trial about parameters and shift, shape (parameters + 1, parameters + 1)."""
        return self.inner(self.sensitivity, self.sensitivity)


def without_shift(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information of a tone's trials, summed, about the parameters whatever its shift in time."""
    shift, of_shift = information[:-1, -1], information[-1, -1] + PHASE_SD_S**-2
    return information[:-1, :-1] - np.outer(shift, shift) / of_shift


def pooled(
    informations: Iterable[tuple[Hashable, NDArray[np.float64]]],
) -> NDArray[np.float64] | float:
    """Information of trials about the parameters, each with the name of its tone; 0 of none."""
    by_tone: dict[Hashable, NDArray[np.float64]] = {}
    for tone, information in informations:
        by_tone[tone] = by_tone.get(tone, 0.0) + information
    return sum((without_shift(total) for total in by_tone.values()), start=0.0)


def prior_information(model: Structure) -> NDArray[np.float64]:
    """Of the model's prior, shape (parameters, parameters); a wide one where it has none."""
    sd = np.array([min(p.prior_sd, 2.0 if p.logarithmic else 1.0) for p in model.parameters])
    return np.diag(sd**-2.0)


def respond(hypothesis: Hypothesis, trial: Run, noise: Noise, seen: float = 1.0) -> Response:
    """Simulate one trial and its sensitivities.

    `trial` has the command and the times of the readings; their positions are ignored. `seen` is
    the share of the readings that arrive.
    """
    model, values = hypothesis.model, hypothesis.values
    par = model.parameters
    step = np.array([_STEP if p.logarithmic else _LINEAR_STEP for p in par])
    centre = np.array([float(p.encode(v)) for p, v in zip(par, values, strict=True)])
    cloud = np.concatenate([centre + np.diag(step), centre - np.diag(step)])
    ends = np.stack([p.decode(cloud[:, j]) for j, p in enumerate(par)], axis=-1)
    off = residuals(model, ends, [trial])[0]
    track = free_run(model, values, [trial])[0]
    speed = at_steps(np.gradient(track) / trial.step_s, trial.sample_step)
    slope = (off[: len(par)] - off[len(par) :]).T / (2 * step)
    shift = slope[:, :1] / values[0]  # of the logarithm: a tone's shift is a dead time of its own
    return Response(
        at_steps(track, trial.sample_step), seen * noise.weights(speed), np.hstack([slope, shift])
    )


def fitted_noise(
    model: Structure, values: NDArray, trials: Sequence[Run], least_rad: float
) -> Noise:
    """Noise that explains the residuals of a fit, tone by tone; its floor is at least `least_rad`.

    Least squares of each trial's mean squared residual over floor² + jitter² · mean squared speed,
    relative to the former; both not negative.
    """
    square, speed = [], []
    for trial, track in zip(trials, free_run(model, values, trials), strict=True):
        off = at_steps(track, trial.sample_step) - trial.sample_rad
        bound = 4 * robust_sd(off) + 1e-12  # a lost command is not the noise
        square.append(np.mean(np.clip(off, -bound, bound) ** 2))
        speed.append(np.mean(np.gradient(track) ** 2) / trial.step_s**2)
    rows = np.column_stack([np.ones(len(square)), speed]) / np.maximum(square, 1e-12)[:, None]
    (floor, jitter), _ = nnls(rows, np.ones(len(rows)))
    return Noise(max(float(np.sqrt(floor)), least_rad), float(np.sqrt(jitter)))


def separation(
    truth: Sequence[Response], rival: Sequence[Response], known: NDArray[np.float64]
) -> float:
    """Nats by which trials are expected to prefer the true model to a rival that is fitted again.

    Both have responses to the same trials; `known` is the information about the rival's coordinates
    so far, shape (parameters, parameters).
    """
    total, pull, curvature = 0.0, np.zeros(len(known)), known.copy()
    for true, wrong in zip(truth, rival, strict=True):
        off = (wrong.position_rad - true.position_rad)[:, None]
        push, information = wrong.inner(wrong.sensitivity, off)[:, 0], wrong.information
        of_shift = information[-1, -1] + PHASE_SD_S**-2
        total += wrong.inner(off, off).item() - push[-1] ** 2 / of_shift
        pull += push[:-1] - information[:-1, -1] * push[-1] / of_shift
        curvature += without_shift(information)
    return 0.5 * max(total - float(pull @ np.linalg.solve(curvature, pull)), 0.0)
