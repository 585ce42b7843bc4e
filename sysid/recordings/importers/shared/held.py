"""Commands and readings of two streams, joined by time: each reading with the command in force.

A servo holds a command until the next one arrives, so a reading belongs to the last command before
it. Nothing is interpolated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def held_commands(
    sent_s: NDArray[np.float64], commands: NDArray[np.float64], read_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """The command in force at each reading (zero-order hold).

    Parameters
    ----------
    sent_s : ndarray, shape (n,)
        When commands were sent, not decreasing.
    commands : ndarray, shape (n,) or (n, joints)
    read_s : ndarray, shape (m,)
        When positions were read.

    Returns
    -------
    send_time_s : ndarray, shape (k,)
        When the command of each row was sent; where it had been sent for an earlier reading
        already, the time of this reading, since the same command stays in force.
    commands : ndarray, shape (k,) or (k, joints)
    kept : ndarray of bool, shape (m,)
        Readings with a command before them.

    Examples
    --------
    >>> sent, command = np.array([0.0, 1.0]), np.array([5.0, 6.0])
    >>> held_commands(sent, command, np.array([-1.0, 0.5, 0.75, 1.5]))
    (array([0.  , 0.75, 1.  ]), array([5., 5., 6.]), array([False,  True,  True,  True]))
    """
    last = np.searchsorted(sent_s, read_s, side="right") - 1
    kept = last >= 0
    last, read = last[kept], read_s[kept]
    again = np.concatenate([[False], np.diff(last) == 0])
    return np.where(again, read, sent_s[last]), commands[last], kept
