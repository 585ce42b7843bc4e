"""Exports of a calibration: servo cards (`servo_models.cards`) of fits under load, and tidy CSV.

A tidy table is for a spreadsheet or for pandas, of a calibration or of a recording. Both open with
comment lines (`# key: JSON value`) on the origin of the numbers; `pandas.read_csv(path,
comment="#")` skips them. A calibration becomes one row per joint and quantity; a recording becomes
a recording file of this project, from whatever layout it was read.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from pupper_sysid.common.data_sheet import stall_torque
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import write_text
from pupper_sysid.servo_models.calibration.calibration import Calibration, InputFile, utc_now
from pupper_sysid.servo_models.calibration.parts import JointCalibration
from pupper_sysid.servo_models.calibration.quantity import Quantity, unit_of
from pupper_sysid.servo_models.cards.card import Gains, Score, ServoCard, Source
from pupper_sysid.servo_models.cards.numbers import LOADED_KEYS, LoadedLoop, TorquePD
from pupper_sysid.sysid.fit.joint_fit import LoadedFit
from pupper_sysid.sysid.recordings.recording import Recording
from pupper_sysid.sysid.recordings.table import comments

_TORQUES = (
    "stall_torque", "back_emf", "armature", "friction_loss", "stribeck_friction", "torque_limit",
)  # fmt: skip

_GRAIN_S = 0.002  # dead times closer than that are alike


def to_card(
    name: str,
    servo: str,
    fits: Mapping[str, LoadedFit],
    recordings: Sequence[Recording],
    source: Source,
    load: str,
    supply_v: float | None = None,
    gains: Gains | None = None,
    default: str | None = None,
    notes: Sequence[str] = (),
) -> ServoCard:
    """A card of fits under load.

    With a known load torques are as fitted. Without one they are known per inertia only, and the
    stall torque of the servo's data sheet at `supply_v` sets their scale.

    Parameters
    ----------
    name : str
        Of the card.
    servo : str
        Manufacturer and model.
    fits : dict of str to LoadedFit
        By specimen, such as a joint.
    recordings : sequence of Recording
        The data; names and hashes go into the card.
    source : Source
        Of the recordings.
    load : str
        What the servo moved, in words.
    supply_v : float, optional
        Supply voltage [V]; by default the reference voltage of the first fit.
    gains : Gains, optional
        I and D gain of the recordings; the P gain is the fit's.
    default : str, optional
        Specimen that stands for the servo type; by default the one nearest to the medians of all.
    notes : sequence of str
        Sentences for the reader.
    """
    first = _first(fits)
    volts = first.reference_voltage_v if supply_v is None else supply_v
    if not volts > 0:
        raise InputError(f"{name}: the recordings hold no supply voltage. Give `supply_v`.")
    told, specimens = list(notes), {}
    for specimen, fit in fits.items():
        scale, why = 1.0, ""
        if not fit.known_load:
            anchor, sheet = stall_torque(servo, volts)
            scale = anchor / fit.numbers["stall_torque"].value
            why = f"scale from the stall torque {anchor:.2f} N·m, {sheet}"
        specimens[specimen] = _loop(fit, scale, why)
        if why and (sentence := f"Torques have their {why}.") not in told:
            told.append(sentence)
            told.append("The armature holds the inertia of what the joint moved.")
    middle = _middle({s: loop.as_pd(fits[s].p_gain) for s, loop in specimens.items()})
    return _card(
        name, servo, fits, recordings, source, specimens, load=load, supply_v=float(volts),
        gains=(gains or Gains()).model_copy(update={"p": float(first.p_gain)}),
        notes=tuple(told), default=default or middle,
    )  # fmt: skip


def to_drive_card(
    name: str,
    servo: str,
    fits: Mapping[str, LoadedFit],
    drives: Mapping[str, tuple[float, float]],
    recordings: Sequence[Recording],
    source: Source,
    load: str,
    notes: Sequence[str] = (),
) -> ServoCard:
    """A card of drives whose gains are in N·m/rad, which sets the scale of all torques.

    Such a drive commands torque, so its numbers are those of a PD servo. Motions that never reach
    its torque limit cannot tell its D gain from drag: `damping_nm_s_per_rad` is their sum.

    Parameters
    ----------
    name : str
        Of the card.
    servo : str
        Manufacturer and model.
    fits : dict of str to LoadedFit
        By specimen, such as a joint.
    drives : dict of str to (float, float)
        By specimen: P gain [N·m/rad] and torque limit [N·m] that were set in the drive.
    recordings : sequence of Recording
        The data; names and hashes go into the card.
    source : Source
        Of the recordings.
    load : str
        What the drive moved, in words.
    notes : sequence of str
        Sentences for the reader.
    """
    _first(fits)
    set_there = "set in the drive and stated by the recording; the scale of all torques"
    specimens = {}
    for specimen, fit in fits.items():
        stiffness, limit = drives[specimen]
        per = fit.numbers["stiffness_nm_per_rad"]

        def scaled(
            of: str, fit: LoadedFit = fit, factor: float = stiffness / per.value
        ) -> Quantity:
            own = fit.numbers[of]
            ends = own.value * factor, own.low * factor, own.high * factor
            return _quantity(ends, fit.undecided.get(of))

        dead_time = fit.numbers["dead_time_s"]
        ends = stiffness / per.value, stiffness / per.high, stiffness / per.low
        specimens[specimen] = TorquePD(
            model="delayed_pd",
            stiffness_nm_per_rad=Quantity(value=stiffness, identified="no", why=set_there),
            damping_nm_s_per_rad=scaled("back_emf"),
            friction_loss_nm=scaled("friction_loss"),
            armature_kg_m2=_quantity(ends, "it holds the inertia of what the joint moved"),
            effort_limit_nm=Quantity(
                value=limit, identified="no", why="set in the drive; never reached here"
            ),
            dead_time_s=_quantity(
                (dead_time.value, dead_time.low, dead_time.high), fit.undecided.get("dead_time_s")
            ),
        )
    return _card(
        name, servo, fits, recordings, source, specimens, load=load, notes=tuple(notes),
        default=next(iter(fits)),
    )  # fmt: skip


def _first(fits: Mapping[str, LoadedFit]) -> LoadedFit:
    if not fits:
        raise InputError("A servo card needs a fit. Name a joint that was fitted.")
    return next(iter(fits.values()))


def _card(
    name: str,
    servo: str,
    fits: Mapping[str, LoadedFit],
    recordings: Sequence[Recording],
    source: Source,
    specimens: Mapping[str, LoadedLoop | TorquePD],
    **stated: Any,
) -> ServoCard:
    return ServoCard(
        name=name,
        servo=servo,
        armature="servo" if all(fit.known_load for fit in fits.values()) else "servo and load",
        published=False,
        source=source,
        data=tuple(
            InputFile(name=r.path.name if r.path else r.name, sha256=r.sha256) for r in recordings
        ),
        scores=tuple(score for s, fit in fits.items() for score in _scores(s, fit)),
        date=utc_now()[:10],
        specimens=dict(specimens),
        **stated,
    )


def _quantity(ends: tuple[float, float, float], doubt: str | None) -> Quantity:
    """A quantity from its value and the ends of its interval."""
    value, low, high = ends
    return Quantity(value=value, low=low, high=high, identified="no" if doubt else "yes", why=doubt)


def _loop(fit: LoadedFit, scale: float, why: str) -> LoadedLoop:
    """Numbers of one fit, torques times `scale`."""
    made: dict[str, Quantity] = {}
    for field, key in LOADED_KEYS.items():
        if field == "armature" and not fit.known_load:
            made[key] = Quantity(value=scale, identified="no", why=why)
            continue
        interval = fit.numbers.get(field)
        if interval is None:
            continue
        factor = scale if field in _TORQUES else 1.0
        factor = 1.0 / scale if field == "load_friction_quadratic" else factor
        doubt = fit.undecided.get(field)
        anchored = bool(why) and factor != 1.0
        made[key] = Quantity(
            value=interval.value * factor,
            low=interval.low * factor,
            high=interval.high * factor,
            identified="no" if doubt else "ratio only" if anchored else "yes",
            why=doubt or (why if anchored else None),
        )
    return LoadedLoop(model="loaded_servo", **made)


def _middle(specimens: Mapping[str, TorquePD]) -> str:
    """The specimen nearest to the medians of stiffness, back-EMF, friction and dead time."""
    own = [pd.parameters for pd in specimens.values()]
    rows = [(p.stiffness, p.back_emf, p.friction_loss, p.dead_time_s) for p in own]
    logs = np.log(np.maximum(np.array(rows, float) + np.array([0, 0, 0, _GRAIN_S]), 1e-9))
    away = np.abs(logs - np.median(logs, axis=0)).sum(axis=1)
    return list(specimens)[int(np.argmin(away))]


def _scores(specimen: str, fit: LoadedFit) -> list[Score]:
    chosen = next(s for s in fit.structures if s.name == fit.structure)
    told = [
        Score(what=f"{specimen}: free run, mean absolute error", value=chosen.mae_rad, unit="rad")
    ]
    if chosen.mae_unseen_rad >= 0:
        unseen = ", ".join(fit.folds)
        told.append(
            Score(
                what=f"{specimen}: the same on runs left out of the fit ({unseen})",
                value=chosen.mae_unseen_rad, unit="rad",
            )
        )  # fmt: skip
    return told


CALIBRATION_COLUMNS = (
    "joint", "part", "quantity", "unit", "value", "low", "high", "identified", "why",
)  # fmt: skip


def to_csv(source: Calibration | Recording, path: Path | None = None, force: bool = False) -> str:
    """`source` as CSV text, written to `path` if one is given.

    Parameters
    ----------
    source : Calibration or Recording
        A calibration gives the columns `CALIBRATION_COLUMNS`: `part` is where the quantity stands
        in the calibration file (`actuator`, `feedback`, `lag`, `scores`, …), `low` and `high` are
        the ends of its 90 % interval, and a number that is not a measured quantity (a score, a
        count of steps) leaves the last four empty. What the calibration does not hold has no row.
        A recording gives its rows with the columns of `sysid.recordings.recording`.
    path : Path, optional
        Where to write; nothing is written without it.
    force : bool
        Replace `path` if it exists.
    """
    text = _calibration(source) if isinstance(source, Calibration) else source.to_csv()
    if path is not None:
        write_text(path, text, force)
    return text


def _calibration(calibration: Calibration) -> str:
    header = calibration.model_dump(mode="json", by_alias=True, exclude={"joints"})
    header["operating_points"] = {
        name: joint.holds_at.model_dump(mode="json") for name, joint in calibration.joints.items()
    }
    buffer = io.StringIO()
    buffer.write(comments("pupper-sysid calibration table", header))
    # text is quoted: a '#' in a sentence must not begin a comment
    table = csv.writer(buffer, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
    buffer.write(",".join(CALIBRATION_COLUMNS) + "\n")
    for name, joint in calibration.joints.items():
        table.writerows([name, *row] for row in _rows(joint))
    return buffer.getvalue()


def _rows(joint: JointCalibration) -> Iterator[list[Any]]:
    """Part, quantity, unit, value, low, high, identified, why of all numbers of one joint."""
    parts: dict[str, BaseModel] = {
        "actuator": joint.actuator,
        "ratios_to_armature": joint.actuator.ratios_to_armature,
        "scale": joint.actuator.scale,
        "feedback": joint.feedback,
        "lag": joint.lag,
        "scores": joint.scores,
    }
    for part, model in parts.items():
        for name, entry in model:
            if isinstance(entry, Quantity):
                numbers = [entry.value, entry.low, entry.high]
                yield [part, name, unit_of(name), *numbers, entry.identified, entry.why]
            elif isinstance(entry, int | float):
                yield [part, name, unit_of(name), entry, "", "", "", ""]
