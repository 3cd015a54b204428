"""Masks of the visible hands: the user's own, or graph cuts that the fit as it is now prompts.

No network: the colours of hands and surroundings are learnt once over the whole clip, and the
projected meshes say where to look. A graph cut finds no edge between two overlapping hands, so two
hands are cut out together. The fitted meshes decide which pixel shows which hand: of two that cover
a pixel, the nearer one is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import surrounding
from hwp_bench.hands.raster import draw_faces, draw_silhouette, overlap
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.shared.frames import CropWindows, cells, each_frame, resample
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import ProjectedHand
from hwp_bench.importers.video.decode import ClipImages
from hwp_bench.importers.video.model import ClipModel, pose_vertices
from hwp_bench.importers.video.residuals import FIELD_SIZE, signed_distance

# --- Colours

# Pixels of each kind that the model is learnt from; more do not change it.
_SAMPLES = 40_000
# Standard deviation (8-bit levels) that is added to every colour. A plain wall is nearly one
# colour: a pixel in which video coding has smeared a trace of skin is then a hundred deviations
# from the wall and called skin. With a common spread the border lies half way.
_SPREAD = 4.0
# Width of the image that the samples are laid out in.
_STRIP = 400
# Colours within so many standard deviations are the same.
_SAME_COLOUR = 2.0
# Colours of a mixture that have less weight than this are noise.
_LEAST_WEIGHT = 0.01
# Bits of a channel whose evidence is computed: neighbours share it.
_BITS = 7
# Where the nine covariance entries of each of the five colours lie in a mixture.
_COVARIANCES = slice(20, 65)


@dataclass(frozen=True, eq=False)
class ColourModel:
    """Two Gaussian mixtures of five colours each, (1, 65) float64 in OpenCV's GrabCut layout."""

    background: np.ndarray
    foreground: np.ndarray

    def sharpened(self, weight: float) -> ColourModel:
        """Return a copy whose log densities vary `weight` times as much (covariances shrink)."""
        background, foreground = self.background.copy(), self.foreground.copy()
        for mixture in (background, foreground):
            mixture[:, _COVARIANCES] /= weight
        return ColourModel(background, foreground)


def learn_colours(samples: Iterable[tuple[np.ndarray, np.ndarray]]) -> ColourModel | None:
    """Learn the mixtures; None where hand or surroundings have fewer than 100 pixels.

    `samples` are, for each frame, colours (N, 3) uint8 of pixels that are hand, and of those that
    are not.
    """
    random = np.random.default_rng(0)
    kinds: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for sample in samples:
        for pixels, found in zip(kinds, sample, strict=True):
            # A thousand of each frame, so that every frame counts and memory is bounded.
            pixels.append(found[random.integers(0, len(found), 1000)] if len(found) else found)
    hand, other = (np.concatenate([np.zeros((0, 3), np.uint8), *pixels]) for pixels in kinds)
    if min(len(hand), len(other)) < 100:
        return None
    cv2.setRNGSeed(0)
    model = _mixtures(hand, other, random)
    # The silhouette also covers objects in the hand. Colours that also occur next to the hand
    # are therefore not learnt as hand. (A hand before skin-coloured things is not harmed.)
    least = np.full(len(hand), np.inf)
    for weight, distance, _ in _gaussians(hand, model.background):
        if weight >= _LEAST_WEIGHT:
            np.minimum(least, distance, out=least)
    elsewhere = least < _SAME_COLOUR**2
    if 0.0 < elsewhere.mean() < 0.5:
        model = _mixtures(hand[~elsewhere], other, random)
    return model


def _mixtures(hand: np.ndarray, other: np.ndarray, random: np.random.Generator) -> ColourModel:
    """Five Gaussians for each of two sets of colours (N, 3) uint8."""
    chosen = [colours[random.integers(0, len(colours), _SAMPLES)] for colours in (hand, other)]
    strip = np.concatenate(chosen).reshape(-1, _STRIP, 3)
    labels = np.repeat([cv2.GC_FGD, cv2.GC_BGD], _SAMPLES).reshape(-1, _STRIP).astype(np.uint8)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(strip, labels, (0, 0, 1, 1), background, foreground, 3, cv2.GC_INIT_WITH_MASK)
    for mixture in (background, foreground):
        mixture[:, _COVARIANCES] += np.tile((_SPREAD**2 * np.eye(3)).ravel(), 5)
    return ColourModel(background, foreground)


def evidence(image: np.ndarray, model: ColourModel) -> np.ndarray:
    """Log of (likelihood as hand / likelihood as surroundings), (S, S) float32.

    `image` is (S, S, 3) uint8, in the colour space that the model was learnt in.
    """
    # Colours as one number each, at half the resolution of each channel.
    coarse = image.astype(np.int32) >> 1
    packed = (coarse[..., 0] << 2 * _BITS) | (coarse[..., 1] << _BITS) | coarse[..., 2]
    seen = np.zeros(1 << 3 * _BITS, dtype=bool)
    seen[packed] = True
    colours = np.flatnonzero(seen)
    # The middle of each cell, as it is when the lowest bit is set.
    channels = [(colours >> shift) & ((1 << _BITS) - 1) for shift in (2 * _BITS, _BITS, 0)]
    table = (2.0 * np.stack(channels, axis=1) + 1.0).astype(float)
    value = _log_density(table, model.foreground) - _log_density(table, model.background)
    by_colour = np.empty(len(seen), dtype=np.float32)
    by_colour[colours] = value
    return by_colour[packed]


def _gaussians(
    colours: np.ndarray, mixture: np.ndarray
) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Weight of each Gaussian, squared Mahalanobis distances (N,) of colours, and covariance."""
    means = mixture[0, 5:20].reshape(5, 3)
    covariances = mixture[0, _COVARIANCES].reshape(5, 3, 3)
    for weight, mean, covariance in zip(mixture[0, :5], means, covariances, strict=True):
        if weight > 0:
            offset = colours - mean
            inverse = np.linalg.inv(covariance)
            yield weight, np.einsum("ni,ij,nj->n", offset, inverse, offset), covariance


def _log_density(colours: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    total = np.full(len(colours), 1e-30)
    for weight, distance, covariance in _gaussians(colours, mixture):
        total += weight * np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(covariance))
    return np.log(total)


# --- The cut of one clip

# Frames that the colour model is learnt from.
_COLOUR_FRAMES = 200
# Mean log evidence around a pixel below which its colour forbids it to be sure hand: an object
# before the hand is then not in the mask; and the edge of the window for that mean, as a share of
# the hand's size.
_FORBIDDING, _WINDOW = -1.0, 0.03
# Holes narrower than this share of the hand's size are filled.
_HOLE = 0.02
# The forearm is cut out up to this distance from the hand, as a share of its size: farther than
# outlines are looked for.
_FOREARM = 0.2
# How much colour counts against smoothness, over GrabCut's own balance, which closes the narrow
# gaps between fingers.
_COLOUR_WEIGHT = 4.0


@dataclass(frozen=True)
class MaskSettings:
    """Trust in the projected hand; lengths are shares of the hand's size."""

    #: Pixels deeper than this inside the silhouette are hand, if their colour allows it.
    inside: float
    #: Pixels farther than this outside the silhouette are not hand.
    outside: float
    #: Pixels outside the silhouette that are nearer to the wrist's line than so many times their
    #: distance to the silhouette are arm: an arm may leave the hand at an angle, the mesh does not.
    arm: float = 0.0


#: For the first masks, made from landmarks only.
WIDE = MaskSettings(inside=0.04, outside=0.12)
#: For masks made after the outline has been fitted.
NARROW = MaskSettings(inside=0.027, outside=0.08)
#: For the masks that are kept.
LAST = replace(NARROW, arm=4.0)


@dataclass(frozen=True, eq=False)
class Prompt:
    """The posed meshes in one image, which prompt the graph cut."""

    #: (S, S) uint8, 255 where a mesh is.
    silhouette: np.ndarray
    #: (S, S) px of every pixel behind the wrist's line: above 0 on the forearm's side.
    behind: np.ndarray
    #: Whether the pose comes from a detection, not from interpolation.
    detected: bool

    @classmethod
    def without_wrist(cls, silhouette: np.ndarray, *, detected: bool) -> Prompt:
        """Return the prompt of meshes whose wrist has no line: nothing is on the forearm's side."""
        return cls(silhouette, _no_line(silhouette.shape[0]), detected)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Masks of one image."""

    #: (S, S) uint8, 255 = hand or forearm.
    skin: np.ndarray
    #: (S, S) uint8, 255 = visible hand, cut at the wrist.
    hand: np.ndarray


def segment_clip(
    image: Callable[[int], np.ndarray],
    prompt: Callable[[int], Prompt],
    count: int,
    hand_size: float,
    settings: MaskSettings,
) -> Iterator[tuple[Prompt, Segmentation]]:
    """Segment every frame with one colour model for the whole clip.

    `image` gives the (S, S, 3) uint8 RGB image of a frame, from several threads; `hand_size` is in
    px of these images.
    """
    chosen = np.unique(np.linspace(0, count - 1, min(count, _COLOUR_FRAMES)).astype(int))

    def sample(frame: int) -> tuple[np.ndarray, np.ndarray] | None:
        drawn = prompt(frame)
        if not drawn.detected:
            return None
        lab = to_lab(image(frame))
        hand, other, _ = _sure(drawn, hand_size, settings)
        return lab[hand], lab[other]

    samples = each_frame(sample, chosen.tolist())
    model = learn_colours(found for found in samples if found is not None)

    def work(frame: int) -> tuple[Prompt, Segmentation]:
        drawn = prompt(frame)
        return drawn, _segment(image(frame), drawn, model, hand_size, settings)

    yield from each_frame(work, range(count))


def _segment(
    image: np.ndarray,
    prompt: Prompt,
    model: ColourModel | None,
    hand_size: float,
    settings: MaskSettings,
) -> Segmentation:
    """Segment one image; without a colour model the silhouette is the mask.

    Source: Boykov and Jolly, "Interactive graph cuts", 2001, with the colour mixtures of
    GrabCut (Rother et al., 2004) held fixed; OpenCV's `grabCut` in its frozen mode.
    """
    if model is None or not prompt.silhouette.any():
        return Segmentation(prompt.silhouette, prompt.silhouette)
    inside, outside, distance = _sure(prompt, hand_size, settings)
    labels = np.full(inside.shape, cv2.GC_PR_BGD, dtype=np.uint8)
    labels[prompt.silhouette > 0] = cv2.GC_PR_FGD
    labels[outside | (distance > _FOREARM * hand_size)] = cv2.GC_BGD
    # What is surely not hand decides nothing, and costs as much as the rest.
    open_ = surrounding(labels != cv2.GC_BGD, 2)
    lab, labels = to_lab(image[open_]), np.ascontiguousarray(labels[open_])
    if prompt.detected:
        edge = max(1, round(_WINDOW * hand_size))
        colour = cv2.blur(np.clip(evidence(lab, model), -5.0, 5.0), (edge, edge))
        labels[inside[open_] & (colour > _FORBIDDING)] = cv2.GC_FGD
    # The rectangle is not read in this mode; the mixtures are written to, so copies.
    sharp = model.sharpened(_COLOUR_WEIGHT)
    background, foreground = sharp.background, sharp.foreground
    cv2.grabCut(lab, labels, (0, 0, 1, 1), background, foreground, 1, cv2.GC_EVAL_FREEZE_MODEL)
    skin = np.zeros_like(prompt.silhouette)
    cut = (labels & 1) * np.uint8(255)
    skin[open_] = _tidied(cut, prompt.silhouette[open_], hand_size)
    # The silhouette's own wrist end is hand.
    hand = (settings.arm * distance <= -prompt.behind) | (prompt.silhouette > 0)
    return Segmentation(skin, np.where(hand, skin, 0).astype(np.uint8))


def to_lab(image: np.ndarray) -> np.ndarray:
    """8-bit CIELAB of an RGB image: distances that look alike count alike."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2Lab)


def _sure(
    prompt: Prompt, hand_size: float, settings: MaskSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels deep inside the silhouette, those far outside that are not forearm, and distances."""
    depth = cv2.distanceTransform(prompt.silhouette, cv2.DIST_L2, 3)
    distance = cv2.distanceTransform(255 - prompt.silhouette, cv2.DIST_L2, 3)
    return (
        depth > settings.inside * hand_size,
        (distance > settings.outside * hand_size) & (prompt.behind <= 0.0),
        distance,
    )


def _tidied(mask: np.ndarray, silhouette: np.ndarray, hand_size: float) -> np.ndarray:
    """Smooth the staircase, drop pieces away from the hand, fill pin holes."""
    from skimage.measure import label
    from skimage.morphology import remove_small_holes

    pieces = label(cv2.medianBlur(mask, 5), connectivity=1)
    touching = np.unique(pieces[silhouette > 0])
    kept = np.isin(pieces, touching[touching > 0])
    # Holes of at most this many pixels are narrower than `_HOLE`.
    largest = math.ceil((_HOLE * hand_size) ** 2) - 1
    filled = remove_small_holes(kept, max_size=largest, connectivity=1)
    return np.where(filled, 255, 0).astype(np.uint8)


# --- One hand or two, projected

# A hand that is not detected is drawn for this many frames before and after it is.
_BRIDGED = 5
# Weight of a landmark that the other hand hides: the tracker has guessed it.
_HIDDEN = 0.1
# A landmark lies inside its hand: one that is less than this behind the other's surface is
# touching it, m.
_BEHIND = 0.015
# Edge of the images in which hidden landmarks are looked for, px.
_HIDDEN_EDGE = 192


@dataclass(frozen=True, eq=False)
class ProjectedClip(ProjectedHand):
    """The model of one hand projected into every frame, in px of the whole frame.

    Landmarks include the tracker's offsets.
    """

    #: (F, 21) float32 m, of the landmarks.
    depths: np.ndarray
    #: Vertices of the open wrist.
    ring: np.ndarray
    #: Where the crops lie.
    windows: CropWindows

    def drawn(self) -> ProjectedHand:
        """The hand in the crops, as a sheet shows it."""
        pixels, landmarks = map(self.windows.place, (self.pixels, self.landmarks))
        return replace(self, pixels=pixels, landmarks=landmarks)

    def in_crop(self, frame: int, edge: int) -> np.ndarray:
        """(V, 2) px of the vertices in a frame's crop of `edge` px."""
        return self.windows.place(self.pixels[frame], edge, frame)

    def silhouette(self, frame: int, edge: int) -> np.ndarray:
        """(edge, edge) uint8, 255 where the mesh is in a frame's crop."""
        return draw_silhouette(self.in_crop(frame, edge), self.faces, edge)


def project_clip(model: ClipModel, windows: CropWindows) -> ProjectedClip:
    """Pose and project every frame of a fit as it is now."""
    vertices = pose_vertices(model)
    with torch.no_grad():
        pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        points = model.pose().landmarks
        landmarks, depths = model.pixels(points).numpy(), points[..., 2].numpy()
    faces, everywhere = model.template.faces, np.ones(len(pixels), dtype=bool)
    ring = boundary_vertices(faces)
    return ProjectedClip(vertices, pixels, landmarks, faces, everywhere, depths, ring, windows)


class ProjectedHands:
    """One hand or two, projected, as one prompt for the cut of their masks."""

    def __init__(self, hands: Sequence[ProjectedClip], landmarks: Sequence[Landmarks]) -> None:
        from scipy.ndimage import binary_dilation

        self.hands = hands
        #: (H, F) bool, frames in which each is drawn; one hand is in all.
        self.shown = np.ones((1, len(landmarks[0].score)), dtype=bool)
        if len(hands) == 2:
            detected = [binary_dilation(one.detected, iterations=_BRIDGED) for one in landmarks]
            self.shown = np.stack(detected)

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw the meshes at `edge` px; a pixel is on the forearm's side of the nearer hand."""
        prompts = []
        for hand, shown in zip(self.hands, self.shown[:, frame], strict=True):
            if shown:
                pixels = hand.in_crop(frame, edge)
                behind = behind_wrist(hand.vertices[frame], pixels, hand.ring, edge)
                prompts.append(Prompt(hand.silhouette(frame, edge), behind, detected))
        if not prompts:
            nothing = np.zeros((edge, edge), dtype=np.uint8)
            return Prompt.without_wrist(nothing, detected=detected)
        if len(prompts) == 1:
            return prompts[0]
        first, second = prompts
        nearer = _distance(first.silhouette) <= _distance(second.silhouette)
        return Prompt(
            np.maximum(first.silhouette, second.silhouette),
            np.where(nearer, first.behind, second.behind),
            detected,
        )

    def coverage(self, masks: np.ndarray) -> list[np.ndarray]:
        """Divide masks (F, S, S) uint8 between the hands: the visible part of each, like them."""
        if len(self.hands) == 1:
            return [masks]

        def first(frame: int) -> np.ndarray:
            return self._owner(frame, masks.shape[1]) == 0

        owned = np.stack(list(each_frame(first, range(len(masks)))))
        return [np.where(part, masks, 0).astype(np.uint8) for part in (owned, ~owned)]

    def covered(self, hand: int, reach: float) -> np.ndarray | None:
        """(F, FIELD_SIZE, FIELD_SIZE) bool: the other hand is here, or as near as `reach` px.

        None where there is no other one.
        """
        if len(self.hands) == 1:
            return None
        other = self.hands[1 - hand]

        def near(frame: int) -> np.ndarray:
            if not self.shown[1 - hand, frame]:
                return np.zeros((FIELD_SIZE, FIELD_SIZE), dtype=bool)
            return np.asarray(_distance(other.silhouette(frame, FIELD_SIZE)) <= reach)

        return np.stack(list(each_frame(near, range(self.shown.shape[1]))))

    def trust(self, hand: int) -> np.ndarray:
        """(F, 21) weights of landmarks of one of two hands: `_HIDDEN` where the other is before."""
        own, other, edge = self.hands[hand], self.hands[1 - hand], _HIDDEN_EDGE

        def weights(frame: int) -> np.ndarray:
            if not self.shown[:, frame].all():
                return np.ones(own.landmarks.shape[1])
            pixels = other.in_crop(frame, edge)
            depth = other.vertices[frame, :, 2]
            face, _ = draw_faces(pixels, depth, other.faces, (edge, edge))
            places = own.windows.place(own.landmarks[frame], edge, frame)
            rows, columns, _ = cells(places, face.shape)
            found = face[rows, columns]
            surface = depth[other.faces[found]].mean(axis=1)
            hidden = (found >= 0) & (own.depths[frame] > surface + _BEHIND)
            return np.where(hidden, _HIDDEN, 1.0)

        return np.stack(list(each_frame(weights, range(self.shown.shape[1]))))

    def _owner(self, frame: int, edge: int) -> np.ndarray:
        """(edge, edge) int: which of two hands a pixel shows, or which is nearer to it."""
        shown = self.shown[:, frame]
        if not shown.all():
            return np.full((edge, edge), int(shown[1] and not shown[0]))
        first, second = self.hands
        pixels = [hand.in_crop(frame, edge) for hand in self.hands]
        depth = np.concatenate([hand.vertices[frame, :, 2] for hand in self.hands])
        faces = np.concatenate([first.faces, second.faces + len(pixels[0])])
        face, _ = draw_faces(np.concatenate(pixels), depth, faces, (edge, edge))
        owner = (face >= len(first.faces)).astype(int)
        away = [_distance(hand.silhouette(frame, edge)) for hand in self.hands]
        return np.where(face >= 0, owner, (away[1] < away[0]).astype(int))


def _distance(silhouette: np.ndarray) -> np.ndarray:
    """Distance of every pixel from a silhouette, px; far for an empty one."""
    if not silhouette.any():
        return np.full(silhouette.shape, np.inf, dtype=np.float32)
    return cv2.distanceTransform(255 - silhouette, cv2.DIST_L2, 3)


def behind_wrist(
    vertices: np.ndarray, pixels: np.ndarray, ring: np.ndarray, size: int
) -> np.ndarray:
    """Distances (size, size) px of pixels behind the wrist, towards the forearm.

    The open end of the mesh spans a plane; its normal points along the forearm. Seen at the
    wrist's depth, the plane cuts the image in a line, and the forearm lies behind the line. A
    mesh without an open end, or seen straight along the forearm, has no such line: all -inf.
    """
    if len(ring) < 3:
        return _no_line(size)
    centre = vertices[ring].mean(axis=0)
    normal = np.linalg.svd(vertices[ring] - centre)[2][2]
    if normal @ (vertices.mean(axis=0) - centre) > 0:
        normal = -normal
    seen = np.linalg.norm(normal[:2])
    if seen == 0:
        return _no_line(size)
    middle = pixels[ring].mean(axis=0)
    along = np.arange(size) + 0.5
    x, y = normal[:2] / seen
    return np.asarray((along[None] - middle[0]) * x + (along[:, None] - middle[1]) * y)


def _no_line(size: int) -> np.ndarray:
    """Distances (size, size) behind a wrist that has no line."""
    return np.full((size, size), -np.inf)


# --- Masks of a clip


@dataclass(frozen=True, eq=False)
class ClipMasks:
    """Masks of every frame, and how well the meshes agree with them."""

    #: (F, size, size) uint8, visible hands, at the stored resolution.
    coverage: np.ndarray
    #: (F, FIELD_SIZE, FIELD_SIZE) float16 signed distances of hands and forearms.
    fields: np.ndarray
    #: (F,) intersection over union of the meshes' silhouette and the hands' mask.
    overlap: np.ndarray


def cut_masks(
    images: ClipImages,
    projected: ProjectedHands,
    detected: np.ndarray,
    hand_size: float,
    settings: MaskSettings,
    own: np.ndarray | None = None,
    edge: int | None = None,
    update: Callable[[int], None] | None = None,
) -> ClipMasks:
    """Cut the masks of a clip, prompted by a fit.

    In `detected` frames (F,) the pose comes from a detection. `hand_size` is in px of the working
    images, and so are `own`, (F, S, S) uint8, masks of the user's own. Images are cut at `edge` px,
    or as they are.
    """
    working, size = images.working, images.frames.shape[1]
    edge = edge or working.shape[1]
    shown = images.frames if edge == size else working

    def prompt(frame: int) -> Prompt:
        return projected.prompt(frame, edge, bool(detected[frame]))

    if own is None:
        size_here = hand_size * edge / working.shape[1]
        found = segment_clip(
            lambda frame: resample(shown[frame], edge), prompt, len(working), size_here, settings
        )
    else:
        given = (resample(mask, edge) for mask in own)
        found = ((prompt(frame), Segmentation(one, one)) for frame, one in enumerate(given))
    coverage, fields, overlaps = [], [], []
    for drawn, masks in found:
        coverage.append(resample(masks.hand, size))
        fields.append(signed_distance(masks.skin))
        overlaps.append(overlap(drawn.silhouette > 0, masks.hand > 127))
        if update is not None:
            update(len(coverage))
    return ClipMasks(np.stack(coverage), np.stack(fields), np.array(overlaps))
