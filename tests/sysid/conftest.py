"""The doctor is asked in its own room, and where its words are read; elsewhere it takes no time."""

from collections.abc import Iterator

import pytest

from support.unexamined import unexamined

EXAMINED = ("doctor", "importers", "test_clocks.py", "test_powered.py")


@pytest.fixture(scope="module", autouse=True)
def doctor(request) -> Iterator[None]:
    """No findings, whatever is computed, but in `EXAMINED`."""
    if set(EXAMINED) & set(request.path.parts):
        yield
        return
    with unexamined():
        yield
