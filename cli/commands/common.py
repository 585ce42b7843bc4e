"""Options that several commands have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pupper_sysid.cli import terminal

if TYPE_CHECKING:
    from pupper_sysid.sysid.recordings.recording import Recording

Joints = Annotated[
    str, tyro.conf.arg(help="Names (LF_hip), legs (LF), kinds (hip), several with commas, or all.")
]
Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object and nothing else.")]
Replace = Annotated[bool, tyro.conf.arg(help="Replace files that exist.")]


@dataclass(frozen=True)
class OfRecordings:
    """Options of a command that reads recordings."""

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings, pooled per joint; by default the newest in recordings/."""
    joints: Joints = "all"
    json: Json = False
    seed: int = 0
    """Seed of the bootstrap and of the models' global starts."""

    def load(self) -> tuple[list[Recording], list[str]]:
        """The recordings, and the joints of them that were chosen."""
        recordings = terminal.load_all(self.recordings)
        return recordings, terminal.pick_joints(recordings, self.joints)
