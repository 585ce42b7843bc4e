"""The published figure that no command of the tool draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pupper_sysid.common.figure_style import JOINT_COLOURS, axes_column, styled

_SHOWN_S = 2.0
_THIGH = 1  # LF thigh, as the paper draws


@styled
def delay_trace_figure(
    actions: Mapping[str, Sequence[NDArray[np.floating]]], delays_ms: Sequence[float], step_s: float
) -> Figure:
    """The LF thigh's action over two seconds, a panel per delay, a line per policy."""
    figure, axes = axes_column(len(delays_ms), 1.9 * len(delays_ms))
    count = round(_SHOWN_S / step_s)
    time = step_s * np.arange(count)
    for i, (one, delay) in enumerate(zip(axes, delays_ms, strict=True)):
        for k, (policy, conditions) in enumerate(actions.items()):
            one.plot(
                time, conditions[i][:count, _THIGH], "-" if k == 0 else "--",
                color=JOINT_COLOURS[k], label=policy,
            )  # fmt: skip
        one.set(title=f"joints late by {delay:g} ms", ylabel="rad", xlim=(0, time[-1]))
    axes[-1].set_xlabel("time [s]")
    axes[0].legend(fontsize=7, loc="upper right")
    return figure
