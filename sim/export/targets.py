"""The exports that are one text, by the target's name.

    text = SIMULATORS["isaaclab"](load_calibration("calibrated.yaml"), physics_step_s=0.005)

Newton takes a folder of files: `sim.export.newton`.
"""

from __future__ import annotations

from collections.abc import Callable

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sim.export.isaaclab import to_isaaclab
from pupper_sysid.sim.export.json_file import to_json
from pupper_sysid.sim.export.mjcf import to_mjcf
from pupper_sysid.sim.export.mjlab import to_mjlab

SIMULATORS: dict[str, Callable[[Calibration, float], str]] = {
    "mjcf": to_mjcf, "isaaclab": to_isaaclab, "mjlab": to_mjlab, "json": to_json,
}  # fmt: skip
ENDINGS = {"mjcf": ".xml", "isaaclab": "_isaaclab.py", "mjlab": "_mjlab.py", "json": ".json"}
"""How the names of their files end."""
