"""pupper-sysid: measure a cheap servo, get a simulator that moves like it.

    import pupper_sysid as ps

    recording = ps.load("sweep.csv")
    print(ps.lag(recording))
    calibrated = ps.calibrate(recording)
    calibrated.save("calibrated.yaml")

Each name is the function or class that the commands use, imported when it is first looked up.
Functions take one `Recording` or a sequence of them, whose trials are pooled per joint, and
return frozen dataclasses with `to_dict` (the JSON of the command), `to_frame` and `plot`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pupper_sysid.common.errors import InputError, PupperError
    from pupper_sysid.common.interval import Interval
    from pupper_sysid.common.joints import JOINT_NAMES
    from pupper_sysid.policies.network.policy_file import Policy, load_policy
    from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
    from pupper_sysid.servo_models.delayed_pd import DelayedPD, DelayedPDParameters
    from pupper_sysid.servo_models.held_feedback import HeldFeedback
    from pupper_sysid.servo_models.servo_file import load_servo_model
    from pupper_sysid.servo_models.sparse_equation import SparseEquation
    from pupper_sysid.sim.walking.env import PupperEnv, make_env
    from pupper_sysid.sysid.backlash.measure import backlash
    from pupper_sysid.sysid.compare.compare import compare
    from pupper_sysid.sysid.doctor.examination import examine
    from pupper_sysid.sysid.fit.calibrate import calibrate
    from pupper_sysid.sysid.fit.dead_time import lag
    from pupper_sysid.sysid.lag.frequency_response import frequency_response
    from pupper_sysid.sysid.recordings.files import load
    from pupper_sysid.sysid.recordings.recording import Recording
    from pupper_sysid.sysid.report.report import write_report as report
    from pupper_sysid.sysid.servo_fit.fit import fit_servo
    from pupper_sysid.sysid.sparse.equations import sparse_equations

_MODULES = {
    "load": "sysid.recordings.files",
    "Recording": "sysid.recordings.recording",
    "examine": "sysid.doctor.examination",
    "lag": "sysid.fit.dead_time",
    "frequency_response": "sysid.lag.frequency_response",
    "backlash": "sysid.backlash.measure",
    "calibrate": "sysid.fit.calibrate",
    "sparse_equations": "sysid.sparse.equations",
    "fit_servo": "sysid.servo_fit.fit",
    "compare": "sysid.compare.compare",
    "report": "sysid.report.report:write_report",
    "load_calibration": "servo_models.calibration.calibration",
    "Calibration": "servo_models.calibration.calibration",
    "load_servo_model": "servo_models.servo_file",
    "DelayedPD": "servo_models.delayed_pd",
    "DelayedPDParameters": "servo_models.delayed_pd",
    "HeldFeedback": "servo_models.held_feedback",
    "SparseEquation": "servo_models.sparse_equation",
    "PupperEnv": "sim.walking.env",
    "make_env": "sim.walking.env",
    "Policy": "policies.network.policy_file",
    "load_policy": "policies.network.policy_file",
    "Interval": "common.interval",
    "JOINT_NAMES": "common.joints",
    "PupperError": "common.errors",
    "InputError": "common.errors",
}

__all__ = [
    "JOINT_NAMES",
    "Calibration",
    "DelayedPD",
    "DelayedPDParameters",
    "HeldFeedback",
    "InputError",
    "Interval",
    "Policy",
    "PupperEnv",
    "PupperError",
    "Recording",
    "SparseEquation",
    "backlash",
    "calibrate",
    "compare",
    "examine",
    "fit_servo",
    "frequency_response",
    "lag",
    "load",
    "load_calibration",
    "load_policy",
    "load_servo_model",
    "make_env",
    "report",
    "sparse_equations",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'pupper_sysid' has no attribute '{name}'")
    module, _, own = _MODULES[name].partition(":")
    found = getattr(import_module(f"pupper_sysid.{module}"), own or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*globals(), *__all__]
