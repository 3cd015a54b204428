"""The shape of the hand model that is nearest to a person off it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.hands.skeleton import PARENTS, SHAPE_COUNT

if TYPE_CHECKING:
    from hwp_bench.hands import HandTemplate

# Cost of one standard deviation of shape, in m of misfit: decides where the surface does not.
_RIDGE = 0.00002
# Largest betas that a person has.
_WIDEST = 3.0


def betas_of_surface(model: HandTemplate, vertices: np.ndarray) -> np.ndarray:
    """Betas whose surface is nearest to one of the same triangles: (10,).

    Args:
        model: the hand model.
        vertices: (V, 3) m at rest; the whole may be elsewhere.

    Source: bounded linear least squares, with a ridge on betas.
    """
    from scipy.optimize import lsq_linear

    count = len(vertices)
    shift = np.tile(np.eye(3), (count, 1))
    system = np.hstack([model.shape_basis.reshape(3 * count, SHAPE_COUNT), shift])
    ridge = np.zeros((SHAPE_COUNT, SHAPE_COUNT + 3))
    ridge[:, :SHAPE_COUNT] = _RIDGE * np.sqrt(count) * np.eye(SHAPE_COUNT)
    rest = (vertices - model.vertices).reshape(-1)
    widest = np.array([_WIDEST] * SHAPE_COUNT + [np.inf] * 3)
    solved = lsq_linear(
        np.vstack([system, ridge]),
        np.concatenate([rest, np.zeros(SHAPE_COUNT)]),
        bounds=(-widest, widest),
    )
    return np.asarray(solved.x[:SHAPE_COUNT]).round(4)


def betas_of_joints(model: HandTemplate, joints: np.ndarray) -> np.ndarray:
    """Betas whose bones have the lengths of a rig: (10,).

    Args:
        model: the hand model.
        joints: (16, 3) m at rest.

    Source: nonlinear least squares over 15 bones, with a ridge on betas.
    """
    from scipy.optimize import least_squares

    parents = np.array(PARENTS)
    wanted = np.linalg.norm(joints[1:] - joints[parents[1:]], axis=1)

    def misfit(betas: np.ndarray) -> np.ndarray:
        places = model.joints + model.joint_basis @ betas
        bones = np.linalg.norm(places[1:] - places[parents[1:]], axis=1)
        return np.concatenate([bones - wanted, _RIDGE * betas])

    return np.asarray(
        least_squares(misfit, np.zeros(SHAPE_COUNT), bounds=(-_WIDEST, _WIDEST)).x
    ).round(4)
