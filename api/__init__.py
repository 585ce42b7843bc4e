"""pupper-sysid: measure a cheap servo, get a simulator that moves like it.

    import pupper_sysid as ps

    recording = ps.load("sweep.csv")
    print(ps.delay(recording))
    calibration = ps.calibrate(recording)
    calibration.save("calibrated.yaml")
    ps.export(calibration, "mjlab", "exported")

Functions have the names of the commands, and are what the commands call; each is imported when it
is first looked up. They take one `Recording` or a sequence of them, whose trials are pooled per
joint, and return frozen dataclasses with `to_dict` (the JSON of the command), `to_frame` and
`plot`. `examine`, `lag`, `frequency_response` and `sparse_equations` are older names of `doctor`,
`delay`, `bode` and `sindy`.
"""

from __future__ import annotations

from importlib import import_module as _import_module

TYPE_CHECKING = False
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
    from pupper_sysid.sim.export.export import export
    from pupper_sysid.sim.walking.env import PupperEnv, make_env
    from pupper_sysid.sysid.backlash import backlash
    from pupper_sysid.sysid.compare.compare import compare
    from pupper_sysid.sysid.doctor.examination import examine as doctor
    from pupper_sysid.sysid.doctor.examination import examine as examine
    from pupper_sysid.sysid.fit.calibrate import calibrate
    from pupper_sysid.sysid.fit.calibrate import lag as delay
    from pupper_sysid.sysid.fit.calibrate import lag as lag
    from pupper_sysid.sysid.lag.frequency_response import frequency_response as bode
    from pupper_sysid.sysid.lag.frequency_response import frequency_response as frequency_response
    from pupper_sysid.sysid.recordings.files import load
    from pupper_sysid.sysid.recordings.recording import Recording
    from pupper_sysid.sysid.report.report import write_report as report
    from pupper_sysid.sysid.servo_fit.fit import fit_servo
    from pupper_sysid.sysid.sparse import sparse_equations as sindy
    from pupper_sysid.sysid.sparse import sparse_equations as sparse_equations

_MODULES = {
    "load": "sysid.recordings.files",
    "Recording": "sysid.recordings.recording",
    "doctor": "sysid.doctor.examination:examine",
    "delay": "sysid.fit.calibrate:lag",
    "bode": "sysid.lag.frequency_response:frequency_response",
    "backlash": "sysid.backlash",
    "calibrate": "sysid.fit.calibrate",
    "sindy": "sysid.sparse:sparse_equations",
    "fit_servo": "sysid.servo_fit.fit",
    "compare": "sysid.compare.compare",
    "report": "sysid.report.report:write_report",
    "export": "sim.export.export",
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
_OLDER_NAMES = {
    "examine": "doctor", "lag": "delay", "frequency_response": "bode", "sparse_equations": "sindy",
}  # fmt: skip

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
    "bode",
    "calibrate",
    "compare",
    "delay",
    "doctor",
    "export",
    "fit_servo",
    "load",
    "load_calibration",
    "load_policy",
    "load_servo_model",
    "make_env",
    "report",
    "sindy",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        public: object = _import_module("importlib.metadata").version("pupper-sysid")
    elif name in _OLDER_NAMES:
        public = __getattr__(_OLDER_NAMES[name])
    elif name in _MODULES:
        module, _, attribute = _MODULES[name].partition(":")
        public = getattr(_import_module(f"pupper_sysid.{module}"), attribute or name)
    else:
        raise AttributeError(f"module 'pupper_sysid' has no attribute '{name}'")
    globals()[name] = public
    return public


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
