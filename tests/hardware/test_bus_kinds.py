"""A bus is one module and one entry: what opens, checks and switches off takes it from there."""

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.address import KINDS, parse_address


def test_every_kind_has_what_the_commands_take_from_it():
    for kind in KINDS.values():
        cls = kind.bus_class()
        assert callable(cls.open_address) and callable(cls.limp_address)
        if kind.is_serial:
            assert callable(cls.scan_address) and cls.family.name == kind.name


def test_an_address_that_is_none_names_every_serial_bus():
    with pytest.raises(InputError) as refused:
        parse_address("usb")
    for kind in KINDS.values():
        assert kind.name in str(refused.value)
