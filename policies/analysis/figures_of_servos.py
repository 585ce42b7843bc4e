"""Figure of what a gait needs of its servos: torque over speed, with what a servo has."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, RED, axes_column, styled
from pupper_sysid.common.joints import KINDS
from pupper_sysid.policies.analysis.servo_demand import ServoDemand

_SHOWN = 4000


@styled
def demand_figure(demand: ServoDemand) -> Figure:
    """Needed torque over speed, by kind of joint; the line is what the servo has."""
    figure, axes = axes_column(len(KINDS), 2.3 * len(KINDS))
    for kind, one in zip(KINDS, axes, strict=True):
        names = [name for name in demand.joints if name.endswith(f"_{kind}")]
        speed = np.concatenate([demand.samples[name][0] for name in names])
        torque = np.concatenate([demand.samples[name][1] for name in names])
        every = max(1, len(speed) // _SHOWN)
        one.plot(speed[::every], torque[::every], ".", ms=1.5, color=BLUE, rasterized=True)
        own = demand.joints[names[0]]
        stall, top = own.stall_torque_nm, own.top_speed_rad_s
        end = float(speed.max())
        last = end if top is None else top
        at_last = stall if top is None else own.torque_at_top_nm
        # driving the torque left falls with speed, braking it rises by as much
        one.plot([0, last, last, 0], [stall, at_last, at_last - 2 * stall, -stall], color=RED)
        one.set_title(kind)
        one.set_ylabel("N·m")
    axes[0].plot([], [], color=RED, label=demand.servo)
    axes[0].legend(loc="center right")
    axes[-1].set_xlabel("speed [rad/s]; torque is positive where it drives")
    return figure
