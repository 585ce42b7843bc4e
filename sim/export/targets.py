"""Targets of the export to other simulators, by the word that `export --to` takes.

A new target is its module, with a function from `ExportedServos` to the text of a file, and one
entry here; the command, its help and the library take it from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pupper_sysid.sim.export.shared import ExportedServos


@dataclass(frozen=True)
class Target:
    """One form of the exported servos."""

    name: str
    module: str
    """In `sim/export/`."""
    function: str
    """Of the module: text of a file."""
    ending: str
    """How the names of its files end."""
    physics_step_s: float = 0.005
    """Where none is chosen; usual in training."""

    def text(self, servos: ExportedServos) -> str:
        """The file; its module is imported only now."""
        package = __name__.rpartition(".")[0]
        return getattr(import_module(f"{package}.{self.module}"), self.function)(servos)


TARGETS = {
    target.name: target
    for target in (
        Target("mjcf", "mjcf", "to_mjcf", ".xml", physics_step_s=0.002),
        Target("isaaclab", "isaaclab", "to_isaaclab", "_isaaclab.py"),
        Target("isaaclab-bam", "isaaclab", "to_isaaclab_bam", "_isaaclab_bam.py"),
        Target("mjlab", "mjlab", "to_mjlab", "_mjlab.py"),
        Target("newton", "newton", "to_newton", "_newton.py"),
        Target("json", "export", "to_json", ".json"),
    )
}
"""All targets, by name."""
