"""Results about trials that several parts of one command ask for: computed once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import fields
from functools import wraps
from hashlib import blake2b
from typing import TypeVar

import numpy as np

from pupper_sysid.sysid.recordings.recording import Trial

Found = TypeVar("Found")


def remembered(most: int) -> Callable[[Callable[..., Found]], Callable[..., Found]]:
    """Keep the last `most` results of a function of trials, by the content of the trials.

    The function takes a trial or a sequence of trials, and hashable arguments by position. Its
    results are shared and must not be changed.
    """

    def decorate(compute: Callable[..., Found]) -> Callable[..., Found]:
        results: OrderedDict[Hashable, Found] = OrderedDict()

        @wraps(compute)
        def from_memory(trials: Trial | Sequence[Trial], *arguments: Hashable) -> Found:
            several = [trials] if isinstance(trials, Trial) else trials
            key = (_digest(several), arguments)
            if key not in results:
                results[key] = compute(trials, *arguments)
                if len(results) > most:
                    results.popitem(last=False)
            results.move_to_end(key)
            return results[key]

        return from_memory

    return decorate


def _digest(trials: Sequence[Trial]) -> bytes:
    content = blake2b(digest_size=16)
    for trial in trials:
        for field in fields(trial):
            value = getattr(trial, field.name)
            if isinstance(value, np.ndarray):
                content.update(np.ascontiguousarray(value).tobytes())
            else:
                content.update(repr(value).encode())
            content.update(b"|")
    return content.digest()
