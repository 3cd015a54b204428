"""A linear shape space for hands: align samples rigidly, then principal components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.landmarks import FINGERS, finger_joints
from hwp_bench.hands.template import SHAPE_COUNT


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


def align_hands(vertices: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move right hands to MANO's directions: the wrist at the origin, fingers along -x.

    The middle knuckle lies on the -x axis, the little and the index knuckle at the same height
    y, the back of the hand towards +y, the index finger's side towards +z.

    Args:
        vertices: (S, V, 3) m.
        joints: (S, 16, 3) m, MANO order.

    Returns:
        The moved vertices and joints.
    """
    wrist, index, middle, little = (joints[:, [joint]] for joint in (0, 1, 4, 7))
    x = _unit(wrist - middle)
    z = index - little
    z = _unit(z - (z * x).sum(axis=-1, keepdims=True) * x)
    axes = np.concatenate([x, np.cross(z, x), z], axis=1)
    return (vertices - wrist) @ axes.swapaxes(1, 2), (joints - wrist) @ axes.swapaxes(1, 2)


def stretch_fingers(
    vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make each finger longer or shorter along its own axis, its knuckle staying in place.

    Args:
        vertices: (S, V, 3) m.
        joints: (S, 16, 3) m, MANO order.
        weights: (V, 16) skinning weights; they say how far a vertex follows its finger.
        factors: (S, 5) length factors in the order of `FINGERS`.

    Returns:
        The changed vertices and joints.
    """
    vertices, joints = vertices.copy(), joints.copy()
    for finger, factor in zip(FINGERS, factors.T, strict=True):
        chain = list(finger_joints(finger))
        base = joints[:, chain[:1]].copy()
        axis = _unit(joints[:, chain[-1:]] - base)
        follow = np.append(weights[:, chain].sum(axis=1), np.ones(len(chain)))
        points = np.concatenate([vertices, joints[:, chain]], axis=1)
        along = np.maximum(((points - base) * axis).sum(axis=-1), 0.0)
        points += ((factor[:, None] - 1.0) * along * follow)[..., None] * axis
        vertices, joints[:, chain] = points[:, : -len(chain)], points[:, -len(chain) :]
    return vertices, joints


def shape_components(vertices: np.ndarray, joints: np.ndarray) -> ShapeSpace:
    """Principal components of aligned hands, scaled to unit deviation, with a fixed sign.

    The sign makes a positive parameter a larger hand (seen from the wrist), so that two
    machines agree.

    Args:
        vertices: (S, V, 3) m; more samples than components.
        joints: (S, J, 3) m.
    """
    samples = len(vertices)
    mean_vertices, mean_joints = vertices.mean(axis=0), joints.mean(axis=0)
    centred = (vertices - mean_vertices).reshape(samples, -1)
    # Far fewer samples than coordinates: the samples' own product has the same spectrum.
    values, vectors = np.linalg.eigh(centred @ centred.T / samples)
    order = np.argsort(values)[::-1][:SHAPE_COUNT]
    deviation = np.sqrt(values[order])
    basis = centred.T @ vectors[:, order] / (deviation * np.sqrt(samples))
    basis = basis * np.where(mean_vertices.reshape(-1) @ basis < 0.0, -1.0, 1.0)
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
