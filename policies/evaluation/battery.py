"""The battery: conditions that make walking robots fall, for `policies.evaluation.evaluate`.

Usual conditions separate nothing: an open-loop trot falls under none of them. These go on until it
does: pushes, slopes, stairs, loads off centre, a weak leg, missed control ticks, late and jittered
servos, slippery ground, and all that typically differs between a robot and its model
(`sim.walking.differences.TYPICAL`). All are walked under random commands.
"""

from __future__ import annotations

from collections.abc import Callable

from pupper_sysid.policies.evaluation.evaluate import Case
from pupper_sysid.policies.walks.conditions import Walker
from pupper_sysid.policies.walks.handicaps import Handicap
from pupper_sysid.sim.robot.terrain import STAIRS_M
from pupper_sysid.sim.walking.differences import TYPICAL

BATTERY: tuple[Case, ...] = (
    *(
        Case("push", f"pushes of {speed:g} m/s", handicap=Handicap(push_m_s=speed))
        for speed in (0.4, 0.8, 1.2)
    ),
    *(
        Case("slope", f"slope of {slope:g}°", handicap=Handicap(slope_deg=slope))
        for slope in (10.0, 15.0, 20.0)
    ),
    *(
        Case(
            "stairs", f"steps of {1e3 * riser:g} mm", terrain="stairs",
            handicap=Handicap(riser_m=riser),
        )
        for riser in STAIRS_M
    ),
    Case(
        "payload", "150 g, 4 cm left",
        handicap=Handicap(payload_kg=0.15, payload_at_m=(0.0, 0.04)),
    ),
    Case(
        "payload", "150 g, 8 cm behind",
        handicap=Handicap(payload_kg=0.15, payload_at_m=(-0.08, 0.0)),
    ),
    *(
        Case("leg", f"one leg at {100 * torque:g} %", handicap=Handicap(weak_leg=torque))
        for torque in (0.5, 0.25)
    ),
    *(
        Case("ticks", f"{100 * share:g} % ticks missed", handicap=Handicap(missed_ticks=share))
        for share in (0.1, 0.3)
    ),
    *(
        Case("dead time", f"dead time +{1e3 * extra:g} ms", extra_dead_time_s=extra)
        for extra in (0.04, 0.08)
    ),
    *(
        Case("jitter", f"jitter +{1e3 * jitter:g} ms", handicap=Handicap(extra_jitter_s=jitter))
        for jitter in (0.01, 0.02)
    ),
    Case("friction", "friction of 0.15", handicap=Handicap(friction=0.15)),
    Case("robot", "unlike its model", differences=TYPICAL),
)  # fmt: skip
"""Rows of the battery, after that of random commands."""


def battery_robots(episodes: int) -> Callable[[Case, Walker], int]:
    """Episodes of each case and walker: equally many."""
    return lambda case, walker: episodes
