"""What to record next, from the parameters that a calibration could not identify.

`advice` finds each joint's gaps (a limit that was not reached, tones too slow to separate dead time
from dynamics, too few tones, too short a recording) and the recording that closes each. Joints with
the same gap share one sentence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES, share_sentences
from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.servo_models.calibration.parts import Actuator
from pupper_sysid.sysid.fit.results import JointCalibrationResult

_FEW_FREQUENCIES = 4
_FAST_HZ = 5.0  # below it a servo of 20 ms dynamics looks like 20 ms more of dead time
_WIDE_MS = 6.0
_FEW_READINGS = 400
_LONG_S = 30.0


def advice(
    results: Mapping[str, JointCalibrationResult],
    calibration: Calibration,
    examinations: Sequence[tuple[str, Any]] = (),
) -> list[str]:
    """What to record next, most useful first; one sentence each.

    Parameters
    ----------
    results : dict of joint to JointCalibrationResult
    calibration : Calibration
        Of those; it says what was identified.
    examinations : sequence of (str, pupper_sysid.sysid.doctor.examination.Examination)
        Name of the recording and what the doctor found.
    """
    again: dict[str, list[str]] = {joint: [] for joint in results}
    for recording, examination in examinations:
        for joint, examined in examination.joints.items():
            if joint in results and examined.verdict == "do not use":
                again[joint].append(
                    f"record {recording} again: the doctor's verdict is not to use it "
                    f"({' '.join(examined.reasons).rstrip('.')})."
                )
    gaps = {
        joint: _gaps(result, calibration.joint(joint).actuator) for joint, result in results.items()
    }
    found = [f"{j}: {text}" for own in (again, gaps) for j, text in share_sentences(own)]
    found.append(
        "Torques rest on an assumed stall torque, because a joint that swings in free air shows "
        "only ratios to its inertia. Hang a known mass at a known distance from the joint and "
        "record the same sweep: that gives the scale."
    )
    missing = [j for j in JOINT_NAMES if j not in results]
    if 0 < len(missing) < len(JOINT_NAMES):  # of a Mini Pupper; how many others have is not known
        found.append(f"Not recorded yet: {', '.join(missing)}. `pupper-sysid sweep` records them.")
    return found


def _gaps(result: JointCalibrationResult, actuator: Actuator) -> list[str]:
    """Sentences for one joint, without its name."""
    pd, lattice = result.delayed_pd, result.lag.feedback
    tones = sorted({round(t.frequency_hz, 2) for t in result.runs if t.frequency_hz > 0})
    fresh = sum(len(t.sample_step) for t in result.runs)
    width = 1e3 * (result.dead_time_s.high - result.dead_time_s.low)
    found = []
    ratios = actuator.ratios_to_armature
    limits = {
        "speed": (actuator.velocity_limit_rad_s, ratios.back_emf), "torque": (ratios.effort_limit,)
    }  # fmt: skip
    unknown = [
        name for name, own in limits.items() if all(quantity.identified == "no" for quantity in own)
    ]
    if unknown:
        found.append(
            f"the limit of its {' and '.join(unknown)} is not identified. Record steps, or tones "
            "whose peak speed 2π·f·A comes close to the servo's no-load speed."
        )
    if ratios.friction_loss.identified == "no":
        found.append(
            "friction is not identified. Record a slow tone (0.2–0.5 Hz): the joint sticks at its "
            "turning points."
        )
    if not tones:
        found.append(
            "there are no tones in this recording. Record a sweep of 1 to 10 Hz: it gives gain and "
            "lag per frequency, and a model can be tested on tones left out of its fit."
        )
    elif len(tones) < _FEW_FREQUENCIES:
        found.append(
            f"only {len(tones)} frequenc{'y' if len(tones) == 1 else 'ies'} "
            f"({', '.join(f'{f:g}' for f in tones)} Hz), too few to test a model on one left out "
            "of its fit. Record 1 to 10 Hz."
        )
    if tones and (tones[-1] < _FAST_HZ or width > _WIDE_MS):
        found.append(
            f"the dead time rests on tones of {tones[-1]:g} Hz and below, where it is hard to "
            "separate from slow dynamics. Record faster tones (up to 10 Hz, at a smaller "
            "amplitude) or steps."
        )
    if fresh < _FEW_READINGS:
        found.append(
            f"fewer than {_FEW_READINGS} fresh readings. Hold each tone longer: four times the "
            "time halves every interval."
        )
    if lattice.kind == "unresolved":
        found.append(
            "readings are held, but the bus's poll period could not be found. Record a longer "
            f"sweep ({_LONG_S:g} s or more) at full amplitude."
        )
    if not np.isfinite(pd.scores.rmse_unseen_rad) and tones:
        found.append("no frequency could be left out, so the model was not tested on new motion.")
    return found
