"""The lit hand, drawn once in a session."""

from __future__ import annotations

import numpy as np
import pytest
from lit_hand import linear_frames


@pytest.fixture(scope="session")
def lit_frames() -> tuple[np.ndarray, np.ndarray]:
    """(F, H, W, 3) linear light and (F, H, W) bool silhouettes; not to be changed."""
    frames, silhouettes = linear_frames()
    frames.setflags(write=False)
    silhouettes.setflags(write=False)
    return frames, silhouettes
