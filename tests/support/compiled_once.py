"""A function is compiled by one process of the tests; the others wait for it and load it.

On a fresh clone every worker would compile the same functions at the same time. Programs and
processes that tests start do not wait: for them the estimator is compiled before.
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


def compile_estimator() -> None:
    """Compile what the lag of polled steps needs, or load what was compiled before.

    The kernel of the fits, the doctor's regression, the search for the poll and the evidence of a
    response: all that takes long, so that no program or pool compiles it once more.
    """
    from pupper_sysid.sysid.lag.lag_budget import lag_budget
    from support.made_recordings import JOINT, USUAL_SERVO, Setup, record

    rng = np.random.default_rng(0)
    steps = record(Setup(USUAL_SERVO, kind="steps", poll_s=0.027, loss=0.3, trial_s=1.5), rng)
    lag_budget(JOINT, steps.trials(JOINT), rng)
