"""A bus is one module and one entry: what opens, checks and switches off takes it from there."""

import pytest

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware.address import KINDS, BusKind, parse_address
from pupper_sysid.hardware.safety.guard import open_bus
from pupper_sysid.hardware.safety.limp import switch_off


def test_every_kind_has_what_the_commands_take_from_it():
    for kind in KINDS.values():
        cls = kind.bus_class()
        assert callable(cls.open_address) and callable(cls.limp_address)
        if kind.is_serial:
            assert callable(cls.scan_address) and cls.family.name == kind.name


def test_an_entry_is_enough_for_address_opening_and_torque_off(monkeypatch):
    calls = []

    class Bus:
        joint_names = ("pan",)

        @classmethod
        def open_address(cls, address, joint_map, joints, exclusive):
            calls.append(("open", address.where))
            return cls()

        @classmethod
        def limp_address(cls, address, ids):
            calls.append(("limp", ids))

        def torque(self, on):
            calls.append(("torque", on))
            return True

        def close(self):
            calls.append(("close",))

    monkeypatch.setattr(BusKind, "bus_class", lambda self: Bus)
    monkeypatch.setitem(KINDS, "other", BusKind("other", "Other", "nowhere", "Bus", "/tmp/other"))
    address = parse_address("other:/tmp/x")
    open_bus(address)
    assert switch_off(address) == []
    assert calls == [("open", "/tmp/x"), ("limp", None), ("open", "/tmp/x"), ("torque", False),
                     ("close",)]  # fmt: skip


def test_an_address_that_is_none_names_every_serial_bus():
    with pytest.raises(InputError) as refused:
        parse_address("usb")
    for kind in KINDS.values():
        assert kind.name in str(refused.value)
