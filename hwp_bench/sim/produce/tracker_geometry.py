"""How hard a posed hand is to see for a tracker: how bent it is, and how far it is turned."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.skeleton import JOINT_NAMES

#: Mean bend of a finger joint in a fist, rad: a curl of 1.
FIST = 1.3
# Landmarks of the wrist and of the knuckles of index, middle and little finger.
_WRIST, _INDEX, _MIDDLE, _LITTLE = 0, 5, 9, 17


def curl(pose: np.ndarray) -> np.ndarray:
    """How far the four fingers are bent: (F,), 0 straight to 1 fist.

    Args:
        pose: (F, 16, 3) axis-angle rad.
    """
    four = [
        row
        for row, name in enumerate(JOINT_NAMES)
        if name != "wrist" and not name.startswith("thumb")
    ]
    bends = np.linalg.norm(pose[:, four], axis=2).mean(axis=1)
    return np.asarray(np.clip(bends / FIST, 0.0, 1.0))


def edge_on(landmarks: np.ndarray) -> np.ndarray:
    """How far a palm is turned from the camera: (F,), 0 facing it or away, 1 seen from its edge.

    Args:
        landmarks: (F, 21, 3) m, camera axes.
    """
    wrist = landmarks[:, _WRIST]
    normal = np.cross(landmarks[:, _INDEX] - wrist, landmarks[:, _LITTLE] - wrist)
    sight = landmarks[:, _MIDDLE]
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    return np.asarray(1.0 - np.abs((normal * sight).sum(axis=1)) / np.maximum(length, 1e-12))
