"""`servo-demand`: speed, torque and dead time that a gait needs, against what a servo has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

from pupper_sysid.cli import terminal
from pupper_sysid.cli.commands.analyze.common import Commanded
from pupper_sysid.cli.terminal import number
from pupper_sysid.common.errors import InputError

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.analyze.common import Found
    from pupper_sysid.policies.analysis.servo_demand import ServoDemand as Demand

_WIDTH = 78


@dataclass(frozen=True)
class ServoDemand(Commanded):
    """Compare what a gait needs of its servos with what a servo has: speed, torque, dead time.

    Example: pupper-analyze servo-demand runs/<name> --servo sts3215-bam-m1
    """

    servo: str | None = None
    """The servo in question: a servo card, its file, a calibration or a preset."""

    def analyse(self) -> Found:
        """Walk, and compare."""
        from pupper_sysid.policies.analysis.figures import demand_figure
        from pupper_sysid.policies.analysis.servo_demand import servo_demand
        from pupper_sysid.servo_models.cards.files import is_card, load_card
        from pupper_sysid.sim.walking.servo_ranges import check_actuator, servo_ranges

        if self.servo is None:
            raise InputError(
                "Which servo? Name one with --servo: a card (`pupper-sysid servo list`) or a "
                "calibration."
            )
        if len(self.policies) != 1:
            raise InputError("One gait at a time: name one policy.")
        check_actuator(self.servo)
        known = not is_card(self.servo) or load_card(self.servo).pd().dead_time_s is not None
        candidate = servo_ranges(self.servo)
        found: dict[str, Demand] = self.each(
            lambda policy, trial: servo_demand(policy, trial, candidate, known), self.command
        )
        (name, demand), *_ = found.items()
        table = terminal.table(
            self.title(f"{name} on {Path(self.servo).name}"), "servo", "rad/s 99 %", "peak", "has",
            "N·m 99 %", "has", "used", "short", "(walked)",
        )  # fmt: skip
        for joint, own in demand.joints.items():
            table.add_row(
                joint, number(own.speed_rad_s.p99, 1), number(own.speed_rad_s.peak, 1),
                number(own.top_speed_rad_s, 1), number(own.torque_nm.p99, 2),
                number(own.stall_torque_nm, 2), f"{100 * own.torque_used:.0f} %",
                f"{100 * own.short:.0f} %", f"{100 * own.walked_short:.0f} %",
            )  # fmt: skip
        if not self.json:
            for line in wrap(demand.verdict, _WIDTH):
                terminal.out.print(line)
        return {"demand": found, "verdict": demand.verdict}, demand_figure(demand), table
