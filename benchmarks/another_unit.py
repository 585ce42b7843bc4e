"""What a calibration of other units is worth for one of which there are 20 s.

    .venv/bin/python benchmarks/another_unit.py [--joints Elbow]

Each joint of the SO-101 arm is calibrated three ways: from 60 s of two motions in free air; from
20 s of one of them; and from the same 20 s with the calibration of the four other joints as the
prior (`calibrate --from`). All predict the arm's chirp, which none was fitted to, from the first
reading on. Recordings are found through `$PUPPER_REAL_DATA`, else in `../shared/real`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

from shared import REAL, free_run_error_rad, mrad, print_rows  # isort: skip

import tyro
from real_recordings import JOINTS

from pupper_sysid.servo_models.calibration.calibration import Calibration
from pupper_sysid.sysid.fit.calibrate import calibrate
from pupper_sysid.sysid.recordings.files import load
from pupper_sysid.sysid.recordings.recording import Recording

LONG, SHORT, UNSEEN = ("prbs_excitation", "step_response"), "prbs_excitation", "chirp_sweep"
LONG_S, SHORT_S = 60.0, 20.0


def beginning(motion: str, joint: str, seconds: float = 1e9) -> Recording:
    """The first seconds of a motion, of one joint."""
    whole = load(REAL / "sage_so101" / motion)
    frame = whole.to_frame().query("joint == @joint")
    first = frame.query(f"send_time_s < {frame['send_time_s'].min() + seconds}")
    return Recording.from_frame(first, metadata=whole.metadata, name=motion)


def joined(calibrations: Sequence[Calibration]) -> Calibration:
    """One calibration of several joints."""
    joints = {name: one for c in calibrations for name, one in c.joints.items()}
    return calibrations[0].model_copy(update={"joints": joints})


def main(joints: tuple[str, ...] = JOINTS, seed: int = 0) -> None:
    """Print the table."""
    refits = {
        joint: calibrate([beginning(m, joint, LONG_S) for m in LONG], seed=seed).calibration
        for joint in JOINTS
    }

    def rows() -> Iterable[list[str]]:
        for joint in joints:
            short, unseen = beginning(SHORT, joint, SHORT_S), beginning(UNSEEN, joint)
            others = joined([c for name, c in refits.items() if name != joint])
            begun = time.process_time()
            models = (
                refits[joint],
                calibrate(short, seed=seed).calibration,
                calibrate(short, seed=seed, prior=others).calibration,
            )
            errors = [free_run_error_rad(unseen, model, joint) for model in models]
            yield [
                joint, *map(mrad, errors), f"{errors[2] / errors[0]:.2f}",
                f"{time.process_time() - begun:.0f}",
            ]  # fmt: skip

    print_rows(
        ("joint", "60 s of two motions", "20 s", "20 s, the four others as the prior",
         "ratio to 60 s", "processor s"), rows(),
    )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
