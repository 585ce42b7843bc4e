"""What could explain a joint's command and position, compared: `relation_findings`.

`RELATIONS` are servos of other signs, shifts and columns: each is fitted to the whole recording
(`explanations`), and the one with the best score explains it. The position servo as it is needs no
advantage; any other must beat it by `CLEAR_NATS`, and a runner-up within them is named.

`CHANGES` are what may come on top of a servo that follows: a second writer (`writers`), a gain or a
clock that changes. What bends its path, a friction or a stop, is in `bends`. Each is fitted beside
the servo alone and must explain a good part of what that leaves. A new hypothesis is one function
and one entry; its simulator and its codes stand in the tests' own table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine, least_squares
from pupper_sysid.sysid.doctor.bends import held_findings
from pupper_sysid.sysid.doctor.changes import CLEAR_NATS, Followed, followed
from pupper_sysid.sysid.doctor.explanations import Explanation, Servo, echo, explain
from pupper_sysid.sysid.doctor.findings import CARE, REFUSE, Finding, rivalled
from pupper_sysid.sysid.doctor.writers import second_writer
from pupper_sysid.sysid.recordings.excitation import split_tones
from pupper_sysid.sysid.recordings.recording import Trial

_UNRELATED, _HALF, _LOOSE, _FOLLOWS = 0.25, 0.5, 0.6, 0.75  # share of the position's variance
_FOLLOWS_LATE, _LATEST_S = 0.9, 0.35  # what swings at a load's own frequency is late
_NO_ONE_LAG = 0.3
_FEWEST_BITS, _NEARLY = 8, 0.15  # of a bit
_FITS = 0.1  # of the position's variance left: nothing jumps
_TURNS, _TURN_SHARE = 4, 0.2
_FAR_TOO_LARGE, _TOO_LARGE, _SMALL, _STILL = 2.0, 1.5, 0.4, 0.1
_UNITS = {
    "degrees": 57.29578, "counts of 4,096 a turn": 651.8986, "counts of 1,024 a turn": 162.97466,
    "milliradians": 1000.0,
}  # fmt: skip
_SAME_SCALE, _NO_SERVO = 0.35, 1.2  # of the logarithm
_STEPWISE, _HOLD_S = 0.75, 0.1  # share of repeats, and how long a level lasts
_MOVES_MORE = 0.2  # share of repeats that what follows a stepwise command lacks
_DISTURBED = 0.08  # of the position's mean deviation; 3 of 146 sound recordings have more
_LEVEL, _AT_LEAST = 0.05, 0.8  # of the range, between two levels; share of changes that are such
_CLEARLY_EARLY_S, _MUCH_LESS = 0.03, 0.3
_SMOOTH = 0.6  # autocorrelation of what is left
_AT_ONCE_S, _FASTEST_S, _LATE_S = 0.02, 0.001, 0.008
_BEYOND, _SURELY = 4.0, 0.01
_LONGEST_LAG_S = 0.5
_FASTEST_RAD_S, _WRAP_RAD, _UNUSUAL = 20.0, 0.5, 8.0  # a good servo of this size; compared then
_SAME_TONE_HZ = 0.02
_DIFFERENT = 0.35  # of the gain
_SPEED_LEFT, _SPEED_BETTER, _SPEED_GAIN = 0.12, 0.35, 0.55  # the last of the logarithm


@dataclass(frozen=True)
class Relation:
    """One explanation of the pair, fitted."""

    code: str
    """Of its finding; empty for the servo as it is."""
    servo: Servo


def relations(trials: Sequence[Trial], step: float, base: Explanation) -> list[Relation]:
    """All relations of one joint's command and position, the likeliest first."""
    causal = np.broadcast_to(base.lags_s >= -0.5 * base.grid_s, base.total_s.shape)
    causal = causal & (base.lags_s <= _LONGEST_LAG_S)
    found = [
        Relation("", base.best(1.0, causal)),
        Relation("sign_inverted", base.best(-1.0, causal)),
    ]
    if _turns(trials) >= _TURNS:
        early = base.total_s < -0.5 * base.grid_s
        ahead = base.best(1.0, early)
        found.append(Relation("position_early", ahead))
        other = explain(trials, step, True)
        if other is not None:
            other = replace(other, rows=base.rows)
            late = np.broadcast_to(other.lags_s >= -0.5 * other.grid_s, other.total_s.shape)
            late = late & (other.total_s > _FASTEST_S) & (other.lags_s <= _LONGEST_LAG_S)
            found.append(Relation("columns_swapped", other.best(1.0, late)))
    return sorted(found, key=lambda r: r.servo.nats)


def relation_findings(
    trials: Sequence[Trial], step: float
) -> tuple[list[Finding], Explanation | None, Servo | None]:
    """Findings on the relation, and the servo that explains it where there is none to refuse."""
    base = explain(trials, step)
    if base is None:
        return [], None, None
    joint = followed(trials, step)
    assert joint is not None
    # a set-point that ramps is late by a part of the motion; a fault may explain the rest
    sound, changes = joint.explained or joint.unexplained < 1 - _FOLLOWS, joint.changes
    if base.explained < _UNRELATED:
        unrelated = Finding("unrelated", REFUSE, {"percent": 100 * base.explained})
        found = changes or [joint.rivalled(unrelated)]
        return ([], base, joint.servo) if sound else (found, base, None)
    ranked = relations(trials, step, base)
    servo = next(r.servo for r in ranked if not r.code)
    best, second = ranked[0], ranked[1]
    hardly = best.servo.nats > servo.nats - CLEAR_NATS
    # swapped back, a position servo follows by about as much as commanded
    hardly |= best.code == "columns_swapped" and abs(np.log(abs(best.servo.gain))) > _NO_SERVO
    if best.code == "position_early" and best.servo.total_s > -_CLEARLY_EARLY_S:
        # a little early is what another shape of the servo looks like
        hardly |= best.servo.unexplained > _MUCH_LESS * servo.unexplained
    # a relation that leaves more than a servo with limits does, or one that changes, is none
    left = joint.changed.fit.unexplained(joint) if joint.changed else joint.unexplained
    hardly |= left + base.floor < 0.5 * (best.servo.unexplained + base.floor)
    if best.code and hardly:
        best = next(r for r in ranked if not r.code)
    share = 1 - best.servo.unexplained
    least = _FOLLOWS_LATE if best.servo.total_s > _LATEST_S else _FOLLOWS
    held = bool(held_findings(trials, step))
    usual = held or sound or bool(changes)
    strange = share < _HALF and not usual and not best.code and _smooth_rest(base, best.servo)
    if strange or (best.code and share < least):
        # a fault explains what is left of a servo, or smooth motion of another cause is left
        none = Finding("not_a_position_servo", REFUSE, {"percent": 100 * share})
        found = changes or [joint.rivalled(none)]
        return found, base, None
    scaled = None
    if best.code != "columns_swapped" and not _usual_gain(joint, base, best):
        scaled = _scale(base, best.servo)
    if scaled:
        return [scaled], base, None
    at_once = None if best.code else _at_once(trials, base, best.servo)
    if at_once or best.code in ("position_early", "columns_swapped"):
        if apart := _clocks_drift(joint, base):
            return [apart], base, None
    if best.code:
        near = second.servo.nats < best.servo.nats + CLEAR_NATS
        return [_refusal(best, second.code if near else "")], base, None
    if at_once:
        return [at_once], base, None
    found = [] if usual else _loose(base, best.servo)
    if not (held or changes or any(t.load is not None for t in trials)):
        found += _odd_scale(joint, base, best)  # a known load is held at a part of the command
    return found, base, best.servo


def _clocks_drift(joint: Followed, base: Explanation) -> Finding | None:
    """Clocks that drift: a position that is early at one time and late as a servo's at another."""
    change = joint.changed
    if change is None or change.finding is None or change.finding.code != "lag_drifts":
        return None
    less = change.fit.unexplained(joint) + base.floor < 0.5 * (1 - base.explained + base.floor)
    return replace(change.finding, verdict=REFUSE) if less else None


def _smooth_rest(base: Explanation, servo: Servo) -> bool:
    """Whether the servo leaves motion rather than noise."""
    along = across = 0.0
    for s, x in zip(base.samples, base.predicted(servo), strict=True):
        spread = float(np.var(x))
        gain = float(np.mean((x - x.mean()) * s.position_rad) / spread) if spread > 0 else 0.0
        rest = s.position_rad - s.position_rad.mean() - gain * (x - x.mean())
        along += float(np.sum(rest[1:] * rest[:-1]))
        across += float(np.sum(rest**2))
    return along > _SMOOTH * across


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
    other, base = explain(trials, 0.0, True), explain(trials, step)
    if other is None:
        return []
    late = np.broadcast_to(other.lags_s >= 0, other.total_s.shape) & (other.total_s > _FASTEST_S)
    servo = other.best(1.0, late)
    plain = 1.0
    if base is not None:
        plain = base.best(1.0, np.broadcast_to(base.lags_s >= 0, base.total_s.shape)).unexplained
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


def _usual_gain(joint: Followed, base: Explanation, best: Relation) -> bool:
    """Whether a servo of a usual gain explains the readings about as well.

    A slow servo of a large gain moves as a fast one that a limit holds back, and on a single tone
    as any other.
    """

    def usual(gain: NDArray | float) -> NDArray[np.bool_]:
        return (np.abs(gain) < _TOO_LARGE) & (np.abs(gain) > _SMALL)

    inside = usual(np.tensordot(base.weight, base.gains, axes=1))
    inside &= (base.lags_s >= -0.5 * base.grid_s) & (base.lags_s <= _LONGEST_LAG_S)
    sign = float(np.sign(best.servo.gain))
    left = base.best(sign, inside).unexplained if inside.any() else 1.0
    least = best.servo.unexplained
    if not best.code:
        left = min(left, joint.unexplained if usual(float(joint.fit.values[0])) else 1.0)
        least = min(least, joint.unexplained)
    return base.nats(left) < base.nats(least) + CLEAR_NATS


def _scale(base: Explanation, servo: Servo) -> Finding | None:
    """A position of another unit or scale than the command, whatever its sign."""
    gain = abs(servo.gain)
    if 1 - servo.unexplained < _LOOSE:
        return None
    for value, large, small in (
        (gain, "positions", "commands"), (1 / max(gain, 1e-9), "commands", "positions"),
    ):  # fmt: skip
        unit = next((u for u, f in _UNITS.items() if abs(np.log(value / f)) < _SAME_SCALE), None)
        if unit:
            values = {"factor": value, "large": large, "small": small, "unit": unit}
            return Finding("wrong_unit", REFUSE, values)
    moves = max(float(np.ptp(s.position_rad) / np.ptp(s.command_rad)) for s in base.samples)
    if gain > _FAR_TOO_LARGE and moves > 1:  # a slow servo of a large gain is as likely a fast one
        return Finding("scale_too_large", REFUSE, {"gain": gain})
    # where a servo cannot follow it moves less: the scale is what it shows at its best
    best = float(np.abs(base.gains[:, servo.filter, _at(base, servo)]).max())
    if best < _STILL:
        return Finding("hardly_moves", REFUSE, {"percent": 100 * best})
    return None


def _since_command_s(trial: Trial) -> float:
    """Usual time between the last command and a read [s]."""
    sent = trial.send_time_s
    last = np.searchsorted(sent, trial.read_time_s, "right") - 1
    return float(np.median(trial.read_time_s - sent[np.maximum(last, 0)]))


def _at(base: Explanation, servo: Servo) -> int:
    return int(np.argmin(np.abs(base.lags_s - servo.lag_s)))


def _at_once(trials: Sequence[Trial], base: Explanation, servo: Servo) -> Finding | None:
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


def _loose(base: Explanation, servo: Servo) -> list[Finding]:
    if base.explained < _LOOSE:
        return [Finding("loosely_related", CARE, {"percent": 100 * base.explained})]
    several_lags = base.explained - (1 - servo.unexplained) > _NO_ONE_LAG
    return [Finding("no_one_lag", CARE)] if several_lags else []


def _odd_scale(joint: Followed, base: Explanation, best: Relation) -> list[Finding]:
    """A gain that servos do not have, where none of a usual one explains the readings as well."""
    if _usual_gain(joint, base, best):
        return []
    gains = np.abs(base.gains[:, best.servo.filter, _at(base, best.servo)])
    gains = np.abs(joint.fit.values[:1]) if joint.explained else gains
    middle, most = float(np.median(gains)), float(gains.max())
    if _SMALL <= most and middle <= _TOO_LARGE:
        return []
    return [Finding("scale_asks_care", CARE, {"gain": middle if middle > _TOO_LARGE else most})]


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
    jumps = [_jumps(t, step) for t in trials]
    sizes = np.concatenate([np.abs(size) for size, _ in jumps])
    if not len(sizes):
        return []
    jump = float(np.median(sizes))
    middle = _gap(np.concatenate([t.position_rad for t in trials]), jump)
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
    left = {name: _unexplained(t, step) for name, t in {"": list(trials), **others}.items()}
    if left[""] < _FITS:
        return []  # a fast joint, or one in another unit
    best = min(left, key=lambda name: left[name])
    if near > 0.1 * turn and (not best or left[best] > max(_FITS, 0.5 * left[""])):
        return []  # it is no turn that jumps, and put back no servo explains it
    if not best or left[best] > 0.7 * left[""]:
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


def _gap(position: NDArray[np.float64], jump: float) -> float:
    """Middle of the widest gap between readings."""
    ordered = np.sort(position[np.isfinite(position)])
    at = int(np.argmax(np.diff(ordered)))
    return float(0.5 * (ordered[at] + ordered[at + 1]))


def _beyond(trial: Trial, middle: float, put_back: Callable[[NDArray], NDArray]) -> Trial:
    position = trial.position_rad
    return replace(trial, position_rad=np.where(position > middle, put_back(position), position))


def _unexplained(trials: Sequence[Trial], step: float) -> float:
    base = explain(trials, step)
    if base is None:
        return 1.0
    return base.best(1.0, np.broadcast_to(base.lags_s >= 0, base.total_s.shape)).unexplained


def speed_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """A column that holds the joint's speed: its integral follows the command, and it does not."""
    base = explain(trials, step)
    if base is None:
        return []
    causal = np.broadcast_to(base.lags_s >= -0.5 * base.grid_s, base.total_s.shape)
    plain = base.best(1.0, causal).unexplained
    summed = [_summed(t) for t in trials if np.isfinite(t.position_rad).sum() > 8]
    other = explain(summed, 0.0) if plain > _SPEED_LEFT and summed else None
    if other is None:
        return []
    servo = other.best(1.0, np.broadcast_to(other.lags_s >= 0, other.total_s.shape))
    if servo.unexplained > min(_SPEED_LEFT, _SPEED_BETTER * plain):
        return []
    if abs(np.log(max(servo.gain, 1e-9))) > _SPEED_GAIN:
        return []
    return [Finding("speed_for_position", REFUSE, {"percent": 100 * (1 - servo.unexplained)})]


def _summed(trial: Trial) -> Trial:
    """The trial with the integral of its position, without the line that a constant leaves."""
    seen = np.isfinite(trial.position_rad)
    time, value = trial.read_time_s[seen], trial.position_rad[seen]
    total = np.concatenate([[0.0], np.cumsum(np.diff(time) * 0.5 * (value[1:] + value[:-1]))])
    line = np.column_stack([np.ones_like(time), time - time[0]])
    position = np.full(len(seen), np.nan)
    position[seen] = total - line @ least_squares(line, total)
    return replace(trial, position_rad=position, position_count=None)


# ----- what comes on top of a servo that follows
def hypothesis_findings(trials: Sequence[Trial], step: float) -> list[Finding]:
    """What explains the pair of columns, and what comes on top of it."""
    if found := echo(trials, step):
        return [found]
    findings, base, servo = relation_findings(trials, step)
    joint = followed(trials, step)
    if joint is None or base is None or servo is None:
        return findings
    changes = _trials_differ(joint) or joint.changes
    if 1 - servo.unexplained < _LOOSE and not joint.explained:
        return [*findings, *changes]
    found = [*findings, *(changes or second_writer(joint))]
    loaded = any(t.load is not None for t in trials)
    if joint.disturbed > _DISTURBED and not (found or loaded or held_findings(trials, step)):
        return [Finding("disturbed", CARE, {"percent": 100 * joint.unexplained})]
    return found


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
