"""Claims about the robot's own walks are judged by logs whose rhythm is known."""

from pathlib import Path

import numpy as np

from reproduction.walks import gather, judge
from support.refusals import assert_each_refused


def log(path: Path, hertz: float, noise: float, tilt_deg: float | None = 5.0) -> Path:
    """12 s of a trunk that turns with one rhythm and noise, tilted by up to an angle."""
    rng = np.random.default_rng(0)
    time = np.arange(600) * 0.02
    rates = noise * rng.standard_normal((600, 3))
    rates[:, 2] += np.sin(2 * np.pi * hertz * time)
    lines = ["timestamp,gx,gy,gz,ax,ay,az"]
    for k, (t, rate) in enumerate(zip(time, rates, strict=True)):
        angle = np.radians((tilt_deg or 0.0) * k / 600)
        shake = 2.0 * np.sin(2 * np.pi * hertz * t) if tilt_deg is not None else 0.0
        gravity = (-9.81 * np.sin(angle) + shake, 0.0, -9.81 * np.cos(angle))
        if tilt_deg is None:
            gravity = (0.0, 0.0, 9.81)
        lines.append(",".join(f"{v:.6f}" for v in (t, *rate, *gravity)))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_rate_steadiness_and_tilt_are_found(tmp_path):
    lstm = log(tmp_path / "lstm.csv", 2.8, 0.2)
    mlp = log(tmp_path / "mlp.csv", 3.1, 2.0, 12.0)
    rate, steady, moved = judge(gather([f"lstm={lstm}", f"mlp={mlp}"]))
    assert rate.verdict == "holds" and "LSTM 2.80 Hz" in rate.ours and "MLP 3.09" in rate.ours
    assert steady.verdict == "holds"
    assert moved.verdict == "holds partly" and "within 5° of upright" in moved.ours
    rate, steady, moved = judge(gather([f"mlp={lstm}", f"lstm={mlp}"]))
    assert rate.verdict == steady.verdict == "does not hold here"
    # a robot on its side does not transfer
    fell = log(tmp_path / "fell.csv", 2.8, 0.2, 80.0)
    assert judge(gather([f"lstm={fell}"]))[2].verdict == "does not hold here"


def test_without_logs_or_accelerations_nothing_is_claimed(tmp_path):
    assert {c.verdict for c in judge([])} == {"not testable here"}
    still = log(tmp_path / "rates.csv", 2.8, 0.2, None)
    rate, steady, moved = judge(gather([f"lstm={still}"]))
    assert rate.verdict == "holds"
    assert steady.verdict == moved.verdict == "not testable here"
    cases = [(name, "Write KIND=FILE") for name in ("walk.csv", "cnn=walk.csv")]
    assert_each_refused(cases, lambda name: gather([name]))
