"""Fixtures: the recordings of a real robot, where they are at hand, and a policy that walks."""

import os
from pathlib import Path

# the workers share the cores; networks this small only wait for other threads
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real recordings: $PUPPER_REAL_DATA, else ../shared/real; skips without."""
    folder = Path(
        os.environ.get("PUPPER_REAL_DATA")
        or Path(__file__).resolve().parents[2] / "shared" / "real"
    )
    if not (folder / "real_motor_0_LF_hip_amp0.3.csv").exists():
        pytest.skip("no recordings of a real robot here (set PUPPER_REAL_DATA)")
    return folder


@pytest.fixture(scope="session")
def real_sweeps(real_data: Path) -> list[Path]:
    """The hip and thigh sweeps."""
    return sorted(real_data.glob("real_motor_*.csv"))


@pytest.fixture(scope="module")
def walker():
    """The shipped LSTM, and two robots with calibrated servos to walk on."""
    from pupper_sysid.policies.analysis.robustness import Trial
    from pupper_sysid.policies.network.policy_file import load_policy
    from pupper_sysid.sim.walking.config import Walking
    from pupper_sysid.sim.walking.servo_ranges import servo_ranges

    samples = Path(__file__).resolve().parents[1] / "data/samples"
    trial = Trial(
        Walking(), servo_ranges(samples / "calibrated.yaml"), robots=2, seconds=7.5, threads=1
    )
    return load_policy(samples / "policies/lstm"), trial
