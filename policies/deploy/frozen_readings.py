"""Detection of a frozen reading by a model of the servo under the same commands.

The guard stops a robot if a command moved by 0.1 rad and the reading did not change
(`hardware.safety.monitor`). A hip is commanded less than that in most walks. Less is no evidence by
itself: dry friction holds a servo, and servos under load stood still for seconds against commands
that moved by 0.05 rad. So the commands are passed through a model of the servo, friction included:
where the model moves and the reading does not, the reading is frozen, or the servo is.

    watch = FrozenReadings(SyntheticPD(parameters, 0.02), controller.to_servo)
    deploy(..., watchers=[watch])

Where the model does not move either, nothing can be found, and the motion is too small to matter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.errors import SafetyStop
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.safety.monitor import GuardLimits

if TYPE_CHECKING:
    from pupper_sysid.policies.deploy.deployment import Tick
    from pupper_sysid.policies.deploy.observers import Observer

Array = NDArray[np.float64]

WINDOW_S = 2.0
"""Longer than any run of lost polls, and than most rests of a live reading."""
_LATE_S = 0.3  # motion that a reading may not show yet: dead time, servo lag, age
_MOVED_RAD = 0.03  # five quantisation steps of the robot's proxy; the models' error in free run
_SAME_RAD = 1e-6
_FOLLOWS_SHARE = GuardLimits().follows_share  # of the model's motion; less is noise about one place
_CHECK_EVERY_TICKS = 5


class FrozenReadings:
    """Watcher of a walk: stops it if a reading stays the same while its servo must have moved.

    Parameters
    ----------
    servos : Observer
        Model of the servos in free run at the loop's period, in servo coordinates.
    to_servo : callable
        Joint angles to servo coordinates [rad].
    joints : sequence of str
        Their names; the Mini Pupper's by default.
    """

    def __init__(
        self,
        servos: Observer,
        to_servo: Callable[[Array], Array],
        joints: Sequence[str] = JOINT_NAMES,
    ):
        self._joints = joints
        self._servos, self._to_servo = servos, to_servo
        ticks = round(WINDOW_S / servos.period_s)
        self._moved: deque[Array] = deque(maxlen=ticks)
        self._read: deque[Array] = deque(maxlen=ticks)
        self._late = max(round(_LATE_S / servos.period_s), 1)
        self._ticks = 0

    def __call__(self, tick: Tick) -> None:
        """Take a tick.

        Raises
        ------
        SafetyStop
            If a reading has not changed in the last two seconds, but for noise, in which the model
            moved.
        """
        sent = self._to_servo(tick.sent)
        if not self._ticks:  # after standing still: at rest where it was commanded to be
            self._servos.reset(sent)
        self._ticks += 1
        self._read.append(self._to_servo(tick.reading.position_rad))
        self._moved.append(self._servos.step(sent, self._read[-1]).position)
        if len(self._read) == self._read.maxlen and self._ticks % _CHECK_EVERY_TICKS == 0:
            self._check()

    def _check(self) -> None:
        moved = np.ptp(np.array(self._moved)[: -self._late], axis=0)
        read = np.array(self._read)
        # a joint without any reading is the guard's business
        spread = np.nanmax(read, axis=0, initial=-np.inf) - np.nanmin(read, axis=0, initial=np.inf)
        noise = np.maximum(_FOLLOWS_SHARE * moved, _SAME_RAD)
        frozen = (moved > _MOVED_RAD) & (spread >= 0) & (spread < noise)
        if frozen.any():
            k = int(np.argmax(frozen))
            same = "the same position"
            if spread[k] >= _SAME_RAD:
                same = f"positions within {spread[k]:.3f} rad"
            raise SafetyStop(
                f"{self._joints[k]} has reported {same} for {WINDOW_S:g} s, in which a "
                f"servo under its commands moves by {moved[k]:.2f} rad. It is blocked, without "
                "power, or has stopped answering; switch the servos' power off and on."
            )
