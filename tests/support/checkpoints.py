"""Checkpoints of training runs, compared; and runs that are stopped at a place."""

import signal

import torch


def different(a, b, path: str = "") -> list[str]:
    """Places where two checkpoints differ by as much as a bit; times of day apart."""
    if path.endswith("elapsed_s"):
        return []
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [d for k in a for d in different(a[k], b[k], f"{path}.{k}")]
    if isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        pairs = enumerate(zip(a, b, strict=True))
        return [d for i, (x, y) in pairs for d in different(x, y, f"{path}[{i}]")]
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return [] if torch.equal(a, b) else [path]
    return [] if type(a) is type(b) and a == b else [path]


def stop_after(phase: str, done: int):
    """A watcher that presses Ctrl-C after so many rounds or updates."""

    def watch(now):
        if (now.phase, now.done) == (phase, done):
            signal.raise_signal(signal.SIGINT)

    return watch
