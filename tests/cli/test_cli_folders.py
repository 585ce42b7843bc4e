"""A fleet's results go beside its folder, by whatever name the folder is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from support.command_line import run


@dataclass
class Reached(Exception):
    """Where the results were about to be written."""

    out: Path


@pytest.mark.parametrize(
    ("command", "worker", "ending"),
    [
        ("calibrate", "pupper_sysid.sysid.fleet.calibration.calibrate_fleet", "calibrated"),
        ("fit-servo", "pupper_sysid.sysid.fleet.servo_model.fit_servo_fleet", "servos"),
    ],
)
@pytest.mark.parametrize(
    ("here", "given"), [("robots", "."), ("robots/one", ".."), (".", "robots")]
)
def test_results_are_beside_the_folder(
    capsys, tmp_path, monkeypatch, command, worker, ending, here, given
):
    (tmp_path / "robots/one").mkdir(parents=True)
    (tmp_path / "robots/one/sweep.csv").touch()

    def reach(root, out, *_):
        raise Reached(out)

    monkeypatch.setattr(worker, reach)
    monkeypatch.chdir(tmp_path / here)
    with pytest.raises(Reached) as reached:
        run(capsys, command, given, "--debug")
    assert reached.value.out.resolve() == tmp_path / f"robots_{ending}"
