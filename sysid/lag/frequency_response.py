"""Frequency response of a recording's joints: `frequency_response`, printed by `bode`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from pupper_sysid.common.results import JointResults
from pupper_sysid.sysid.lag.joint_response import FrequencyResponse, joint_response
from pupper_sysid.sysid.recordings.joints import Joints, Recordings, each_joint, joint_rng
from pupper_sysid.sysid.recordings.recording import Trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponses(JointResults[FrequencyResponse]):
    """Frequency responses by joint."""

    def plot(self) -> Figure:
        """Gain and phase over frequency."""
        from pupper_sysid.sysid.report.figures import bode_figure

        return bode_figure(self)

    def __str__(self) -> str:
        return "\n".join(f"{joint}\n{response}" for joint, response in self.items())


def frequency_response(
    recordings: Recordings,
    joints: Joints = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> FrequencyResponses:
    """Measure the frequency response of every joint.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Trials of one joint are pooled.
    joints : str or sequence of str, optional
        Which joints; by default all that were recorded.
    seed : int
        Of the bootstrap.
    workers : int
        Processes.
    progress : callable, optional
        Called with a joint's name when it is done.

    Returns
    -------
    FrequencyResponses
        Response by joint.

    Raises
    ------
    InputError
        If a joint has neither tones nor a multisine.
    """
    work = partial(_measure, seed=seed)
    return FrequencyResponses(joints=each_joint(work, recordings, joints, workers, progress))


def _measure(joint: str, trials: tuple[Trial, ...], seed: int) -> FrequencyResponse:
    return joint_response(joint, trials, joint_rng(seed, joint))
