"""The residuals of the fit that need no pictures: landmarks, motion, anatomy, touch, and outlines.

Each is a sum over frames of a robust function of an error over its scale, so that a scale is the
size of an error that is still normal. The numbers stand at the residual that they belong to.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from hwp_bench.base.images import sample
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.articulation import anatomical_limits, axis_angle_to_matrix
from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.hands.skeleton import FINGERS, finger_joints, palm_directions, unit
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.shared.frames import CropWindows, cells, each_frame
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.model import ClipModel, pose_vertices

# --- Landmarks, motion, and what is known of hands

#: Landmark error in the image, as a share of the hand's size in the image.
IMAGE_SCALE = 0.012
#: Error of centred world landmarks, m; the tracker's bones change by 5 mm between frames.
WORLD_SCALE = 0.015
# Weight of the world landmarks; they guide depth, the image decides the rest.
_WORLD_WEIGHT = 0.5
# Weight of the image landmarks in the first steps, relative to 1 of the world landmarks.
_START_IMAGE_WEIGHT = 0.05
# Acceleration of landmarks in space, m per (1/30 s)^2, and of joint angles, rad per (1/30 s)^2.
_MOTION_SCALE, _TURNING_SCALE = 0.003, 0.06
# Weight of both.
_MOTION_WEIGHT = 0.3
#: Weight of the joint-limit penalty (rad^2 beyond the anatomical range).
LIMIT_WEIGHT = 300.0
# Weight of the finger angles squared: it keeps undetermined angles near the rest pose.
_POSE_WEIGHT = 0.02
# Constant distance between the tracker's landmark and the model's joint, m.
_OFFSET_SCALE = 0.004
# Share of the frames that shape, offsets, scale and focal length priors weigh as much as: the
# tracker's errors repeat from frame to frame, so a clip is worth far fewer views.
_PRIOR_SHARE = 0.1
# Uncertainty of the metres in the world landmarks, and of the default focal length (logs).
_SIZE_SCALE, _FOCAL_SCALE = 0.05, 0.15


class LandmarkResidual:
    """Everything that does not need the images: landmarks, smoothness, anatomy, priors.

    `steps` (F - 1,), in units of 1/30 s, lie between the frames; None where these are far apart, so
    that motion between them is not smooth.
    `default_focal`, px, is what the prior favours; None where the focal length is known.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        model: ClipModel,
        steps: np.ndarray | None,
        default_focal: float | None,
    ) -> None:
        self.default_focal = default_focal
        self.image = landmarks.image
        self.weight = np.where(landmarks.detected, landmarks.score, 0.0)[:, None]
        #: (F, 21, 3) m, about their mean.
        self.world = model.world - model.world.mean(axis=1, keepdims=True)
        self.image_scale = IMAGE_SCALE * landmarks.hand_size
        self.limits = anatomical_limits(model.template)
        self.contact = template_spheres(model.template)
        self.pairs, self.least = touching_pairs(self.contact)
        self.steps = steps
        self.prior = _PRIOR_SHARE * float(landmarks.detected.sum())

    def weaken(self, weights: np.ndarray) -> None:
        """Multiply the weights of landmarks by (F, 21) numbers: some are hidden."""
        self.weight = self.weight * weights

    def pull(
        self,
        points: np.ndarray,
        centre: np.ndarray,
        focal: float,
        log_size: float,
        *,
        afar: bool = False,
    ) -> tuple[float, np.ndarray, float, float]:
        """Compare the hand's landmarks (F, 21, 3) m, camera axes, with the tracker's.

        `afar`: for the first steps, when most fingers are bent wrongly. Only the world landmarks,
        which dominate then, show in which direction a finger bends. `centre` is px.

        Returns:
            the energy, and its derivatives by the points, by log size and by log focal length.
        """
        depth = np.maximum(points[..., 2], 1e-3)
        aside = points[..., :2] / depth[..., None] * focal
        error = (aside + centre - self.image) / self.image_scale
        if afar:
            values, rates = charbonnier((error**2).sum(axis=-1))
            share, world_share = _START_IMAGE_WEIGHT, 1.0
        else:
            values, rates = geman_mcclure((error**2).sum(axis=-1))
            share, world_share = 1.0, _WORLD_WEIGHT
        energy = share * float((self.weight * values).sum())
        by_pixels = (2.0 * share / self.image_scale) * (self.weight * rates)[..., None] * error
        along = (by_pixels * aside).sum(axis=-1)
        slope = np.empty_like(points)
        slope[..., :2] = by_pixels * (focal / depth)[..., None]
        slope[..., 2] = np.where(points[..., 2] > 1e-3, -along / depth, 0.0)
        # Compared at the tracker's own scale: measured at the hand's, a hand that shrinks to
        # nothing would fit best.
        factor = float(np.exp(-log_size))
        scaled = (points - points.mean(axis=1, keepdims=True)) * factor
        error = (scaled - self.world) / WORLD_SCALE
        values, rates = charbonnier((error**2).sum(axis=-1))
        energy += world_share * float((self.weight * values).sum())
        by_scaled = (2.0 * world_share / WORLD_SCALE) * (self.weight * rates)[..., None] * error
        by_size = -float((by_scaled * scaled).sum())
        slope += factor * (by_scaled - by_scaled.mean(axis=1, keepdims=True))
        energy += self._add_motion(points, _MOTION_SCALE, slope)
        return energy, slope, by_size, float(along.sum())

    def add_priors(self, free: dict[str, np.ndarray], slopes: dict[str, np.ndarray]) -> float:
        """Add what the variables cost by themselves to their derivatives; return the energy."""
        fingers, betas, offsets = free["fingers"], free["betas"], free["offsets"] / _OFFSET_SCALE
        energy = self._add_motion(fingers, _TURNING_SCALE, slopes["fingers"])
        energy += _POSE_WEIGHT * float((fingers**2).sum())
        slopes["fingers"] += 2.0 * _POSE_WEIGHT * fingers
        size, focal = float(free["log_size"]) / _SIZE_SCALE, 0.0
        if self.default_focal is not None:
            focal = (float(free["log_focal"]) - float(np.log(self.default_focal))) / _FOCAL_SCALE
        constant = float((betas**2).sum() + (offsets**2).sum()) + size**2 + focal**2
        slopes["betas"] += self.prior * betas
        slopes["offsets"] += self.prior * offsets / _OFFSET_SCALE
        slopes["log_size"] += self.prior * size / _SIZE_SCALE
        slopes["log_focal"] += self.prior * focal / _FOCAL_SCALE
        return energy + 0.5 * self.prior * constant

    def _add_motion(self, track: np.ndarray, unit: float, slope: np.ndarray) -> float:
        """Add the acceleration of tracks (F, N, 3) to the slope by them; return its energy."""
        if self.steps is None or len(track) < 3:
            return 0.0
        first, middle, last = acceleration_weights(self.steps, unit)
        bend = first * track[:-2] + middle * track[1:-1] + last * track[2:]
        values, rates = charbonnier((bend**2).sum(axis=-1))
        by_bend = 2.0 * _MOTION_WEIGHT * rates[..., None] * bend
        slope[:-2] += first * by_bend
        slope[1:-1] += middle * by_bend
        slope[2:] += last * by_bend
        return _MOTION_WEIGHT * float(values.sum())


def acceleration_weights(
    steps: np.ndarray, unit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights of three frames in a row whose sum is the second derivative by time, in some unit.

    Of frames x, y, z that are h and k apart it is ((z - y) / k - (y - x) / h) 2 / (h + k): the
    second divided difference, times 2. Each is (F - 2, 1, 1) for (F - 1,) steps.
    """
    before, after = steps[:-1, None, None], steps[1:, None, None]
    first, last = 2.0 / (before * (before + after)), 2.0 / (after * (before + after))
    return first / unit, -2.0 / (before * after * unit), last / unit


def geman_mcclure(squared: np.ndarray, turn: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """r^2 / (1 + r^2 / (4 turn^2)) of r^2, and its derivative by r^2.

    It is quadratic for small r, constant for outliers: the pull fades beyond a residual of `turn`
    scales. Source: Geman and McClure, 1987, scaled to the second derivative of r^2.
    """
    flat = 1.0 / (1.0 + squared / (4.0 * turn * turn))
    return squared * flat, flat * flat


def charbonnier(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """2 (sqrt(1 + r^2) - 1) of r^2, quadratic for small r and linear beyond; and its derivative."""
    root = np.sqrt(1.0 + squared)
    return 2.0 * (root - 1.0), 1.0 / root


# --- Fingers in fingers

#: Share of the radii that counts: skin and flesh give way.
FIRMNESS = 0.85
#: Overlap of fingers with each other or the palm that is still ordinary, m; and its weight.
CONTACT_SCALE, CONTACT_WEIGHT = 0.003, 0.5
# Slices along each finger segment and along each metacarpal.
_FINGER_SLICES, _PALM_SLICES = 2, 3
# A sphere of fewer vertices does not measure thickness.
_LEAST_VERTICES = 4


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres inside a template, each moving with one joint."""

    #: (K, 3) m, rest place; the mean of the vertices around it.
    centres: np.ndarray
    #: (K, 3, 10) m per unit of shape.
    basis: np.ndarray
    #: (K,) m.
    radii: np.ndarray
    #: (K,) int64.
    joints: np.ndarray
    #: (K,) int64, index into `FINGERS`, or -1 in the palm.
    fingers: np.ndarray
    #: (K,) int64, 0 to 2 from a finger's base; 0 in the palm.
    segments: np.ndarray


def template_spheres(template: HandTemplate) -> Spheres:
    """Place spheres in slices of the fingers and of the palm."""
    owner = template.weights.argmax(axis=1)
    found: list[tuple[np.ndarray, float, int, int, int]] = []
    for finger, name in enumerate(FINGERS):
        chain = finger_joints(name)
        ends = [*template.joints[list(chain)], template.vertices[template.fingertips[finger]]]
        for segment, joint in enumerate(chain):
            start, axis = ends[segment], unit(ends[segment + 1] - ends[segment])
            members = np.flatnonzero(owner == joint)
            along = (template.vertices[members] - start) @ axis
            for part in _slices(members, along, _FINGER_SLICES):
                radial = template.vertices[part] - template.vertices[part].mean(axis=0)
                radial = radial - np.outer(radial @ axis, axis)
                radius = float(np.linalg.norm(radial, axis=1).mean())
                found.append((part, radius, joint, finger, segment))
    found += [(*sphere, 0, -1, 0) for sphere in _palm_spheres(template, owner == 0)]
    parts, radii, joints, fingers, segments = zip(*found, strict=True)
    return Spheres(
        np.stack([template.vertices[part].mean(axis=0) for part in parts]),
        np.stack([template.shape_basis[part].mean(axis=0) for part in parts]),
        *(np.array(column) for column in (radii, joints, fingers, segments)),
    )


def touching_pairs(spheres: Spheres) -> tuple[np.ndarray, np.ndarray]:
    """Choose the pairs that must not overlap: (P, 2) int64, and (P,) m, their least distance.

    Left out are neighbours: spheres of one finger, a finger's first segment with the palm, and
    the first segments of two fingers. The least distance is the firm part of both radii, or the
    distance at rest where that is smaller.
    """
    first, second = np.triu_indices(len(spheres.radii), k=1)
    base = spheres.segments == 0
    allowed = (spheres.fingers[first] != spheres.fingers[second]) & ~(base[first] & base[second])
    first, second = first[allowed], second[allowed]
    firm = FIRMNESS * (spheres.radii[first] + spheres.radii[second])
    rest = np.linalg.norm(spheres.centres[first] - spheres.centres[second], axis=1)
    return np.stack([first, second], axis=1), np.minimum(firm, rest)


def _palm_spheres(template: HandTemplate, palm: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Slices along the four metacarpals; the radius is half the palm's thickness there."""
    members = np.flatnonzero(palm)
    wrist = template.joints[0]
    knuckles = template.joints[[finger_joints(name)[0] for name in FINGERS[1:]]]
    across = palm_directions(template.joints, template.side).palmar
    rays = knuckles - wrist
    offsets = template.vertices[members] - wrist
    share = (offsets @ rays.T) / (rays**2).sum(axis=1)
    off_axis = np.linalg.norm(offsets[:, None] - share[..., None] * rays, axis=-1)
    nearest = off_axis.argmin(axis=1)
    along = share[np.arange(len(members)), nearest]
    found = []
    for ray in range(len(rays)):
        mine = (nearest == ray) & (along > 0.2)
        for part in _slices(members[mine], along[mine], _PALM_SLICES):
            height = template.vertices[part] @ across
            found.append((part, float(np.abs(height - height.mean()).mean())))
    return found


def _slices(members: np.ndarray, along: np.ndarray, count: int) -> list[np.ndarray]:
    """Divide vertices into slices of equal length along an axis."""
    if len(members) == 0:
        return []
    edges = np.linspace(along.min(), along.max() + 1e-9, count + 1)
    parts = [members[(along >= low) & (along < high)] for low, high in itertools.pairwise(edges)]
    return [part for part in parts if len(part) >= _LEAST_VERTICES]


# --- Outlines

#: Edge of the images in which outlines are compared, px; distances interpolate well, so less
#: than the crop's resolution is enough.
FIELD_SIZE = 192
#: How far an outline vertex looks for the mask's outline, as a share of the hand's size.
REACH = 0.06
# Outline error in the image, as a share of the hand's size in the image.
_OUTLINE_SCALE = 0.007
#: Weight of one outline vertex; neighbours agree, so each counts little.
OUTLINE_WEIGHT = 0.2
#: Scales beyond which the pull of an outline fades.
OUTLINE_TURN = 4.0
# Outline vertices of each frame.
_OUTLINE_COUNT = 200
# Vertices of the outline lie at most this far inside the silhouette, px of the field.
_OUTLINE_WITHIN = 1.6
# Step of the search along a normal, px of the field.
_STEP = 0.5


class Outlines(NamedTuple):
    """P outline vertices of each frame and the lines that they are pulled to; float64."""

    #: (F, P) int64; (F, P, 3) m, at rest with correctives as they were, without the shape.
    vertices: np.ndarray
    rest: np.ndarray
    #: (F, P, 2) and (F, P), of `Outline`; (F, 2) px, corners of the windows.
    normal: np.ndarray
    target: np.ndarray
    corners: np.ndarray
    #: (V, 3) m, what the shape adds; (V, 3, 10); (V, B) the bones of a vertex, and their weights.
    shaped: np.ndarray
    basis: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    #: Px of the field to one of the frame; an error that is still normal, px of the field.
    ratio: float
    scale: float

    @classmethod
    def nothing(cls, frames: int) -> Outlines:
        """Return outlines that have no vertices."""
        none = np.zeros((frames, 0))
        chosen = none.astype(np.int64), none[..., None], none[..., None], none
        vertices = np.zeros((0, 3)), np.zeros((0, 3, 10)), np.zeros((0, 0), np.int64)
        return cls(*chosen, np.zeros((frames, 2)), *vertices, np.zeros((0, 0)), 1.0, 1.0)


class OutlineResidual:
    """Robust distance of outline vertices from the mask's outline, along their normals.

    The vertices and their targets are chosen by `rematch` between rounds of descent
    and held within a round (iterated closest points). The wrist's open end is not an outline of
    the hand and never chosen.

    Args:
        fields: (F, S, S) from `signed_distance`, of hand and forearm; zero fields do nothing.
        usable: (F,) bool, frames that count.
        hand_size: px of the whole frame.
        ignored: (F, S, S) bool, where skin meets skin, or None.
    """

    def __init__(
        self,
        fields: np.ndarray,
        usable: np.ndarray,
        windows: CropWindows,
        hand_size: float,
        ignored: np.ndarray | None = None,
    ) -> None:
        self.fields = fields
        self.ignored = ignored
        self.usable = np.asarray(usable) & (np.abs(fields).max(axis=(1, 2)) > 0)
        self.ratio = FIELD_SIZE / windows.side
        self.corners = windows.corners.astype(np.float64)
        self.scale = _OUTLINE_SCALE * hand_size * self.ratio
        self.reach = REACH * hand_size * self.ratio

    def rematch(self, model: ClipModel) -> None:
        """Choose the outline vertices of the model as it is now, and their targets."""
        faces = model.template.faces
        candidates = np.setdiff1d(np.arange(len(model.template.vertices)), boundary_vertices(faces))
        with torch.no_grad():
            pixels = model.pixels(torch.as_tensor(pose_vertices(model))).numpy()
        pixels = (pixels - self.corners[:, None]) * self.ratio

        def match(frame: int) -> Outline:
            if not self.usable[frame]:
                return Outline.nothing()
            usable = candidates
            if self.ignored is not None:
                rows, columns, inside = cells(pixels[frame][candidates], self.ignored[frame].shape)
                usable = candidates[~(inside & self.ignored[frame][rows, columns])]
            return match_outline(pixels[frame], faces, usable, self.fields[frame], self.reach)

        matches = list(each_frame(match, range(len(self.usable))))
        index, normal, target = (
            np.stack([getattr(match, name) for match in matches])
            for name in ("index", "normal", "target")
        )
        template = model.template
        rest = template.vertices[index]
        if template.pose_basis is not None:
            with torch.no_grad():
                turns = axis_angle_to_matrix(model.variables.fingers.double())
            feature = (turns - torch.eye(3)).flatten(1).numpy()
            for frame, some in enumerate(index):
                rest[frame] += template.pose_basis[some] @ feature[frame]
        # Most vertices move with two bones or three.
        most = int((template.weights > 0.0).sum(axis=1).max())
        bones = np.argsort(-template.weights, axis=1, kind="stable")[:, :most]
        self.outlines = Outlines(
            index,
            rest,
            normal.astype(np.float64),
            target.astype(np.float64),
            self.corners,
            np.zeros_like(template.vertices),
            np.ascontiguousarray(template.shape_basis, np.float64),
            np.ascontiguousarray(bones),
            np.take_along_axis(template.weights, bones, axis=1).astype(np.float64),
            self.ratio,
            self.scale,
        )

    def shaped(self, betas: np.ndarray) -> Outlines:
        """Return what `rematch` chose, for a shape (10,)."""
        return self.outlines._replace(shaped=self.outlines.basis @ betas)


@dataclass(frozen=True, eq=False)
class Outline:
    """N outline vertices of one frame and the line that each is pulled to: normal . pixel = target.

    Where nothing matched, normal and target are zero.
    """

    #: (N,) int64 vertices.
    index: np.ndarray
    #: (N, 2) float32, outward unit normals.
    normal: np.ndarray
    #: (N,) float32, px of the field.
    target: np.ndarray

    @classmethod
    def nothing(cls) -> Outline:
        """Return an outline that pulls nothing."""
        return cls(
            np.zeros(_OUTLINE_COUNT, dtype=np.int64),
            np.zeros((_OUTLINE_COUNT, 2), dtype=np.float32),
            np.zeros(_OUTLINE_COUNT, dtype=np.float32),
        )


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """Distance to the outline of a mask (S, S) uint8, positive outside.

    (FIELD_SIZE, FIELD_SIZE) float16 in px of the field; zeros where the mask has no outline.
    """
    small = cv2.resize(mask, (FIELD_SIZE, FIELD_SIZE), interpolation=cv2.INTER_AREA)
    inside = (small >= 128).astype(np.uint8)
    if inside.all() or not inside.any():
        return np.zeros((FIELD_SIZE, FIELD_SIZE), dtype=np.float16)
    outer = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inner = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Pixel centres next to the outline are half a pixel from it, on either side.
    return (outer - inner - np.where(inside, -0.5, 0.5)).astype(np.float16)


def match_outline(
    pixels: np.ndarray, faces: np.ndarray, candidates: np.ndarray, field: np.ndarray, reach: float
) -> Outline:
    """Match the outline of a mesh, (V, 2) px of the field, with the outline of a mask.

    Each of the `candidates` looks along its normal, up to `reach` px, for the nearest place
    where the mask ends in the same direction: a finger's left side never snaps to the right side
    of its neighbour, as it may with the plainly nearest point.
    """

    def read(image: np.ndarray, at: np.ndarray) -> np.ndarray:
        return sample(image, at, border=cv2.BORDER_REPLICATE)

    own = signed_distance(draw_silhouette(pixels, faces, FIELD_SIZE)).astype(np.float32)
    if not own.any():
        return Outline.nothing()
    # Those near the outline, evenly thinned.
    rows, columns, inside = cells(pixels[candidates], own.shape)
    chosen = candidates[inside & (own[rows, columns] >= -_OUTLINE_WITHIN)]
    # The other hand may cover all of them.
    if len(chosen) == 0:
        return Outline.nothing()
    if len(chosen) > _OUTLINE_COUNT:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _OUTLINE_COUNT).astype(np.int64)]
    places = pixels[chosen].astype(np.float32)
    smooth = cv2.GaussianBlur(own, (0, 0), 1.0)
    gradient = np.stack(
        [read(cv2.Sobel(smooth, cv2.CV_32F, *axis), places) for axis in ((1, 0), (0, 1))], axis=1
    )
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = gradient / np.maximum(length, 1e-6)
    steps = np.arange(-reach, reach + _STEP, _STEP, dtype=np.float32)
    along = places[:, None] + normals[:, None] * steps[:, None]
    values = read(field.astype(np.float32), along.reshape(-1, 2)).reshape(len(chosen), -1)
    leaves = (values[:, :-1] <= 0) & (values[:, 1:] > 0)
    middle = np.abs(steps[:-1] + 0.5 * _STEP)
    best = np.where(leaves, middle, np.inf).argmin(axis=1)
    rows = np.arange(len(chosen))
    matched = leaves[rows, best] & (length[:, 0] > 1e-6)
    before, after = values[rows, best], values[rows, best + 1]
    crossing = steps[best] + _STEP * before / np.minimum(before - after, -1e-6)
    # A vertex that lies inside the mesh's own outline is to stay as far inside the mask's.
    offset = crossing + read(own, places)
    outline = Outline.nothing()
    count = len(chosen)
    outline.index[:count] = chosen
    outline.normal[:count] = np.where(matched[:, None], normals, 0.0)
    outline.target[:count] = np.where(matched, (normals * places).sum(axis=1) + offset, 0.0)
    return outline
