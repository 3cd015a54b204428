"""The anatomy of a hand: landmarks on it, and a person that no shape parameter describes.

Landmarks say where creases, tendons, veins and nails lie, in metres on the right hand in its rest
frame (fingers along -x, back of the hand +y, thumb's side +z).

For another person every segment of the hand is scaled along its bone and across it, about the
joint that moves it. Segments blend by the skinning weights, as in posing, so that the surface
stays whole. Nails and bones then stand out of the smooth surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from msgspec import Meta

from hwp_bench.base.records import Seed, number
from hwp_bench.hands import HandTemplate, mirror_template
from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.hands.skeleton import FINGERS, JOINT_COUNT, PARENTS
from hwp_bench.hands.template import rebuilt
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import ease, perpendicular, smoothing_step, unit

# Palm lines as rows of (along, across): 0-1 from the wrist to the middle knuckle, and from the
# little finger's knuckle to the index finger's.
_PALM_LINES = (
    ((0.80, -0.12), (0.84, 0.25), (0.90, 0.55), (1.02, 0.78)),
    ((0.50, 0.02), (0.60, 0.35), (0.70, 0.70), (0.80, 1.12)),
    ((0.80, 1.14), (0.62, 0.80), (0.40, 0.62), (0.16, 0.55), (0.02, 0.55)),
)

# exp(-x) of a larger x is lost in any sum of the numbers here, so that it need not be computed.
_LOST = 48.0
# Places that are compared with a whole line at once: what they need stays in the processor's cache.
_BLOCK = 8192


@dataclass(frozen=True, eq=False)
class Anatomy:
    """N places on a rest hand, and what the landmarks are at each of them."""

    #: (N, 3) m.
    points: np.ndarray
    #: (N, 3) unit normals.
    normals: np.ndarray
    #: (N, 16) skinning weights.
    weights: np.ndarray
    #: (16, 3) rest joints, m.
    joints: np.ndarray
    #: (5, 3) finger tips, rows in the order of `FINGERS`.
    tips: np.ndarray

    @property
    def back(self) -> np.ndarray:
        """1 on the back of the hand, 0 on the palm side, soft between: (N,)."""
        thumb = self.weights[:, 13:16].sum(axis=1)[:, None]
        axis = unit((1.0 - thumb) * finger_back("index") + thumb * finger_back("thumb"))
        facing = np.einsum("ni,ni->n", self.normals, axis)
        return ease((facing + 0.35) / 0.6)

    def joint_creases(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Wrinkles across the finger joints, and the swelling of the knuckles: (N,), 0-1 each."""
        lines = np.zeros(len(self.points))
        swell = np.zeros(len(self.points))
        wobble = fractal_noise(self.points, 0.006, rng, octaves=2) * 0.0006
        back = self.back
        for finger in FINGERS:
            first = FIRST_JOINT[finger]
            chain = np.vstack([self.joints[0], self.joints[first : first + 3], self._tip(finger)])
            for step in range(3):
                joint = chain[step + 1]
                along = unit(unit(chain[step + 2] - joint) + unit(joint - chain[step]))
                rows, near = self._around(joint, 0.017)
                s = (self.points[rows] - joint) @ along
                knuckle = step == 0
                swell[rows] += np.exp(-((s / 0.008) ** 2)) * near * (0.7 if knuckle else 1.0)
                count = 2 if knuckle else 5
                places = np.linspace(-0.0045, 0.0045, count) + rng.normal(0, 0.0004, count)
                for place in places:
                    depth = rng.uniform(0.4, 1.0) * (0.35 if knuckle else 1.0)
                    line = np.exp(-(((s - place + wobble[rows]) / 0.00042) ** 2))
                    lines[rows] += depth * line * near * back[rows]
                if knuckle and finger != "thumb":
                    # The palm side folds at the finger's root, beyond the joint.
                    rows, near = self._around(joint + 0.02 * along, 0.02)
                    s = (self.points[rows] - joint) @ along
                    s = s - 0.42 * np.linalg.norm(chain[2] - joint)
                owned = self.weights[rows, first : first + 3].sum(axis=1)
                for place in (-0.0011, 0.0013) if step == 1 else (0.0,):
                    line = np.exp(-(((s - place + 0.7 * wobble[rows]) / 0.0005) ** 2))
                    lines[rows] += 1.3 * line * near * (1.0 - back[rows]) * np.clip(owned * 2, 0, 1)
        return np.clip(lines, 0.0, 1.5), np.clip(swell, 0.0, 1.0)

    def _around(self, middle: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the places within a radius, and weights that fall from 1 at the centre."""
        power = (np.linalg.norm(self.points - middle, axis=1) / radius) ** 4
        rows = np.flatnonzero(power < _LOST)
        return rows, np.exp(-power[rows])

    def palm_creases(self, rng: np.random.Generator) -> np.ndarray:
        """The three lines of the palm and finer ones: (N,), 0-1."""
        along, across = self.palm_coordinates()
        wobble = fractal_noise(self.points, 0.012, rng, octaves=2) * 0.012
        place = np.stack([along + wobble, across + wobble], axis=1)
        total = np.zeros(len(self.points))
        width = 0.011
        for line in _PALM_LINES:
            bends = np.array(line) + rng.normal(0.0, 0.02, (len(line), 2))
            total += _drawn(place, _rounded(bends), width)
        for _ in range(14):
            start = rng.uniform([0.1, 0.0], [0.95, 1.0])
            end = start + rng.normal(0.0, 0.16, 2)
            total += 0.35 * _drawn(place, np.array([start, end]), 0.6 * width)
        owned = self.weights[:, 0] + 0.6 * self.weights[:, [1, 4, 7, 10, 13]].sum(axis=1)
        return np.clip(total, 0.0, 1.3) * np.clip(1.6 * owned - 0.3, 0.0, 1.0)

    def tendons(self) -> np.ndarray:
        """Ridges from the wrist to the knuckles: (N,), 0-1."""
        wrist = self.joints[0] + np.array([0.0, 0.012, 0.0])
        total = np.zeros(len(self.points))
        for finger in FINGERS:
            knuckle = self.joints[FIRST_JOINT[finger] + (1 if finger == "thumb" else 0)]
            start = wrist + 0.3 * (knuckle - wrist) * np.array([0.6, 0.0, 1.0])
            distance, through = _to_segment(self.points[:, [0, 2]], start[[0, 2]], knuckle[[0, 2]])
            fade = np.clip(4.0 * through, 0.0, 1.0) * np.clip(6.0 * (1.05 - through), 0.0, 1.0)
            total += np.exp(-((distance / 0.0023) ** 2)) * fade
        return np.clip(total, 0.0, 1.0)

    def veins(self, rng: np.random.Generator) -> np.ndarray:
        """A few winding veins on the back of the hand: (N,), 0-1."""
        along, across = self.palm_coordinates()
        wobble = fractal_noise(self.points, 0.02, rng, octaves=2) * 0.035
        place = np.stack([along + wobble, across - wobble], axis=1)
        total = np.zeros(len(self.points))
        for lane in (0.12, 0.38, 0.62, 0.88):
            bends = np.array(
                [[x, 0.5 + (lane - 0.5) * (0.55 + 0.6 * x)] for x in (-0.1, 0.2, 0.45, 0.7, 0.95)]
            )
            bends[:, 1] += rng.normal(0.0, 0.06, len(bends))
            line = _drawn(place, _rounded(bends), 0.022)
            total = np.maximum(total, rng.uniform(0.5, 1.0) * line)
        owned = np.clip(2.0 * self.weights[:, 0] - 0.2, 0.0, 1.0)
        return total * owned

    def flushed(self) -> np.ndarray:
        """Where blood shows: finger tips and the heel of the palm: (N,), 0-1."""
        total = np.zeros(len(self.points))
        for row in range(len(FINGERS)):
            distance = np.linalg.norm(self.points - self.tips[row], axis=1)
            total += np.exp(-((distance / 0.016) ** 2))
        along, across = self.palm_coordinates()
        heel = np.exp(-(((along - 0.3) / 0.25) ** 2)) * (1.0 - self.back)
        return np.clip(total + 0.5 * heel * np.abs(2.0 * across - 1.0), 0.0, 1.0)

    def nails(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nail plate, its white half-moon, its free edge, and the groove around it: (N,) each."""
        plate, moon, edge, groove = (np.zeros(len(self.points)) for _ in range(4))
        for finger in FINGERS:
            s, w, top, owned = self.nail_coordinates(finger)
            radius = (np.abs(s) ** 3 + np.abs(w) ** 3) ** (1 / 3)
            inside = ease((1.0 - radius) / 0.08 + 0.5) * top * owned
            plate = np.maximum(plate, inside)
            moon = np.maximum(moon, inside * ease((-0.62 - s - 0.35 * w * w) / 0.15 + 0.5))
            edge = np.maximum(edge, inside * ease((s - 0.74 + 0.2 * w * w) / 0.1 + 0.5))
            rim = np.exp(-(((radius - 1.04) / 0.07) ** 2)) * top * owned
            groove = np.maximum(groove, rim * ease((0.6 - s) / 0.3 + 0.5))
        return plate, moon, edge, groove

    def nail_coordinates(
        self, finger: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where places lie on a finger's nail: (N,) each.

        Along the plate from -1 to 1 at its free edge, across it from -1 to 1, 1 on top of the
        finger, and 1 on its last segment.
        """
        joint = self.joints[FIRST_JOINT[finger] + 2]
        tip = self._tip(finger)
        along = unit(tip - joint)
        length = np.linalg.norm(tip - joint)
        axis = perpendicular(finger_back(finger), along)
        across = np.cross(along, axis)
        offset = (self.points - joint) / length
        s = (offset @ along - 0.70) / 0.27
        w = (offset @ across) / (0.27 if finger == "thumb" else 0.235)
        top = np.clip((self.normals @ axis - 0.15) * 6.0, 0.0, 1.0)
        owned = np.clip(3.0 * self.weights[:, FIRST_JOINT[finger] + 2] - 0.5, 0.0, 1.0)
        return s, w, top, owned

    def _tip(self, finger: str) -> np.ndarray:
        return self.tips[FINGERS.index(finger)]

    def palm_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Along (0 at the wrist, 1 at the middle knuckle) and across (0 at the little finger's
        knuckle, 1 at the index finger's): (N,) each.
        """
        wrist, index, middle, little = (self.joints[i] for i in (0, 1, 4, 7))
        forward = middle - wrist
        sideways = index - little
        offset = (self.points - wrist)[:, [0, 2]]
        basis = np.stack([forward[[0, 2]], sideways[[0, 2]]], axis=1)
        along, across = np.linalg.solve(basis, offset.T)
        start = np.linalg.solve(basis, (0.5 * (index + little) - wrist)[[0, 2]])
        return along, across - start[1] + 0.5


def _rounded(bends: np.ndarray, samples: int = 24) -> np.ndarray:
    """Points along a smooth curve through the bends."""
    from scipy.interpolate import PchipInterpolator

    knots = np.arange(len(bends))
    return PchipInterpolator(knots, bends, axis=0)(np.linspace(0, len(bends) - 1, samples))


def _drawn(places: np.ndarray, line: np.ndarray, width: float) -> np.ndarray:
    """A line through (K, 2) points with soft borders: 1 on it, exp(-1) at `width` from it: (N,)."""
    reach = width * np.sqrt(_LOST)
    low, high = line.min(axis=0) - reach, line.max(axis=0) + reach
    found = np.zeros(len(places))
    rows = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
    for first in range(0, len(rows), _BLOCK):
        block = rows[first : first + _BLOCK]
        x, y = places[block].T.copy()
        nearest = np.full(len(block), np.inf)
        for (x0, y0), (x1, y1) in pairwise(line):
            dx, dy = x1 - x0, y1 - y0
            along = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-18)
            along = np.clip(along, 0.0, 1.0)
            off_x, off_y = x - (x0 + along * dx), y - (y0 + along * dy)
            nearest = np.minimum(nearest, off_x * off_x + off_y * off_y)
        found[block] = np.exp(-nearest / width**2)
    return found


def _to_segment(
    places: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of (N, D) places to a segment, and how far along it: (N,) each."""
    direction = end - start
    through = (places - start) @ direction / max(float(direction @ direction), 1e-18)
    nearest = start + np.clip(through, 0.0, 1.0)[:, None] * direction
    return np.linalg.norm(places - nearest, axis=1), through


_Length = Annotated[float, Meta(ge=0.8, le=1.25)]
_Width = Annotated[float, Meta(ge=0.75, le=1.25)]
_Palm = Annotated[float, Meta(ge=0.85, le=1.2)]


@dataclass(frozen=True)
class SubjectAnatomy:
    """How a subject differs from every shape of the hand model; the default not at all.

    Spreads are standard deviations; what is drawn stays within two of them. Both hands of a
    person are the same, mirrored.
    """

    #: Seed of what is drawn; the subject's own where it is absent.
    seed: Seed | None = None
    #: Spread of the bones' lengths, percent; bones of the palm have half of it.
    bone_length: float = number(0.0, 0.0, 10.0)
    #: Spread of the segments' thickness, percent.
    thickness: float = number(0.0, 0.0, 15.0)
    #: Length of thumb, index, middle, ring and little finger, as a factor.
    finger_lengths: tuple[_Length, _Length, _Length, _Length, _Length] = (1.0,) * 5
    #: Thickness of the same.
    finger_widths: tuple[_Width, _Width, _Width, _Width, _Width] = (1.0,) * 5
    #: Length, width and depth of the palm, as factors.
    palm: tuple[_Palm, _Palm, _Palm] = (1.0, 1.0, 1.0)
    #: How far the centres about which fingers bend are moved, mm: each by a third to all of it,
    #: in any direction. Skinning weights stay.
    joint_shift: float = number(0.0, 0.0, 6.0)
    #: Skinning: 1 bends in narrow folds, -1 in wide ones, 0 as the hand model does.
    folds: float = number(0.0, -1.0, 1.0)
    #: How far nails stand out before the finger tips, mm.
    nail_length: float = number(0.0, 0.0, 8.0)
    #: Shape of their free edge, 0 (straight) to 1 (pointed).
    nail_taper: float = number(0.4, 0.0, 1.0)
    #: Thickening of the finger joints, mm.
    knuckles: float = number(0.0, 0.0, 2.5)
    #: Relief of bones and tendons on the back of the hand, mm.
    bony: float = number(0.0, 0.0, 1.5)


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
    """Give a hand model with these betas (10,) another anatomy.

    Returns a template of the same triangles without shape parameters, which bends about the moved
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
    """Scale the segments of a right hand at rest: vertices (V, 3) and joints (16, 3), m.

    Takes `lengths` (16,) factor along each segment's bone, `widths` (16,) factor across it,
    `palm_bones` (16,) factor of the way from the wrist to each finger's first joint, `palm` (3,)
    further factors along the fingers.
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
    """A changed surface in which no triangle has turned over or nearly vanished, if that succeeds.

    In the folds between fingers small triangles are squeezed. Around each that is, the change is
    averaged over wider and wider rings until it fits; the rest of the surface stays.
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
    """How the palm's skin moves where its bones grow: (V, 3) m."""
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


# Half length along a finger of the swelling at its joints, and its reach around them, m.
_SWELL, _REACH = 0.006, 0.017
# Where the free edge of a nail begins and ends, in the plate's own coordinate; see `Anatomy`.
_EDGE, _END = 0.62, 1.0


@dataclass(frozen=True, eq=False)
class Nails:
    """Vertices that nails push forward, each with a finger's last joint."""

    #: (N,) rows of the fine mesh.
    rows: np.ndarray
    #: (N,) joint that they move with.
    joints: np.ndarray
    #: (N, 3) m, in the rest frame.
    offsets: np.ndarray

    def pushed(self, vertices: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """The mesh (V, 3) with its nails, which turn with the joints (16, 3, 3)."""
        grown = vertices.copy()
        grown[self.rows] += np.einsum("nij,nj->ni", turns[self.joints], self.offsets)
        return grown


def bone_relief(places: Anatomy, anatomy: SubjectAnatomy) -> np.ndarray:
    """Height of thick finger joints and of bones under the back's skin: (N,) m."""
    height = np.zeros(len(places.points))
    if not (anatomy.knuckles or anatomy.bony):
        return height
    back = places.back
    around, heads = np.zeros(len(height)), np.zeros(len(height))
    for row, finger in enumerate(FINGERS):
        first = FIRST_JOINT[finger]
        chain = np.vstack([places.joints[[0, first, first + 1, first + 2]], places.tips[row]])
        owned = places.weights[:, first : first + 3].sum(axis=1)
        for step in range(3):
            joint = chain[step + 1]
            along = unit(unit(chain[step + 2] - joint) + unit(joint - chain[step]))
            offset = places.points - joint
            near = np.exp(-((np.linalg.norm(offset, axis=1) / _REACH) ** 4))
            ring = np.exp(-((offset @ along / _SWELL) ** 2)) * near
            if step == 0:
                heads = np.maximum(heads, ring * back)
            else:
                around = np.maximum(around, ring * np.clip(2.0 * owned - 0.6, 0.0, 1.0))
    height += 0.001 * anatomy.knuckles * around * (0.65 + 0.35 * back)
    relief = np.maximum(heads, 0.6 * places.tendons() * back)
    return height + 0.001 * anatomy.bony * relief


def grown_nails(places: Anatomy, anatomy: SubjectAnatomy, mirror: np.ndarray) -> Nails | None:
    """Nails that stand out before the finger tips, or None.

    The free edge of the painted nail is drawn out forwards; the skin below it stays, so that the
    nail is a blade.
    """
    if not anatomy.nail_length:
        return None
    rows, joints, offsets = [], [], []
    for row, finger in enumerate(FINGERS):
        s, w, top, owned = places.nail_coordinates(finger)
        edge = np.clip((s - _EDGE) / (_END - _EDGE), 0.0, 1.0)
        side = np.clip((1.0 - np.abs(w)) / 0.25, 0.0, 1.0) * (1.0 - anatomy.nail_taper * w * w)
        reach = edge * side * np.clip(2.0 * top * owned, 0.0, 1.0)
        found = np.flatnonzero((reach > 1e-3) & (s < 1.6))
        joint = FIRST_JOINT[finger] + 2
        forward = unit(places.tips[row] - places.joints[joint]) * mirror
        rows.append(found)
        joints.append(np.full(len(found), joint))
        offsets.append(0.001 * anatomy.nail_length * reach[found, None] * forward)
    return Nails(*(np.concatenate(part) for part in (rows, joints, offsets)))
