"""The curves of a training run: means over an update, as rows of CSV files and for TensorBoard."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import torch

from pupper_sysid.common.border import read_text
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.files import write_text
from pupper_sysid.common.reading.content import refuse_more
from pupper_sysid.common.reading.dialect import whole_number

LARGEST_BYTES = 100e6
"""Of a table of curves."""
_NUMBER = 40  # characters of a row that may hold its number
MOST_ROWS = 1_000_000
PROGRESS, IMITATION = "progress.csv", "imitation.csv"


class EpisodeMeans:
    """Means over the steps of an update: reward and its terms, falls, lengths of episodes."""

    def __init__(self, environments: int):
        self._length = np.zeros(environments)
        self._terms: list[dict[str, float]] = []
        self._ended: list[float] = []
        self._falls = self._steps = 0

    def __call__(self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict) -> None:
        done = dones.cpu().numpy().astype(bool)
        self._length += 1
        self._ended += self._length[done].tolist()
        self._length[done] = 0
        self._falls += int(done.sum()) - len(extras["terminal_ids"])
        self._steps += len(done)
        self._terms.append({k: float(v.mean()) for k, v in extras["terms"].items()})

    def row(self) -> dict[str, float]:
        """Means since the last call."""
        names = self._terms[0]
        terms = {k: float(np.mean([t[k] for t in self._terms])) for k in names}
        row = {
            "reward": sum(terms.values()),
            "falls_per_1000_steps": 1000 * self._falls / self._steps,
            "episode_steps": float(np.mean(self._ended)) if self._ended else float("nan"),
            **{f"reward.{k}": v for k, v in terms.items()},
        }
        self._terms, self._ended, self._falls, self._steps = [], [], 0, 0
        return row


class CurveWriter:
    """`progress.csv`, `imitation.csv` and TensorBoard, appended to.

    Rows beyond `done` (by phase) are from after the checkpoint that is resumed, and are dropped.
    """

    def __init__(self, folder: Path, done: dict[str, int]):
        from torch.utils.tensorboard import SummaryWriter

        self._paths = {"ppo": folder / PROGRESS, "imitation": folder / IMITATION}
        for phase, path in self._paths.items():
            with _writing(path):
                _drop_rows(path, done[phase])
        with _writing(folder / "tensorboard"):
            self._board = SummaryWriter(str(folder / "tensorboard"))

    def write(self, phase: str, step: int, row: dict[str, float]) -> None:
        """One row."""
        path = self._paths[phase]
        with _writing(path):
            new = not path.exists()
            with path.open("a", newline="") as file:
                writer = csv.writer(file)
                if new:
                    writer.writerow(["update", *row])
                writer.writerow([step, *(f"{v:.6g}" for v in row.values())])
            for name, value in row.items():
                self._board.add_scalar(f"{phase}/{name}", value, step)

    def close(self) -> None:
        """Finish writing."""
        self._board.close()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn a failed write (full disk, no permission) into an `InputError`."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _drop_rows(path: Path, last: int) -> None:
    """Keep a table's header and its rows up to update `last`."""
    if not path.exists():
        return
    text = read_text(path, LARGEST_BYTES)
    refuse_more(path, text.count("\n"), MOST_ROWS, "rows")
    header, *rows = text.splitlines(keepends=True) or [""]
    rows_before = [row for row in rows if _update(row[:_NUMBER]) <= last]
    if rows_before != rows:
        write_text(path, "".join([header, *rows_before]), force=True)


def _update(row: str) -> float:
    """Number of a row's update; infinite where there is none."""
    with suppress(ValueError):
        return whole_number(row.split(",")[0])
    return math.inf
