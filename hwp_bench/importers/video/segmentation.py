"""Visible-hand masks without a network: a graph cut prompted by the projected hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.video.colour_model import ColourModel, evidence, learn_colours

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
