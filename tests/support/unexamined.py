"""The doctor finds nothing: for tests of what is computed after it, with the same numbers.

An examination costs most of a second, and every function of `sysid` begins with one.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from pupper_sysid.sysid.doctor import checks


@contextmanager
def unexamined() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks, "findings", lambda trials: [])
        yield
