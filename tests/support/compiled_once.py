"""A function is compiled by one process of the tests; the others wait for it and load it.

On a fresh clone every worker would compile the same functions at the same time. Programs and
processes that tests start do not wait: for them the kernel, by far the largest, is there before.
"""

import fcntl

import numpy as np
from numba.core.dispatcher import Dispatcher

from support.package import ROOT

_compile = Dispatcher.compile
_lock = (ROOT / "Makefile").open()
_depth = 0


def _compile_alone(dispatcher: Dispatcher, signature: object) -> object:
    global _depth
    if not _depth:
        fcntl.flock(_lock, fcntl.LOCK_EX)
    _depth += 1
    try:
        return _compile(dispatcher, signature)
    finally:
        _depth -= 1
        if not _depth:
            fcntl.flock(_lock, fcntl.LOCK_UN)


Dispatcher.compile = _compile_alone


def compile_kernel() -> None:
    """Compile the kernel of the fits, or load what was compiled before."""
    from pupper_sysid.servo_models import kernel
    from pupper_sysid.sysid.fit.run import simulate
    from support.runs import run_of

    simulate(kernel.ABSENT[None], np.zeros(1), run_of(np.zeros(4)))
