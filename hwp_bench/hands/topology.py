"""The edges of a mesh: its open end, midpoint subdivision of a template, and MANO-HD."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.hands.template import HandTemplate, rebuilt

#: More would exceed the memory that a template may take: each time is four times the faces.
MAX_TIMES = 4

#: Name and number of subdivisions of the paper's MANO-HD (778 -> 49,281 vertices).
MANO_HD_NAME = "mano-hd"
MANO_HD_TIMES = 3

_VERTEX_FIELDS = ("vertices", "shape_basis", "pose_basis", "weights")


def subdivide(template: HandTemplate, times: int = 1) -> HandTemplate:
    """Split every face into four at its edges' midpoints; the surface keeps its shape.

    A new vertex is the mean of its edge's end points in position, in both bases and in skinning
    weight; old vertices keep their numbers, joints do not change. Texture coordinates are split
    along their own edges, so that seams stay seams.

    Args:
        template: any template.
        times: 0 to `MAX_TIMES`.

    Returns:
        A template whose name ends in "+times".

    Raises:
        UsageError: `times` is out of range.
    """
    if not 0 <= times <= MAX_TIMES:
        raise UsageError(
            f"{times} subdivisions are not possible",
            field="times",
            remedy=f"Use 0 to {MAX_TIMES}.",
        )
    if times == 0:
        return template
    arrays = {field: getattr(template, field) for field in _VERTEX_FIELDS}
    faces, uv, face_uv = template.faces, template.uv, template.face_uv
    for _ in range(times):
        faces, edges = _split(faces, len(arrays["vertices"]))
        for field, values in arrays.items():
            if values is not None:
                arrays[field] = _with_midpoints(values, edges)
        face_uv, uv_edges = _split(face_uv, len(uv))
        uv = _with_midpoints(uv, uv_edges)
    name = f"{template.name}+{times}"
    return rebuilt(template, name=name, faces=faces, uv=uv, face_uv=face_uv, **arrays)


def mano_hd(template: HandTemplate) -> HandTemplate:
    """The paper's high-resolution MANO: three subdivisions, then one averaging pass.

    The pass replaces everything that a vertex carries (position, bases, weights) by the mean
    over the vertex and its neighbours, so that smoothing a shaped mesh and shaping the smoothed
    mesh are the same.

    Args:
        template: MANO at 778 vertices.
    """
    fine = subdivide(template, MANO_HD_TIMES)
    edges = unique_edges(fine.faces)[0]
    smooth = {
        field: None if values is None else _neighbour_mean(values, edges)
        for field, values in ((field, getattr(fine, field)) for field in _VERTEX_FIELDS)
    }
    return rebuilt(fine, name=MANO_HD_NAME, **smooth)


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Return the vertices on the open end of a mesh (the wrist), sorted.

    Args:
        faces: (F, 3) int.

    Returns:
        (N,) int64, the vertices of the edges that belong to one face only.
    """
    return np.unique(_open_edges(faces))


def open_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the open ends of a mesh, each as the vertices around it.

    Args:
        faces: (F, 3) int.

    Returns:
        (L,) int64 for each open end, one neighbour after the other in the direction of the faces'
        own edges, the longest first; none for a closed mesh. Where more than two open edges meet in
        a vertex, one of the ways through it is taken.
    """
    following = dict(_open_edges(faces).tolist())
    loops = []
    while following:
        loop = [next(iter(following))]
        step = following.pop(loop[0])
        while step != loop[0] and step in following:
            loop.append(step)
            step = following.pop(step)
        loops.append(np.array(loop, dtype=np.int64))
    return sorted(loops, key=len, reverse=True)


def boundary_loop(faces: np.ndarray) -> np.ndarray:
    """Return the longest loop of boundary vertices, in order; empty for a closed mesh."""
    return next(iter(open_loops(faces)), np.zeros(0, dtype=np.int64))


def _open_edges(faces: np.ndarray) -> np.ndarray:
    """(E, 2) directed edges that belong to one face only."""
    edges, edge_of = unique_edges(faces)
    once = np.bincount(edge_of.ravel(), minlength=len(edges)) == 1
    return _directed_edges(faces)[once[edge_of.ravel()]]


def _split(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The four faces of each face, and the end points of the new vertices (from `count` on)."""
    edges, edge_of = unique_edges(faces)
    a, b, c = faces.T
    ab, bc, ca = count + edge_of
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.stack(face, axis=1) for face in quarters], axis=1).reshape(-1, 3), edges


def unique_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of a mesh, each once.

    Args:
        faces: (F, 3) int.

    Returns:
        (E, 2) edges in sorted order, and for each face the edges ab, bc, ca as (3, F).
    """
    ends = np.sort(_directed_edges(faces), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    return edges, inverse.reshape(3, -1)


def _directed_edges(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2): the edge ab of each face, then bc, then ca."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _with_midpoints(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.concatenate([values, 0.5 * (values[edges[:, 0]] + values[edges[:, 1]])])


def _neighbour_mean(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    from scipy.sparse import coo_matrix

    count = len(values)
    itself = np.arange(count)
    rows = np.concatenate([edges[:, 0], edges[:, 1], itself])
    columns = np.concatenate([edges[:, 1], edges[:, 0], itself])
    adjacency = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count)).tocsr()
    sums = adjacency @ values.reshape(count, -1)
    means = sums / np.asarray(adjacency.sum(axis=1))
    return means.reshape(values.shape)
