"""Analyses of walks: the gait and its orbit, and walks under altered conditions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Commanded, OfPolicies, interval, table_of
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
        from pupper_sysid.policies.analysis.gait import SETTLE_S, SHORTEST_S

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


@dataclass(frozen=True)
class Delay(Commanded):
    """Later servos and later readings, in replay and in closed loop.

    Example: pupper-analyze delay runs/A runs/B
    """

    def analyse(self) -> Found:
        """Delay curves of each policy."""
        from pupper_sysid.policies.analysis.figures import delay_figure
        from pupper_sysid.policies.analysis.robustness import delay_curve

        found = self.each(delay_curve, self.command)
        columns = (
            "extra_delay_ms", "mode", "survival", "frequency_hz", "amplitude_rad", "mae_vx_m_s",
        )  # fmt: skip
        table = table_of(self.title("Against more delay"), found, columns)
        return {"curves": found}, delay_figure(found), table


@dataclass(frozen=True)
class Ablation(Commanded):
    """Noise, zeros and staleness per channel of the observation.

    Example: pupper-analyze ablation runs/<name>
    """

    def analyse(self) -> Found:
        """Ablations of each policy."""
        from pupper_sysid.policies.analysis.figures import ablation_figure
        from pupper_sysid.policies.analysis.robustness import ablation

        found = self.each(ablation, self.command)
        columns = ("channel", "kind", "level", "sigma", "correlation", "survival", "mae_vx_m_s")
        table = table_of(self.title("Altered observations"), found, columns)
        return {"ablations": found}, ablation_figure(found), table


@dataclass(frozen=True)
class Autonomy(Commanded):
    """Rhythm with frozen inputs, after pushes, and at other control rates.

    Example: pupper-analyze autonomy runs/<name>
    """

    def analyse(self) -> Found:
        """Tests of each policy."""
        from pupper_sysid.policies.analysis.autonomy import autonomy
        from pupper_sysid.policies.analysis.figures import autonomy_figure

        found = self.each(autonomy, self.command)
        table = terminal.table(
            self.title("Autonomy of the rhythm"), "policy", "test", "gait Hz", "share of amplitude",
            "still up", "phase shift", "of it kept",
        )  # fmt: skip
        for name, tests in found.items():
            for r in tests.frozen:
                table.add_row(
                    name, r.test, number(r.frequency_hz, 2), number(r.share, 2), "", "", ""
                )
            for r in tests.push:
                table.add_row(
                    name, f"push of {r.push_m_s:g} m/s", "", "", number(r.survival, 2),
                    number(r.shift_late, 3), number(r.kept, 2),
                )  # fmt: skip
            for r in tests.rate:
                table.add_row(
                    name, f"control rate {r.rate_hz:.4g} Hz", number(r.frequency_hz, 2), "",
                    number(r.survival, 2), "", "",
                )  # fmt: skip
        return {"autonomy": found}, autonomy_figure(found), table


@dataclass(frozen=True)
class Terrain(Commanded):
    """Survival and errors on rough ground, slopes, troughs, steps and stairs.

    Example: pupper-analyze terrain runs/<name>
    """

    def analyse(self) -> Found:
        """Walks of each policy on each ground."""
        from pupper_sysid.policies.analysis.figures import terrain_figure
        from pupper_sysid.policies.analysis.robustness import terrain

        found = self.each(terrain, self.command)
        columns = (
            "ground", "survival", "frequency_hz", "mae_vx_m_s", "mae_vy_m_s", "mae_yaw_rad_s",
        )  # fmt: skip
        table = table_of(self.title("On other ground"), found, columns)
        return {"terrain": found}, terrain_figure(found), table


@dataclass(frozen=True)
class Compliance(OfPolicies):
    """Path, drift and arc in six directions.

    Example: pupper-analyze compliance runs/<name>
    """

    def analyse(self) -> Found:
        """Walks of each policy in each direction."""
        from pupper_sysid.policies.analysis.figures import compliance_figure
        from pupper_sysid.policies.analysis.robustness import compliance

        found = self.each(compliance)
        table = terminal.table(
            self.title("Walks by direction, 90 % intervals over robots"), "policy", "direction",
            "still up", "share of speed", "drift m/m", "arc rad/m", "wander m/turn",
        )  # fmt: skip
        for name, rows in found.items():
            for row in rows:
                measures = (row.share, row.drift, row.arc_rad_m, row.wander_m)
                table.add_row(
                    name, row.direction, number(row.survival, 2),
                    *(interval(m, 2) for m in measures),
                )  # fmt: skip
        return {"compliance": found}, compliance_figure(found), table
