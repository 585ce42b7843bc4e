"""`gait` and `attractor`: frequency, sine fit and phases of a gait, and its orbit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Commanded, interval
from pupper_sysid.cli.terminal import number
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.analyze.common import Found


@dataclass(frozen=True)
class Gait(Commanded):
    """Frequency, sine fit, phases, duty factors and jitter of a gait.

    Example: pupper-analyze gait runs/<name> --command 0.15 0 0
    """

    def analyse(self) -> Found:
        """Describe the gait of each policy."""
        import numpy as np

        from pupper_sysid.policies.analysis.figures import gait_figure
        from pupper_sysid.policies.analysis.gait import describe

        rng = np.random.default_rng(self.seed)
        walks = self.each(lambda policy, trial: trial.walk(policy), self.command)
        found = {name: describe(walked, rng) for name, walked in walks.items()}
        table = terminal.table(
            self.title("Gait, 90 % intervals over robots"), "policy", "Hz", "sine R² actions",
            "of noise", "diagonal", "duty", "jitter rad", "robots",
        )  # fmt: skip
        for name, gait in found.items():
            table.add_row(
                name, interval(gait.frequency_hz, 2), interval(gait.action_r2, 2),
                number(gait.null_r2, 2), interval(gait.diagonal, 2),
                number(float(np.mean([d.value for d in gait.duty])), 2),
                number(gait.jitter_rad.value, 3), f"{gait.robots} of {self.size[0]}",
            )  # fmt: skip
        return {"gaits": found}, gait_figure(next(iter(walks.values()))), table


@dataclass(frozen=True)
class Attractor(Commanded):
    """Orbits of actions and hidden states in replay, with more delay of the joints.

    Example: pupper-analyze attractor runs/<name>
    """

    def analyse(self) -> Found:
        """Orbits of each policy."""
        from pupper_sysid.policies.analysis.attractor import DELAYS_MS, orbits
        from pupper_sysid.policies.analysis.figures import orbit_figure
        from pupper_sysid.policies.analysis.gait import SETTLE_S
        from pupper_sysid.policies.analysis.rhythm import SHORTEST_S

        found = {name: one for name, one in self.each(orbits, self.command).items() if one}
        if not found:
            raise InputError(
                f"No robot walked for {SETTLE_S + SHORTEST_S:g} s and moved: there is no orbit to "
                "analyse. Give a policy that walks, or more --seconds."
            )
        table = terminal.table(
            self.title("Orbits at more delay of the joints, in replay, as published"), "states",
            "variance in 3 PCs", "dimensions", *(f"closure +{d:g} ms" for d in DELAYS_MS),
            *(f"area +{d:g} ms" for d in DELAYS_MS[1:]),
        )  # fmt: skip
        drawn = {}
        for name, one in found.items():
            for states, orbit in one.items():
                drawn[f"{name} {states}"] = orbit.orbits
                table.add_row(
                    f"{name} {states}", number(orbit.explained_3, 3),
                    number(orbit.participation_ratio, 1), *(number(c, 2) for c in orbit.closure),
                    *(number(a, 2) for a in orbit.area_ratio[1:]),
                )  # fmt: skip
        return {"delays_ms": DELAYS_MS, "orbits": found}, orbit_figure(drawn, DELAYS_MS), table
