"""A posed hand as a linear function of its rest surface and rest joints."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS


def vertex_turns(turns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How a displacement of a rest vertex moves the posed one.

    Args:
        turns: (16, 3, 3) rotation of each joint's segment, rest to posed.
        weights: (V, 16) skinning weights.

    Returns:
        (V, 3, 3).
    """
    blended: np.ndarray = (weights @ turns.reshape(JOINT_COUNT, 9)).reshape(-1, 3, 3)
    return blended


def joint_turns(turns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How displacements of the rest joints move posed vertices; the wrist stays where it is.

    A vertex is sum_k w_k (G_k (v - j_k) + p_k), and the posed joint is p_k = p_parent +
    G_parent (j_k - j_parent): both are linear in the rest joints j.

    Args:
        turns: (16, 3, 3) rotation of each joint's segment, rest to posed.
        weights: (V, 16) skinning weights.

    Returns:
        (V, 16, 3, 3): of vertex v by rest joint j.
    """
    places = np.zeros((JOINT_COUNT, JOINT_COUNT, 3, 3))  # of posed joint k by rest joint j
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        places[joint] = places[parent]
        places[joint, joint] += turns[parent]
        places[joint, parent] -= turns[parent]
    moved = places.copy()
    moved[np.arange(JOINT_COUNT), np.arange(JOINT_COUNT)] -= turns
    moved[:, 0] = 0.0
    flat: np.ndarray = weights @ moved.reshape(JOINT_COUNT, -1)
    return flat.reshape(-1, JOINT_COUNT, 3, 3)
