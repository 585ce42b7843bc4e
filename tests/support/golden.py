"""Golden figures: what the estimators say of the frozen recordings, to 4 significant digits.

`tests/golden/figures.yaml` has one entry per recording of `support.golden_recordings`: its origin,
and the figures of three stages, by joint.

* `doctor`: verdict and sentences of `ps.examine`, poll period, loss, share of stale readings.
* `lag`: the lag before a model is fitted, its parts, and the lag and gain of each tone, of all
  joints. (`ps.lag` adds the dead time, at the price of a calibration: it is in the next stage.)
* `calibrate`: lag, dead time, structure, ratios to the armature, feedback and scores as the
  calibration file holds them, and the errors of `ps.compare` on the same recording, whose baselines
  stand beside. Of the joints that `golden_recordings` names, each calibrated alone.

Intervals are 90 %. A refused stage has the refusal instead. `differences` holds figures to 1 % or
to the absolute floor of their unit (`FLOORS`), whichever is larger; words must be the same. A
search and a posterior by random draws can turn on the last bit of a sum, so that another processor,
or another version of NumPy, may move what the data hardly determine by more than that.
`tests/golden/renew.py` is the command that checks, renews and says what changed.
"""

import argparse
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

import pupper_sysid as ps
from pupper_sysid.common.results import plain
from pupper_sysid.sysid.doctor.checks import Recordings, chosen_joints, joint_rng, usable_trials
from pupper_sysid.sysid.lag.lag_budget import LagBudget, lag_budget
from support.golden_recordings import EMULATED, REAL

FIGURES = Path(__file__).resolve().parents[1] / "golden" / "figures.yaml"
STAGES = ("doctor", "lag", "calibrate")
DIGITS = 4
RELATIVE = 0.01
FLOORS = {
    "ms": 0.05, "mrad": 0.05, "deg": 0.1, "hz": 0.01, "percent": 0.1, "1": 0.002,
    "per_s2": 1.0, "per_s": 0.1, "rad_s2": 0.1, "rad_s": 0.01, "nm": 1e-4,
}  # fmt: skip
"""Absolute tolerance by unit, the ending of a figure's name; `1` for names without one."""
SEED = 0

Place = tuple[str, ...]
Figures = dict[str, Any]
"""Nested figures: dicts by name of dicts, lists, texts, numbers and None."""

_HEADER = """\
# Golden figures of the frozen recordings; what they are says tests/support/golden.py.
# Not edited by hand:  .venv/bin/python tests/golden/renew.py --renew
"""
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def figures_of(name: str, stages: Sequence[str] = STAGES) -> Figures:
    """Origin and figures of one recording.

    Parameters
    ----------
    name : str
        Of `EMULATED` or `REAL`.
    stages : sequence of str
        Of `STAGES`.
    """
    figures: Figures = {}
    for place, compute in pieces(name, stages):
        _put(figures, place, compute())
    return figures


def pieces(name: str, stages: Sequence[str]) -> list[tuple[Place, Callable[[], Any]]]:
    """Places in the figures of one recording, and what computes each."""
    joints: Sequence[str] | None = None
    if name in EMULATED:
        recordings = [EMULATED[name].record()]
        head, origin = recordings, EMULATED[name].origin(recordings[0])
    else:
        recordings, joints = REAL[name].record(), REAL[name].calibrated
        head, origin = REAL[name].head(recordings), REAL[name].origin()
    every = chosen_joints(recordings)
    parts: list[tuple[Place, Callable[[], Any]]] = [(("recording",), lambda: origin)]
    if "doctor" in stages:
        parts.append((("doctor",), partial(_doctor, recordings)))
    if "lag" in stages:
        parts += [(("lag", j), partial(_or_refusal, _lag, recordings, j)) for j in every]
    if "calibrate" in stages:
        parts += [
            (("calibrate", j), partial(_or_refusal, _calibrate, head, j)) for j in joints or every
        ]
    return parts


def is_absent(name: str) -> bool:
    """Whether a real recording is out of reach here."""
    return name in REAL and not REAL[name].paths


def read() -> Figures:
    """The frozen figures, by recording."""
    return yaml.load(FIGURES.read_text(), _LOADER) if FIGURES.exists() else {}


def write(figures: Figures) -> None:
    """Freeze figures, in the order of `EMULATED` and `REAL`."""
    ordered = {
        name: {key: figures[name][key] for key in ("recording", *STAGES) if key in figures[name]}
        for name in (*EMULATED, *REAL)
        if name in figures
    }
    # leaves in one line each: a figure with its interval is one line of a diff
    text = yaml.safe_dump(
        ordered, sort_keys=False, default_flow_style=None, width=10_000, allow_unicode=True
    )
    FIGURES.write_text(_HEADER + text)


@dataclass(frozen=True)
class Difference:
    """A figure that changed: its place, and both values (None where there is none)."""

    place: str
    before: Any
    after: Any

    @property
    def percent(self) -> float:
        """Relative change [%]; NaN where it is none of numbers."""
        numbers = isinstance(self.before, int | float) and isinstance(self.after, int | float)
        if not numbers or isinstance(self.before, bool) or not self.before:
            return math.nan
        return 100 * (self.after - self.before) / abs(self.before)


def differences(before: Any, after: Any, exact: bool = False, place: str = "") -> list[Difference]:
    """Figures that differ by more than the tolerance.

    Parameters
    ----------
    before, after : plain data
    exact : bool
        Without a tolerance.
    place : str
        Of both, for `Difference.place`.
    """
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        keys = [*before, *(key for key in after if key not in before)]
        return [
            each
            for key in keys
            for each in differences(
                before.get(key), after.get(key), exact, f"{place} / {key}" if place else str(key)
            )
        ]
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        return [
            each
            for n, (one, other) in enumerate(zip(before, after, strict=True), 1)
            for each in differences(one, other, exact, f"{place} {n}")
        ]
    same = before == after if exact else _close(before, after, place)
    return [] if same else [Difference(place, before, after)]


def table(changes: Sequence[Difference]) -> str:
    """The changes as aligned lines: quantity, before, after, %."""
    rows = [("quantity", "before", "after", "%")]
    for each in changes:
        percent = f"{each.percent:+.1f}" if math.isfinite(each.percent) else ""
        rows.append((each.place, _shown(each.before), _shown(each.after), percent))
    wide = [max(len(row[k]) for row in rows) for k in range(4)]
    return "\n".join(
        "  ".join(cell.ljust(w) for cell, w in zip(row, wide, strict=True)).rstrip() for row in rows
    )


def unit_of(place: str) -> str:
    """Unit of a figure: the longest key of `FLOORS` that its name ends in, else `1`.

    Examples
    --------
    >>> unit_of("sweep / lag / LF_hip / lag_ms / low"), unit_of("feedback / loss / value")
    ('ms', '1')
    """
    name = next(
        part for part in reversed(place.split(" / ")) if part not in ("value", "low", "high")
    )
    endings = [unit for unit in FLOORS if name == unit or name.endswith(f"_{unit}")]
    return max(endings, key=len, default="1")


def _close(before: Any, after: Any, place: str) -> bool:
    if isinstance(before, str) and isinstance(after, str):
        # the words must be the same, numbers in them may move by 1 % or their last digit
        numbers = [_NUMBER.findall(text) for text in (before, after)]
        if _NUMBER.sub("#", before) != _NUMBER.sub("#", after) or "sha256" in place:
            return before == after
        return all(
            abs(float(a) - float(b)) <= max(RELATIVE * abs(float(a)), 1.01 * _last_digit(a))
            for a, b in zip(*numbers, strict=True)
        )
    if not all(isinstance(x, int | float) for x in (before, after)):
        return before == after
    # half of the last stored digit on either side is rounding
    rounding = 10.0 ** (math.floor(math.log10(abs(before) or 1.0)) + 1 - DIGITS)
    return abs(after - before) <= max(RELATIVE * abs(before), FLOORS[unit_of(place)]) + rounding


def _last_digit(number: str) -> float:
    return 10.0 ** -len(number.partition(".")[2])


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}"
    text = "–" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:59]}…"


def _or_refusal(stage: Any, recordings: Recordings, joint: str) -> Figures:
    try:
        return stage(recordings, joint)
    except ps.InputError as error:
        return {"refused": str(error)}


def _doctor(recordings: Recordings) -> Figures:
    return {
        joint: _rounded({
            "verdict": j.verdict,
            "poll_period_ms": 1e3 * j.poll_period_s, "loss": j.loss, "stale_share": j.hold_share,
            "fresh_share": j.fresh_fraction, "quantum_mrad": 1e3 * j.quantum_rad,
            "findings": list(j.reasons),
        })
        for joint, j in ps.examine(recordings, seed=SEED).items()
    }  # fmt: skip


def _lag(recordings: Recordings, joint: str) -> Figures:
    trials = usable_trials(recordings, joint)[joint]
    return _budget(lag_budget(joint, trials, joint_rng(SEED, joint)))


def _budget(lag: LagBudget) -> Figures:
    feedback = lag.feedback
    return _rounded({
        "lag_ms": _interval(lag.lag_s, 1e3), "fresh_lag_ms": _interval(lag.fresh_lag_s, 1e3),
        "raw_lag_ms": _interval(lag.raw_lag_s, 1e3),
        "readings": feedback.kind, "poll_period_ms": 1e3 * feedback.poll_period_s,
        "loss": feedback.loss,
        "tones": {
            f"{tone.frequency_hz:.2f} Hz": {
                "lag_ms": _interval(tone.lag_s, 1e3), "gain": tone.gain,
            }
            for tone in lag.by_frequency
        },
    })  # fmt: skip


def _calibrate(recordings: Recordings, joint: str) -> Figures:
    result = ps.calibrate(recordings, joint, seed=SEED)
    own = result.calibration.joint(joint)
    a, f, s, ratios = own.actuator, own.feedback, own.scores, own.actuator.ratios_to_armature
    unseen = s.rmse_leave_one_frequency_out_rad
    unseen = s.rmse_unseen_runs_rad if unseen is None else unseen
    found: Figures = {
        "structure": own.selection.model,
        "speed_limited_by": "back-EMF" if a.back_emf_nm_s_per_rad.value > 0 else "set-point rate",
        "dead_time_ms": _quantity(a.dead_time_s, 1e3),
        "stiffness_per_s2": _quantity(ratios.stiffness),
        "damping_per_s": _quantity(ratios.damping),
        "friction_rad_s2": _quantity(ratios.friction_loss),
        "effort_rad_s2": _quantity(ratios.effort_limit),
        "back_emf_per_s": _quantity(ratios.back_emf),
        "velocity_limit_rad_s": _quantity(a.velocity_limit_rad_s),
        "top_speed_rad_s": a.top_speed_rad_s,
        "command_jitter_ms": _quantity(a.command_jitter_s, 1e3),
        "offset_mrad": _quantity(f.offset_rad, 1e3),
        "poll_period_ms": _quantity(f.poll_period_s, 1e3),
        "loss": _quantity(f.loss),
        "mean_age_ms": _quantity(f.mean_age_s, 1e3),
        "lag": _budget(result[joint].lag),
        "scores": {
            "fresh_error_mrad": _times(s.rmse_free_run_fresh_rad, 1e3),
            "held_error_mrad": _times(s.rmse_free_run_held_rad, 1e3),
            "raw_error_mrad": _times(s.rmse_free_run_raw_rad, 1e3),
            "one_step_error_mrad": _times(s.rmse_one_step_rad, 1e3),
            "unseen_error_mrad": _times(unseen, 1e3),
            "fit_percent": s.fit_percent,
        },
    }  # fmt: skip
    if own.servo is not None:
        found["servo"] = {
            name: _quantity(value) if hasattr(value, "identified") else plain(value)
            for name, value in own.servo
            if value is not None and name != "loads_tested"
        }
    found["compare"] = _compare(recordings, joint, result.calibration)
    return _rounded(found)


def _compare(recordings: Recordings, joint: str, calibration: ps.Calibration) -> Figures:
    """Errors of the calibration and of the baselines, as `compare` prints them."""
    try:
        made = ps.compare(recordings, [calibration], joint, seed=SEED)
    except ps.InputError as error:
        return {"refused": str(error)}
    models = {
        name: {
            "free_run_error_mrad": 1e3 * model.joints[joint].rmse_free_run_rad,
            "held_error_mrad": 1e3 * model.joints[joint].rmse_held_rad,
            "raw_error_mrad": 1e3 * model.joints[joint].rmse_raw_rad,
        }
        for name, model in made.models.items()
    }
    return {
        "readings": made.readings[joint].rule,
        **models,
        "persistence_error_mrad": 1e3 * made.persistence_rmse_rad[joint],
        "repeatability_mrad": 1e3 * made.repeatability_rad[joint],
    }


def _interval(interval: ps.Interval, factor: float = 1.0) -> Figures:
    return {name: factor * getattr(interval, name) for name in ("value", "low", "high")}


def _quantity(quantity: Any, factor: float = 1.0) -> Figures:
    numbers = {name: _times(getattr(quantity, name), factor) for name in ("value", "low", "high")}
    return numbers | {"identified": quantity.identified}


def _times(number: float | None, factor: float) -> float | None:
    return None if number is None else factor * number


def _rounded(value: Any) -> Any:
    """Plain data, its numbers to 4 significant digits; one that is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def names(only: Sequence[str] = ()) -> Iterator[str]:
    """Recordings whose name contains one of `only`; all without it."""
    for name in (*EMULATED, *REAL):
        if not only or any(part in name for part in only):
            yield name


def main(arguments: list[str] | None = None) -> int:
    """Check or renew figures, as `tests/golden/renew.py` says; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Check or renew the golden figures, and print what changed."
    )
    parser.add_argument("--renew", action="store_true", help="write the figures")
    parser.add_argument("--only", nargs="+", default=[], help="parts of recordings' names")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES)
    parser.add_argument("--missing", action="store_true", help="only figures that are not frozen")
    parser.add_argument("--exact", action="store_true", help="every stored digit counts")
    parser.add_argument("--reverse", action="store_true", help="the last recording first")
    options = parser.parse_args(arguments)
    chosen = list(names(options.only))
    if not chosen:
        parser.error(f"no recording's name contains {' or '.join(options.only)}")
    changes: list[Difference] = []
    for name in reversed(chosen) if options.reverse else chosen:
        if is_absent(name):
            print(f"{name}: not here, left as it is", file=sys.stderr)
            continue
        for place, compute in pieces(name, options.stages):
            if options.missing and _at(read(), (name, *place)) is not None:
                continue
            started = time.process_time()
            after = compute()
            frozen = read()  # now, so that two runs may share the work
            # a renewed figure counts as changed where its stored digits are
            exact = options.exact or options.renew
            before = _at(frozen, (name, *place))
            changes += differences(before, after, exact, " / ".join((name, *place)))
            if options.renew:
                _put(frozen, (name, *place), after)
                write(frozen)
            spent = time.process_time() - started
            print(f"{' / '.join((name, *place))}: {spent:.1f} s of processor time", file=sys.stderr)
    print(table(changes) if changes else "No figure differs.")
    return 1 if changes and not options.renew else 0


def _at(figures: Figures, place: Place) -> Any:
    """The figures at a place; None where there are none."""
    for name in place:
        figures = (figures or {}).get(name)
    return figures


def _put(figures: Figures, place: Place, value: Any) -> None:
    *way, last = place
    for name in way:
        figures = figures.setdefault(name, {})
    figures[last] = value
