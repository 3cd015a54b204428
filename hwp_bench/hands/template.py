"""A hand template: rest mesh, shape, pose, skeleton; its open end, subdivision, and MANO-HD."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS, SHAPE_COUNT, SIDES

if TYPE_CHECKING:
    import torch


#: Pose correctives: nine entries of (R - I) for each joint but the wrist.
POSE_FEATURE_COUNT = 9 * (JOINT_COUNT - 1)

# Digests ignore differences between two machines' linear algebra: 10 micrometres in lengths.
_DIGEST_DECIMALS = 5


@dataclass(frozen=True, eq=False)
class HandTemplate:
    """One hand that `pose_hand` can pose; metres, float64 and int64 arrays.

    The free template's rest frame: wrist at the origin, the fingers of the right hand along
    -x, the back of the hand along +y, the thumb's side along +z (MANO's directions). A left
    hand is the mirror image in x.
    """

    #: Which model: "anny-1", "mano" or "mano-hd", with "+N" after N further subdivisions.
    name: str
    #: SHA-256 of the rounded content; equal digests mean interchangeable parameters.
    digest: str
    #: "right" or "left".
    side: str
    #: (V, 3) rest vertices, m.
    vertices: np.ndarray
    #: (F, 3) vertex indices, counter-clockwise seen from outside.
    faces: np.ndarray
    #: (V, 3, 10) metres per unit of each shape parameter.
    shape_basis: np.ndarray
    #: (V, 3, 135) metres per entry of the pose feature R - I, or None without correctives.
    pose_basis: np.ndarray | None
    #: (16, 3) rest joints, m.
    joints: np.ndarray
    #: (16, 3, 10) metres per unit of each shape parameter.
    joint_basis: np.ndarray
    #: (V, 16) skinning weights; rows sum to 1.
    weights: np.ndarray
    #: (16,) parent of each joint; -1 for the wrist.
    parents: np.ndarray
    #: (45,) mean pose of the 15 finger joints, axis-angle rad; zeros where there is none.
    mean_pose: np.ndarray
    #: (T, 2) texture coordinates in [0, 1], origin at the bottom left.
    uv: np.ndarray
    #: (F, 3) indices into `uv`, face corner by face corner.
    face_uv: np.ndarray
    #: (5,) vertices at the tips of thumb, index, middle, ring and little finger.
    fingertips: np.ndarray

    def to_torch(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> TemplateTensors:
        """Return the arrays that posing needs as tensors: of float32, on the CPU, if None."""
        import torch

        real = dtype or torch.float32

        def tensor(array: np.ndarray | None) -> torch.Tensor | None:
            if array is None:
                return None
            kind = real if array.dtype.kind == "f" else None
            return torch.as_tensor(array, dtype=kind, device=device)

        arrays = {**vars(self), "mean_pose": self.mean_pose.reshape(-1, 3)}
        names = [part.name for part in fields(TemplateTensors)]
        return TemplateTensors(**{name: tensor(arrays[name]) for name in names})  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class TemplateTensors:
    """The arrays of a `HandTemplate` that posing reads, on one device and in one type."""

    vertices: torch.Tensor
    faces: torch.Tensor
    shape_basis: torch.Tensor
    pose_basis: torch.Tensor | None
    joints: torch.Tensor
    joint_basis: torch.Tensor
    weights: torch.Tensor
    #: (15, 3) axis-angle rad.
    mean_pose: torch.Tensor
    fingertips: torch.Tensor


def make_template(
    *, name: str, side: str, where: str | None = None, **given: np.ndarray | None
) -> HandTemplate:
    """Check the parts of a template, fix their types, and compute its digest.

    `given` are the arrays of `HandTemplate` but `parents`.
    """
    count, face_count, places = (
        len(part) if part is not None and np.ndim(part) else 0
        for part in (given[field] for field in ("vertices", "faces", "uv"))
    )
    floats = {
        "vertices": (count, 3),
        "shape_basis": (count, 3, SHAPE_COUNT),
        "joints": (JOINT_COUNT, 3),
        "joint_basis": (JOINT_COUNT, 3, SHAPE_COUNT),
        "weights": (count, JOINT_COUNT),
        "mean_pose": (3 * (JOINT_COUNT - 1),),
        "uv": (places, 2),
    }
    if given["pose_basis"] is not None:
        floats["pose_basis"] = (count, 3, POSE_FEATURE_COUNT)
    indices = {
        "faces": ((face_count, 3), count),
        "face_uv": ((face_count, 3), places),
        "fingertips": ((5,), count),
    }
    parts: dict[str, np.ndarray] = {
        field: _float_part(given[field], shape, field, where) for field, shape in floats.items()
    }
    for field, (shape, limit) in indices.items():
        parts[field] = _index_part(given[field], shape, limit, field, where)
    if side not in SIDES:
        raise BadHandModel(f"side is {side!r}, not right or left", where=where, field="side")
    sums = parts["weights"].sum(axis=1)
    if (parts["weights"] < -1e-6).any() or np.abs(sums - 1.0).max(initial=0.0) > 1e-3:
        raise BadHandModel(
            "skinning weights are negative or do not sum to 1", where=where, field="weights"
        )
    parts["weights"] = np.clip(parts["weights"], 0.0, None)
    parts["weights"] /= parts["weights"].sum(axis=1, keepdims=True)
    parts.setdefault("pose_basis", None)  # type: ignore[arg-type]
    return HandTemplate(
        name=name,
        side=side,
        digest=_digest(name, side, parts),
        parents=np.asarray(PARENTS, dtype=np.int64),
        **parts,
    )


def mirror_template(template: HandTemplate) -> HandTemplate:
    """Mirror a hand to the other side: x negated, faces reversed so that they still face out.

    A pose (x, y, z) of one hand looks the same on the other as (x, -y, -z), joint by joint:
    a rotation vector is an axial vector.
    """
    flip = np.array([-1.0, 1.0, 1.0])
    parts = {
        "vertices": template.vertices * flip,
        "shape_basis": template.shape_basis * flip[:, None],
        "joints": template.joints * flip,
        "joint_basis": template.joint_basis * flip[:, None],
        "mean_pose": (template.mean_pose.reshape(-1, 3) * [1.0, -1.0, -1.0]).reshape(-1),
        "faces": template.faces[:, ::-1].copy(),
        "face_uv": template.face_uv[:, ::-1].copy(),
    }
    if template.pose_basis is not None:
        # R mirrors to S R S, so entry (i, j) of the feature changes sign with the two flips.
        signs = np.tile(np.outer(flip, flip).reshape(-1), JOINT_COUNT - 1)
        parts["pose_basis"] = template.pose_basis * flip[:, None] * signs
    side = SIDES[1 - SIDES.index(template.side)]
    return rebuilt(template, side=side, **parts)


def rebuilt(template: HandTemplate, **changes: object) -> HandTemplate:
    """Return a template with some fields replaced and its digest computed again."""
    changed = replace(template, **changes)  # type: ignore[arg-type]
    return replace(changed, digest=_digest(changed.name, changed.side, vars(changed)))


def _float_part(value: object, shape: tuple[int, ...], field: str, where: str | None) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or 0 in shape:
        raise BadHandModel(f"shape is {array.shape}, expected {shape}", where=where, field=field)
    if not np.isfinite(array).all():
        raise BadHandModel("holds NaN or infinity", where=where, field=field)
    return array


def _index_part(
    value: object, shape: tuple[int, ...], limit: int, field: str, where: str | None
) -> np.ndarray:
    array = np.asarray(value)
    if array.shape != shape or 0 in shape or array.dtype.kind not in "iu":
        raise BadHandModel(
            f"is {array.dtype} of shape {array.shape}, expected integers of shape {shape}",
            where=where,
            field=field,
        )
    array = array.astype(np.int64)
    if array.min() < 0 or array.max() >= limit:
        raise BadHandModel(f"an index lies outside 0..{limit - 1}", where=where, field=field)
    return array


def _digest(name: str, side: str, parts: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(f"{name}/{side}".encode())
    fields = ["vertices", "shape_basis", "joints", "joint_basis", "mean_pose", "weights"]
    if parts["pose_basis"] is not None:
        fields.append("pose_basis")
    for field in fields:
        rounded = np.round(parts[field], _DIGEST_DECIMALS) + 0.0  # -0.0 becomes 0.0
        digest.update(f"/{field}{rounded.shape}".encode())
        digest.update(np.ascontiguousarray(rounded, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(parts["faces"], dtype="<i8").tobytes())
    return digest.hexdigest()


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
        said, remedy = f"{times} subdivisions are not possible", f"Use 0 to {MAX_TIMES}."
        raise UsageError(said, field="times", remedy=remedy)
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
    """
    fine = subdivide(template, MANO_HD_TIMES)
    edges = unique_edges(fine.faces)[0]
    smooth = {
        field: None if values is None else _neighbour_mean(values, edges)
        for field, values in ((field, getattr(fine, field)) for field in _VERTEX_FIELDS)
    }
    return rebuilt(fine, name=MANO_HD_NAME, **smooth)


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Return the vertices on the open end of a mesh (the wrist), (N,) int64, sorted."""
    return np.unique(_open_edges(faces))


def open_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the open ends of a mesh, each as the vertices around it, the longest first.

    (L,) int64 each, one neighbour after the other in the direction of the faces' own edges. Where
    more than two open edges meet in a vertex, one of the ways through it is taken.
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
