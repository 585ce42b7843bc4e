"""What a column of a log is, by the words of its name: command, position, time, and whose.

    q_cmd_rad              command of the only joint, in rad
    observation.state.knee position of the knee
    /joint_states/LF_HAA/position, joint_pos_target_0, pos_estimate, present_position_tick …

A name is taken apart at its separators, at capitals (`kneeCmd`) and into known words
(`targetpos`, `qdes`). `WORDS` says what each word stands for, once for all layouts; what is no word
of the table is the joint's name. Of several columns for one joint the better one is taken: radians
before degrees before counts, words for a command before words that may mean one, `present` before
a bare `position`, plain before filtered or simulated values.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

COMMAND, STATE, ANGLE, OTHER = "command", "state", "angle", "other"
MAYBE_COMMAND, MAYBE_STATE = "command, perhaps", "state, perhaps"
TIME, UNIT, JOINT, DERIVED = "time", "unit", "joint", "derived"

UNITS: dict[str, str] = {
    word: unit
    for unit, words in (
        ("rad", "rad rads radian radians 弧度 рад 라디안"),
        ("mrad", "mrad"),
        ("deg", "deg degs degree degrees ° grad grados gradi graus graden degré degrés degres "
                "stopnie stopni derece grader fok grade astetta stupňů stupeň "
                "stupne 度 도 град градусы градусов"),
        ("turns", "turn turns rev revs revolution revolutions rotation rotations "
                  "umdrehungen"),
        ("percent", "percent pct"),
        ("share", "norm normalized normalised"),
        ("length", "mm cm meter meters metre metres inch inches"),
        ("counts", "count counts tick ticks pulse pulses"),
        ("steps", "steps microsteps qc inc incs increments lsb"),
        ("scale:1e-06", "urad µrad"),
        (f"scale:{np.pi / 18e3!r}", "cdeg centideg centidegree centidegrees"),
        (f"scale:{np.pi / 1800!r}", "ddeg decideg decidegree decidegrees"),
        (f"scale:{np.pi / 18e4!r}", "mdeg millideg millidegree millidegrees"),
        (f"scale:{np.pi / 200!r}", "gon gons gradian gradians"),
        (f"scale:{np.pi / 10800!r}", "arcmin"),
    )
    for word in words.split()
}  # fmt: skip
"""Words of units, and the unit as options write it; of counts and steps the log does not say how
many make a turn."""

SECONDS = {"ns": 1e-9, "nsec": 1e-9, "nanosec": 1e-9, "nsecs": 1e-9, "nanos": 1e-9, "us": 1e-6,
           "µs": 1e-6, "usec": 1e-6, "micros": 1e-6, "ms": 1e-3, "millis": 1e-3, "s": 1.0,
           "sec": 1.0, "secs": 1.0, "seconds": 1.0, "min": 60.0, "minutes": 60.0, "秒": 1.0,
           "毫秒": 1e-3, "초": 1.0}  # fmt: skip
"""Words of units of time, and how long they are."""

WORDS: dict[str, str] = {
    word: kind
    for kind, words in (
        (COMMAND, "command commands commanded cmd cmds goal goals target targets tgt desired des "
                  "setpoint setpoints set sp reference references ref refs demand demanded "
                  "requested action actions soll sollwert sv consigne consigna riferimento "
                  "referencia börvärde 目标 目標 指令 给定 设定 목표 명령 "
                  "ohjearvo tavoite žádaná žádaný zadaná alapjel cél mål 指令値 目標値 "
                  "zadana zadany referência deseado deseada desejado desejada desiderato gewenst "
                  "gewenste voulu voulue заданный заданное задание hedef 目標"),
        (MAYBE_COMMAND, "u r ctrl control input inputs send sent tx request planned plan "
                        "expected trajectory traj leader nominal wanted write written order"),
        (STATE, "actual act present pres measured measurement measurements meas msr feedback fb "
                "fbk observed observation observations obs state states estimate estimated est "
                "real encoder enc reading readings sensed sensor response resp "
                "potentiometer pot resolver pv ist istwert ärvärde mesure misura medida "
                "实际 当前 実測 反馈 現在 測定 测量 현재 측정 "
                "zmierzona zmierzony medido gemeten atual mesuré mesurée misurato измеренный "
                "mittaus mitattu skutečná skutečný měřená mért olculen ölçülen uppmätt "
                "計測値 測定値 "
                "измеренное gerçek gercek"),
        (MAYBE_STATE, "y output outputs read rx follower receive received recv rcv process"),
        (ANGLE, "position positions pos posn angle angles ang qpos q p theta θ winkel "
                "角度 位置 각도 위치 ángulo posición posicion ângulo posição kąt hoek угол "
                "angolo posizione açı aci poloha úhel szög pozíció asento kulma vinkel läge "
                "положение позиция kot"),
        (OTHER, "v w velocity velocities vel vels speed speeds omega qd dq qdot qvel rate accel "
                "acceleration accelerations acc qdd ddq torque torques tau effort efforts load "
                "current currents curr cur amps ampere voltage volt volts temperature temperatures "
                "temp temps pwm duty power pw error errors err deviation mode status flag flags "
                "latency delay age dt counter crc checksum quat quaternion gyro imu mag battery "
                "gain gains kp ki kd stiffness damping limit limits lim max min seq index idx "
                "frame iteration iter step overrun moving force feedforward ff tff integral prev "
                "previous last offset home initial init delta diff frequency freq hz cov "
                "covariance enable enabled reached done warning fault trial episode loop "
                "strom spannung dot iq uq ud trq torq rpm rps dps nm newton"),
        (TIME, "time times timestamp timestamps t ts stamp stamps clock elapsed seconds secs sec "
               "millis micros nanos nsec ns us µs ms date datetime utc epoch at "
               "nanosec nanosecs nsecs usec usecs tout minutes days datenum zeit temps tiempo "
               "tempo tid datum fecha uhrzeit hora heure 时间 時間 "
               "時刻 시간 秒 毫秒 초 czas tijd время zaman aika čas idő cas"),
        (UNIT, " ".join(UNITS)),
        (JOINT, "joint joints dof dofs motor motors servo servos actuator actuators axis axes dxl "
                "group controller controllers data value values val field name names msg body "
                "header array low point"),
        (DERIVED, "filtered filt filter smoothed smooth sim simulated simulation model modeled "
                  "modelled predicted prediction pred mean avg relative rel next raw"),
    )
    for word in words.split()
}  # fmt: skip
"""What each word of a column's name stands for."""

TIMES = ("time", "timestamp", "t", "stamp", "time_since_start", "ts", "elapsed", "seconds", "clock",
         "uhrzeit", "hora", "heure")  # fmt: skip
"""Names of times, the likeliest first."""

TIMER = re.compile(r"ticks?|timer|cycles?|counter", re.IGNORECASE)
"""Names of times in ticks, where the log says how long one is."""
TIME_STEP = re.compile(r"(d_?t|delta_?t(ime)?|time_?(step|delta))([_ (\[].*)?", re.IGNORECASE)
"""Names of times between rows."""

_UNIT_RANK = {"rad": 0, "": 1, "mrad": 2, "deg": 3, "turns": 4, "counts": 5, "steps": 5,
              "percent": 6, "share": 6, "length": 6}  # fmt: skip
_SEPARATORS = re.compile(r"[\s_./:\\\[\](){}<>$%#*,;|='\"（）［］【】：，-]+")
_CAMEL = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?(?:[^\W\dA-Z_]|°)+|\d+|[^\w°]+")
_IN_UNIT = re.compile(r"\s+(?:in|en)\s+(?=\S+$)", re.IGNORECASE)  # Winkel in Grad
_SOLE_LETTERS = frozenset("ury")  # that mean something where no other word does
_LETTERS = frozenset("qput")  # that begin a word such as qdes or tcmd
_LONGEST = 200
_PARTS_OF = re.compile(  # 0.1deg, 1e-3 rad, pi rad; deg/10, deg*100, deg_x10
    r"(?<![^\W_])(?<!\.)(?P<part>\d*\.\d+|\d+e-\d+|pi|π)[\s*·_]*(?P<unit>deg|rad|°)(?![a-z])|"
    r"(?<![a-z])(?P<whole>deg|rad|°)[\s_]*[/*×x][\s_]*(?P<times>10+)(?!\d)"
)
_PERCENT = re.compile(r"(?<=.)[%％]")  # %time is ROS's
_SYMBOL = re.compile(r"\[(m|N|N[·.*]?m|A|mA|V|mV)\]\s*$")  # units of one letter, only in brackets
_RAD = {"deg": np.pi / 180, "°": np.pi / 180, "rad": 1.0}


@dataclass(frozen=True)
class Column:
    """What a name says of its column."""

    name: str
    kind: str
    """Empty for another quantity, and unknown where no word of the name is known."""
    joint: str
    """The words that name a joint, as in the column's name, joined by `_`; empty for none."""
    key: str
    """The same without words such as `joint`, to be compared."""
    unit: str
    """"rad", "mrad", "deg", "turns", "counts", "steps", "percent", "scale:0.01" (rad), or empty."""
    rank: tuple[int, ...]
    """Smaller for the better of two columns for one purpose."""
    words: frozenset[str]
    """Those that make it what it is."""
    template: str
    """The name with `{joint}` in place of the joint's name."""


def column(name: str) -> Column:
    """What the name of a column says."""
    name = str(name)[:_LONGEST]
    if symbol := _SYMBOL.search(name):
        plain = _column(name[: symbol.start()])
        length = symbol[1] == "m"
        return replace(
            plain,
            name=name,
            template=f"{plain.template}{name[symbol.start() :]}",
            kind=plain.kind if length else "",
            unit="length" if length else "",
        )
    if not (part := _PARTS_OF.search(name)):
        return _column(name)
    word = part["unit"] or part["whole"]
    if part["times"]:
        factor = 1 / float(part["times"])
    else:
        factor = np.pi if part["part"] in ("pi", "π") else float(part["part"])
    if not factor > 0:
        return _column(name)
    plain = _column(name.replace(part[0], word))
    return replace(plain, name=name, template=name, unit=f"scale:{factor * _RAD[word]:.9g}")


@lru_cache(4096)
def _column(name: str) -> Column:
    bare_name = _IN_UNIT.sub(" ", name.strip()).replace("μ", "µ")  # the Greek letter
    bare_name = _PERCENT.sub(" percent ", bare_name)
    parts = [part for word in _SEPARATORS.split(bare_name) if word for part in _parts(word)]
    known = [WORDS.get(p.lower(), "") for p in parts]
    lower = [p.lower() for p in parts]
    leaf = _SEPARATORS.split(re.split(r"[./]", bare_name)[-1])
    of_leaf = [WORDS.get(part.lower(), "") for word in leaf if word for part in _parts(word)]
    above = len(known) - len(of_leaf)
    if above > 0 and ANGLE in of_leaf and OTHER not in of_leaf and len(lower[-1]) > 1:
        known = [JOINT if k == OTHER else k for k in known[:above]] + of_leaf  # pos_vel_mapper.pos
    kinds = set(known)

    def others(kind: str, words: Iterable[str]) -> None:
        """Make these words of another kind."""
        known[:] = [kind if w in words else k for w, k in zip(lower, known, strict=True)]
        kinds.clear()
        kinds.update(known)

    if "d" in lower and ANGLE in kinds and not kinds & {COMMAND, STATE, OTHER}:  # q_d, theta_d
        known[lower.index("d")] = COMMAND
        kinds.add(COMMAND)
    if (
        lower[-1:] in (["s"], ["s2"], ["sec"], ["min"])
        and known[-2:-1] == [UNIT]
        and (lower[-2] in UNITS)
    ):  # rad/s
        others(OTHER, lower[-1:])
    if parts[-1:] == ["A"] and lower[-2:-1] in (["q"], ["d"], ["i"]):  # q_A, a current; not q_a
        others(OTHER, ("q", "d", "i", "a"))
    if "mapper" in lower:  # pos_rel of ODrive's mapper is its estimate
        others("", ("rel",))
    if kinds & {COMMAND, STATE, ANGLE}:  # a joint that is called y
        others("", _SOLE_LETTERS)
    angle = ANGLE in kinds and (lower.count("p") == 0 or kinds & {COMMAND, STATE, UNIT}
                                or "pos" in "".join(lower))  # fmt: skip
    long_angle = any(k == ANGLE and len(w) > 1 for w, k in zip(lower, known, strict=True))
    if long_angle and lower[-1] != "status":  # a message's name: Motor_1_Status.Position
        others(STATE, ("status",))
    if (long_angle or UNIT in kinds) and lower[-1:] != ["current"]:  # not a current of an axis
        others(STATE, ("current", "curr", "cur"))
    unit = next((UNITS[w] for w, k in zip(lower[::-1], known[::-1], strict=True)
                 if k == UNIT), "")  # fmt: skip
    if lower[-1:] == ["raw"]:
        unit = unit or "counts"
        known[-1] = UNIT
    timed = any(
        k == TIME and (w != "t" or n == 0 or not angle)  # q_t is an angle
        for n, (w, k) in enumerate(zip(lower, known, strict=True))
    )
    if timed:  # time_s
        known = [UNIT if w == "s" and not k else k for w, k in zip(lower, known, strict=True)]
    telling = {COMMAND, MAYBE_COMMAND, STATE, MAYBE_STATE} | ({ANGLE} if timed else set())
    words = frozenset(w for w, k in zip(lower, known, strict=True) if k in telling)
    kind = ""
    if OTHER in kinds and (UNIT in kinds or not timed):
        pass
    elif timed:
        kind = "time"
    elif COMMAND in kinds:
        kind = "command"
    elif MAYBE_COMMAND in kinds and STATE not in kinds:
        kind = "command"
    elif angle or STATE in kinds or MAYBE_STATE in kinds:
        kind = "position"
    elif not kinds & {TIME, DERIVED} and "" in kinds:
        kind = "unknown"
    sure = COMMAND in kinds if kind == "command" else bool(angle or STATE in kinds)
    doubt = 0 if sure else 2 if lower == ["u"] else 1  # beside a reference, u is a drive's input
    style = (0 if angle and (STATE in kinds) else 1 if angle else 2) if kind == "position" else 0
    rank = (int(DERIVED in set(known)), doubt, _UNIT_RANK.get(unit, 3), style)
    runs: list[list[tuple[str, str]]] = [[]]  # of words that are no others'
    for part, k in zip(parts, known, strict=True):
        if k in ("", JOINT):
            runs[-1].append((part, k))
        elif runs[-1]:
            runs.append([])
    runs = [run for run in runs if any(k == "" for _, k in run)]
    joint = "_".join(p for run in runs for p, _ in run)
    bare = [p for run in runs for p, k in run if k == ""]
    key = "_".join(f"{int(p)}" if p.isascii() and p.isdigit() else p.lower() for p in bare)
    key = re.sub(r"(?<=[^\W\d])_(?=[^\W\d])", "", key)  # ShoulderPan is shoulder_pan
    template = name if kind == "unknown" else _template(name, bare)
    return Column(name, kind, joint, key, unit, rank, words, template)


def columns_of(names: Iterable[str]) -> list[Column]:
    """What the names of a table say, with the joints' bare names beside their commands.

    In `hip_cmd, hip` and `phi_ref, phi` the name of a joint alone is its position.
    """
    columns = [column(name) for name in names]
    commands = {c.key for c in columns if c.kind == "command"}
    if any(c.kind == "command" and c.name.lower().startswith("p_") for c in columns):  # p_des
        columns = [replace(c, kind="position", rank=(0, 0, 1, 1)) if c.name == "p" else c
                 for c in columns]  # fmt: skip
    if any(c.kind == "command" and c.words != {"input"} for c in columns):
        # of a controller with a set-point: what it reads, and what it sends to the motor
        inputs = [c for c in columns if c.name.lower() == "input" and c.key == ""]
        driven = inputs or any(c.name.lower() in ("error", "err", "e") for c in columns)
        columns = [
            replace(c, kind="position", rank=(0, 1, 1, 2)) if c in inputs
            else replace(c, kind="") if driven and c.name.lower() == "output" else c
            for c in columns
        ]  # fmt: skip
    placed = {c.key for c in columns if c.kind == "position"}
    return [
        replace(c, kind="position", template=_template(c.name, [c.name]))
        if c.kind == "unknown" and c.key in commands - placed else c
        for c in columns
    ]  # fmt: skip


def _parts(word: str) -> list[str]:
    """A word as known words and what is between them; whole where it has none."""
    if word.lower() in WORDS:
        return [word]
    pieces = _CAMEL.findall(word)
    if len(pieces) > 1 and any(_known(piece) for piece in pieces):
        words: list[str] = []
        rest = ""
        for piece in pieces:
            if split := _known(piece):
                words += [rest, *split] if rest else split
                rest = ""
            elif piece == "d" and rest.isdigit():  # q1d, the desired q1
                words, rest = [*words, rest, "d"], ""
            else:
                rest += piece
        return [*words, rest] if rest else words
    return _known(word) or [word]


def _known(word: str) -> list[str]:
    """The words of the table that a word is made of; empty if it has others."""
    lower = word.lower()
    if lower in WORDS and (len(lower) > 1 or lower in "qθ°"):
        return [word]
    return list(_compound(lower))


@lru_cache(4096)
def _compound(word: str) -> tuple[str, ...]:
    """Two to four words of the table, one behind the other; a letter may stand before them."""
    for first in sorted(range(2, len(word) - 1), reverse=True):
        head, tail = word[:first], word[first:]
        if head in WORDS and (rest := (tail,) if tail in WORDS else _compound(tail)):
            return (head, *rest) if len(tail) > 1 else ()
    if len(word) > 3 and word[0] in _LETTERS:
        tail = word[1:]
        rest = (tail,) if tail in WORDS else _compound(tail)
        if rest and {WORDS[w] for w in rest} & {COMMAND, STATE}:
            return (word[0], *rest)
    return ()


def _template(name: str, joint: Sequence[str]) -> str:
    """The name with `{joint}` for the words that name a joint, where they stand together."""
    if not joint:
        return name
    match = re.search(r"[^0-9A-Za-z]+".join(map(re.escape, joint)), name)
    return f"{name[: match.start()]}{{joint}}{name[match.end() :]}" if match else name


def time_columns(names: Sequence[str]) -> list[str]:
    """Columns of times, the likeliest first: plain names, then those of a clock or an event."""
    ranked = []
    for name in names:
        parsed = column(name)
        lower = [w.lower() for w in _SEPARATORS.split(name) if w]
        if parsed.kind == "time" and not parsed.words:
            bare = [w for w in lower if WORDS.get(w) == TIME and w not in SECONDS] or lower
            place = TIMES.index(bare[0]) if bare[0] in TIMES else len(TIMES)
            ranked.append(((len(parsed.key) > 0, place, len(lower)), name))
        elif lower[:3] == ["time", "since", "start"] or name.lower() == "x_value":  # LabVIEW's
            ranked.append(((False, 4, 3), name))
    return [name for _, name in sorted(ranked, key=lambda pair: pair[0])]


def has_time(names: Sequence[str]) -> bool:
    """Whether one of these columns is a time."""
    return any(column(n).kind == "time" or TIME_STEP.fullmatch(n) for n in names) or bool(
        time_columns(names)
    )
