"""One frame, every metric of the chosen protocols, in one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadImage, BadInput, BadPrediction, ShapeMismatch
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics.oriented_distance import oriented_distance
from hwp_bench.metrics.pixels import (
    Box,
    bounding_box,
    check_prediction,
    check_truth,
    composite,
    crop,
    hand_pixels,
    scored_pixels,
)
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND, PROTOCOLS, Protocol
from hwp_bench.metrics.psnr_ssim import decibels, squared_error, ssim_box, ssim_map

#: A distance of two (H, W, 3) float images in [0, 1]; `hwp_bench.metrics.lpips.Lpips` is one.
Network = Callable[[np.ndarray, np.ndarray], float]
#: Largest value of a float image: renderings overshoot 1, and one in 0 to 255 is a mistake.
FLOAT_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class _Pair:
    """Shared by the protocols: a checked pair of images and the error between them."""

    #: (H, W, 3) uint8.
    prediction: np.ndarray
    #: (H, W, 3) uint8.
    target: np.ndarray
    #: (H, W) bool, the hand with its mixed border pixels.
    hand: np.ndarray
    #: (H, W) bool, the pixels that the hand covers fully.
    covered: np.ndarray
    #: (H, W) float64, squared error in units of 1, mean over channels; 0 outside `hand`.
    error: np.ndarray


def score_frame(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    protocols: Iterable[Protocol] = PROTOCOLS,
    *,
    coverage: bool = False,
    networks: Mapping[str, Network] | None = None,
) -> dict[str, float]:
    """Score one predicted frame.

    Pixels outside the mask never matter, in either image.

    Args:
        prediction: (H, W, 3) uint8, or float in [0, 1], sRGB. A float image is scored as the 8 bits
            that it has on disk: clipped, rounded half to even.
        target: (H, W, 3) like `prediction`.
        mask: (H, W) uint8 (above 127 is hand) or bool, the data set's own visible-hand mask.
        protocols: which protocols to score in.
        coverage: True where `mask` holds the share of each pixel that the hand covers
            (255 = all); see `region.scored_pixels`.
        networks: LPIPS by backbone name ("alex", "vgg"); metrics of an absent one are absent.

    Returns:
        metric name -> score, the names of `table.metric_names(protocols, networks)`.

    Raises:
        BadImage: target or mask have the wrong type, or the target has values that an image
            cannot have.
        BadPrediction: the same of the prediction.
        ShapeMismatch: the three do not describe the same image, or it is smaller than the
            window of SSIM.
        EmptyMask: no pixel to score; this depends on mask and protocol only, never on the
            prediction, so it is the same for every method.
    """
    target = _eight_bits(target, "target", BadImage)
    check_truth(target, mask)
    chosen = tuple(protocols)
    hand = hand_pixels(mask)
    covered = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    bounding_box(covered if HWP_V1 in chosen else hand)
    prediction = _eight_bits(prediction, "prediction", BadPrediction)
    check_prediction(prediction, target)

    unit = 1.0 / 255.0**2
    error = squared_error(composite(prediction, hand), composite(target, hand)) * unit
    pair = _Pair(prediction, target, hand, covered, error)
    scores: dict[str, float] = {}
    for protocol in chosen:
        scores |= _SCORERS[protocol.name](pair, protocol, networks or {})
    return scores


def _eight_bits(image: np.ndarray, field: str, error: type[BadInput]) -> np.ndarray:
    """The image as uint8; float images are converted, and an impossible one is refused by name."""
    if not np.issubdtype(image.dtype, np.floating):
        return image
    try:
        pixels = as_uint8(image)
    except BadImage as found:
        raise error(f"the {field} cannot be scored: {found.problem}", field=field) from found
    if image.size and image.max() > FLOAT_LIMIT:
        raise error(
            f"the {field} is a float image with values up to {image.max():.4g}",
            field=field,
            remedy="A float image has values from 0 to 1; divide one of 0 to 255 by 255.",
        )
    return pixels


def _score_hwp_v1(
    pair: _Pair, protocol: Protocol, networks: Mapping[str, Network]
) -> dict[str, float]:
    """The headline protocol, on the pixels that the hand covers fully."""
    region, cap, radius = pair.covered, protocol.psnr_cap, protocol.ssim.radius
    box = bounding_box(region).grown(protocol.box_padding).at_least(protocol.smallest_box)
    total, count = float(pair.error[region].sum()), int(np.count_nonzero(region))

    wide = box.grown(radius)
    wide_region = crop(region, wide)
    x, y = (_on_black(image, wide, wide_region) for image in (pair.prediction, pair.target))
    similarity = ssim_map(x, y, protocol.ssim)
    scores = {
        "psnr": decibels(total / count, cap),
        "ssim": float(similarity[crop(region, box)].mean()),
        "oriented_distance": oriented_distance(x, y, wide_region, protocol.box_padding),
        "psnr_full": decibels(total / region.size, cap),
        "psnr_box": decibels(total / box.area, cap),
        "psnr_edge": decibels(float(pair.error[pair.hand].mean()), cap),
        "ssim_full": _whole_frame_mean(similarity, box, region.shape, radius),
    }
    for name, network in networks.items():
        scores[f"lpips_{name}"] = _lpips(pair, region, box, protocol, network)
    return scores


def _score_paper_wildghand(
    pair: _Pair, protocol: Protocol, networks: Mapping[str, Network]
) -> dict[str, float]:
    """The released evaluator's settings, on the data set's mask."""
    box = bounding_box(pair.hand).grown(protocol.box_padding).at_least(protocol.smallest_box)
    region = crop(pair.hand, box)
    x, y = (_on_black(image, box, region) for image in (pair.prediction, pair.target))
    scores = {
        "paper_psnr": decibels(float(pair.error.sum()) / pair.error.size, protocol.psnr_cap),
        "paper_ssim": ssim_box(x, y, region, protocol.ssim),
    }
    if "alex" in networks:
        scores["paper_lpips"] = _lpips(pair, pair.hand, box, protocol, networks["alex"])
    return scores


_SCORERS = {
    HWP_V1.name: _score_hwp_v1,
    PAPER_WILDGHAND.name: _score_paper_wildghand,
}


def _on_black(image: np.ndarray, box: Box, region: np.ndarray) -> np.ndarray:
    """The box of an 8-bit image as float64 in [0, 1], black outside `region` (of the box)."""
    return composite(crop(image, box), region) / 255.0


def _whole_frame_mean(
    similarity: np.ndarray, box: Box, shape: tuple[int, ...], radius: int
) -> float:
    """The mean SSIM over all windows of a frame from the map of the box.

    Windows centred outside the box see black in both images and count exactly 1.
    """
    rows, columns = shape[0] - 2 * radius, shape[1] - 2 * radius
    if min(rows, columns) < 1:
        raise ShapeMismatch(f"an image of {shape[:2]} is smaller than the window of SSIM")
    top, left = max(0, radius - box.top), max(0, radius - box.left)
    inside = similarity[top : shape[0] - radius - box.top, left : shape[1] - radius - box.left]
    return float((inside.sum() + (rows * columns - inside.size)) / (rows * columns))


def _lpips(
    pair: _Pair, region: np.ndarray, box: Box, protocol: Protocol, network: Network
) -> float:
    """LPIPS of the box, grown to what the network's strides need."""
    box = box.at_least(protocol.smallest_lpips_box)
    inside = crop(region, box)
    return network(_on_black(pair.prediction, box, inside), _on_black(pair.target, box, inside))
