"""What could explain a joint's command and position, compared: `relation_findings`.

`RELATIONS` are servos of other signs, shifts and columns: each is fitted to the whole recording
(`explanations`), and the one with the best score explains it. The position servo as it is needs no
advantage; any other must beat it by `CLEAR_NATS`, and a runner-up within them is named.

What may come on top of a servo that follows is in `changes` and `writers`. A new hypothesis is one
entry of a table; its simulator and its codes stand in the tests' own table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine, least_squares
from pupper_sysid.sysid.doctor.changes import CLEAR_NATS, EXPLAINED, Followed, followed
from pupper_sysid.sysid.doctor.explanations import Explanation, Servo, echo, explain
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding, rivalled
from pupper_sysid.sysid.doctor.writers import second_writer
from pupper_sysid.sysid.recordings.excitation import split_tones
from pupper_sysid.sysid.recordings.recording import Trial

_UNRELATED, _HALF, _LOOSE, _FOLLOWS = 0.25, 0.5, 0.6, 0.75  # share of the position's variance
_FEWEST_BITS, _NEARLY = 8, 0.15  # of a bit
_FITS = 0.1  # of the position's variance left: nothing jumps
_TURNS, _TURN_SHARE = 4, 0.2
_FAR_TOO_LARGE, _TOO_LARGE, _SMALL, _STILL = 2.0, 1.5, 0.4, 0.1
_UNITS = {
    "degrees": 57.29578, "counts of 4,096 a turn": 651.8986, "counts of 1,024 a turn": 162.97466,
    "milliradians": 1000.0,
}  # fmt: skip
_SAME_SCALE = 0.35  # of the logarithm
_STEPWISE, _HOLD_S = 0.75, 0.1  # share of repeats, and how long a level lasts
_MOVES_MORE = 0.2  # share of repeats that what follows a stepwise command lacks
_DISTURBED = 0.08  # of the position's mean deviation; 3 of 146 sound recordings have more
_LEVEL, _AT_LEAST = 0.05, 0.8  # of the range, between two levels; share of changes that are such
_AT_ONCE_S, _FASTEST_S, _LATE_S = 0.02, 0.001, 0.008
_BEYOND, _SURELY = 4.0, 0.01
_LONGEST_LAG_S = 0.5
_FASTEST_RAD_S, _WRAP_RAD, _UNUSUAL = 20.0, 0.5, 8.0  # a good servo of this size; compared then
_HELD = 0.4  # of the command's range, to and fro
_SAME_TONE_HZ = 0.02
_DIFFERENT = 0.35  # of the gain
_NEAR_TURN = 0.5  # of a command's jump
_SPEED_LEFT, _SPEED_BETTER, _SPEED_GAIN = 0.12, 0.35, 0.55  # the last of the logarithm


@dataclass(frozen=True)
class Relation:
    """One explanation of the pair, fitted."""

    code: str
    """Of its finding; empty for the servo as it is."""
    servo: Servo


def relations(joint: Followed) -> list[Relation]:
    """All relations of one joint's command and position, the likeliest first."""
    base = joint.base
    causal = base.causal(_LONGEST_LAG_S)
    candidates = [Relation("", joint.servo), Relation("sign_inverted", base.best(-1.0, causal))]
    if _turns(joint.trials) >= _TURNS:
        ahead = base.best(1.0, base.total_s < -0.5 * base.grid_s)
        candidates.append(Relation("position_early", ahead))
        other = explain(joint.trials, joint.step, True)
        if other is not None:
            other = replace(other, rows=base.rows)
            late = other.causal(_LONGEST_LAG_S) & (other.total_s > _FASTEST_S)
            swapped = other.best(1.0, late)
            # a filter takes the noise out of any position, but only ahead of time if it is one
            if swapped.nats < other.best(1.0, other.total_s < -0.5 * other.grid_s).nats:
                candidates.append(Relation("columns_swapped", swapped))
    return sorted(candidates, key=lambda r: r.servo.nats)


def _sound(joint: Followed) -> bool:
    """Whether a servo with limits follows; a ramped set-point is late by a part of the motion."""
    return joint.explained or joint.unexplained < 1 - _FOLLOWS


def relation_findings(joint: Followed) -> list[Finding]:
    """What the pair of columns is, where it is no servo that follows its command."""
    trials, base, sound = joint.trials, joint.base, _sound(joint)
    # a change is the cause where a servo with it explains nearly all
    change = joint.changed
    changes = joint.changes if change and change.fit.cost - joint.unsure < EXPLAINED else []
    if base.explained < _UNRELATED:
        unrelated = Finding("unrelated", REFUSE, {"percent": 100 * base.explained})
        return [] if sound or changes else [joint.rivalled(unrelated)]
    ranked = relations(joint)
    best, second = ranked[:2]
    plain = next(r for r in ranked if not r.code)
    # the servo as it is has limits and may change, which the other relations are not fitted with
    unexplained = change.fit.unexplained(joint) if change else joint.unexplained
    if best.code and best.servo.nats > min(plain.servo.nats, base.nats(unexplained)) - CLEAR_NATS:
        best = plain
    share = 1 - best.servo.unexplained
    held = bool(held_findings(trials, joint.step) or changes or joint.stays_often)
    rest = joint.fit.residuals_rad
    noisy = np.var(np.diff(rest)) > np.var(rest)  # an autocorrelation below one half
    if share < (_FOLLOWS if best.code else _HALF) and (best.code or not (held or sound or noisy)):
        # a fault explains what is left of a servo, or smooth motion of another cause is left
        none = Finding("not_a_position_servo", REFUSE, {"percent": 100 * share})
        return [] if changes else [joint.rivalled(none)]
    held = held or any(t.load is not None for t in trials)
    scale = _scale(joint, best, held)
    if scale and scale.verdict == REFUSE:
        return [scale]
    if best.code:
        near = second.servo.nats < best.servo.nats + CLEAR_NATS
        return [_refusal(best, second.code if near else "")]
    if not changes and (at_once := _at_once(trials, base)):
        return [at_once]
    return [scale] if scale else []


def stepwise_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A position that moves in steps, followed by the command: the columns are swapped."""
    holds, commands, repeats = [], [], []
    for t in trials:
        seen = np.isfinite(t.position_rad)
        value, time = t.position_rad[seen], t.read_time_s[seen]
        least = max(_LEVEL * float(np.ptp(value)) if len(value) else 0.0, 1e-3)
        moves = np.abs(np.diff(value))
        jump = np.flatnonzero(moves > least)
        if len(jump) < _AT_LEAST * np.count_nonzero(moves):
            return []  # on its way from one level to the next
        holds.append(np.diff(time[jump]) if len(jump) > 4 else np.zeros(1))
        commands.append(np.mean(np.diff(t.command_rad) == 0))
        repeats.append(np.mean(np.diff(value) == 0))
        if len(value) < 8 or repeats[-1] < _STEPWISE:
            return []
    if np.median(np.concatenate(holds)) < _HOLD_S:
        return []
    if np.median(commands) > np.median(repeats) - _MOVES_MORE:
        return []
    other = explain(trials, 0.0, True)
    if other is None:
        return []
    servo = other.best(1.0, other.causal() & (other.total_s > _FASTEST_S))
    plain = _unexplained(trials, step)
    if 1 - servo.unexplained < _FOLLOWS or servo.unexplained > 0.5 * plain:
        return []
    return [_refusal(Relation("columns_swapped", servo), "")]


def _refusal(relation: Relation, rival: str) -> Finding:
    servo = relation.servo
    if relation.code == "position_early":
        return rivalled(Finding(relation.code, REFUSE, {"early_ms": -1e3 * servo.total_s}), rival)
    values = {"lag_ms": 1e3 * servo.total_s}
    if relation.code == "sign_inverted":
        values["gain"] = servo.gain
    return rivalled(Finding(relation.code, REFUSE, values), rival)


def _usual_gain(joint: Followed, best: Relation) -> bool:
    """Whether a servo of a usual gain explains the readings about as well.

    A slow servo of a large gain moves as a fast one that a limit holds back, and on a single tone
    as any other.
    """

    def usual(gain: NDArray | float) -> NDArray[np.bool_]:
        return (np.abs(gain) < _TOO_LARGE) & (np.abs(gain) > _SMALL)

    base = joint.base
    inside = base.causal(_LONGEST_LAG_S) & usual(np.tensordot(base.weight, base.gains, axes=1))
    sign = float(np.sign(best.servo.gain))
    unexplained = base.best(sign, inside).unexplained if inside.any() else 1.0
    least = best.servo.unexplained
    if not best.code:
        unexplained = min(
            unexplained, joint.unexplained if usual(float(joint.fit.values[0])) else 1.0
        )
        least = min(least, joint.unexplained)
    return base.nats(unexplained) < base.nats(least) + CLEAR_NATS


def _scale(joint: Followed, best: Relation, excused: bool) -> Finding | None:
    """A position of another unit or scale than the command, whatever its sign.

    Where a servo of a usual gain explains the readings about as well it is none. `excused`: what is
    known of the joint makes it move less.
    """
    base, servo = joint.base, best.servo
    if best.code == "columns_swapped" or _usual_gain(joint, best):
        return None
    gain, follows = abs(servo.gain), 1 - servo.unexplained >= _LOOSE
    for value, large, small in (
        (gain, "positions", "commands"), (1 / max(gain, 1e-9), "commands", "positions"),
    ):  # fmt: skip
        unit = next((u for u, f in _UNITS.items() if abs(np.log(value / f)) < _SAME_SCALE), None)
        if unit and follows:
            values = {"factor": value, "large": large, "small": small, "unit": unit}
            return Finding("wrong_unit", REFUSE, values)
    moves = max(float(np.ptp(s.position_rad) / np.ptp(s.command_rad)) for s in base.samples)
    if follows and gain > _FAR_TOO_LARGE and moves > 1:  # a slow servo is as likely a fast one
        return Finding("scale_too_large", REFUSE, {"gain": gain})
    # where a servo cannot follow it moves less: the scale is what it shows at its best
    at = int(np.argmin(np.abs(base.lags_s - servo.lag_s)))
    gains = np.abs(base.gains[:, servo.filter, at])
    if follows and gains.max() < _STILL:
        return Finding("hardly_moves", REFUSE, {"percent": 100 * float(gains.max())})
    gains = np.abs(joint.fit.values[:1]) if joint.explained else gains
    middle, most = float(np.median(gains)), float(gains.max())
    if excused or (_SMALL <= most and middle <= _TOO_LARGE):
        return None
    return Finding("scale_asks_care", CARE, {"gain": middle if middle > _TOO_LARGE else most})


def _since_command_s(trial: Trial) -> float:
    """Usual time between the last command and a read [s]."""
    sent = trial.send_time_s
    last = np.searchsorted(sent, trial.read_time_s, "right") - 1
    return float(np.median(trial.read_time_s - sent[np.maximum(last, 0)]))


def _at_once(trials: Sequence[Trial], base: Explanation) -> Finding | None:
    """A position that goes with the command, beyond doubt: no servo is that fast."""
    if all(_since_command_s(t) >= _LATE_S for t in trials):
        return None  # read when a fast servo has arrived
    plain = np.tensordot(base.weight, np.maximum(base.rho[:, 0], 0.0) ** 2, axes=1)
    at = int(np.argmax(plain))
    lag = float(base.lags_s[at])
    late = (base.lags_s >= -0.5 * base.grid_s) & (base.total_s >= _LATE_S)
    rest = 1 - base.best(1.0, late).unexplained
    noise = 2 * 10.0 * (1 - base.explained) / max(base.rows, 1.0)
    away, beyond = base.explained - float(plain[at]), base.explained - rest
    if lag >= _FASTEST_S or abs(lag) >= _AT_ONCE_S:
        return None
    if beyond <= max(_BEYOND * away + noise, _SURELY):
        return None
    return Finding("at_once", REFUSE, {"lag_ms": 1e3 * lag})


def _turns(trials: Sequence[Trial]) -> int:
    """How often commands turn round, by a fifth of their range or more.

    On a single way a bend, such as that of a load's sag, looks like a shift in time; on the way
    back it does not.
    """
    count = 0
    for t in trials:
        least, extreme, way = _TURN_SHARE * float(np.ptp(t.command_rad)), t.command_rad[0], 0
        for value in t.command_rad.tolist() if least > 0 else ():
            if way >= 0 and value < extreme - least:
                count, way, extreme = count + (way > 0), -1, value
            elif way <= 0 and value > extreme + least:
                count, way, extreme = count + (way < 0), 1, value
            elif (value - extreme) * (way or 1) > 0:
                extreme = value
    return count


# ----- how the encoder's number is read
def encoder_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Readings that jump farther than a servo moves: a wrapped angle, an overflow, a sign bit.

    The readings beyond the jump are put back, shifted or mirrored, whichever the command explains.
    """
    for t in trials:
        turned = np.flatnonzero(np.abs(np.abs(np.diff(t.command_rad)) - 2 * np.pi) < _NEAR_TURN)
        if len(turned):
            when = float(t.send_time_s[turned[0] + 1] - trials[0].send_time_s[0])
            return [Finding("angle_wrapped", REFUSE, {"times": len(turned), "time_s": when})]
    jumps = [_jumps(t, step) for t in trials]
    sizes = np.concatenate([np.abs(size) for size, _ in jumps])
    if not len(sizes):
        return []
    jump = float(np.median(sizes))
    ordered = np.concatenate([t.position_rad for t in trials])
    ordered = np.sort(ordered[np.isfinite(ordered)])
    widest = int(np.argmax(np.diff(ordered)))
    middle = float(0.5 * (ordered[widest] + ordered[widest + 1]))
    shifted = [_beyond(t, middle, lambda v: v - jump) for t in trials]
    edge = min(float(np.nanmin(np.where(t.position_rad > middle, t.position_rad, np.inf)))
               for t in trials)  # fmt: skip
    bottom = min(float(np.nanmin(t.position_rad)) for t in trials)  # count 0, or next to it
    mirrored = [_beyond(t, middle, lambda v: bottom + edge - v) for t in trials]
    when = min(float(time[0] - trials[0].send_time_s[0]) for size, time in jumps if len(size))
    turn = 2 * np.pi
    near = min(abs(jump - k * turn / 6) for k in (5, 6))  # servos of 300 and of 360 degrees
    sign = np.log2(max(edge - bottom, 1e-6) / step) if step > 0 else 0.0
    signed = _is_bit(sign) if step > 0 else near > 0.1 * turn
    others = {"shifted": shifted} | ({"mirrored": mirrored} if signed else {})
    unexplained = {name: _unexplained(t, step) for name, t in {"": list(trials), **others}.items()}
    if unexplained[""] < _FITS:
        return []  # a fast joint, or one in another unit
    best = min(unexplained, key=lambda name: unexplained[name])
    if near > 0.1 * turn and (not best or unexplained[best] > max(_FITS, 0.5 * unexplained[""])):
        return []  # it is no turn that jumps, and put back no servo explains it
    if not best or unexplained[best] > 0.7 * unexplained[""]:
        best = "shifted"
    values = {"times": len(sizes), "time_s": when}
    bits = np.log2(jump / step) if step > 0 else 0.0
    if best == "mirrored":
        values |= {"jump_rad": jump, "bit": round(sign)}
        return [Finding("sign_bit", REFUSE, values)]
    if _is_bit(bits) and abs(jump - turn) > 0.15 * turn and near > 0.1 * turn:
        values |= {"jump_rad": step * 2.0 ** round(bits), "bits": round(bits)}
        return [Finding("encoder_overflow", REFUSE, values)]
    return [Finding("angle_wrapped", REFUSE, values)]


def _is_bit(bits: float) -> bool:
    """Whether a number of counts is a power of 2, as far as readings next to it tell."""
    return bits > _FEWEST_BITS and abs(bits - round(bits)) < _NEARLY


def _jumps(trial: Trial, step: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sizes and times of steps that no servo makes."""
    seen = np.flatnonzero(np.isfinite(trial.position_rad))
    value, time = trial.position_rad[seen], trial.read_time_s[seen]
    new = np.concatenate([[0], np.flatnonzero(np.diff(value)) + 1]) if len(value) else []
    if len(new) < 4:
        return np.zeros(0), np.zeros(0)
    # a held value may be old, of a joint at rest by no more than usual
    move, taken = np.diff(value[new]), np.maximum(np.diff(time[new]), 1e-6)
    taken = np.minimum(taken, 2 * np.median(taken))
    usual = _UNUSUAL * float(np.median(np.abs(move)))
    far = np.abs(move) > np.maximum(_FASTEST_RAD_S * taken, max(5 * step + 0.2, usual))
    far &= np.abs(move) > _WRAP_RAD
    return move[far], time[new][1:][far]


def _beyond(trial: Trial, middle: float, put_back: Callable[[NDArray], NDArray]) -> Trial:
    position = trial.position_rad
    return replace(trial, position_rad=np.where(position > middle, put_back(position), position))


def _unexplained(trials: Sequence[Trial], step: float) -> float:
    base = explain(trials, step)
    return base.best(1.0, base.causal()).unexplained if base else 1.0


def speed_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A column that holds a speed: its integral goes with the other column, and it does not.

    A position may hold the joint's speed; a command may be one, a duty cycle, or a change of the
    goal.
    """
    plain = _unexplained(trials, step)
    read = [t for t in trials if np.isfinite(t.position_rad).sum() > 8]
    if plain <= _SPEED_LEFT or not read:
        return []
    for code, summed in (("speed_for_position", _position_summed),
                         ("speed_for_command", _command_summed)):  # fmt: skip
        other = explain([summed(t) for t in read], 0.0)
        servo = other.best(1.0, other.causal()) if other else None
        if servo is None or servo.unexplained > min(_SPEED_LEFT, _SPEED_BETTER * plain):
            continue
        # of commands the factor is the drive's
        if code == "speed_for_command" or abs(np.log(max(servo.gain, 1e-9))) <= _SPEED_GAIN:
            return [Finding(code, REFUSE, {"percent": 100 * (1 - servo.unexplained)})]
    return []


def _position_summed(trial: Trial) -> Trial:
    """The trial with the integral of its position, without the line that a constant leaves."""
    seen = np.isfinite(trial.position_rad)
    time, value = trial.read_time_s[seen], trial.position_rad[seen]
    position = np.full(len(seen), np.nan)
    position[seen] = _level(time, np.cumsum(np.gradient(time) * value))
    return replace(trial, position_rad=position, position_count=None)


def _command_summed(trial: Trial) -> Trial:
    """The trial with the integral of its command; both without the line that a constant leaves."""
    seen, sent = np.isfinite(trial.position_rad), trial.send_time_s
    total = np.concatenate([[0.0], np.cumsum(np.diff(sent) * trial.command_rad[:-1])])
    command, position = _level(sent, total), trial.position_rad.copy()
    position[seen] = _level(trial.read_time_s[seen], position[seen])
    return replace(
        trial, command_rad=command, position_rad=position, position_count=None,
        initial_command_rad=float(command[0]),
    )  # fmt: skip


def _level(time: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values without their straight line."""
    line = np.column_stack([np.ones_like(time), time - time[0]])
    return values - line @ least_squares(line, values)


# ----- what comes on top of a servo that follows
def held_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """Friction that holds the joint through a large part of the command's range."""
    joint = followed(trials, step)
    if joint is None or joint.changes or any(t.load is not None for t in trials):
        return []  # a stop holds as well; a known load sags, and its friction is fitted
    travel = 2 * joint.friction_rad
    if travel <= _HELD * joint.reach:
        return []
    return [joint.rivalled(Finding("held_by_friction", CARE, {"travel_rad": travel}))]


def hypothesis_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """What explains the pair of columns, and what comes on top of it."""
    if findings := echo(trials, step):
        return [findings]
    joint = followed(trials, step)
    findings = relation_findings(joint) if joint else []
    if joint is None or any(f.verdict == REFUSE for f in findings):
        return findings
    findings += _trials_differ(joint) or joint.changes or second_writer(joint)
    loaded = any(t.load is not None for t in trials)
    loose = joint.base.explained < _LOOSE and not _sound(joint)
    disturbed = joint.fit.cost - joint.noise - joint.unsure > _DISTURBED
    if (loose or disturbed) and not (findings or loaded or held_findings(trials, step)):
        if joint.stays_often:
            return [joint.stays_often]
        if loose:
            return [Finding("loosely_related", CARE, {"percent": 100 * joint.base.explained})]
        return [Finding("disturbed", CARE, {"percent": 100 * joint.unexplained})]
    return findings


def _trials_differ(joint: Followed) -> list[Finding]:
    """Trials of one tone and amplitude, named or found, that differ."""
    tones = []
    for trial in (part for whole in joint.trials for part in split_tones(whole)):
        if not trial.frequency_hz > 0 or np.isfinite(trial.position_rad).sum() < 16:
            continue
        seen = np.isfinite(trial.position_rad)
        half = trial.read_time_s > trial.read_time_s[0] + 0.4 * np.ptp(trial.read_time_s)
        angle = 2 * np.pi * trial.frequency_hz * trial.read_time_s[seen & half]
        if len(angle) < 8:
            continue
        moved = abs(fit_sine(angle, trial.position_rad[seen & half]).phasor)
        sent = abs(fit_sine(angle, trial.command_rad[seen & half]).phasor)
        tones.append((trial.frequency_hz, sent, moved / max(sent, 1e-9), trial.p_gain,
                      float(trial.send_time_s[0])))  # fmt: skip
    pairs = [
        (abs(g - g2) / max(abs(g), abs(g2)), f, g2, g, at)
        for n, (f, a, g, p, at) in enumerate(tones)
        for f2, a2, g2, p2, _ in tones[:n]
        if abs(f - f2) < _SAME_TONE_HZ
        and abs(a - a2) < 0.05 * a
        and (p == p2 or not np.isfinite(p + p2))  # another P gain moves differently
    ]
    if not pairs or max(pairs)[0] <= _DIFFERENT:
        return []
    _, f, before, after, _ = max(pairs)
    # slow tones hardly show what fast ones do, and tell the moment
    moment = min(at for share, *_, at in pairs if share > _DIFFERENT / 10)
    values = {"frequency_hz": f, "gain": before, "other_gain": after,
              "time_s": moment - joint.start_s}  # fmt: skip
    return [Finding("trials_differ", CARE, values)]
