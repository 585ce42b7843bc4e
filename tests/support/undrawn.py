"""Reports without their pictures: two thirds of the time of a page are spent drawing."""

import pytest

from pupper_sysid.common.page import Picture

EMPTY_PNG = b"\x89PNG\r\n\x1a\n"
EMPTY_SVG = b'<svg viewBox="0 0 1 1"></svg>'


def leave_undrawn(patch: pytest.MonkeyPatch) -> None:
    """Write empty pictures: for tests of a page's words, tables and files."""
    patch.setattr(Picture, "png", EMPTY_PNG)
    patch.setattr(Picture, "svg", EMPTY_SVG)
