"""What takes time and proves nothing is left out: pictures of pages, standing up before walks."""

import pytest

from pupper_sysid.common.page import Picture
from pupper_sysid.policies.deploy import deployment

EMPTY_PNG = b"\x89PNG\r\n\x1a\n"
EMPTY_SVG = b'<svg viewBox="0 0 1 1"></svg>'


def leave_undrawn(patch: pytest.MonkeyPatch) -> None:
    """Write empty pictures: for tests of a page's words, tables and files."""
    patch.setattr(Picture, "png", EMPTY_PNG)
    patch.setattr(Picture, "svg", EMPTY_SVG)


def stand_soon(patch: pytest.MonkeyPatch) -> None:
    """Have a walk begin after 0.3 s: the emulated robot stands already."""
    patch.setattr(deployment, "STAND_S", 0.3)
