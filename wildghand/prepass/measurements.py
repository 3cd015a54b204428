"""The measurements of one frame: how it differs from what the intensity model expects of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.hands.anchors import Footprint
from wildghand.prepass.borders import ShownCells, interior
from wildghand.prepass.intensity import HIGHEST, LOWEST, IntensityModel, log_light_table

#: A frame with fewer readable pixels of the hand cannot be judged.
LEAST_PIXELS = 20
# Margin inside mask and silhouette that is left out, px.
_MARGIN = 2
# Least cosine between normal and viewing direction of a pixel that is fitted.
_FACING = 0.25
# Standard deviations of the two blurs whose difference is texture, px.
_FINE, _COARSE = 0.8, 3.0
# Passes of the vote for a gain, and pixels that vote.
_PASSES = 5
_VOTERS = 1500


@dataclass(frozen=True, eq=False)
class FrameMeasurements:
    """The measurements of one usable frame; P pixels of the silhouette, B of the mask beyond it."""

    #: (P,) int32 row-major numbers of the silhouette's pixels.
    pixels: np.ndarray
    #: (P,) int32 cells that these pixels show.
    cells: np.ndarray
    #: (P,) float32 mean absolute residual of the channels under the intensity model, log.
    residual: np.ndarray
    #: (P,) float32 distance of the pixel's tint from the skin's, log; brightness does not count.
    tint: np.ndarray
    #: (B,) int32 row-major numbers of the pixels that the mask has and the silhouette lacks.
    beyond: np.ndarray
    #: (B,) float32 distance of their tint from the skin's, log.
    tint_beyond: np.ndarray
    #: (3,) gain that most pixels agree on, log of linear light.
    gain: np.ndarray
    #: Median residual of the inner pixels.
    level: float
    #: Share of the expected fine structure that the frame shows, about 1 in a sharp frame whose
    #: hand is where it should be; NaN where nothing can be compared.
    texture: float
    #: Share of the hand that the mask lacks.
    hidden: float
    #: `wildghand.prepass.borders.misplacement`.
    misplacement: float
    #: `wildghand.prepass.borders.border_width`, px; NaN where it cannot be read.
    border: float
    #: Distance that the hand has moved since the frame before, px.
    motion: float


def measure_frame(
    model: IntensityModel,
    footprint: Footprint,
    image: np.ndarray,
    mask: np.ndarray,
    *,
    shown: ShownCells,
    misplacement: float,
    border: float,
    motion: float,
) -> FrameMeasurements:
    """Compare a frame with the intensity model.

    Args:
        model: fitted to all frames.
        footprint: what the silhouette's pixels show; at least one of them is inner.
        image: (H, W, 3) uint8 sRGB.
        mask: (H, W) uint8, 255 = visible hand.
        shown: the cells that the masks of all frames show.
        misplacement: of this frame.
        border: width of its border, px.
        motion: since the frame before, px.
    """
    table = log_light_table()
    values = image.reshape(-1, 3)[footprint.pixels]
    light, masked = table[values], mask > 127
    inner = inner_pixels(footprint, masked, values)
    beyond = np.flatnonzero((mask > 0) & ~footprint.silhouette)

    expected = model.predict(footprint.cells, footprint.normals)
    rest = light - expected
    gain = _agreed_gain(rest[inner], 2.5 * model.scale)
    residual = channel_mean(np.abs(rest - gain.astype(np.float32)))
    skin = model.skin[footprint.cells]
    tint = _tint(light - skin - gain)
    colours = table[image.reshape(-1, 3)[beyond]] - gain
    tint_beyond = _tint(colours - np.median(skin, axis=0))
    if model.second is not None:
        # A place that no clean frame shows has one of the hand's colours, and nobody knows which.
        tint = np.minimum(tint, _tint(light - model.second - gain))
        tint_beyond = np.minimum(tint_beyond, _tint(colours - model.second))
        shade = expected - model.albedo[footprint.cells]
        other = channel_mean(np.abs(light - shade - model.second - gain)).astype(np.float32)
        known = model.known[footprint.cells]
        residual = np.where(known, residual, np.minimum(residual, other))
    return FrameMeasurements(
        pixels=footprint.pixels,
        cells=footprint.cells,
        residual=residual,
        tint=tint,
        beyond=beyond.astype(np.int32),
        tint_beyond=tint_beyond,
        gain=gain,
        level=float(np.median(residual[inner])),
        texture=_texture(
            channel_mean(light[inner]),
            channel_mean(expected[inner]),
            footprint.pixels[inner],
            footprint.silhouette.shape,
        ),
        hidden=shown.hidden_share(footprint.cells, masked.reshape(-1)[footprint.pixels]),
        misplacement=misplacement,
        border=border,
        motion=motion,
    )


def inner_pixels(footprint: Footprint, masked: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The pixels that should show skin in a known place and can be read.

    Args:
        footprint: with P pixels.
        masked: (H, W) bool, visible hand.
        values: (P, 3) uint8 sRGB.

    Returns:
        (P,) bool: well inside silhouette and mask, seen from the front, neither dark nor clipped.
    """
    inside = interior(footprint.silhouette, _MARGIN) & interior(masked, _MARGIN)
    return (
        inside.reshape(-1)[footprint.pixels]
        & (footprint.facing > _FACING)
        & ((values >= LOWEST) & (values <= HIGHEST)).all(axis=1)
    )


def channel_mean(values: np.ndarray) -> np.ndarray:
    """(P,) mean of the three channels of (P, 3); several times faster than over an axis."""
    return (values[:, 0] + values[:, 1] + values[:, 2]) / 3.0


def _tint(values: np.ndarray) -> np.ndarray:
    """(P,) length of (P, 3) log values after their mean is taken away."""
    return np.linalg.norm(values - channel_mean(values)[:, None], axis=1).astype(np.float32)


def _agreed_gain(rest: np.ndarray, reach: float) -> np.ndarray:
    """The gain that most pixels agree on; a gain of 0 wins a tie.

    Where something covers most of the hand, the median is the colour of that thing, not a gain.
    """
    rest = rest[:: max(1, len(rest) // _VOTERS)]
    best, votes = np.zeros(3), -1.0
    for start in (np.zeros(3), np.median(rest, axis=0)):
        gain = start
        for _ in range(_PASSES):
            weights = 1.0 / (1.0 + (channel_mean(np.abs(rest - gain)) / reach) ** 4)
            gain = (weights[:, None] * rest).sum(axis=0) / max(float(weights.sum()), 1e-9)
        if weights.sum() > votes:
            best, votes = gain, float(weights.sum())
    return best


def _texture(
    shown: np.ndarray, expected: np.ndarray, pixels: np.ndarray, size: tuple[int, ...]
) -> float:
    """Slope of the shown fine structure on the expected one, which noise does not change."""
    planes = np.zeros((size[0] * size[1], 3), dtype=np.float32)
    planes[pixels] = np.column_stack([shown, expected, np.ones(len(shown))])
    image = planes.reshape(size[0], size[1], 3)
    fine = cv2.GaussianBlur(image, (0, 0), _FINE).reshape(-1, 3)[pixels]
    coarse = cv2.GaussianBlur(image, (0, 0), _COARSE).reshape(-1, 3)[pixels]
    detail = fine[:, :2] / fine[:, 2:] - coarse[:, :2] / coarse[:, 2:]
    power = float((detail[:, 1] ** 2).sum())
    return float((detail[:, 0] * detail[:, 1]).sum() / power) if power > 1e-6 else float("nan")
