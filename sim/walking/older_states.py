"""States of environments that older versions saved, in the layout of today."""

from __future__ import annotations

from typing import Any

import numpy as np

from pupper_sysid.sim.robot.mini_pupper import TRUNK_KG

_TRUNK = 1  # MuJoCo's first body after the world


def of_today(state: dict[str, Any], readings: int) -> dict[str, Any]:
    """A state of `PupperEnv`, perhaps of an older version, as the present one saves it.

    Parameters
    ----------
    state : dict
        See `PupperEnv.state`.
    readings : int
        How many readings of each joint are kept.
    """
    if "robot" in state or "batch.body_mass" not in state:
        return state
    found = {k: v for k, v in state.items() if not k.startswith("batch.") or k == "batch.state"}
    if "drawn.delay_s" in found:
        found["drawn.dead_time_s"] = found.pop("drawn.delay_s")
    found.setdefault("drawn.back_emf", np.zeros_like(found["drawn.dead_time_s"]))
    found["payload_kg"] = np.asarray(state["batch.body_mass"])[:, _TRUNK] - TRUNK_KG
    found["robot"] = "with feet of cylinders"
    found["knee"] = "linkage" if "batch.tendon_armature" in state else "serial"
    # they were kept newest first, and are kept in turn
    newest = int(state["counters"][1])
    order = [(newest - k) % readings for k in range(readings)]
    seen = np.empty_like(np.moveaxis(state["_seen"], 1, 0))
    seen[order] = np.moveaxis(state["_seen"], 1, 0)
    return found | {"_seen": seen}
