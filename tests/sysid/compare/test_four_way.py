"""The comparison of published, fitted and learned servo models: its end and its progress."""

from __future__ import annotations

from pathlib import Path

import pytest

from pupper_sysid.sysid.compare import four_way as module
from pupper_sysid.sysid.recordings.files import load

SAMPLE = Path(__file__).resolve().parents[3] / "data/samples/playback.csv"


def test_ctrl_c_ends_the_comparison_with_the_training_that_it_interrupts():
    """Networks trained to different ends are not compared; `fit-servo` keeps the best so far."""
    recording, said = load(SAMPLE), []

    def interrupt(what, share):
        said.append(what)
        if share > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        module.four_way(recording, ["LF_thigh"], 0, interrupt)
    assert set(said) == {"lstm"}


def test_the_bar_of_both_fits_runs_once(monkeypatch):
    fitted, shares = [], []

    def fit(recording, joints, arch, *, split, seed, progress, keep_unfinished):
        fitted.append(arch)
        assert not keep_unfinished
        for share in (0.0, 0.5, 1.0):
            progress(arch, share)
        progress("DelayedPD", 0.0)
        if arch == "mlp":
            raise KeyboardInterrupt

    monkeypatch.setattr(module, "fit_servo", fit)
    recording = load(SAMPLE)
    with pytest.raises(KeyboardInterrupt):
        module.four_way(recording, ["LF_thigh"], 0, lambda what, share: shares.append(share))
    assert fitted == ["lstm", "mlp"]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0
