"""Independent random streams: one per purpose, each fixed by the seed and its own name alone."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *key: str | int) -> np.random.Generator:
    """Return the generator of one named stream.

    The stream depends on the seed and the key only, never on which other streams were drawn, so leaving out a term,
    a layer or a CCD leaves all others as they were. A key is a name such as ``("atmosphere", "layer", 3)``; the seed is
    not negative.
    """
    # CRC-32 and not hash(): Python's own hash of a string changes from process to process.
    words = tuple(zlib.crc32(word.encode()) if isinstance(word, str) else int(word) for word in key)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(int(seed), spawn_key=words)))


def natural_number(number: int) -> int:
    """Map integers to distinct natural numbers: keys of random streams are not negative."""
    return 2 * abs(number) + (number < 0)
