"""The processes of one training: which of them this is, and what they decide together.

`torchrun` starts them, each with environments of its own; they exchange through gloo.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @classmethod
    def join(cls) -> Ranks:
        """Join the processes that `torchrun` started; alone if it did not."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size == 1:
            return cls()
        found = cls(int(os.environ["RANK"]), size, int(os.environ.get("LOCAL_RANK", "0")))
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("gloo", rank=found.rank, world_size=size)
        return found

    def same(self, text: str) -> str:
        """The first process's `text`, in all."""
        found = [text]
        if self.size > 1:
            torch.distributed.broadcast_object_list(found, src=0)
        return found[0]

    def any(self, here: bool) -> bool:
        """Whether it is so in any process; all must decide alike, or they would deadlock."""
        return bool(self._reduced(float(here), "MAX"))

    def mean(self, here: float) -> float:
        """Mean over the processes, the same in all."""
        return self._reduced(here, "SUM") / self.size

    def _reduced(self, here: float, operation: str) -> float:
        if self.size == 1:
            return here
        found = torch.tensor(here, dtype=torch.float64)
        torch.distributed.all_reduce(found, getattr(torch.distributed.ReduceOp, operation))
        return float(found)
