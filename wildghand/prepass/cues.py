"""What one frame shows against what the intensity model expects of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from wildghand.prepass.footprint import Footprint
from wildghand.prepass.intensity import IntensityModel

# Standard deviations of the two blurs whose difference is texture, px.
_FINE, _COARSE = 0.8, 3.0
#: Pixels below which a frame says nothing.
LEAST_PIXELS = 20
# Passes of the vote for a gain, and pixels that vote.
_PASSES = 5
_VOTERS = 1500


@dataclass(frozen=True, eq=False)
class Explained:
    """One frame under the intensity model; P pixels of the silhouette."""

    #: (P,) float32 mean absolute residual of the channels, log.
    residual: np.ndarray
    #: (P,) float32 how far the pixel's tint is from the skin's, log: its brightness is left out.
    tint: np.ndarray
    #: (B,) float32 the same of pixels that the mask has and the silhouette lacks.
    tint_beyond: np.ndarray
    #: (3,) gain that most pixels agree on, log of linear light.
    gain: np.ndarray
    #: Median residual of the inner pixels.
    level: float
    #: Share of the expected fine structure that the frame shows, about 1 in a sharp frame whose
    #: hand is where it should be; not a number where nothing can be compared.
    texture: float


def explain(
    model: IntensityModel,
    footprint: Footprint,
    light: np.ndarray,
    inner: np.ndarray,
    beyond: np.ndarray,
) -> Explained:
    """Compare a frame with the intensity model.

    Args:
        model: fitted to all frames.
        footprint: what its P pixels show.
        light: (P, 3) log light.
        inner: (P,) bool, at least one: the pixels that lie well inside hand and mask and are
            neither dark nor clipped.
        beyond: (B, 3) log light of pixels that the mask has and the silhouette lacks.
    """
    expected = model.predict(footprint.cells, footprint.normals)
    rest = light - expected
    gain = _agreed_gain(rest[inner], 2.5 * model.scale)
    residual = channel_mean(np.abs(rest - gain.astype(np.float32)))
    skin = model.skin[footprint.cells]
    return Explained(
        residual=residual,
        tint=_tint(light - skin - gain),
        tint_beyond=_tint(beyond - np.median(skin, axis=0) - gain),
        gain=gain,
        level=float(np.median(residual[inner])),
        texture=_texture(
            channel_mean(light[inner]),
            channel_mean(expected[inner]),
            footprint.pixels[inner],
            footprint.silhouette.shape,
        ),
    )


def channel_mean(values: np.ndarray) -> np.ndarray:
    """(P,) mean of the three channels of (P, 3); several times faster than over an axis."""
    return (values[:, 0] + values[:, 1] + values[:, 2]) / 3.0


def _tint(values: np.ndarray) -> np.ndarray:
    """(P,) length of what (P, 3) log values have besides their mean."""
    return np.linalg.norm(values - channel_mean(values)[:, None], axis=1).astype(np.float32)


def _agreed_gain(rest: np.ndarray, reach: float) -> np.ndarray:
    """The gain that most pixels agree on; no gain at all wins a tie.

    Where something covers most of the hand, the median is its colour and no gain.
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
