"""Whether a recording shows the load that its header claims.

A known load gives torques their scale: the droop under its weight is a torque in N·m. A load that
is claimed and not there leaves no droop, and a fit explains that by a servo of any strength.
Positions cannot exclude a servo so strong and heavy that the load hardly matters, but data sheets
can: `check_claimed_load` fits the runs without any load, and with the claimed one on a plausible
servo. Where the first is better, the claim is refused; where neither is, the recording cannot tell,
and a note says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.data_sheet import data_sheet
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.signals import rms
from pupper_sysid.sysid.fit import search
from pupper_sysid.sysid.fit.goodness import noise_by_run
from pupper_sysid.sysid.fit.operating_point import loads_in_words
from pupper_sysid.sysid.fit.run import Run, fresh_residuals
from pupper_sysid.sysid.fit.search import Fit, Problem, temperature_at
from pupper_sysid.sysid.fit.structure import Structure
from pupper_sysid.sysid.recordings.recording import Trial

_TELLING_NATS = 5.0
"""Difference of log-likelihoods that decides: one free number explains 5.4 by chance in one of
1,000."""
_REFUSING_NATS = 3.0
"""The same between two fits of which neither beats the other by `_TELLING_NATS` on any servo."""
_HEAVIEST_ARMATURE = 30.0
"""Armature over the load's inertia, where no data sheet of the servo is known. A load that a servo
more than twice as heavy moves hardly counts in its motion."""
_TORQUE_FACTORS = (0.25, 3.0)
"""Stall torque over the data sheet's. Published fits of the STS3215 have up to 1.9 times that; a
lower supply and limits of the firmware reduce it."""
_TIME_CONSTANT_S = 0.3
"""Armature times no-load speed over stall torque: fits of STS3215, XL330 and SCS0009 have 0.02 to
0.08 s."""
_STARTS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Armatures over the largest plausible one, from which fits with the claimed load start."""
_LIGHT_ARMATURE = 0.05
"""Armature over the load's inertia below which a load is checked for being claimed too small."""
_TORQUES = ("stiffness", "stall_torque", "friction_loss", "armature", "damping")


def check_claimed_load(
    joint: str,
    trials: Sequence[Trial],
    structure: Structure,
    runs: tuple[Run, ...],
    noise_rad: tuple[float, ...],
    fit: Fit,
    least_rad: float,
    rng: np.random.Generator,
) -> tuple[str, ...]:
    """Notes on a claimed load that the recording cannot confirm, or contradicts in its size.

    `structure`: without a known load nothing is checked. `noise_rad`: of each run. `fit`: of
    `structure` to the runs with the claimed load. `least_rad`: least noise. Raises InputError if
    the runs move as without a load, or with a small part of it.
    """
    if not structure.scales.known_load:
        return ()
    claim = Problem(structure, runs, noise_rad)
    temperature = temperature_at(claim, fit)
    unloaded = tuple(replace(run, load=np.zeros(3)) for run in runs)
    bare = Problem(structure, unloaded, noise_rad)
    near = search.refine(bare, _with_armature(structure, fit, structure.scales.inertia)[None])
    if _data_cost(bare, near) - _data_cost(claim, fit) > _TELLING_NATS * temperature:
        return _size_notes(joint, trials, structure, claim, fit, temperature)
    # the noise of the load-free fit: that of the claim may be all misfit
    rough = min(near, *search.search(bare, rng, near.point[None]), key=lambda f: f.cost)
    residuals = fresh_residuals(structure, structure.decode(rough.point), unloaded)
    noise_rad = noise_by_run(residuals, unloaded, least_rad)
    bare, claim = (replace(problem, noise_rad=noise_rad) for problem in (bare, claim))
    free = search.refine(bare, np.array([rough.point, near.point]))
    temperature = temperature_at(bare, free)
    plausible = _plausible(trials, structure)
    loaded = Problem(plausible, runs, noise_rad)
    heaviest = _high(plausible, "armature")
    starts = np.array([_scaled(structure, free, heaviest * s) for s in _STARTS])
    any_servo, best = (_best_fit(p, np.array([fit.point, *starts]), rng) for p in (claim, loaded))
    if _data_cost(bare, free) - _data_cost(claim, any_servo) > _TELLING_NATS * temperature:
        return _size_notes(joint, trials, structure, claim, any_servo, temperature)
    nats = (_data_cost(loaded, best) - _data_cost(bare, free)) / temperature
    claimed = f"{joint}: the header claims a load of {loads_in_words(trials)}"
    if nats > _REFUSING_NATS:
        errors = (1e3 * _rms(problem, f) for problem, f in ((bare, free), (loaded, best)))
        without, with_load = (f"{error:.2g}" for error in errors)
        raise InputError(
            f"{claimed}, but the recording shows none: without a load a servo fits to {without} "
            f"mrad, with this one on any plausible servo ({_words(plausible)}) to "
            f"{with_load} mrad. Take `loads` out of the header, or hang the load on so that it "
            "swings about a horizontal axis, and record again."
        )
    return (
        f"{claimed}; the recording neither shows its weight beside the servo's friction and "
        "inertia nor excludes it, so only the claim sets the scale of torques. Check it, and "
        "record with a heavier load or larger motions.",
    )


def _best_fit(problem: Problem, starts: NDArray[np.float64], rng: np.random.Generator) -> Fit:
    """The best fit from some starts."""
    near = search.refine(problem, np.clip(starts, *problem.structure.box))
    return search.evolve(problem, [near], rng, short=True)


def _size_notes(
    joint: str,
    trials: Sequence[Trial],
    structure: Structure,
    claim: Problem,
    fit: Fit,
    temperature: float,
) -> tuple[str, ...]:
    """Notes on a load that is there, and of another size than claimed.

    Raises InputError if it is much smaller, by what the named servo can be.
    """
    values = dict(zip(structure.names, structure.decode(fit.point), strict=True))
    stated_load = f"{joint}: the load of {loads_in_words(trials)} that the header claims"
    plausible = _plausible(trials, structure)
    low, high = _low(plausible, "stall_torque"), _high(plausible, "stall_torque")
    if not low <= values["stall_torque"] <= high:
        bounded = replace(claim, structure=_bounded(structure, stall=(low, high)))
        near = search.refine(bounded, np.clip(fit.point, *bounded.structure.box)[None])
        if _data_cost(bounded, near) - _data_cost(claim, fit) > _TELLING_NATS * temperature:
            stall = f"{values['stall_torque']:.2g} N·m"
            if values["stall_torque"] > high:
                raise InputError(
                    f"{stated_load} is not there: the recording shows at most "
                    f"{100 * high / values['stall_torque']:.2g} % of its weight, because with all "
                    f"of it the servo's stall torque would be {stall}, and by its data sheet "
                    f"{high:.2g} N·m is more than it can have. Weigh and measure the load again "
                    "and correct `loads` in the header, or take it out."
                )
            return (
                f"{stated_load} is probably too small: with it the servo's stall torque is "
                f"{stall}, where its data sheet leads to expect {low:.2g} to {high:.2g}. Weigh and "
                "measure it again: all torques scale with it.",
            )
    if values["armature"] < _LIGHT_ARMATURE * structure.scales.inertia:
        doubled = replace(
            claim, runs=tuple(replace(r, load=r.load * [1, 2, 1]) for r in claim.runs)
        )
        near = search.refine(doubled, fit.point[None])
        if _data_cost(claim, fit) - _data_cost(doubled, near) > _TELLING_NATS * temperature:
            return (
                f"{stated_load} has less weight for its inertia than the recording shows: twice "
                "its weight fits better. Weigh arm and mass again: all torques scale with it.",
            )
    return ()


def _plausible(trials: Sequence[Trial], structure: Structure) -> Structure:
    """The structure within the limits of the named servo, or of servos in general."""
    inertia = structure.scales.inertia
    models = {t.servo.model for t in trials}
    sheet = data_sheet(models.pop() or "") if len(models) == 1 else None
    if sheet is None:
        return _bounded(structure, armature=_HEAVIEST_ARMATURE * inertia)
    volts = {t.servo.supply_voltage_v for t in trials}
    known = volts.pop() if len(volts) == 1 else None
    ratings = sheet.ratings if known is None else (sheet.at(known),)
    torques = [rating.stall_torque_nm for rating in ratings]
    speeds = [rating.no_load_speed_rad_s for rating in ratings if rating.no_load_speed_rad_s]
    limits = [t.servo.registers.get("torque_limit", 1000) / 1000 for t in trials]
    most = _TORQUE_FACTORS[1] * max(torques)
    heaviest = _TIME_CONSTANT_S * max(torques) / min(speeds) if speeds else np.inf
    return _bounded(
        structure,
        armature=heaviest if speeds else _HEAVIEST_ARMATURE * inertia,
        stall=(_TORQUE_FACTORS[0] * min(torques) * min(*limits, 1.0), most),
    )


def _bounded(
    structure: Structure, armature: float = np.inf, stall: tuple[float, float] = (0.0, np.inf)
) -> Structure:
    """The structure with a largest armature [kg·m²], and a least and largest torque [N·m]."""
    ends = {"armature": (0.0, armature), "stall_torque": stall}
    parameters = []
    for p in structure.parameters:
        low, high = ends.get(p.name, (0.0, np.inf))
        if p.name in ends:
            high = float(np.clip(high, p.low, p.high))
            p = replace(p, low=min(float(np.clip(low, p.low, p.high)), high), high=high)
        parameters.append(p)
    return replace(structure, parameters=tuple(parameters))


def _low(structure: Structure, name: str) -> float:
    return structure.parameters[structure.names.index(name)].low


def _high(structure: Structure, name: str) -> float:
    return structure.parameters[structure.names.index(name)].high


def _with_armature(structure: Structure, fit: Fit, more: float) -> NDArray[np.float64]:
    """The fit's point with a larger armature: that of the load that is left out."""
    values = structure.decode(fit.point)
    values[structure.names.index("armature")] += more
    return np.clip(structure.encode(values), *structure.box)


def _scaled(structure: Structure, fit: Fit, armature: float) -> NDArray[np.float64]:
    """The fit's point with all torques and inertias scaled to an armature: the same motion."""
    values = structure.decode(fit.point)
    factor = armature / values[structure.names.index("armature")]
    scaled = np.array([name in _TORQUES for name in structure.names])
    return structure.encode(np.where(scaled, factor * values, values))


def _data_cost(problem: Problem, fit: Fit) -> float:
    """Cost of the readings alone, without the prior."""
    cost = float(problem.costs(fit.point[None])[0])
    return cost - float(problem.prior(fit.point))


def _rms(problem: Problem, fit: Fit) -> float:
    """RMS error of the readings [rad]."""
    noise = np.repeat(problem.noise_rad, [len(r.sample_step) for r in problem.runs])
    return rms(problem.scaled(fit.point[None])[0] * noise)


def _words(plausible: Structure) -> str:
    """The limits of a servo, in words."""
    return (
        f"armature up to {_high(plausible, 'armature'):.2g} kg·m², stall torque up to "
        f"{_high(plausible, 'stall_torque'):.2g} N·m"
    )
