"""Dynamixel servos with protocol 2.0 as a `ServoBus`: `--bus dynamixel:/dev/ttyUSB0`.

While the torque is on, each servo's own bus watchdog is set: it stops the servo if no program talks
to it for 2 s, even if every process of the host is gone. `keep_alive` talks to the servos in
pauses of a driver.
"""

from __future__ import annotations

from pupper_sysid.hardware.dynamixel import registers
from pupper_sysid.hardware.dynamixel.line import DynamixelLine
from pupper_sysid.hardware.serial_servos.bus import LineServo, SerialBus
from pupper_sysid.hardware.serial_servos.line import Reply
from pupper_sysid.hardware.serial_servos.series import Family
from pupper_sysid.hardware.serial_servos.settings import read_register

FAMILY = Family(
    name="dynamixel",
    open_line=DynamixelLine,
    rates=(1_000_000, 57_600, 2_000_000, 3_000_000, 4_000_000, 115_200),
    highest_id=registers.HIGHEST_ID,
    series=registers.SERIES,
    profiles={},
    presets={},
    error_bits=registers.HARDWARE_ERRORS | {registers.ALERT: "hardware error"},
    present="present_pwm",
    reading_bytes=(12, 13, 14, 15, 16, 23),  # PWM, current, velocity, position; … voltage, heat
    memory_pieces=(40, 38, 37, 32),
    shaping=registers.SHAPING,
    modes=registers.MODES,
    position_mode=registers.POSITION_MODE,
    turns_freely=frozenset(
        {registers.EXTENDED_POSITION_MODE, registers.CURRENT_BASED_POSITION_MODE}
    ),
    acknowledges=registers.ACKNOWLEDGES,
    profile=registers.profile,
    own_faults=registers.own_faults,
    protections=registers.protections,
    volt_scale=0.1,
    load=("present_pwm", 1 / registers.FULL_PWM),
    return_delay_unit_s=2e-6,
    tool="DYNAMIXEL Wizard",
)


class DynamixelBus(SerialBus):
    """Dynamixel servos on a serial line; parameters and errors are those of `SerialBus`."""

    family = FAMILY
    _turns = 256  # of the extended position mode

    def register(self, joint: str, name: str) -> int:
        """Present value of a register; that of a bus watchdog that has acted is 0 (off)."""
        value = super().register(joint, name)
        return 0 if name == "bus_watchdog" and value == registers.TRIGGERED else value

    def set_register(self, joint: str, name: str, value: int) -> None:
        """Set a register and read it back; a bus watchdog that has acted is cleared before."""
        if name == "bus_watchdog" and value:
            super().set_register(joint, name, 0)
        super().set_register(joint, name, value)

    def keep_alive(self) -> None:
        """Talk to every servo, so that its bus watchdog does not act."""
        heat = self._servos[0].series.register("present_temperature").address
        self.line.sync_read([servo.id for servo in self._servos], heat, 1)

    def _status(self, servo: LineServo, reply: Reply) -> int:
        if not reply.frame.code & registers.ALERT:
            return 0
        errors = read_register(self.line, servo.id, servo.series, "hardware_error_status")
        return errors or registers.ALERT
