"""Servo cards of fits under load: what `servo_cards.py` writes into `servo_models/cards/data`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.data_sheet import stall_torque
from pupper_sysid.common.errors import InputError
from pupper_sysid.servo_models.calibration.calibration import InputFile, utc_now
from pupper_sysid.servo_models.calibration.quantity import Quantity
from pupper_sysid.servo_models.cards.card import Gains, Score, ServoCard, Source
from pupper_sysid.servo_models.cards.numbers import LOADED_KEYS, LoadedLoop, TorquePD
from pupper_sysid.sysid.fit.results import LoadedFit
from pupper_sysid.sysid.recordings.recording import Recording

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

    `fits` are by specimen, such as a joint; of `recordings` names and hashes go into the card;
    `load` says in words what the servo moved. The supply voltage [V] is by default the reference
    voltage of the first fit, `gains` adds I and D gain of the recordings, and `default` names the
    specimen that stands for the servo type, by default the one nearest to the medians of all.
    """
    first = _first_fit(fits)
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

    `drives` has by specimen the P gain [N·m/rad] and the torque limit [N·m] that were set in it.
    """
    _first_fit(fits)
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


def _first_fit(fits: Mapping[str, LoadedFit]) -> LoadedFit:
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
