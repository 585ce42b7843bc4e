"""Options that most commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.recordings.recording import Recording


@dataclass(frozen=True)
class OfRecordings:
    """Options of a command that reads recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: str = "all"
    """Names (LF_hip), legs (LF), kinds (hip), several with commas, or all."""
    json: bool = False
    """Print one JSON object and nothing else."""
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def load(self) -> tuple[list[Recording], list[str]]:
        """The recordings, and the joints of them that were chosen."""
        recordings = terminal.load_all(self.recordings)
        return recordings, terminal.pick_joints(recordings, self.joints)
