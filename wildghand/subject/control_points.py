"""Control points on a rest hand: smooth displacements of its surface from few numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hwp_bench.hands import HandTemplate, unique_edges


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """K points on the surface, and how they move V vertices."""

    #: (V, K) shares of each vertex; rows sum to 1.
    shares: np.ndarray
    #: (E, 2) pairs of neighbouring points.
    pairs: np.ndarray
    #: (E,) m along the surface between them.
    lengths: np.ndarray


def place_control_points(template: HandTemplate, count: int) -> ControlPoints:
    """Spread control points over a hand, each as far as possible from those before it.

    Distances run along the edges of the mesh, so that neighbouring fingers move apart.

    Args:
        template: the hand.
        count: K; every vertex is one where the template has fewer.
    """
    vertices, edges = template.vertices, unique_edges(template.faces)[0]
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = coo_matrix((lengths, edges.T), shape=(len(vertices),) * 2).tocsr()
    count = min(count, len(vertices))
    chosen = [0]
    paths = [dijkstra(graph, directed=False, indices=0)]
    nearest = paths[0].copy()
    for _ in range(count - 1):
        chosen.append(int(np.where(np.isfinite(nearest), nearest, -1.0).argmax()))
        paths.append(dijkstra(graph, directed=False, indices=chosen[-1], limit=0.08))
        nearest = np.minimum(nearest, paths[-1])
    distance = np.stack(paths, axis=1)
    width = float(np.median(np.sort(distance[chosen], axis=1)[:, min(1, count - 1)]))
    shares = np.exp(-0.5 * (distance / max(width, 1e-6)) ** 2)
    shares[np.arange(len(vertices)), distance.argmin(axis=1)] += 1e-6  # far from all of them
    shares /= shares.sum(axis=1, keepdims=True)
    between = distance[chosen]
    first, second = np.nonzero(np.triu(between < 2.0 * width, k=1))
    return ControlPoints(shares, np.column_stack([first, second]), between[first, second])
