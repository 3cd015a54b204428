"""A hand template: the rest mesh, how it changes with shape and pose, and its skeleton."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadHandModel
from hwp_bench.hands.skeleton import PARENTS, SIDES

if TYPE_CHECKING:
    import torch

#: Number of shape parameters of every template.
SHAPE_COUNT = 10
#: Number of joints of every template, the wrist included.
JOINT_COUNT = len(PARENTS)
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
        """Return the arrays that posing needs as tensors.

        Args:
            dtype: floating type; float32 if None.
            device: where to put them; the CPU if None.
        """
        import torch

        dtype = dtype or torch.float32

        def real(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        return TemplateTensors(
            vertices=real(self.vertices),
            faces=torch.as_tensor(self.faces, device=device),
            shape_basis=real(self.shape_basis),
            pose_basis=None if self.pose_basis is None else real(self.pose_basis),
            joints=real(self.joints),
            joint_basis=real(self.joint_basis),
            weights=real(self.weights),
            mean_pose=real(self.mean_pose.reshape(-1, 3)),
            fingertips=torch.as_tensor(self.fingertips, device=device),
        )


@dataclass(frozen=True, eq=False)
class TemplateTensors:
    """The arrays of a `HandTemplate` that posing reads, on one device and in one type."""

    #: (V, 3) rest vertices, m.
    vertices: torch.Tensor
    #: (F, 3) int64 vertex indices.
    faces: torch.Tensor
    #: (V, 3, 10).
    shape_basis: torch.Tensor
    #: (V, 3, 135) or None.
    pose_basis: torch.Tensor | None
    #: (16, 3) rest joints, m.
    joints: torch.Tensor
    #: (16, 3, 10).
    joint_basis: torch.Tensor
    #: (V, 16).
    weights: torch.Tensor
    #: (15, 3) axis-angle rad.
    mean_pose: torch.Tensor
    #: (5,) int64.
    fingertips: torch.Tensor


def make_template(
    *,
    name: str,
    side: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    shape_basis: np.ndarray,
    pose_basis: np.ndarray | None,
    joints: np.ndarray,
    joint_basis: np.ndarray,
    weights: np.ndarray,
    mean_pose: np.ndarray,
    uv: np.ndarray,
    face_uv: np.ndarray,
    fingertips: np.ndarray,
    where: str | None = None,
) -> HandTemplate:
    """Check the parts of a template, fix their types, and compute its digest.

    Args:
        where: the file that the parts came from, for error messages.
        (others): the fields of `HandTemplate`.

    Raises:
        BadHandModel: a part has the wrong shape, is not finite, or points outside its range.
    """
    vertices = np.asarray(vertices)
    count = vertices.shape[0] if vertices.ndim == 2 else 0
    face_count = np.asarray(faces).shape[0] if np.ndim(faces) else 0
    floats = {
        "vertices": (vertices, (count, 3)),
        "shape_basis": (shape_basis, (count, 3, SHAPE_COUNT)),
        "joints": (joints, (JOINT_COUNT, 3)),
        "joint_basis": (joint_basis, (JOINT_COUNT, 3, SHAPE_COUNT)),
        "weights": (weights, (count, JOINT_COUNT)),
        "mean_pose": (mean_pose, (3 * (JOINT_COUNT - 1),)),
        "uv": (uv, (np.shape(uv)[0] if np.ndim(uv) else 0, 2)),
    }
    if pose_basis is not None:
        floats["pose_basis"] = (pose_basis, (count, 3, POSE_FEATURE_COUNT))
    parts: dict[str, np.ndarray] = {
        field: _float_part(value, shape, field, where) for field, (value, shape) in floats.items()
    }
    parts["faces"] = _index_part(faces, (face_count, 3), count, "faces", where)
    parts["face_uv"] = _index_part(face_uv, (face_count, 3), len(parts["uv"]), "face_uv", where)
    parts["fingertips"] = _index_part(fingertips, (5,), count, "fingertips", where)
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
