"""Triangle mesh arithmetic: subdivision as a matrix, normals, boundary loops."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.hands.template import boundary_vertices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


def subdivision(faces: np.ndarray, vertex_count: int) -> tuple[csr_matrix, np.ndarray]:
    """One midpoint subdivision, written as a matrix.

    Args:
        faces: (F, 3).
        vertex_count: V.

    Returns:
        (V', V) sparse matrix that turns per-vertex values into those of the finer mesh, the
        first V rows unchanged, and its (4F, 3) faces.
    """
    from scipy.sparse import csr_matrix

    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = (vertex_count + inverse.reshape(3, -1).T).astype(faces.dtype)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    fine = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=0)
    count = len(unique)
    rows = np.concatenate([np.arange(vertex_count), np.repeat(vertex_count + np.arange(count), 2)])
    columns = np.concatenate([np.arange(vertex_count), unique.reshape(-1)])
    values = np.concatenate([np.ones(vertex_count), np.full(2 * count, 0.5)])
    matrix = csr_matrix((values, (rows, columns)), shape=(vertex_count + count, vertex_count))
    return matrix, fine.transpose(0, 2, 1).reshape(-1, 3)


def smoothing(faces: np.ndarray, vertex_count: int, rounds: int) -> csr_matrix:
    """Taubin smoothing as one matrix: rounds facets off without shrinking.

    The boundary stays where it is.

    Source: Taubin, "A signal processing approach to fair surface design" (lambda 0.5, mu -0.53).
    """
    from scipy.sparse import diags, identity

    adjacency = _adjacency(faces, vertex_count)
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    free = np.ones(vertex_count)
    free[boundary_vertices(faces)] = 0.0
    laplacian = diags(free) @ (diags(1.0 / np.maximum(degree, 1.0)) @ adjacency) - diags(free)
    one = identity(vertex_count, format="csr")
    step = (one - 0.53 * laplacian) @ (one + 0.5 * laplacian)
    matrix = one
    for _ in range(rounds):
        matrix = step @ matrix
    return matrix.tocsr()


def smoothing_step(faces: np.ndarray, vertex_count: int, share: float) -> csr_matrix:
    """(V, V) matrix that replaces a share of each value by the mean of its neighbours'."""
    from scipy.sparse import diags, identity

    adjacency = _adjacency(faces, vertex_count)
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    mean = diags(1.0 / np.maximum(degree, 1.0)) @ adjacency
    # A vertex without neighbours keeps its value.
    keep = 1.0 - share * (degree > 0)
    return (diags(keep) @ identity(vertex_count, format="csr") + share * mean).tocsr()


def normal_operator(faces: np.ndarray, vertex_count: int) -> csr_matrix:
    """(V, F) matrix that adds the faces' vectors up at their corners."""
    from scipy.sparse import csr_matrix

    rows = faces.reshape(-1)
    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(vertex_count, len(faces)))


def surface_normals(vertices: np.ndarray, faces: np.ndarray, operator: csr_matrix) -> np.ndarray:
    """Unit normals at the vertices, weighted by area: (V, 3).

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        operator: `normal_operator` of the mesh; frames share it.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return unit(operator @ np.cross(b - a, c - a))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors at length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    return vectors / np.maximum(length, 1e-12)


def _adjacency(faces: np.ndarray, vertex_count: int) -> csr_matrix:
    from scipy.sparse import csr_matrix

    rows = np.concatenate([faces[:, i] for i in (0, 1, 2, 1, 2, 0)])
    columns = np.concatenate([faces[:, i] for i in (1, 2, 0, 0, 1, 2)])
    matrix = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(vertex_count,) * 2)
    matrix.data[:] = 1.0
    return matrix
