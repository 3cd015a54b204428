"""A subject: hands with a surface finer than the hand model's, and skin of their own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.arrays import read_npz
from hwp_bench.errors import BadInput
from hwp_bench.files import atomic_write, cache_root, sha256_json
from hwp_bench.sim.anatomy import Anatomy
from hwp_bench.sim.mesh import (
    normal_operator,
    smoothing,
    subdivision,
    unit,
    vertex_normals,
)
from hwp_bench.sim.scene import Scene, Subject
from hwp_bench.sim.seeds import generator
from hwp_bench.sim.skin import sample_skin

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from hwp_bench.hands import HandTemplate, TemplateTensors

#: Midpoint subdivisions on top of the template: 1,609 vertices become 25,609.
FINE = 2
#: Subdivisions of what moves during an exposure: finer detail would be blurred away.
MOVING = 1
#: Edge of the skin atlas in texels; about 0.25 mm of skin each.
ATLAS = 1024
#: Version of the skin painting; part of the cache key.
SKIN_VERSION = 1


@dataclass(frozen=True, eq=False)
class SkinAtlas:
    """Skin of one subject as textures, row 0 at the top (v = 1)."""

    #: (ATLAS, ATLAS, 3) float32, linear reflectance.
    albedo: np.ndarray
    #: (ATLAS, ATLAS) float32, m.
    height: np.ndarray
    #: (ATLAS, ATLAS) float32, 0-1.
    roughness: np.ndarray


@dataclass(frozen=True, eq=False)
class SubjectHand:
    """One hand of a subject, ready to be posed."""

    #: The hand model that parameters refer to.
    template: HandTemplate
    #: The same as tensors, float64.
    tensors: TemplateTensors
    #: (10,) shape.
    betas: np.ndarray
    #: (16, 3) rest joints with this shape, m.
    joints: np.ndarray
    #: (V, T) turns template vertices into those of the fine mesh.
    lift: csr_matrix
    #: (F, 3) faces of the fine mesh.
    faces: np.ndarray
    #: (F, 3, 2) texture coordinates of the face corners.
    corner_uv: np.ndarray
    #: (V, F) sums the faces' vectors up at their corners.
    normal_sum: csr_matrix
    #: (V,) m along the normal that no parameter explains.
    relief: np.ndarray
    #: (F,) face of the template that each fine face lies in.
    parent_face: np.ndarray

    def pose(self, pose: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose the fine mesh.

        Args:
            pose: (16, 3) axis-angle rad.
            transl: (3,) m.

        Returns:
            vertices (V, 3) m and unit normals (V, 3).
        """
        coarse = template_vertices(self.tensors, pose, self.betas, transl)
        smooth = self.lift @ coarse
        normals = vertex_normals(smooth, self.faces, self.normal_sum)
        vertices = smooth + self.relief[:, None] * normals
        return vertices, vertex_normals(vertices, self.faces, self.normal_sum)


def template_vertices(
    tensors: TemplateTensors, pose: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> np.ndarray:
    """Vertices of the hand model itself for one frame: (T, 3) m."""
    import torch

    from hwp_bench.hands import pose_hand

    kind = tensors.vertices.dtype
    with torch.no_grad():
        posed = pose_hand(
            tensors,
            torch.as_tensor(pose, dtype=kind)[None],
            torch.as_tensor(betas, dtype=kind),
            torch.as_tensor(transl, dtype=kind)[None],
        )
    return posed.vertices[0].numpy()


def subject_betas(subject: Subject) -> np.ndarray:
    """Shape parameters of a subject: (10,), within 1.5 standard deviations."""
    return np.clip(generator(subject.seed, "betas").normal(0.0, 0.7, 10), -1.5, 1.5).round(4)


@lru_cache(maxsize=8)
def subject_hand(
    subject: Subject, side: str, subdivisions: int = FINE, source: str = "anny"
) -> SubjectHand:
    """Build one hand of a subject; kept for the next frames.

    Args:
        subject: whose.
        side: `right` or `left`.
        subdivisions: how often each triangle of the template is split in four.
        source: hand model, as `hwp_bench.hands.load_template` takes it.
    """
    import torch

    from hwp_bench.hands import load_template

    template = load_template(source, side)
    betas = subject_betas(subject)
    faces = template.faces
    corner_uv = template.uv[template.face_uv]
    lift = None
    count = len(template.vertices)
    parent = np.arange(len(faces))
    for _ in range(subdivisions):
        step, fine = subdivision(faces, count)
        corner_uv = _subdivide_corners(corner_uv)
        parent = np.concatenate([parent] * 4)
        lift = step if lift is None else step @ lift
        faces, count = fine, step.shape[0]
    lift = (smoothing(faces, count, rounds=2 * subdivisions - 1) @ lift).tocsr()
    joints = template.joints + template.joint_basis @ betas
    normal_sum = normal_operator(faces, count)
    rest = lift @ (template.vertices + template.shape_basis @ betas)
    anatomy = _anatomy(template, lift @ template.weights, joints, rest, faces, normal_sum)
    return SubjectHand(
        template=template,
        tensors=template.to_torch(dtype=torch.float64),
        betas=betas,
        joints=joints,
        lift=lift,
        faces=faces,
        corner_uv=corner_uv,
        normal_sum=normal_sum,
        relief=sample_skin(anatomy, subject).height,
        parent_face=parent,
    )


@lru_cache(maxsize=2)
def skin_atlas(subject: Subject, source: str = "anny") -> SkinAtlas:
    """Paint a subject's skin, or read it from the cache. Both hands share it, mirrored."""
    hand = subject_hand(subject, "right", source=source)
    key = sha256_json(
        [SKIN_VERSION, ATLAS, hand.template.digest, subject.seed, subject.tone, subject.age]
    )
    path = cache_root() / "sim" / "skin" / f"{key}.npz"
    if path.exists():
        try:
            arrays = read_npz(path)
            return SkinAtlas(*(arrays[name] for name in ("albedo", "height", "roughness")))
        except (BadInput, KeyError):
            path.unlink(missing_ok=True)
    atlas = _paint(hand, subject)
    _store(path, atlas)
    return atlas


def _store(path: object, atlas: SkinAtlas) -> None:
    import io
    from pathlib import Path

    buffer = io.BytesIO()
    np.savez(buffer, albedo=atlas.albedo, height=atlas.height, roughness=atlas.roughness)
    atomic_write(Path(str(path)), buffer.getvalue())


def _paint(hand: SubjectHand, subject: Subject) -> SkinAtlas:
    from collections import Counter

    from scipy.ndimage import distance_transform_edt

    from hwp_bench.sim.raycast import Tracer

    flat = np.concatenate([hand.corner_uv, np.zeros((*hand.corner_uv.shape[:2], 1))], axis=2)
    tracer = Tracer(flat.reshape(-1, 3), np.arange(flat.shape[0] * 3).reshape(-1, 3), Counter())
    ticks = (np.arange(ATLAS) + 0.5) / ATLAS
    u, v = np.meshgrid(ticks, 1.0 - ticks)
    origins = np.stack([u.ravel(), v.ravel(), np.ones(ATLAS * ATLAS)], axis=1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
    hits = tracer.first_hits(origins, down, "atlas")
    corners = hand.faces[hits.face]
    template = hand.template

    rest = hand.lift @ (template.vertices + template.shape_basis @ hand.betas)
    normals = vertex_normals(rest, hand.faces, hand.normal_sum)

    def spread(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", hits.weights, values[corners])

    anatomy = Anatomy(
        points=spread(rest),
        normals=unit(spread(normals)),
        weights=spread(hand.lift @ template.weights),
        joints=hand.joints,
        tips=(template.vertices + template.shape_basis @ hand.betas)[template.fingertips],
    )
    skin = sample_skin(anatomy, subject)
    layers = np.zeros((ATLAS * ATLAS, 5), dtype=np.float32)
    layers[hits.ray] = np.column_stack([skin.albedo, skin.height, skin.roughness])
    empty = np.ones(ATLAS * ATLAS, dtype=bool)
    empty[hits.ray] = False
    # Texels outside the atlas's islands repeat the nearest one inside, so that no seam shows.
    nearest = distance_transform_edt(
        empty.reshape(ATLAS, ATLAS), return_distances=False, return_indices=True
    )
    layers = layers.reshape(ATLAS, ATLAS, 5)[nearest[0], nearest[1]]
    return SkinAtlas(
        np.ascontiguousarray(layers[..., :3]),
        np.ascontiguousarray(layers[..., 3]),
        np.ascontiguousarray(layers[..., 4]),
    )


def _anatomy(
    template: HandTemplate,
    weights: np.ndarray,
    joints: np.ndarray,
    rest: np.ndarray,
    faces: np.ndarray,
    normal_sum: csr_matrix,
) -> Anatomy:
    mirror = np.array([1.0, 1.0, 1.0] if template.side == "right" else [-1.0, 1.0, 1.0])
    normals = vertex_normals(rest, faces, normal_sum)
    return Anatomy(
        points=rest * mirror,
        normals=normals * mirror,
        weights=weights,
        joints=joints * mirror,
        tips=rest[template.fingertips] * mirror,
    )


def _subdivide_corners(corners: np.ndarray) -> np.ndarray:
    """Corner values (F, 3, C) of the four faces that `subdivision` makes of each: (4F, 3, C)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate(
        [np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )


def scene_hands(scene: Scene, subdivisions: int = FINE) -> dict[str, SubjectHand]:
    """The subject's hands that a scene shows, by side."""
    return {side: subject_hand(scene.subject, side, subdivisions) for side in scene.sides}
