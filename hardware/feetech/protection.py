"""The protections that a Feetech servo has of its own, and the weakest settings that are accepted.

If every process of the host is gone, only these act: above a temperature, or when a joint has been
blocked for some time, the servo reduces its torque by itself. Neither series has a communication
time-out: a servo that is free to move holds its last command for ever.

Registers 37 to 39 of the SCS series are left alone: sources name them, the vendor's table does not.
"""

from __future__ import annotations

from collections.abc import Mapping

from pupper_sysid.hardware.feetech.registers import Series

_HEAT, _OVERLOAD = 4, 32  # of `registers.ERROR_BITS`
_MOST = {"protective_torque": 20, "protection_time": 200, "overload_torque": 80}
"""Factory settings: share of the torque afterwards [%], duration [10 ms], share before [%]."""
_OFF_AT_ZERO = ("protection_time", "overload_torque")

PROTECTIONS = ("unload_condition", *_MOST)
"""Registers of which a servo's protections consist, as far as its series has them."""


def protections_to_set(series: Series, found: Mapping[str, int]) -> dict[str, int]:
    """Values that bring a servo's protections to at least the factory's; {} if they are.

    Parameters
    ----------
    series : Series
    found : mapping of str to int
        Its registers.

    Examples
    --------
    >>> from pupper_sysid.hardware.feetech.registers import SCS0009
    >>> protections_to_set(SCS0009, {"unload_condition": 1})
    {'unload_condition': 37}
    """
    wanted = {"unload_condition": found["unload_condition"] | _HEAT | _OVERLOAD}
    for name, most in _MOST.items():
        if name in series.registers:
            off = found[name] == 0 and name in _OFF_AT_ZERO
            wanted[name] = most if off else min(found[name], most)
    return {name: value for name, value in wanted.items() if value != found[name]}
