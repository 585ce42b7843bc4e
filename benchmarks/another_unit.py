"""What a calibration of other units is worth for one of which there are 20 s.

    .venv/bin/python benchmarks/another_unit.py [--joints Elbow]

Each joint of the SO-101 arm is calibrated three ways: from 60 s of two motions in free air; from
20 s of one of them; and from the same 20 s with the calibrations of the four other joints as the
prior (`calibrate --from`). All predict the arm's chirp, which none was fitted to, from the first
reading on. Recordings are found through PUPPER_REAL_DATA, else in ../shared/real.
"""

from __future__ import annotations

import argparse
import time

from real_recordings import JOINTS, REAL, mrad, print_rows

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.compare.compare import compare
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording

LONG, SHORT, UNSEEN = ("prbs_excitation", "step_response"), "prbs_excitation", "chirp_sweep"
LONG_S, SHORT_S = 60.0, 20.0


def beginning(motion: str, joint: str, seconds: float) -> Recording:
    """The first seconds of a motion, of one joint."""
    whole = load(REAL / "sage_so101" / motion)
    frame = whole.to_frame()
    begun = frame["send_time_s"].min()
    kept = frame[(frame["joint"] == joint) & (frame["send_time_s"] < begun + seconds)]
    return Recording.from_frame(kept, metadata=whole.metadata, name=motion)


def joined(calibrations: list[Calibration]) -> Calibration:
    """One calibration of several joints."""
    joints = {name: one for c in calibrations for name, one in c.joints.items()}
    return calibrations[0].model_copy(update={"joints": joints})


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--joints", nargs="*", default=JOINTS)
    wanted = parser.parse_args().joints
    long: dict[str, Calibration] = {}
    for joint in JOINTS:
        recordings = [beginning(motion, joint, LONG_S) for motion in LONG]
        long[joint] = calibrate(recordings).calibration
    rows = []
    for joint in wanted:
        short, unseen = beginning(SHORT, joint, SHORT_S), beginning(UNSEEN, joint, 1e9)
        others = joined([c for name, c in long.items() if name != joint])
        begun = time.process_time()
        models = [
            long[joint],
            calibrate(short).calibration,
            calibrate(short, prior=others).calibration,
        ]
        errors = [
            next(iter(compare(unseen, [model]).models.values())).joints[joint].rmse_held_rad
            for model in models
        ]
        rows.append([joint, *map(mrad, errors), f"{errors[2] / errors[0]:.2f}",
                     f"{time.process_time() - begun:.0f}"])  # fmt: skip
        print(rows[-1], flush=True)
    print_rows(("joint", "60 s of two motions", "20 s", "20 s and four others", "ratio", "s"), rows)


if __name__ == "__main__":
    main()
