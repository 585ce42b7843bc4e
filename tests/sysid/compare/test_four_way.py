"""The comparison of published, fitted and learned servo models: its end and its progress."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from pupper_sysid.sysid.compare import four_way as module
from pupper_sysid.sysid.recordings.files import load

SAMPLE = Path(__file__).resolve().parents[3] / "data/samples/playback.csv"


def test_networks_trained_to_different_ends_are_not_compared(monkeypatch):
    """Ctrl-C ends the training of one network, and with it the comparison; the bar never returns."""
    fitted, shares = [], []

    def fit(recording, joints, arch, *, split, seed, progress):
        fitted.append(arch)
        for share in (0.0, 0.5, 1.0):
            progress(arch, share)
        progress("DelayedPD", 0.0)
        return SimpleNamespace(interrupted=arch == "mlp")

    monkeypatch.setattr(module, "fit_servo", fit)
    recording = load(SAMPLE)
    with pytest.raises(KeyboardInterrupt):
        module.four_way(recording, recording.joints, 0, lambda what, share: shares.append(share))
    assert fitted == ["lstm", "mlp"]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0
