"""Random bits that depend neither on the device nor on the order in which they are drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

INCREMENT = 0x9E3779B9  # between the hash inputs of consecutive numbers
FACTORS = (16, 0x85EBCA6B), (13, 0xC2B2AE35)  # (shift, factor) of the rounds of `hashed`


def hashed(numbers: NDArray[np.uint32], key: int) -> NDArray[np.uint32]:
    """32 bits for each number and this key, by the finaliser of MurmurHash3 (Appleby, public
    domain)."""
    h = numbers * np.uint32(INCREMENT) + np.uint32(key)
    for shift, factor in FACTORS:
        h ^= h >> np.uint32(shift)
        h *= np.uint32(factor)
    return np.asarray(h ^ (h >> np.uint32(16)))


def signs(shape: tuple[int, ...], key: int) -> NDArray[np.float32]:
    """1 or -1 with equal probability: the bits of the hashes of 0, 1, ..., 32 of each, the lowest
    first."""
    count = int(np.prod(shape))
    words = hashed(np.arange(-(-count // 32), dtype=np.uint32), key).astype("<u4")
    bits = np.unpackbits(words.view(np.uint8), bitorder="little", count=count)
    return np.where(bits, np.float32(1), np.float32(-1)).reshape(shape)
