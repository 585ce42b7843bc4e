"""`delay`, `ablation`, `autonomy`, `terrain` and `compliance`: walks under altered conditions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Commanded, OfPolicies, interval, table_of
from pupper_sysid.cli.terminal import number

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.analyze.common import Found


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
