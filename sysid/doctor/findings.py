"""Findings: what was found about one joint, by a code and numbers, and the words of each code.

Nothing else makes a sentence of a finding, and nothing reads one: what findings of several joints
have in common is decided by code and values (`shared`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

USE, CARE, REFUSE = "use", "use with care", "do not use"
VERDICTS = (REFUSE, CARE, USE)
"""Worst first."""


@dataclass(frozen=True)
class Finding:
    """What was found about a joint."""

    code: str
    """A key of `WORDS`."""
    verdict: str
    """One of `VERDICTS`."""
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """What the sentence of this code holds."""
    joint: str = ""
    """Empty where one joint is looked at."""

    @property
    def text(self) -> str:
        """Reason and cure, without the joint's name."""
        return text(self)


def rivalled(finding: Finding, rival: str) -> Finding:
    """The finding with the code of an explanation that is nearly as good, empty where none is."""
    return replace(finding, values={**finding.values, "rival": rival}) if rival else finding


WORDS: dict[str, str] = {
    "angle_wrapped": (
        "angles jump by about a turn {times} times within a row, the first time at "
        "{time_s:.2f} s: an angle wrapped at ±π or at the encoder's end. Unwrap it "
        "(numpy.unwrap), or mount the horn so that the range is not crossed."
    ),
    "at_once": (
        "the position goes with the command ({lag_ms:.1f} ms after its zero-order hold): an echo"
        " with noise, or positions stamped too early. Read the servo's Present_Position, and "
        "stamp it when it is read."
    ),
    "bad_readings": (
        "{readings} single readings ({percent:.1f} %) lie away from those before and after "
        "them, the first at {time_s:.2f} s ({value_rad:.3f} rad): failed or foreign answers of "
        "the bus. They are left out; check cable, baud rate and ids."
    ),
    "clipped": (
        "readings stay near {level_rad:.3f} rad for {percent:.0f} % of the time while the command "
        "goes beyond: an angle limit of the servo, a clamped goal or a mechanical stop clips the "
        "motion, and what looks like a speed limit is none. Widen the limits, or record with a "
        "smaller amplitude."
    ),
    "clocks_apart": (
        "the time from a command to its reading varies by {drift_s:.3g} s: two clocks that "
        "drift apart, or reads that hang. Stamp both with one monotonic clock."
    ),
    "columns_swapped": (
        "the command follows the position by {lag_ms:.0f} ms, as a servo would: the columns "
        "command_rad and position_rad look swapped. Swap them back."
    ),
    "constant_command": (
        "the command never changes: {joint} was not swept. Record it with `pupper-sysid sweep`."
    ),
    "degrees": ("{evidence} like degrees. {cure}"),
    "degrees_by_step": (
        "readings come in steps of {step:.5g}, which is a turn of 360 over 2^{bits}: they look "
        "like degrees. {cure}"
    ),
    "disordered_times": (
        "{rows} time stamps repeat or run backwards, so lags are uncertain there. Record with a"
        " monotonic clock of 1 ms or finer, and give each pass its own trial number."
    ),
    "does_not_move": (
        "the command moves and the reading does not: torque off, wrong servo id, or a servo "
        "that no longer answers. Power it again and look at it move."
    ),
    "disturbed": (
        "a servo with the usual limits leaves {percent:.1f} % of the motion unexplained, all "
        "along: another program commands it too (a second writer), a load or play moves it, or "
        "readings are older than their times. Record in free air with one program on the bus."
    ),
    "echo": (
        "the position is the command itself, {late}: an echo and no measurement. Read the "
        "servo's Present_Position, not its goal."
    ),
    "echo_between_rows": (
        "the position is the command itself, {late_ms:.1f} ms late at every speed: an echo or a"
        " computed value and no measurement. Read the servo's Present_Position, not its goal."
    ),
    "encoder_overflow": (
        "readings jump by {jump_rad:.2f} rad ({bits} bits of its steps) {times} times, the "
        "first time at {time_s:.2f} s: negative counts are read as unsigned. Subtract "
        "{jump_rad:.4f} rad from the upper readings, or read the register as a signed number "
        "(two's complement)."
    ),
    "fast_joint": (
        "the joint moves at {speed_rad_s:.0f} rad/s, faster than servos of this size do. {cure}"
    ),
    "few_fresh": (
        "only {readings} readings differ from the one before, too few to measure anything. "
        "Record for longer, with a larger amplitude."
    ),
    "few_steps": (
        "the joint moves by {steps:.0f} quantisation steps only. Record with a larger amplitude."
    ),
    "frozen": (
        "in {trials} of {of} trials the reading stays the same for up to {longest_s:.1f} s "
        "while the command moves on: the servo no longer answered, or its torque was off. "
        "Record these trials again."
    ),
    "gain_changed": (
        "from {time_s:.1f} to {until_s:.1f} s the joint moves {after:.2f} times as far as the "
        "command, and {before:.2f} times otherwise: settings, supply, torque limit or load "
        "changed. Use the parts apart."
    ),
    "clocks_drift": (
        "the clock of the readings drifts from that of the commands by {percent:+.3f} %; readings "
        "are dated by the commands' clock, in doubt by {doubt_ms:.1f} ms. Stamp both with one "
        "monotonic clock."
    ),
    "falls_behind": (
        "the time from a command to its reading grows by {growth_ms:+.1f} ms over the recording: "
        "clocks that drift apart, or two loops whose rates differ a little. Dates are in doubt by "
        "{doubt_ms:.1f} ms; stamp commands and readings with one monotonic clock."
    ),
    "gain_drifts": (
        "the gain goes from {before:.2f} at the beginning to {after:.2f} at the end "
        "({percent:+.0f} %): a servo that heats, a supply that sinks, or a load that grows. Use a "
        "part, or record again when it has cooled."
    ),
    "gaps": (
        "{percent:.0f} % of the recorded time lies in gaps of up to {longest_s:,.1f} s between "
        "rows, where the motion is unknown. Give each stretch its own trial number, or record "
        "again."
    ),
    "hardly_moves": (
        "the joint moves by {percent:.0f} % of its command at best: torque off, blocked, or "
        "another scale. Check that it turns freely."
    ),
    "held_by_friction": (
        "the joint rests until its command has moved by {travel_rad:.3f} rad to and fro: friction "
        "holds it against so small commands. Record with a larger amplitude."
    ),
    "interpolated": (
        "{percent:.0f} % of the positions lie on straight lines between others: the log was "
        "interpolated, and when its readings were taken is lost. Use the log as it was "
        "recorded."
    ),
    "lag_changed": (
        "the lag changes by {more_ms:+.0f} ms at {time_s:.1f} s: buffers of an adapter, another "
        "rate of the loop, or two recordings in one. Use the two parts apart."
    ),
    "lag_drifts": (
        "the lag grows by {drift_ms:.1f} ms a second ({percent:.2f} %): times of commands and "
        "readings are of clocks that drift apart, or rows are not at the rate that their times "
        "say. Stamp both with one clock."
    ),
    "left_path": (
        "{times} times, the first at {time_s:.1f} s, the joint leaves the path that its command "
        "sets, for up to {longest_s:.1f} s, and comes back: torque off, a supply that breaks down, "
        "another program, or something that holds or pushes it. Leave this part out, or record "
        "again."
    ),
    "loop_stood_still": (
        "the loop stood still {times} times for more than three periods, up to {longest_s:.2g} "
        "s; commands are taken to hold there. Record on an idle machine, or give each stretch "
        "its own trial number."
    ),
    "loop_too_fast": (
        "rows are {loop_us:.3g} µs apart, faster than any bus. Times must be seconds: multiply "
        "minutes by 60, hours by 3600."
    ),
    "loop_too_slow": ("rows are {loop_s:.4g} s apart, too slow for a servo. {cure}"),
    "loosely_related": (
        "the command explains {percent:.0f} % of the position's motion: noise, play or a load "
        "moves the joint as well. Record with a larger amplitude and a free joint."
    ),
    "many_bad_readings": (
        "{readings} single readings ({percent:.0f} %) lie away from those before and after "
        "them, the first at {time_s:.2f} s ({value_rad:.3f} rad): failed or foreign answers of "
        "the bus, too many to leave out. Check cable, baud rate and ids, then record again."
    ),
    "most_missing": (
        "{percent:.0f} % of the readings are missing: check wiring and power, then record again."
    ),
    "no_readings": (
        "there is no reading at all: check the servo's plug, id and power, then record again."
    ),
    "not_a_position_servo": (
        "the command explains {percent:.0f} % of the position's motion, and neither sign "
        "explains it: a loaded joint at a low gain (its target is a force, not a place), and no"
        " log of a position servo. Record the joint in free air, or at its full gain."
    ),
    "not_its_tone": (
        "trial {trial} is called a tone of {called_hz:.3g} Hz, and its command is none: it "
        "moves mostly at {strongest_hz:.3g} Hz. Check the unit of the times and `frequency_hz`,"
        " or leave that empty."
    ),
    "nothing_wrong": (
        "nothing wrong was found: timing is even, readings are new, motion covers its range."
    ),
    "offset": (
        "readings are offset by {offset_rad:.3f} rad from the commands; the offset is fitted, "
        "but check the joint's zero."
    ),
    "one_frequency": (
        "one frequency only ({frequency_hz:g} Hz): the lag is known up to whole periods and no "
        "model can be tested. Record tones of 1 to 10 Hz."
    ),
    "other_joint": (
        "its position follows the command of {other} and not its own: the joints are mixed up. "
        "Check servo ids and the joint map."
    ),
    "own_trajectory": (
        "the servo's register {register} is {value} ({limit}): it then moves its set-point by "
        "itself, and what is measured is this trajectory, not the servo. Write {cure} into "
        "{register} and record again."
    ),
    "poll_slipped": (
        "{where} the poll slipped by {jump_ms:.0f} ms at {time_s:.2f} s "
        "(Δ log-likelihood {nats:.0f}); "
        "readings before and after it are dated apart."
    ),
    "poll_unresolved": (
        "{percent:.0f} % of the rows have a new reading, and no poll period explains when they "
        "were taken: times are in doubt by {doubt_ms:.0f} ms, which widens lags and dead times."
        " Record at least four tones of 3 s, with a loop faster than the poll."
    ),
    "polled": ("the bus reads each servo every {period_ms:.2f} ms."),
    "polled_loss": (
        "the bus reads each servo every {period_ms:.2f} ms and {loss_percent:.0f} % of the "
        "reads fail silently, so a reading is {age_ms:.0f} ms old on average."
    ),
    "polled_loss_share": (
        "the bus reads each servo every {period_ms:.2f} ms and {loss_percent:.0f} % of the "
        "reads fail silently, so a reading is {age_ms:.0f} ms old on average, "
        "{share_percent:.0f} % of the lag that all rows show."
    ),
    "polled_share": (
        "the bus reads each servo every {period_ms:.2f} ms, {share_percent:.0f} % of the lag "
        "that all rows show."
    ),
    "position_early": (
        "the position moves {early_ms:.0f} ms before the command does: the columns command_rad "
        "and position_rad look swapped, or a row holds the command of another time. Swap them "
        "back, or shift one."
    ),
    "read_early": (
        "readings are stamped {early_ms:.0f} ms before the commands of their rows, which is "
        "{loops:.1f} turns of the loop: lag and dead time come out too short by as much, unless"
        " they were read then. Stamp each reading when it arrives."
    ),
    "scale_asks_care": (
        "the joint moves {gain:.2f} times as far as commanded: check the scale (counts per "
        "radian) and mechanical stops, or record slower tones."
    ),
    "scale_too_large": (
        "the joint moves {gain:.2f} times as far as commanded, which no position servo does: "
        "check the scale (counts per radian, gear, joint map), then record again."
    ),
    "second_writer": (
        "{times} times the joint is pushed off its path while the command goes on, the first time "
        "at {time_s:.2f} s: another program commands this servo too (a second writer). Stop it and"
        " record again; lags come out wrong."
    ),
    "short_tones": (
        "{tones} of {of} tones last less than two periods and are left out of phases and gains."
        " Record 3 s or more each."
    ),
    "short_trials": (
        "{trials} trials have fewer than {rows} rows and are left out. Record them again."
    ),
    "sign_bit": (
        "readings jump by {jump_rad:.2f} rad {times} times, the first time at {time_s:.2f} s, "
        "and run backwards there: negative counts are sent as a sign bit (bit {bit}) and a "
        "magnitude. Clear this bit and negate, then import again."
    ),
    "sign_changed": (
        "from {time_s:.1f} to {until_s:.1f} s the joint moves {after:.2f} times as far as the "
        "command, and {before:.2f} times otherwise: the sign of a column changes there. Make it "
        "one sign, or use the parts apart."
    ),
    "sign_inverted": (
        "the position moves against the command: its sign is inverted (gain {gain:.2f}, "
        "{lag_ms:.0f} ms late). Change the direction in the joint map, or multiply one column "
        "by -1."
    ),
    "slow_commands": (
        "commands reach {speed_rad_s:.1f} of about {limit_rad_s:.1f} rad/s ({percent:.0f} %), "
        "which may not show the servo's speed limit: `calibrate` says whether it is identified."
        " Steps would show it."
    ),
    "some_missing": (
        "{percent:.0f} % of the readings are missing; the rest is used. Check the plugs before "
        "the next recording."
    ),
    "speed_for_command": (
        "the position moves as the sum of the commands ({percent:.0f} %), and not as they do: "
        "they are speeds, duty cycles or changes of the goal. A position servo's log needs its "
        "goals; of changes they are the sum (numpy.cumsum)."
    ),
    "speed_for_position": (
        "the position moves as the joint's speed does: its integral follows the command "
        "({percent:.0f} %), and it does not. The column holds a velocity; take that of the angle."
    ),
    "start_pose": (
        "`start_pose_rad` is {header_rad:.2f}, and the joint stands at {stands_rad:.2f} rad "
        "when the first trial begins. Correct the header, or leave the pose out."
    ),
    "still_trials": (
        "the reading does not move in trial{plural} {trials}, and does in others that are no "
        "slower: the servo no longer answered, or its torque was off. Record again."
    ),
    "tones_found": (
        "tones were found in the command ({listed} Hz): lags and gains are by frequency."
    ),
    "too_few_rows_a_period": (
        "the tone of {frequency_hz:.3g} Hz has {rows:.2g} rows per period, too few to see it. "
        "Record with a faster loop, or slower tones."
    ),
    "too_long": (
        "{where} {span_s:.4g} s; at most {most_s:.0f} s can be computed. Check that times are "
        "seconds and come from one session, or cut the recording."
    ),
    "too_short": ("no trial has {rows} rows: the recording was cut short. Record it again."),
    "torque_changed": (
        "from {time_s:.1f} s on the servo has {percent:+.0f} % torque for the same error (its "
        "natural frequency goes from {before_hz:.1f} to {after_hz:.1f} Hz): settings, supply or "
        "torque limit changed. Use the parts apart."
    ),
    "torque_fades": (
        "at the end the servo has {percent:+.0f} % torque for the same error (its natural "
        "frequency goes from {before_hz:.1f} to {after_hz:.1f} Hz): a motor that heats, or a "
        "supply that sinks. Use a part, or record again when it has cooled."
    ),
    "trials_differ": (
        "two trials of {frequency_hz:.3g} Hz differ: the joint moves {gain:.2f} and "
        "{other_gain:.2f} times as far as commanded, the latter from {time_s:.1f} s on. "
        "Settings, supply or load changed between them: use them apart."
    ),
    "turned": (
        "readings are {offset_rad:.2f} rad away from the commands, half a turn or more: the "
        "encoder's zero or a multiple of 2π. Subtract it from `position_rad`, or calibrate the "
        "joint's zero."
    ),
    "two_clocks": (
        "readings are stamped {apart_s:.3g} s after the commands of their rows: `read_time_s` "
        "and `send_time_s` are of two clocks. Stamp both with one monotonic clock."
    ),
    "uneven_loop": (
        "the loop is uneven ({jitter_ms:.1f} ms of jitter on {loop_ms:.1f} ms); time stamps are"
        " used as they are, but record on an idle machine."
    ),
    "unrepeatable": (
        "periods of one tone differ by {percent:.0f} % of its amplitude, which neither poll nor "
        "quantisation explains: another program commands this servo too (a second writer), "
        "commands are lost, or something touches the joint. Lags come out wrong; record again "
        "with one program on the bus."
    ),
    "unrelated": (
        "the command explains {percent:.0f} % of the position's motion: the two have nothing to"
        " do with each other. Check that both are of the same joint and on the same clock."
    ),
    "wrong_unit": (
        "{large} are {factor:.0f} times as large as {small}, which looks like {unit}. Convert "
        "them to radians: degrees times 0.0174533, counts times 2π over the counts of a turn."
    ),
    "zero_drifts": (
        "the joint's zero moves steadily, by {offset_rad:.2f} rad from first to last reading: a "
        "sensor that warms, a slipping horn, or a load that grows. Use a part, or record again."
    ),
    "zero_moves": (
        "the joint's zero moves by {offset_rad:.2f} rad within a trial, at {time_s:.1f} s: a "
        "slipping horn, a servo that restarted, or two recordings in one trial. Record again."
    ),
}
"""Reason and cure, without the joint's name."""

RIVALS = {
    "clipped": "a clamped goal or a stop",
    "columns_swapped": "swapped columns",
    "gain_changed": "a gain that changes",
    "gain_drifts": "a gain that drifts",
    "held_by_friction": "friction",
    "lag_changed": "a lag that changes",
    "lag_drifts": "clocks that drift apart",
    "left_path": "a joint that does not follow for a while",
    "position_early": "columns shifted in time",
    "second_writer": "a second program",
    "sign_changed": "a sign that changes",
    "sign_inverted": "an inverted sign",
    "torque_changed": "a torque that changes",
    "torque_fades": "a torque that fades",
    "zero_drifts": "a zero that drifts",
    "zero_moves": "a zero that moves",
}
"""What explains a recording nearly as well, by the code of its finding."""


class _Ranges(Formatter):
    """Writes a pair of numbers as a range, once where both read alike."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if not isinstance(value, tuple):
            return format(value, format_spec)
        low, high = (format(end, format_spec) for end in value)
        return low if low == high else f"{low} to {high}"


def text(finding: Finding) -> str:
    """The sentences of one finding, without the joint's name."""
    return _template(finding).format(**finding.values)


def _template(finding: Finding) -> str:
    rival = finding.values.get("rival")
    return WORDS[finding.code] + (f" Nearly as likely: {RIVALS[rival]}." if rival else "")


def shared(by_joint: Mapping[str, Sequence[Finding]]) -> list[tuple[str, str]]:
    """Joints and sentences: findings that differ in nothing but their numbers become one."""
    groups: dict[tuple, dict[str, Finding]] = {}
    for joint, findings in by_joint.items():
        kinds = [
            (f.code, f.verdict, *(v for v in f.values.values() if isinstance(v, str)))
            for f in findings
        ]
        for finding, kind in zip(findings, kinds, strict=True):
            # two of a kind about one joint, e.g. on two of its trials, stay apart
            group = kind if kinds.count(kind) == 1 else (*kind, str(finding.values))
            groups.setdefault(group, {})[joint] = finding
    return [
        ("All joints" if len(group) == len(by_joint) > 2 else ", ".join(group), _ranged(group))
        for group in groups.values()
    ]


def _ranged(findings: Mapping[str, Finding]) -> str:
    first = next(iter(findings.values()))
    values = {
        name: value
        if isinstance(value, str)
        else _ends([f.values[name] for f in findings.values()])
        for name, value in first.values.items()
    }
    return _Ranges().format(_template(first), **values)


def _ends(numbers: Sequence[float]) -> tuple[float, float]:
    return min(numbers), max(numbers)
