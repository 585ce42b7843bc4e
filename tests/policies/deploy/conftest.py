"""Walks of these tests begin soon: the emulated robot stands already when it is to stand up."""

import pytest

from support.undrawn import stand_soon


@pytest.fixture(autouse=True)
def standing(monkeypatch):
    stand_soon(monkeypatch)
