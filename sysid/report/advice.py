"""What to record next: sentences derived from what a calibration could not settle.

`advice` looks at each joint's result for what its data leave open (a limit never reached, tones too
slow to tell dead time from dynamics, too few of them, too little time) and says which recording
would close the gap. Joints with the same gap share one sentence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.sysid.identify.calibrate import JointCalibrationResult
from pupper_sysid.sysid.identify.search import PREFERRED

_FEW_FREQUENCIES = 4
_FAST_HZ = 5.0  # below it a servo of 20 ms dynamics looks like 20 ms more of dead time
_WIDE_MS = 6.0
_FEW_READINGS = 400
_LONG_S = 30.0


def advice(
    results: Mapping[str, JointCalibrationResult], examinations: Sequence[tuple[str, Any]] = ()
) -> list[str]:
    """What to record next, most useful first; one sentence each.

    Parameters
    ----------
    results : dict of joint to JointCalibrationResult
    examinations : sequence of (str, pupper_sysid.sysid.doctor.examination.Examination)
        Name of the recording and what the doctor found.
    """
    grouped: dict[str, list[str]] = {}
    for recording, examination in examinations:
        for joint, found in examination.joints.items():
            if joint in results and found.verdict == "do not use":
                sentence = (
                    f"record {recording} again: the doctor says not to use it "
                    f"({' '.join(found.reasons).rstrip('.')})."
                )
                grouped.setdefault(sentence, []).append(joint)
    for joint, result in results.items():
        for sentence in _gaps(result):
            grouped.setdefault(sentence, []).append(joint)
    said = [f"{_names(joints, results)}: {sentence}" for sentence, joints in grouped.items()]
    said.append(
        "Torques rest on an assumed stall torque, because a joint that swings in free air shows "
        "only ratios to its inertia. Hang a known mass at a known distance from the joint and "
        "record the same sweep: that gives the scale."
    )
    missing = [j for j in JOINT_NAMES if j not in results]
    if 0 < len(missing) < len(JOINT_NAMES):  # of a Mini Pupper; how many others have is not known
        said.append(
            f"Nothing is known of {', '.join(missing)}. "
            "`pupper-sysid sweep --joints all` records them."
        )
    return said


def _gaps(result: JointCalibrationResult) -> list[str]:
    """Sentences for one joint, without its name."""
    pd, lattice = result.rungs[PREFERRED], result.budget.lattice
    tones = sorted({round(t.frequency_hz, 2) for t in result.trials if t.frequency_hz > 0})
    fresh = sum(len(t.sample_step) for t in result.trials)
    width = 1e3 * (result.dead_time.high - result.dead_time.low)
    said = []
    if "velocity_limit_rad_s" in pd.undecided or "effort_rad_s2" in pd.undecided:
        limits = [
            name
            for name, key in (("speed", "velocity_limit_rad_s"), ("torque", "effort_rad_s2"))
            if key in pd.undecided
        ]
        said.append(
            f"the limit of its {' and '.join(limits)} was never reached. Record steps "
            "(`pupper-sysid sweep --kind steps`), or tones whose peak speed 2π·f·A comes "
            "close to the servo's no-load speed."
        )
    if "friction_rad_s2" in pd.undecided:
        said.append(
            "friction is not identified. Record a slow tone (0.2–0.5 Hz): its turning points show "
            "where the joint sticks."
        )
    if not tones:
        said.append(
            "there are no tones in this recording. Record a sweep (`pupper-sysid sweep "
            "--freqs 1-10`): it gives gain and lag per frequency, and a model can be tested on "
            "tones it has not seen."
        )
    elif len(tones) < _FEW_FREQUENCIES:
        said.append(
            f"only {len(tones)} frequenc{'y' if len(tones) == 1 else 'ies'} "
            f"({', '.join(f'{f:g}' for f in tones)} Hz), too few to test a model on one it has "
            "not seen with any confidence. Record `--freqs 1-10`."
        )
    if tones and (tones[-1] < _FAST_HZ or width > _WIDE_MS):
        said.append(
            f"the dead time rests on tones of {tones[-1]:g} Hz and below, where it looks much like "
            "slow dynamics. Faster tones (up to 10 Hz, at a smaller amplitude) or steps would tell "
            "them apart."
        )
    if fresh < _FEW_READINGS:
        said.append(
            f"fewer than {_FEW_READINGS} fresh readings. Hold each tone longer: four times the "
            "time halves every interval."
        )
    if lattice.kind == "unresolved":
        said.append(
            "readings are held, but the bus's poll period could not be found. A longer sweep "
            f"({_LONG_S:g} s or more) at full amplitude would settle it."
        )
    if not np.isfinite(pd.scores.leave_one_out) and tones:
        said.append("no frequency could be left out, so nothing tested the model on new motion.")
    return said


def _names(joints: Sequence[str], results: Mapping[str, JointCalibrationResult]) -> str:
    if len(joints) == len(results) > 2:
        return "All joints"
    return ", ".join(joints)
