"""Damaged frames of a serial line."""

import numpy as np


def damaged(rng: np.random.Generator, frames: list[bytes]) -> bytes:
    """A frame with flipped bits, cut, doubled, or with noise around it."""
    data = bytearray(frames[int(rng.integers(len(frames)))])
    kind = int(rng.integers(4))
    if kind == 0:
        for _ in range(int(rng.integers(1, 4))):
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[int(rng.integers(len(data))) :]
    elif kind == 2:
        data[3:3] = data[: int(rng.integers(len(data)))]
    else:
        data += rng.bytes(int(rng.integers(12)))
    return bytes(data)
