"""Hysteresis of a servo over its P gain, with what explains it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from pupper_sysid.common.figure_style import BLUE, FAINT, ORANGE, WIDTH_IN, styled
from pupper_sysid.common.interval import Interval
from pupper_sysid.sysid.backlash.results import JointBacklash

_PANEL_IN = 2.8


@styled
def hysteresis_figure(found: Mapping[str, JointBacklash]) -> Figure:
    """Hysteresis with its 90 % interval over the P gain, a panel per joint.

    Parameters
    ----------
    found : mapping of str to JointBacklash
        By joint.
    """
    drawn = Figure(figsize=(WIDTH_IN, _PANEL_IN * len(found)), layout="constrained")
    for axes, (joint, own) in zip(
        drawn.subplots(len(found), squeeze=False)[:, 0], found.items(), strict=True
    ):
        gains = np.array([g.p_gain for g in own.gains])
        known = np.isfinite(gains).all()
        place = gains if known else np.arange(len(gains), dtype=float)
        best, low, high = np.degrees([_ends(g.hysteresis_rad) for g in own.gains]).T
        axes.errorbar(
            place, best, [best - low, high - best], fmt="o", color=BLUE, capsize=3,
            label="hysteresis, 90 %",
        )  # fmt: skip
        if known and len(gains) > 1:
            lowest = int(np.argmin(gains))
            line = np.linspace(gains.min(), gains.max(), 200)
            axes.plot(
                line, best[lowest] * gains[lowest] / line, "--", color=FAINT,
                label="friction alone: as 1/P",
            )  # fmt: skip
        if (zone := own.dead_zone_rad) is not None:
            ends = 2 * np.degrees([zone.low, zone.high])
            axes.axhspan(*ends, color=ORANGE, alpha=0.3, lw=0, label="twice the dead zone, 90 %")
        axes.set_ylim(bottom=0)
        axes.set_xticks(place, [f"{g:g}" if known else "?" for g in gains])
        axes.set_xlabel("P gain")
        axes.set_ylabel("hysteresis [°]")
        play = own.backlash_rad
        told = (
            "not determined"
            if play is None
            else "{:.2f}° [{:.2f}, {:.2f}]".format(*np.degrees(_ends(play)))
        )
        axes.set_title(f"{joint}: backlash {told}")
        axes.legend()
    return drawn


def _ends(interval: Interval) -> tuple[float, float, float]:
    return interval.value, interval.low, interval.high
