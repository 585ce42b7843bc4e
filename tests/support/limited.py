"""Readers of hostile files within limits of time and memory: `limited`."""

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pupper_sysid.common.errors import PupperError

CPU_S = 5.0
"""Processor time of one reading; the slowest refusal takes a few milliseconds."""
MEMORY_BYTES = 2 << 30
"""Address space beyond what the process has: a reader that needs more raises MemoryError."""


def limited(call: Callable[[], Any]) -> str:
    """The refusal of a call, empty if there is none; fails beyond the limits of time and memory."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, before[1]))
    started, refusal = time.thread_time(), ""
    try:
        call()
    except PupperError as error:
        refusal = str(error)
        assert refusal.isprintable() and refusal.endswith((".", "?", ".)")), refusal
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert time.thread_time() - started < CPU_S
    return refusal
