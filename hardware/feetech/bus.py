"""Feetech servos (STS, SCS and SMS series) as a `ServoBus`: `--bus feetech:/dev/ttyUSB0`."""

from __future__ import annotations

from pupper_sysid.hardware.feetech import registers
from pupper_sysid.hardware.feetech.line import FeetechLine
from pupper_sysid.hardware.feetech.registers import HD1910, SCS0009, STS3215
from pupper_sysid.hardware.serial_servos.bus import SerialBus
from pupper_sysid.hardware.serial_servos.series import ERROR_BITS, Family

FAMILY = Family(
    name="feetech",
    open_line=FeetechLine,
    rates=(1_000_000, 500_000, 115_200, 250_000, 57_600, 38_400),
    highest_id=registers.HIGHEST_ID,
    series=registers.SERIES,
    profiles={HD1910.name: HD1910},
    presets={SCS0009.name: "mini_pupper_2_direct", STS3215.name: "sts3215"},
    error_bits=ERROR_BITS,
    present="present_position",
    reading_bytes=(6, 7, 8, 9, 10, 11),  # position, speed, load; voltage; temperature; …
    memory_pieces=(16, 15, 14, 13, 9),  # registers 0 to 66
    shaping=registers.SHAPING,
    modes=registers.MODES,
    position_mode=registers.POSITION_MODE,
    turns_freely=frozenset(),
    acknowledges=registers.ACKNOWLEDGES,
    profile=registers.profile,
    own_faults=lambda series, found: [],
    protections=registers.protections_to_set,
    volt_scale=0.1,
    load=("present_load", 1e-3),
    return_delay_unit_s=registers.RETURN_DELAY_UNIT_S,
    tool="Feetech's FD program",
)


class FeetechBus(SerialBus):
    """Feetech servos on a serial line; parameters and errors are those of `SerialBus`."""

    family = FAMILY
