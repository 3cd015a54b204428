"""A hand model turned into a person that no shape parameter describes.

Every segment of the hand is scaled along its bone and across it, about the joint that moves it.
Segments blend by the skinning weights, as in posing, so that the surface stays whole: where two
segments meet, in a joint, both maps agree.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.hands import HandTemplate, mirror_template
from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS, JOINT_COUNT, PARENTS
from hwp_bench.hands.template import rebuilt
from hwp_bench.sim.geometry.mesh import smoothing_step, unit
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.subject_anatomy import SubjectAnatomy

# Factors beyond these would tear the surface, whatever is drawn on top of what is set.
_LENGTHS, _WIDTHS = (0.7, 1.4), (0.65, 1.35)
# Knuckles whose bones differ in length share the palm's skin over this width, m.
_ACROSS = 0.011
# Shares of what is asked that are tried, until the surface is sound.
_STRENGTHS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0)
# Least size of a triangle, as a share of its size before, in its own direction; tries to get it.
_LEAST, _ATTEMPTS = 0.05, 40
# Rounds of averaging that make weights as soft as they get, and their power at the sharpest.
_SOFTEST, _SHARPEST = 24, 3.0


def off_template(
    template: HandTemplate, betas: np.ndarray, anatomy: SubjectAnatomy, seed: int
) -> tuple[HandTemplate, np.ndarray]:
    """Give a hand model another anatomy.

    Args:
        template: the hand model, or a rig, of either side.
        betas: (10,) its shape, which becomes part of the rest surface.
        anatomy: what differs; nails and relief are not made here (`growth`).
        seed: of what is drawn where the anatomy has none of its own.

    Returns:
        A template of the same triangles without shape parameters, which bends about the moved
        joints, and the (16, 3) joints where they were before they were moved, m.
    """
    if template.side == "left":
        made, joints = off_template(mirror_template(template), betas, anatomy, seed)
        return mirror_template(made), joints * [-1.0, 1.0, 1.0]
    seed = seed if anatomy.seed is None else anatomy.seed
    vertices = template.vertices + template.shape_basis @ betas
    joints = template.joints + template.joint_basis @ betas
    asked = (*_factors(anatomy, seed), np.array(anatomy.palm))
    tips = vertices[template.fingertips]
    surface, places = vertices, joints
    for strength in _STRENGTHS:
        changes = (1.0 + strength * (factors - 1.0) for factors in asked)
        surface, places = resized(vertices, template.weights, joints, tips, *changes)
        surface, sound = untangled(vertices, surface, template.faces)
        if sound:
            break
    weights = reweighted(template.weights, template.faces, anatomy.folds)
    made = rebuilt(
        template,
        name=f"{template.name}, other anatomy",
        vertices=surface,
        shape_basis=np.zeros_like(template.shape_basis),
        joints=places + _shifts(anatomy.joint_shift / 1000.0, seed),
        joint_basis=np.zeros_like(template.joint_basis),
        weights=weights,
    )
    return made, places


def resized(
    vertices: np.ndarray,
    weights: np.ndarray,
    joints: np.ndarray,
    tips: np.ndarray,
    lengths: np.ndarray,
    widths: np.ndarray,
    palm_bones: np.ndarray,
    palm: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Scale the segments of a right hand at rest.

    Args:
        vertices: (V, 3) m.
        weights: (V, 16).
        joints: (16, 3) m.
        tips: (5, 3) m, thumb first.
        lengths: (16,) factor along each segment's bone.
        widths: (16,) factor across it.
        palm_bones: (16,) factor of the way from the wrist to each finger's first joint.
        palm: (3,) further factors along the fingers, across the palm, and through it.

    Returns:
        (V, 3) vertices and (16, 3) joints.
    """
    wrist, axes = joints[0], palm[[0, 2, 1]]
    ends = np.vstack([joints[1:], wrist])
    for row, finger in enumerate(FINGERS):
        ends[FIRST_JOINT[finger] + 2] = tips[row]
    places = wrist + axes * (joints - wrist)
    roots = [FIRST_JOINT[finger] for finger in FINGERS]
    pushed = (palm_bones[roots, None] - 1.0) * (places[roots] - wrist)
    places[roots] += pushed
    moved = weights[:, :1] * (
        wrist + axes * (vertices - wrist) + _palm_field(vertices, joints, roots, pushed)
    )
    stretch = np.eye(3)
    for joint in range(1, JOINT_COUNT):
        bone = unit(ends[joint] - joints[joint])
        along = np.outer(bone, bone)
        scale = lengths[joint] * along + widths[joint] * (np.eye(3) - along)
        parent = PARENTS[joint]
        if parent > 0:
            places[joint] = places[parent] + stretch @ (joints[joint] - joints[parent])
        moved += weights[:, joint, None] * (places[joint] + (vertices - joints[joint]) @ scale)
        stretch = scale
    return moved, places


def reweighted(weights: np.ndarray, faces: np.ndarray, folds: float) -> np.ndarray:
    """Skinning weights with narrower (up to 1) or wider folds (down to -1): (V, 16)."""
    if folds > 0:
        powered = weights ** (1.0 + (_SHARPEST - 1.0) * folds)
    else:
        step = smoothing_step(faces, len(weights), 0.5 * abs(folds))
        powered = weights
        for _ in range(_SOFTEST if folds else 0):
            powered = step @ powered
    return powered / powered.sum(axis=1, keepdims=True)


def untangled(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, bool]:
    """A changed surface in which no triangle has turned over or nearly vanished.

    In the folds between fingers small triangles are squeezed. Around each that is, the change is
    averaged over wider and wider rings until it fits; the rest of the surface stays.

    Args:
        before: (V, 3) m.
        after: (V, 3) m.
        faces: (F, 3).

    Returns:
        (V, 3) m, and whether that succeeded.
    """
    step = smoothing_step(faces, len(before), 0.5)
    reach = (step > 0).astype(np.float64)
    change = after - before
    normals = _face_vectors(before, faces)
    size = np.einsum("fi,fi->f", normals, normals)
    for attempt in range(_ATTEMPTS):
        now = _face_vectors(before + change, faces)
        bad = np.einsum("fi,fi->f", normals, now) < _LEAST * size
        if not bad.any():
            return before + change, True
        near = np.zeros(len(before))
        near[faces[bad]] = 1.0
        for _ in range(attempt // 4):
            near = reach @ near
        rows = near > 0
        change[rows] = (step @ change)[rows]
    return before + change, False


def _face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _factors(anatomy: SubjectAnatomy, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths and widths of the segments, and lengths of the palm's bones: (16,) each."""
    rng = generator(seed, "anatomy")
    drawn = np.clip(rng.normal(size=(3, JOINT_COUNT)), -2.0, 2.0)
    fingers = np.clip(rng.normal(size=len(FINGERS)), -2.0, 2.0)
    lengths = 1.0 + anatomy.bone_length / 100.0 * drawn[0]
    palm_bones = 1.0 + anatomy.bone_length / 200.0 * drawn[2]
    widths = np.ones(JOINT_COUNT)
    for row, finger in enumerate(FINGERS):
        own = slice(FIRST_JOINT[finger], FIRST_JOINT[finger] + 3)
        lengths[own] *= anatomy.finger_lengths[row]
        # Two thirds of the spread are a finger's, so that neighbouring segments go together.
        spread = anatomy.thickness / 100.0 * (0.8 * fingers[row] + 0.6 * drawn[1, own])
        widths[own] = anatomy.finger_widths[row] * (1.0 + spread)
    return np.clip(lengths, *_LENGTHS), np.clip(widths, *_WIDTHS), palm_bones


def _shifts(longest: float, seed: int) -> np.ndarray:
    """How far each joint is moved: (16, 3) m; the wrist stays."""
    rng = generator(seed, "joints")
    way = unit(rng.normal(size=(JOINT_COUNT, 3))) * rng.uniform(1 / 3, 1.0, (JOINT_COUNT, 1))
    way[0] = 0.0
    return longest * way


def _palm_field(
    vertices: np.ndarray, joints: np.ndarray, roots: list[int], pushed: np.ndarray
) -> np.ndarray:
    """How the palm's skin moves where its bones grow: (V, 3) m.

    Args:
        vertices: (V, 3) m.
        joints: (16, 3) m.
        roots: first joints of the fingers.
        pushed: (5, 3) m, the way that each of them goes.
    """
    field, total = np.zeros_like(vertices), np.full(len(vertices), 1e-9)
    for root, push in zip(roots, pushed, strict=True):
        bone = joints[root] - joints[0]
        offset = vertices - joints[0]
        through = np.clip(offset @ bone / (bone @ bone), 0.0, 1.0)
        distance = np.linalg.norm(offset - through[:, None] * bone, axis=1)
        near = np.exp(-((distance / _ACROSS) ** 2))
        field += (near * through)[:, None] * push
        total += near
    return field / total[:, None]
