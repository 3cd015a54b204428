"""A linear shape space for hands: align samples rigidly, then principal components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.template import SHAPE_COUNT

#: Rows are the rest directions of a right hand in MANO's axes: from the wrist to the middle
#: knuckle is -x, out of the back of the hand is +y, towards the thumb's side is +z.
MANO_DIRECTIONS = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """Mean and ten components of sampled hands; metres, components per standard deviation."""

    #: (V, 3).
    mean_vertices: np.ndarray
    #: (J, 3).
    mean_joints: np.ndarray
    #: (V, 3, 10).
    vertex_basis: np.ndarray
    #: (J, 3, 10) least squares regression of the joints on the ten parameters.
    joint_basis: np.ndarray
    #: Root mean square distance, m, between the samples' joints and their regression.
    joint_residual: float
    #: (10,) share of the vertices' variance that each component explains.
    explained: np.ndarray


def align_hands(
    vertices: np.ndarray, joints: np.ndarray, palm: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move right hands so that the wrist is the origin and the palm has one orientation.

    Args:
        vertices: (S, V, 3) m.
        joints: (S, J, 3) m.
        palm: (S, 5, 3) wrist, then the knuckles of index, middle, little and ring finger.
        directions: (3, 3) rows: where fingers, back of the hand and thumb's side shall point.

    Returns:
        The moved vertices and joints.
    """
    wrist = palm[:, :1]
    forward = _unit(palm[:, 2] - palm[:, 0])
    across = palm[:, 1] - palm[:, 3]
    across = _unit(across - (across * forward).sum(axis=-1, keepdims=True) * forward)
    back = np.cross(forward, across)
    turn = np.einsum("sic,id->sdc", np.stack([forward, back, across], axis=1), directions)
    return (
        np.einsum("sdc,svc->svd", turn, vertices - wrist),
        np.einsum("sdc,sjc->sjd", turn, joints - wrist),
    )


def shape_components(vertices: np.ndarray, joints: np.ndarray) -> ShapeSpace:
    """Principal components of aligned hands, scaled to unit deviation, with a fixed sign.

    The sign makes the component's largest coordinate change positive, so that two machines
    agree.

    Args:
        vertices: (S, V, 3) m, S at least 11.
        joints: (S, J, 3) m.
    """
    samples = len(vertices)
    mean_vertices, mean_joints = vertices.mean(axis=0), joints.mean(axis=0)
    centred = (vertices - mean_vertices).reshape(samples, -1)
    values, vectors = np.linalg.eigh(centred.T @ centred / samples)
    order = np.argsort(values)[::-1][:SHAPE_COUNT]
    basis = vectors[:, order]
    largest = basis[np.argmax(np.abs(basis), axis=0), np.arange(SHAPE_COUNT)]
    basis = basis * np.sign(largest)
    deviation = np.sqrt(values[order])
    scores = centred @ basis / deviation
    joint_offsets = (joints - mean_joints).reshape(samples, -1)
    # The scores are uncorrelated with unit variance: least squares is one product.
    joint_basis = joint_offsets.T @ scores / samples
    error = (joint_offsets - scores @ joint_basis.T).reshape(samples, -1, 3)
    return ShapeSpace(
        mean_vertices=mean_vertices,
        mean_joints=mean_joints,
        vertex_basis=(basis * deviation).reshape(*mean_vertices.shape, SHAPE_COUNT),
        joint_basis=joint_basis.reshape(*mean_joints.shape, SHAPE_COUNT),
        joint_residual=float(np.sqrt((error**2).sum(axis=-1).mean())),
        explained=values[order] / values.sum(),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
