"""DelayedPD and sparse equations, fitted to the same part of the data as the networks.

Both are fitted in free run from rest to the part's readings at their own times
(`sysid.identify.output_error`). The result is arrays per joint, ready for a servo model file.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS
from pupper_sysid.sysid.feedback.poll_lattice import quantum
from pupper_sysid.sysid.identify.candidates.models import candidate_model
from pupper_sysid.sysid.identify.candidates.simulation import TrialData
from pupper_sysid.sysid.identify.output_error import Problem
from pupper_sysid.sysid.identify.search import PREFERRED, fit_problems
from pupper_sysid.sysid.servo_fit.data import ServoData
from pupper_sysid.sysid.servo_fit.windows import Part, chosen

_NAMES = (
    "dead_time_s", "stiffness", "damping", "friction_loss", "effort_limit", "velocity_limit",
)  # fmt: skip
_MANY = 10  # problems; fewer get more starts, since few tones have many local optima


def delayed_pd_fits(
    data: ServoData, parts: Sequence[Part], seed: int
) -> list[dict[str, NDArray[np.float64]]]:
    """One DelayedPD per joint for each part of the data.

    Returns
    -------
    list of dict of str to ndarray, shape (joints,)
        Fields of `DelayedPDParameters` for an armature of 1, and `offset_rad`.
    """
    model = candidate_model(PREFERRED)
    problems, shifts = [], []
    for part in parts:
        for joint in data.joints:
            trials = part_trials(data, joint, part)
            noise = noise_scale(data, joint)
            problems.append(Problem(trials, (True,) * len(trials), noise, {}))
            shifts.append(_truncation_shift(data, joint))
    rng = np.random.default_rng(seed)
    keep, final = (12, 3) if len(problems) <= _MANY else (6, 2)
    best = fit_problems(model, problems, rng, keep, final)
    found = []
    for n in range(len(parts)):
        own = slice(n * len(data.joints), (n + 1) * len(data.joints))
        v = np.array([f.values for f in best[own]]).T
        found.append(
            dict(zip(_NAMES, v, strict=False))
            | {"armature": np.ones_like(v[0]), "offset_rad": v[6] + np.array(shifts[own])}
        )
    return found


def sindy_fits(
    data: ServoData, parts: Sequence[Part], seed: int
) -> list[dict[str, NDArray[np.float64]]]:
    """One sparse equation per joint for each part of the data.

    Returns
    -------
    list of dict of str to ndarray, shape (joints,)
        Every name of `COEFFICIENTS` that some joint has, `dead_time_s` and `offset_rad`.
    """
    from pupper_sysid.sysid.sparse.equations import fit_equations

    found = []
    for part in parts:
        trials = {j: part_trials(data, j, part) for j in data.joints}
        results = fit_equations(trials, {j: noise_scale(data, j) for j in data.joints}, seed)
        names = [n for n in COEFFICIENTS if any(n in r.coefficients for r in results.values())]
        absent = {"saturation_error_rad": np.inf}
        values = {
            n: np.array([r.coefficients.get(n, absent.get(n, 0.0)) for r in results.values()])
            for n in names
        }
        values["dead_time_s"] = np.array([r.dead_time_s for r in results.values()])
        values["offset_rad"] = np.array(
            [r.offset_rad + _truncation_shift(data, j) for j, r in results.items()]
        )
        found.append(values)
    return found


def part_trials(data: ServoData, joint: str, part: Part) -> tuple[TrialData, ...]:
    """Runs of a joint on the clock of physics, with only the part's readings."""
    found = [(run, chosen(run, part)) for run in data.runs[joint]]
    return tuple(run.trial_data(use) for run, use in found if use.any())


def noise_scale(data: ServoData, joint: str) -> float:
    """Scale of ordinary residuals [rad]: two quantisation steps, or the scatter of readings."""
    step = quantum([run.trial for run in data.runs[joint]])
    # two counts, as measured on the real servos (facts of the recordings); 12 mrad if unknown
    return 2.0 * step if step > 0 else 0.012


def _truncation_shift(data: ServoData, joint: str) -> float:
    """Mean of quantised minus unquantised commands [rad].

    The fit uses commands as whole counts; the model that runs gets them unquantised.
    """
    runs = data.runs[joint]
    return float(np.mean(np.concatenate([r.truncated_rad - r.command_rad for r in runs])))
