"""Random numbers that depend on what they are for, never on who asks first."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return a generator for one purpose.

    Args:
        seed: seed of the scene.
        purpose: what the numbers are for, such as `("noise", frame)`. Equal seeds and purposes
            give equal numbers in any process and any order.
    """
    text = "/".join(str(part) for part in (seed, *purpose))
    words = np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype=np.uint32)
    return np.random.default_rng(words.tolist())
