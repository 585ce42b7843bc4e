"""DelayedPD and sparse equations, fitted to the same part of the data as the networks.

Both are fitted in free run from the first reading to the part's readings at their own times
(`sysid.fit.search`). The result is arrays per joint, ready for a servo model file.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.sparse_equation import COEFFICIENTS
from pupper_sysid.sysid.feedback.poll_lattice import quantum
from pupper_sysid.sysid.fit.run import Run
from pupper_sysid.sysid.fit.search import Problem, search
from pupper_sysid.sysid.fit.structure import PREFERRED, candidate
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
    model = candidate(PREFERRED)
    keep, final = (12, 3) if len(parts) * len(data.joints) <= _MANY else (6, 2)
    fits = []
    for part in parts:
        own = []
        for joint in data.joints:
            runs = part_runs(data, joint, part)
            problem = Problem(model, runs, (noise_scale(data, joint),) * len(runs))
            rng = np.random.default_rng(seed)
            own.append(model.decode(search(problem, rng, keep=keep, final=final)[0].point))
        v = np.array(own).T
        shifts = np.array([_truncation_shift(data, joint) for joint in data.joints])
        fits.append(
            dict(zip(_NAMES, v, strict=False))
            | {"armature": np.ones_like(v[0]), "offset_rad": v[6] + shifts}
        )
    return fits


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
        runs = {j: part_runs(data, j, part) for j in data.joints}
        results = fit_equations(runs, {j: noise_scale(data, j) for j in data.joints}, seed)
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


def part_runs(data: ServoData, joint: str, part: Part) -> tuple[Run, ...]:
    """Runs of a joint on the clock of physics, with only the part's readings."""
    found = [(run, chosen(run, part)) for run in data.runs[joint]]
    return tuple(run.on_physics(use) for run, use in found if use.any())


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
