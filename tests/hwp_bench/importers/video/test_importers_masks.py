"""Masks. Oracle: synthetic pictures whose hand pixels are known."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
from scipy.stats import multivariate_normal
from synthetic_clip import CUP, HEIGHT, SKIN, WIDTH, SyntheticClip, make_clip

from hwp_bench.hands.raster import draw_silhouette, overlap
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.video.masks import (
    LAST,
    WIDE,
    ColourModel,
    MaskSettings,
    Prompt,
    Segmentation,
    behind_wrist,
    evidence,
    learn_colours,
    segment_clip,
    to_lab,
)

HAND = 150.0


@functools.cache
def clip() -> SyntheticClip:
    return make_clip(6)


def square(picture: np.ndarray) -> np.ndarray:
    """Pad a frame at the bottom: masks are cut in squares."""
    return np.pad(picture, ((0, WIDTH - HEIGHT), (0, 0), (0, 0))[: picture.ndim])


def prompt(frame: int, shift: float = 0.0, detected: bool = True) -> Prompt:
    known = clip()
    pixels = known.vertex_pixels[frame] + shift
    ring = boundary_vertices(known.template.faces)
    return Prompt(
        draw_silhouette(pixels, known.template.faces, WIDTH),
        behind_wrist(known.vertices[frame], pixels, ring, WIDTH),
        detected,
    )


def masks(
    pictures: list[np.ndarray], shift: float = 0.0, trust: MaskSettings = WIDE
) -> list[Segmentation]:
    found = segment_clip(
        lambda frame: pictures[frame], lambda f: prompt(f, shift), len(pictures), HAND, trust
    )
    return [segmentation for _, segmentation in found]


def pictures() -> list[np.ndarray]:
    return [square(clip().picture(frame)) for frame in range(6)]


def test_a_prompt_that_is_off_still_finds_the_hand() -> None:
    # 4 px of 150 in x and y is more than a landmark fit is ever off.
    for frame, found in enumerate(masks(pictures(), shift=4.0)):
        truth = square(clip().silhouette(frame)) > 0
        drawn = overlap(prompt(frame, 4.0).silhouette > 0, truth)
        cut = overlap(found.hand > 0, truth)
        assert drawn < 0.88
        assert cut > 0.94


def test_the_mask_is_not_swollen() -> None:
    for frame, found in enumerate(masks(pictures())):
        truth = square(clip().silhouette(frame)) > 0
        # Along the whole outline less than a third of a pixel.
        edge = np.count_nonzero(cv2.morphologyEx(truth * np.uint8(1), cv2.MORPH_GRADIENT, None))
        assert abs(np.count_nonzero(found.hand) - np.count_nonzero(truth)) < edge / 3


def test_the_forearm_is_skin_but_no_hand() -> None:
    found = masks(pictures())[0]
    beyond = prompt(0).behind > 0
    assert np.count_nonzero(found.skin[beyond]) > 500
    assert np.count_nonzero(found.hand[beyond & (prompt(0).silhouette == 0)]) == 0


def test_an_arm_that_leaves_at_an_angle_is_no_hand() -> None:
    """Oracle: the silhouette that the picture is painted with. Fewer than 20 px are farther out."""
    known, seen = clip(), pictures()
    for frame, picture in enumerate(seen):
        ring = known.vertex_pixels[frame][boundary_vertices(known.template.faces)]
        wrist, knuckle = ring.mean(axis=0), known.landmarks.image[frame, 9]
        along = (wrist - knuckle) / np.linalg.norm(wrist - knuckle)
        aside = along + np.array([-along[1], along[0]])
        # The arm begins 25 px before the end of the hand, as where a wrist is bent.
        arm = np.concatenate([ring - 25 * along, ring + 300 * aside]).astype(np.float32)
        cv2.fillConvexPoly(picture, cv2.convexHull(arm).astype(np.int32), SKIN)
    for frame, found in enumerate(masks(seen, trust=replace(WIDE, arm=LAST.arm))):
        silhouette = prompt(frame).silhouette
        away = cv2.distanceTransform(255 - silhouette, cv2.DIST_L2, 3)
        beside = (away > 2.0) & (prompt(frame).behind <= 0)
        assert np.count_nonzero(found.skin[beside]) > 150
        assert np.count_nonzero(found.hand[away > 2.0]) < 20


def test_an_object_before_the_hand_stays_out() -> None:
    seen = pictures()
    for picture in seen:
        cv2.circle(picture, (150, 100), 22, CUP, -1)
        cv2.circle(picture, (30, 40), 22, CUP, -1)
    covered = cv2.circle(np.zeros((WIDTH, WIDTH), np.uint8), (150, 100), 22, 1, -1) > 0
    on_hand = square(clip().silhouette(0))[covered] > 0
    assert on_hand.mean() > 0.8
    found = masks(seen)[0]
    assert (found.hand[covered] > 0).mean() < 0.1


def test_nothing_is_invented_where_no_hand_is_drawn() -> None:
    known = clip()
    empty = Prompt.without_wrist(np.zeros((WIDTH, WIDTH), np.uint8), detected=False)
    found = list(
        segment_clip(
            lambda frame: square(known.picture(frame)),
            lambda frame: empty if frame == 5 else prompt(frame),
            6,
            HAND,
            WIDE,
        )
    )
    assert not found[5][1].hand.any()


def test_without_any_detection_the_silhouette_is_the_mask() -> None:
    frames = pictures()
    found = list(segment_clip(lambda f: frames[f], lambda f: prompt(f, 0.0, False), 6, HAND, WIDE))
    for said, mask in found:
        np.testing.assert_array_equal(mask.hand > 0, said.silhouette > 0)


def test_masks_repeat_exactly() -> None:
    few = pictures()[:2]
    for first, second in zip(masks(few), masks(few), strict=True):
        np.testing.assert_array_equal(first.hand, second.hand)


def test_evidence_has_the_sign_of_the_colour() -> None:
    picture = to_lab(pictures()[0])
    hand = square(clip().silhouette(0)) > 0
    model = learn_colours([(picture[hand], picture[~hand & (prompt(0).behind <= 0)])])
    assert model is not None
    value = evidence(picture, model)
    assert (value[hand] > 0).mean() > 0.99
    assert (value[~hand & (prompt(0).behind <= 0)] < 0).mean() > 0.97
    assert learn_colours([(picture[hand & False], picture[~hand])]) is None


def test_evidence_is_that_of_the_middle_of_a_colour_s_cell() -> None:
    """Oracle: SciPy's densities, pixel by pixel."""
    random = np.random.default_rng(0)
    mixtures = []
    for _ in range(2):
        covariances = [np.diag(random.uniform(200, 900, 3)) for _ in range(5)]
        parts = [np.full(5, 0.2), random.uniform(60, 200, 15), np.ravel(covariances)]
        mixtures.append(np.concatenate(parts)[None])
    image = random.integers(0, 256, (20, 30, 3)).astype(np.uint8)

    def density(mixture: np.ndarray) -> np.ndarray:
        means, covariances = mixture[0, 5:20].reshape(5, 3), mixture[0, 20:].reshape(5, 3, 3)
        parts = [
            multivariate_normal(mean, covariance).pdf(image | 1)
            for mean, covariance in zip(means, covariances, strict=True)
        ]
        return 0.2 * (2 * np.pi) ** 1.5 * np.sum(parts, axis=0) + 1e-30

    expected = np.log(density(mixtures[1])) - np.log(density(mixtures[0]))
    found = evidence(image, ColourModel(*mixtures))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
