"""The package works in a folder whose files have the names of its rooms."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

DECOY = 'raise ImportError("a file of the user, not of pupper-sysid")\n'


@pytest.fixture
def folder(tmp_path) -> Path:
    """What a user may have beside a notebook."""
    for name in ("common", "cli", "hardware", "servo_models"):
        (tmp_path / f"{name}.py").write_text(DECOY)
    for name in ("sim", "sysid", "policies", "api"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(DECOY)
    return tmp_path


def python(folder: Path, *arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_rooms_and_commands_are_found_beside_files_of_their_names(folder):
    rooms = "common.errors", "hardware.bus", "sysid.lag.tone", "sim.walking.config"
    python(folder, "-c", "import pupper_sysid, " + ", ".join(f"pupper_sysid.{r}" for r in rooms))
    python(folder, "-m", "pupper_sysid.cli.programs.pupper_sysid", "export", "paper")
    assert (folder / "paper.csv").is_file()
    program = Path(sys.executable).with_name("pupper-sysid")
    assert "calibrate" in python(folder, program, "--help")
