"""The colours of the hand and of its surroundings, learnt once over the whole clip."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from hwp_bench.hands.raster import draw_faces, draw_silhouette, overlap
from hwp_bench.hands.topology import boundary_vertices
from hwp_bench.importers.shared.frames import CropWindows, each_frame, resample
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.decode import ClipImages
from hwp_bench.importers.video.model import ClipModel, posed_vertices
from hwp_bench.importers.video.residuals import FIELD_SIZE, signed_distance

#: Pixels of each kind that the model is learnt from; more do not change it.
SAMPLES = 40_000
#: Standard deviation (8-bit levels) that is added to every colour. A plain wall is nearly one
#: colour: a pixel in which video coding has smeared a trace of skin is then a hundred deviations
#: from the wall and called skin. With a common spread the border lies half way.
SPREAD = 4.0
#: Width of the image that the samples are laid out in.
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
    """Two Gaussian mixtures of five colours each, in OpenCV's GrabCut layout.

    Attributes:
        background: (1, 65) float64.
        foreground: (1, 65) float64.
    """

    background: np.ndarray
    foreground: np.ndarray

    def sharpened(self, weight: float) -> ColourModel:
        """Return a copy whose log densities vary `weight` times as much (covariances shrink)."""
        background, foreground = self.background.copy(), self.foreground.copy()
        for mixture in (background, foreground):
            mixture[:, _COVARIANCES] /= weight
        return ColourModel(background, foreground)


def learn_colours(
    samples: Iterable[tuple[np.ndarray, np.ndarray]], seed: int = 0
) -> ColourModel | None:
    """Learn the mixtures from labelled pixels of all frames.

    Args:
        samples: for each frame the colours (N, 3) uint8 of pixels that are hand, and of pixels
            that are not.
        seed: of the choice of pixels and of the clustering.

    Returns:
        The model, or None where one of the two kinds has fewer than 100 pixels.
    """
    import cv2

    random = np.random.default_rng(seed)
    kinds: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for sample in samples:
        for pixels, found in zip(kinds, sample, strict=True):
            # A thousand of each frame, so that every frame counts and memory is bounded.
            pixels.append(found[random.integers(0, len(found), 1000)] if len(found) else found)
    hand, other = (np.concatenate([np.zeros((0, 3), np.uint8), *pixels]) for pixels in kinds)
    if min(len(hand), len(other)) < 100:
        return None
    cv2.setRNGSeed(seed)
    model = _mixtures(hand, other, random)
    # The silhouette also covers objects in the hand. Colours that also occur next to the hand
    # are therefore not learnt as hand. (A hand before skin-coloured things is not harmed.)
    elsewhere = _least_distance(hand, model.background) < _SAME_COLOUR**2
    if 0.0 < elsewhere.mean() < 0.5:
        model = _mixtures(hand[~elsewhere], other, random)
    return model


def _mixtures(hand: np.ndarray, other: np.ndarray, random: np.random.Generator) -> ColourModel:
    """Five Gaussians for each of two sets of colours (N, 3) uint8."""
    import cv2

    chosen = [colours[random.integers(0, len(colours), SAMPLES)] for colours in (hand, other)]
    strip = np.concatenate(chosen).reshape(-1, _STRIP, 3)
    labels = np.repeat([cv2.GC_FGD, cv2.GC_BGD], SAMPLES).reshape(-1, _STRIP).astype(np.uint8)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(strip, labels, (0, 0, 1, 1), background, foreground, 3, cv2.GC_INIT_WITH_MASK)
    for mixture in (background, foreground):
        mixture[:, _COVARIANCES] += np.tile((SPREAD**2 * np.eye(3)).ravel(), 5)
    return ColourModel(background, foreground)


def evidence(image: np.ndarray, model: ColourModel) -> np.ndarray:
    """Log of (likelihood as hand / likelihood as surroundings) for every pixel.

    Args:
        image: (S, S, 3) uint8, in the colour space that the model was learnt in.
        model: the mixtures.

    Returns:
        (S, S) float32.
    """
    packed = _packed(image)
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


def _packed(image: np.ndarray) -> np.ndarray:
    """Colours (S, S) as one number each, at half the resolution of each channel."""
    coarse = image.astype(np.int32) >> 1
    return (coarse[..., 0] << 2 * _BITS) | (coarse[..., 1] << _BITS) | coarse[..., 2]


def _least_distance(colours: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distance (N,) to the nearest Gaussian of a mixture."""
    means = mixture[0, 5:20].reshape(5, 3)
    covariances = mixture[0, _COVARIANCES].reshape(5, 3, 3)
    least = np.full(len(colours), np.inf)
    for k in np.flatnonzero(mixture[0, :5] >= _LEAST_WEIGHT):
        offset = colours - means[k]
        inverse = np.linalg.inv(covariances[k])
        np.minimum(least, np.einsum("ni,ij,nj->n", offset, inverse, offset), out=least)
    return least


def _log_density(colours: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    weights = mixture[0, :5]
    means = mixture[0, 5:20].reshape(5, 3)
    covariances = mixture[0, _COVARIANCES].reshape(5, 3, 3)
    total = np.full(len(colours), 1e-30)
    for weight, mean, covariance in zip(weights, means, covariances, strict=True):
        if weight <= 0:
            continue
        offset = colours - mean
        distance = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)
        total += weight * np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(covariance))
    return np.log(total)


#: Frames that the colour model is learnt from.
_COLOUR_FRAMES = 200


@dataclass(frozen=True)
class MaskSettings:
    """Trust in the projected hand; lengths are shares of the hand's size."""

    #: Pixels deeper than this inside the silhouette are hand, if their colour allows it.
    inside: float = 0.04
    #: Pixels farther than this outside the silhouette are not hand.
    outside: float = 0.12
    #: Mean log evidence around a pixel below which its colour forbids it to be sure hand: an
    #: object before the hand is then not in the mask.
    forbidding: float = -1.0
    #: Edge of the window for that mean.
    window: float = 0.03
    #: Holes narrower than this are filled.
    hole: float = 0.02
    #: How much colour counts against smoothness, over GrabCut's own balance, which closes the
    #: narrow gaps between fingers.
    colour_weight: float = 4.0


#: For the first masks, made from landmarks only.
WIDE = MaskSettings()
#: For the last masks, made after the outline has been fitted.
NARROW = MaskSettings(inside=0.027, outside=0.08)


@dataclass(frozen=True, eq=False)
class Prompt:
    """The posed mesh in one image, which prompts the graph cut.

    Attributes:
        silhouette: (S, S) uint8, 255 where the mesh is.
        beyond: (S, S) bool, the forearm's side of the wrist.
        detected: whether the pose comes from a detection, not from interpolation.
    """

    silhouette: np.ndarray
    beyond: np.ndarray
    detected: bool

    @property
    def hand_side(self) -> np.ndarray:
        """(S, S) bool: the mask may be here; the silhouette's own wrist end included."""
        return ~self.beyond | (self.silhouette > 0)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Masks of one image.

    Attributes:
        skin: (S, S) uint8, 255 = hand or forearm.
        hand: (S, S) uint8, 255 = visible hand, cut at the wrist.
    """

    skin: np.ndarray
    hand: np.ndarray


def segment_clip(
    image: Callable[[int], np.ndarray],
    prompt: Callable[[int], Prompt],
    count: int,
    hand_size: float,
    settings: MaskSettings,
) -> Iterator[tuple[Prompt, Segmentation]]:
    """Segment every frame with one colour model for the whole clip.

    Args:
        image: gives the (S, S, 3) uint8 RGB image of a frame; called from several threads.
        prompt: gives the prompt of a frame; called from several threads.
        count: number of frames.
        hand_size: px of these images.
        settings: how far to trust the prompts.

    Yields:
        The prompt and the masks of each frame, in order.
    """

    chosen = np.unique(np.linspace(0, count - 1, min(count, _COLOUR_FRAMES)).astype(int))

    def sample(frame: int) -> tuple[np.ndarray, np.ndarray] | None:
        drawn = prompt(frame)
        if not drawn.detected:
            return None
        lab = to_lab(image(frame))
        hand, other = _sure(drawn, hand_size, settings)
        return lab[hand], lab[other]

    samples = each_frame(sample, chosen.tolist())
    model = learn_colours(found for found in samples if found is not None)

    def work(frame: int) -> tuple[Prompt, Segmentation]:
        drawn = prompt(frame)
        return drawn, segment(image(frame), drawn, model, hand_size, settings)

    yield from each_frame(work, range(count))


def segment(
    image: np.ndarray,
    prompt: Prompt,
    model: ColourModel | None,
    hand_size: float,
    settings: MaskSettings,
) -> Segmentation:
    """Segment one image.

    Args:
        image: (S, S, 3) uint8 RGB.
        prompt: of the posed mesh.
        model: colours; None = the silhouette is the mask.
        hand_size: px.
        settings: how far to trust the prompt.

    Source: Boykov and Jolly, "Interactive graph cuts", 2001, with the colour mixtures of
    GrabCut (Rother et al., 2004) held fixed; OpenCV's `grabCut` in its frozen mode.
    """
    import cv2

    if model is None or not prompt.silhouette.any():
        skin = prompt.silhouette
    else:
        lab = to_lab(image)
        inside, outside = _sure(prompt, hand_size, settings)
        labels = np.full(inside.shape, cv2.GC_PR_BGD, dtype=np.uint8)
        labels[prompt.silhouette > 0] = cv2.GC_PR_FGD
        labels[outside] = cv2.GC_BGD
        if prompt.detected:
            edge = max(1, round(settings.window * hand_size))
            colour = cv2.blur(np.clip(evidence(lab, model), -5.0, 5.0), (edge, edge))
            labels[inside & (colour > settings.forbidding)] = cv2.GC_FGD
        # The rectangle is not read in this mode; the mixtures are written to, so copies.
        sharp = model.sharpened(settings.colour_weight)
        background, foreground = sharp.background, sharp.foreground
        cv2.grabCut(lab, labels, (0, 0, 1, 1), background, foreground, 1, cv2.GC_EVAL_FREEZE_MODEL)
        skin = _tidy((labels & 1) * np.uint8(255), prompt.silhouette, hand_size, settings)
    return Segmentation(skin, np.where(prompt.hand_side, skin, 0).astype(np.uint8))


def to_lab(image: np.ndarray) -> np.ndarray:
    """8-bit CIELAB of an RGB image: distances that look alike count alike."""
    import cv2

    return cv2.cvtColor(image, cv2.COLOR_RGB2Lab)


def _sure(
    prompt: Prompt, hand_size: float, settings: MaskSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels deep inside the silhouette, and pixels far outside that are not forearm."""
    import cv2

    depth = cv2.distanceTransform(prompt.silhouette, cv2.DIST_L2, 3)
    distance = cv2.distanceTransform(255 - prompt.silhouette, cv2.DIST_L2, 3)
    return (
        depth > settings.inside * hand_size,
        (distance > settings.outside * hand_size) & ~prompt.beyond,
    )


def _tidy(
    mask: np.ndarray, silhouette: np.ndarray, hand_size: float, settings: MaskSettings
) -> np.ndarray:
    """Smooth the staircase, drop pieces away from the hand, fill pin holes."""
    import cv2
    from skimage.measure import label
    from skimage.morphology import remove_small_holes

    pieces = label(cv2.medianBlur(mask, 5), connectivity=1)
    touching = np.unique(pieces[silhouette > 0])
    kept = np.isin(pieces, touching[touching > 0])
    # Holes of at most this many pixels are narrower than `settings.hole`.
    largest = math.ceil((settings.hole * hand_size) ** 2) - 1
    filled = remove_small_holes(kept, max_size=largest, connectivity=1)
    return np.where(filled, 255, 0).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class ClipMasks:
    """Masks of every frame, and how well the mesh agrees with them.

    Attributes:
        coverage: (F, size, size) uint8, visible hand, at the stored resolution.
        fields: (F, FIELD_SIZE, FIELD_SIZE) float16 signed distances of hand and forearm.
        overlap: (F,) intersection over union of the mesh's silhouette and the hand's mask.
    """

    coverage: np.ndarray
    fields: np.ndarray
    overlap: np.ndarray


class Prompts(Protocol):
    """The fit as it is now, of one hand or of two."""

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw what prompts the cut of a frame at `edge` px."""
        ...


class Masking:
    """Makes the masks of one clip.

    Args:
        images: of the clip.
        detected: (F,) bool, frames whose pose comes from a detection.
        hand_size: px of the working images.
        own: (F, S, S) uint8 masks of the user's own at the working resolution, or None.
    """

    def __init__(
        self,
        images: ClipImages,
        detected: np.ndarray,
        hand_size: float,
        own: np.ndarray | None,
    ) -> None:
        self._images = images
        self._detected = detected
        self._hand_size = hand_size
        self._own = own

    def masks(
        self,
        projected: Prompts,
        settings: MaskSettings,
        *,
        reduction: int = 1,
        update: Callable[[int], None] | None = None,
    ) -> ClipMasks:
        """Cut the masks, prompted by a fit.

        Args:
            projected: the fit.
            settings: how far to trust it.
            reduction: work at this fraction of the working resolution: 2 is four times faster
                and enough for the outline.
            update: called with the number of frames done.
        """
        coverage, fields, overlaps = [], [], []
        size = self._images.frames.shape[1]
        for prompt, found in self._segmentations(projected, settings, reduction):
            coverage.append(resample(found.hand, size))
            fields.append(signed_distance(found.skin))
            overlaps.append(overlap(prompt.silhouette > 0, found.hand > 127))
            if update is not None:
                update(len(coverage))
        return ClipMasks(np.stack(coverage), np.stack(fields), np.array(overlaps))

    def _segmentations(
        self, projected: Prompts, settings: MaskSettings, reduction: int
    ) -> Iterator[tuple[Prompt, Segmentation]]:
        working = self._images.working
        edge = working.shape[1] // reduction

        def prompt(frame: int) -> Prompt:
            return projected.prompt(frame, edge, bool(self._detected[frame]))

        if self._own is not None:
            for frame, mask in enumerate(self._own):
                own = resample(mask, edge)
                yield prompt(frame), Segmentation(own, own)
            return
        yield from segment_clip(
            lambda frame: resample(working[frame], edge),
            prompt,
            len(working),
            self._hand_size * edge / working.shape[1],
            settings,
        )


@dataclass(frozen=True, eq=False)
class ProjectedClip:
    """The model projected into every frame.

    Attributes:
        vertices: (F, V, 3) float32 m, camera axes.
        pixels: (F, V, 2) float32, px of the whole frame.
        landmarks: (F, 21, 2) float32, px of the whole frame, the tracker's offsets included.
        depths: (F, 21) float32 m, of the landmarks.
        faces: (T, 3) int64.
        ring: vertices of the open wrist.
        windows: where the crops lie.
    """

    vertices: np.ndarray
    pixels: np.ndarray
    landmarks: np.ndarray
    depths: np.ndarray
    faces: np.ndarray
    ring: np.ndarray
    windows: CropWindows

    def in_crop(self, pixels: np.ndarray, frame: int, edge: int) -> np.ndarray:
        """Move pixels of a whole frame to its crop at `edge` px."""
        return (pixels - self.windows.corners[frame]) * (edge / self.windows.side)

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw the mesh in a frame's crop at `edge` px."""
        pixels = self.in_crop(self.pixels[frame], frame, edge)
        return Prompt(
            draw_silhouette(pixels, self.faces, edge),
            beyond_wrist(self.vertices[frame], pixels, self.ring, edge),
            detected,
        )


def project_clip(model: ClipModel, windows: CropWindows) -> ProjectedClip:
    """Pose and project every frame of a fit as it is now."""
    vertices = posed_vertices(model)
    with torch.no_grad():
        pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        points = model.posed().landmarks
        landmarks, depths = model.pixels(points).numpy(), points[..., 2].numpy()
    faces = model.template.faces
    ring = boundary_vertices(faces)
    return ProjectedClip(vertices, pixels, landmarks, depths, faces, ring, windows)


def beyond_wrist(
    vertices: np.ndarray, pixels: np.ndarray, ring: np.ndarray, size: int
) -> np.ndarray:
    """Pixels on the forearm's side of the wrist.

    The open end of the mesh spans a plane; its normal points along the forearm. Seen at the
    wrist's depth, the plane cuts the image in a line, and the forearm lies behind the line.

    Args:
        vertices: (V, 3) camera axes, m.
        pixels: (V, 2) px.
        ring: vertices of the open end.
        size: edge of the image, px.

    Returns:
        (size, size) bool; all False for a mesh without an open end, or seen straight along
        the forearm.
    """
    if len(ring) < 3:
        return np.zeros((size, size), dtype=bool)
    centre = vertices[ring].mean(axis=0)
    normal = np.linalg.svd(vertices[ring] - centre)[2][2]
    if normal @ (vertices.mean(axis=0) - centre) > 0:
        normal = -normal
    middle = pixels[ring].mean(axis=0)
    along = np.arange(size) + 0.5
    depth = (along[None] - middle[0]) * normal[0] + (along[:, None] - middle[1]) * normal[1]
    return depth > 0


#: A hand that is not detected is drawn for this many frames before and after it is.
BRIDGED = 5
#: Weight of a landmark that the other hand hides: the tracker has guessed it.
HIDDEN = 0.1
# A landmark lies inside its hand: one that is less than this behind the other's surface is
# touching it, m.
_BEHIND = 0.015
# Edge of the images in which hidden landmarks are looked for, px.
_EDGE = 192


@dataclass(frozen=True, eq=False)
class ProjectedHands:
    """Two projected hands, as one prompt for the cut of their masks.

    Attributes:
        hands: the two.
        shown: (2, F) bool, frames in which each is drawn.
    """

    hands: tuple[ProjectedClip, ProjectedClip]
    shown: np.ndarray

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw both meshes; a pixel is on the forearm's side if it is for the nearer hand."""
        prompts = [
            hand.prompt(frame, edge, detected)
            for hand, shown in zip(self.hands, self.shown[:, frame], strict=True)
            if shown
        ]
        if not prompts:
            nothing = np.zeros((edge, edge), dtype=np.uint8)
            return Prompt(nothing, nothing > 0, detected)
        if len(prompts) == 1:
            return prompts[0]
        first, second = prompts
        nearer = _distance(first.silhouette) <= _distance(second.silhouette)
        return Prompt(
            np.maximum(first.silhouette, second.silhouette),
            np.where(nearer, first.beyond, second.beyond),
            detected,
        )

    def coverage(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Divide masks between the hands.

        Args:
            masks: (F, S, S) uint8, visible hands.

        Returns:
            Two arrays like it: the visible part of each hand.
        """

        def first(frame: int) -> np.ndarray:
            return self._owner(frame, masks.shape[1]) == 0

        owned = np.stack(list(each_frame(first, range(len(masks)))))
        return np.where(owned, masks, 0).astype(np.uint8), np.where(owned, 0, masks).astype(
            np.uint8
        )

    def covered(self, hand: int, reach: float) -> np.ndarray:
        """Return (F, FIELD_SIZE, FIELD_SIZE) bool: where the other hand is, or as near as `reach`.

        Args:
            hand: 0 or 1.
            reach: px of the field.
        """
        other = self.hands[1 - hand]

        def near(frame: int) -> np.ndarray:
            if not self.shown[1 - hand, frame]:
                return np.zeros((FIELD_SIZE, FIELD_SIZE), dtype=bool)
            pixels = other.in_crop(other.pixels[frame], frame, FIELD_SIZE)
            drawn = draw_silhouette(pixels, other.faces, FIELD_SIZE)
            return np.asarray(_distance(drawn) <= reach)

        return np.stack(list(each_frame(near, range(self.shown.shape[1]))))

    def trust(self, hand: int) -> np.ndarray:
        """Return (F, 21) weights of landmarks: `HIDDEN` where the other hand hides them."""
        own, other = self.hands[hand], self.hands[1 - hand]

        def weights(frame: int) -> np.ndarray:
            if not self.shown[:, frame].all():
                return np.ones(own.landmarks.shape[1])
            pixels = other.in_crop(other.pixels[frame], frame, _EDGE)
            depth = other.vertices[frame, :, 2]
            face, _ = draw_faces(pixels, depth, other.faces, (_EDGE, _EDGE))
            spots = own.in_crop(own.landmarks[frame], frame, _EDGE)
            column, row = np.clip(np.floor(spots), 0, _EDGE - 1).astype(np.int64).T
            found = face[row, column]
            surface = depth[other.faces[found]].mean(axis=1)
            hidden = (found >= 0) & (own.depths[frame] > surface + _BEHIND)
            return np.where(hidden, HIDDEN, 1.0)

        return np.stack(list(each_frame(weights, range(self.shown.shape[1]))))

    def _owner(self, frame: int, edge: int) -> np.ndarray:
        """(edge, edge) int: the hand that a pixel shows, or that is nearer to it."""
        shown = self.shown[:, frame]
        if not shown.all():
            return np.full((edge, edge), int(shown[1] and not shown[0]))
        first, second = self.hands
        pixels = [hand.in_crop(hand.pixels[frame], frame, edge) for hand in self.hands]
        depth = np.concatenate([hand.vertices[frame, :, 2] for hand in self.hands])
        faces = np.concatenate([first.faces, second.faces + len(pixels[0])])
        face, _ = draw_faces(np.concatenate(pixels), depth, faces, (edge, edge))
        owner = (face >= len(first.faces)).astype(int)
        away = [
            _distance(draw_silhouette(place, hand.faces, edge))
            for place, hand in zip(pixels, self.hands, strict=True)
        ]
        return np.where(face >= 0, owner, (away[1] < away[0]).astype(int))


def project_hands(hands: Sequence[ProjectedClip], landmarks: Sequence[Landmarks]) -> ProjectedHands:
    """Join two projected hands."""
    first, second = hands
    return ProjectedHands((first, second), np.stack([_bridged(one.detected) for one in landmarks]))


def _bridged(detected: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(detected, iterations=BRIDGED))


def _distance(silhouette: np.ndarray) -> np.ndarray:
    """Distance of every pixel from a silhouette, px; far for an empty one."""
    import cv2

    if not silhouette.any():
        return np.full(silhouette.shape, np.inf, dtype=np.float32)
    return cv2.distanceTransform(255 - silhouette, cv2.DIST_L2, 3)
