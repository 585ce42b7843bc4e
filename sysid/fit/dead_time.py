"""Lag of a recording's joints with its parts: `lag`, printed by `delay`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from pupper_sysid.common.results import JointResults
from pupper_sysid.sysid.doctor.checks import Joints, Recordings, each_joint
from pupper_sysid.sysid.fit.joint_fit import joint_lag
from pupper_sysid.sysid.lag.lag_budget import LagBudget

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False)
class LagBudgets(JointResults[LagBudget]):
    """Lag budgets by joint."""

    def plot(self) -> Figure:
        """One stacked bar per joint."""
        from pupper_sysid.sysid.report.figures import lag_budget_figure

        return lag_budget_figure(self)


def lag(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> LagBudgets:
    """Measure the lag of every joint: stale readings, command hold, dead time and dynamics.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Of the bootstrap and of the model's global start.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    LagBudgets
        Lag budget by joint.

    Raises
    ------
    InputError
        If a joint has too little motion.

    Examples
    --------
    >>> from pupper_sysid.sysid.recordings.files import load
    >>> found = lag(load("data/samples/sweep.csv"), "LF_hip")  # doctest: +SKIP
    >>> found["LF_hip"].dead_time_s  # doctest: +SKIP
    Interval(value=0.0249, low=0.0233, high=0.0263)
    """
    work = partial(joint_lag, seed=seed)
    return LagBudgets(joints=each_joint(work, recordings, joints, workers, progress))
