"""Measurements of one frame: its borders, what hides, what differs from the model."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.capture import Cameras, Capture
from hwp_bench.hands import HandParameters, HandTemplate
from hwp_bench.hands.anchors import Footprint
from wildghand.prepass.intensity import HIGHEST, LOWEST, IntensityModel, log_light_table


@dataclass(frozen=True, eq=False)
class PrepassInput:
    """R frames and the estimates that come with them: all that the pre-pass reads."""

    #: (R,) ascending numbers of the frames in `hands` and `cameras`.
    indices: np.ndarray
    #: (R, H, W, 3) uint8 sRGB.
    images: np.ndarray
    #: (R, H, W) uint8, 255 = visible hand.
    masks: np.ndarray
    #: Estimated parameters of every frame, by side.
    hands: Mapping[str, HandParameters]
    #: Cameras of every frame.
    cameras: Cameras
    #: Template of every side.
    templates: Mapping[str, HandTemplate]

    def __post_init__(self) -> None:
        shape = (len(self.indices), *self.images.shape[1:3])
        if self.images.shape != (*shape, 3) or self.masks.shape != shape:
            raise ShapeMismatch(
                f"images {self.images.shape} and masks {self.masks.shape} do not belong to "
                f"{len(self.indices)} frames"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return (self.images.shape[1], self.images.shape[2])

    def shrunk(self, factor: int) -> PrepassInput:
        """The same at `1 / factor` of the resolution, sizes rounded down."""
        height, width = (edge // factor for edge in self.size)
        scale = np.array([[width / self.size[1]], [height / self.size[0]], [1.0]])

        def small(images: np.ndarray) -> np.ndarray:
            return np.stack(
                [cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in images]
            )

        return replace(
            self,
            images=small(self.images),
            masks=small(self.masks),
            cameras=Cameras(self.cameras.Ks * scale, self.cameras.viewmats),
        )


def capture_input(
    capture: Capture, indices: np.ndarray, frames: Iterable[int] | None = None
) -> PrepassInput:
    """Read frames of a capture; its truth is not read.

    Args:
        indices: (R,) ascending, which frames.
    """
    numbers = indices.tolist() if frames is None else frames
    images, masks = zip(*((capture.frame(k), capture.mask(k)) for k in numbers), strict=True)
    return PrepassInput(
        indices=indices,
        images=np.stack(images),
        masks=np.stack(masks),
        hands=capture.hands,
        cameras=capture.cameras,
        templates={side: capture.template(side) for side in capture.info.sides},
    )


# Reach of a profile to either side of the border, share of the image's edge.
_REACH = 0.1
# Step along a profile, px.
_STEP = 0.5
# Least difference between inside and outside, sRGB in [0, 1].
_CONTRAST = 0.12
# Directions are told apart modulo a half turn in so many bins.
_BINS = 6
# Profiles of a frame.
_POINTS = 250
# Profiles that a bin needs.
_LEAST = 6

# Difference of silhouette and mask at a sound border, px.
_SLACK = 1


def border_width(image: np.ndarray, mask: np.ndarray) -> float:
    """Width of the border between hand and background, in its most blurred direction.

    Profiles across the outline of the mask are projected on the difference of the colours at
    their ends and scaled to a range of 1, so that their steepest slope gives the width:
    1 / slope. The outline itself may be off by some pixels. Widths are medians over the profiles
    of similar direction.

    Args:
        image: (H, W, 3) uint8.
        mask: (H, W) bool, visible hand.

    Returns:
        px; NaN where too little of the border can be read.
    """
    reach = max(4.0, _REACH * max(mask.shape))
    points, directions = _outline(mask)
    if len(points) < _LEAST:
        return float("nan")
    steps = np.arange(-reach, reach + 0.5 * _STEP, _STEP)
    places = (points[:, None] + steps[None, :, None] * directions[:, None]).astype(np.float32)
    size = np.array(mask.shape[::-1]) - 1.0
    inside = ((places >= 0.0) & (places <= size)).all(axis=(1, 2))
    places, directions = places[inside], directions[inside]
    if len(places) < _LEAST:
        return float("nan")
    profiles = (
        cv2.remap(
            image,
            np.ascontiguousarray(places[..., 0]),
            np.ascontiguousarray(places[..., 1]),
            cv2.INTER_LINEAR,
        ).astype(np.float32)
        / 255.0
    )
    third = len(steps) // 3
    inner, outer = profiles[:, :third].mean(axis=1), profiles[:, -third:].mean(axis=1)
    clear = np.linalg.norm(inner - outer, axis=1) > _CONTRAST
    if np.count_nonzero(clear) < _LEAST:
        return float("nan")
    # Shutters add up light, so that a streak is a straight ramp in light, not in sRGB.
    profiles = srgb_to_linear(profiles[clear])
    way = profiles[:, :third].mean(axis=1) - profiles[:, -third:].mean(axis=1)
    along = np.einsum("nsk,nk->ns", profiles, way / np.linalg.norm(way, axis=1)[:, None])
    along /= np.maximum(np.ptp(along, axis=1), 1e-6)[:, None]
    # Differences over 2 px: noise counts less, and a sharp border is that wide anyway.
    gap = round(2.0 / _STEP)
    slope = np.abs(along[:, gap:] - along[:, :-gap]).max(axis=1) / (gap * _STEP)
    width = 1.0 / np.maximum(slope, 0.5 / reach)
    angle = np.mod(np.arctan2(directions[clear, 1], directions[clear, 0]), np.pi)
    bins = np.minimum((angle / np.pi * _BINS).astype(np.int64), _BINS - 1)
    medians = [np.median(width[bins == k]) for k in range(_BINS) if (bins == k).sum() >= _LEAST]
    return float(max(medians)) if medians else float(np.median(width))


def misplacement(mask: np.ndarray, silhouette: np.ndarray) -> float:
    """Mean distance by which the mask lies outside the silhouette.

    The mask of a misplaced hand lies outside the silhouette on one side and lacks a part of it on
    the other. An object in front removes pixels from the mask and adds none outside. So only the
    outside tells them apart.

    Args:
        mask: (H, W) bool, visible hand.
        silhouette: (H, W) bool, the estimated hands; not empty.

    Returns:
        Share of the hand's size, the square root of its area. Differences of `_SLACK` px at the
        border are not counted.
    """
    near = _grow(silhouette, _SLACK)
    outside = float(np.count_nonzero(mask & ~near))
    ring = float(np.count_nonzero(near & ~silhouette))
    return outside / max(ring, 1.0) / float(np.sqrt(np.count_nonzero(silhouette)))


def interior(area: np.ndarray, margin: int) -> np.ndarray:
    """(H, W) bool: the pixels of an area that lie more than `margin` px inside; 1 at least."""
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    # The hand continues beyond the border of the image.
    eroded = cv2.erode(area.astype(np.uint8), shape, borderType=cv2.BORDER_REPLICATE)
    return eroded.astype(bool)


def _outline(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels (x, y) on the outline and (N, 2) unit directions outward."""
    solid = mask.astype(np.uint8)
    inward = cv2.distanceTransform(solid, cv2.DIST_L2, 3)
    outward = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 3) - inward
    smooth = cv2.GaussianBlur(outward, (0, 0), 2.0)
    rows, columns = np.nonzero(mask & (outward > -1.5))
    every = max(2, len(rows) // _POINTS)
    rows, columns = rows[::every], columns[::every]
    slope = np.stack(
        [
            cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[rows, columns],
            cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[rows, columns],
        ],
        axis=1,
    )
    length = np.linalg.norm(slope, axis=1)
    sound = length > 1e-3
    points = np.stack([columns, rows], axis=1)[sound].astype(np.float64)
    return points, slope[sound] / length[sound, None]


def _grow(area: np.ndarray, margin: int) -> np.ndarray:
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.dilate(area.astype(np.uint8), shape).astype(bool)


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
    #: `wildghand.prepass.measurements.misplacement`.
    misplacement: float
    #: `wildghand.prepass.measurements.border_width`, px; NaN where it cannot be read.
    border: float
    #: Distance that the hand has moved since the frame before, px.
    motion: float


@dataclass(eq=False)
class DrawnFrame:
    """A frame in which hands are drawn where its parameters place them."""

    #: Of the hands: P pixels.
    footprint: Footprint
    #: (H, W, 3) uint8 sRGB.
    image: np.ndarray
    #: (H, W) uint8, 255 = visible hand.
    mask: np.ndarray

    @property
    def masked(self) -> np.ndarray:
        """(H, W) bool, visible hand."""
        return np.asarray(self.mask > 127)

    @property
    def values(self) -> np.ndarray:
        """(P, 3) uint8 sRGB."""
        return self.image.reshape(-1, 3)[self.footprint.pixels]

    @functools.cached_property
    def inner(self) -> np.ndarray:
        """(P,) bool: the pixels that should show skin in a known place and can be read.

        They lie well inside silhouette and mask, seen from the front, neither dark nor clipped.
        """
        inside = interior(self.footprint.silhouette, _MARGIN) & interior(self.masked, _MARGIN)
        return np.asarray(
            inside.reshape(-1)[self.footprint.pixels]
            & (self.footprint.facing > _FACING)
            & ((self.values >= LOWEST) & (self.values <= HIGHEST)).all(axis=1)
        )

    @functools.cached_property
    def misplacement(self) -> float:
        """See `misplacement`."""
        return misplacement(self.masked, self.footprint.silhouette)

    @functools.cached_property
    def border(self) -> float:
        """See `border_width`."""
        return border_width(self.image, self.masked)


def shown_cells(frames: Iterable[DrawnFrame], cell_count: int) -> np.ndarray:
    """(C,) bool: the cells that masks have in most frames in which the silhouette has them.

    A cell that no mask shows (the wrist inside a sleeve) does not count as hidden.
    """
    drawn, shown = np.zeros(cell_count, dtype=np.int64), np.zeros(cell_count, dtype=np.int64)
    for frame in frames:
        cells = frame.footprint.cells
        drawn += np.bincount(cells, minlength=cell_count)
        masked = frame.masked.reshape(-1)[frame.footprint.pixels]
        shown += np.bincount(cells[masked], minlength=cell_count)
    return np.asarray(2 * shown > drawn)


def measure_frame(model: IntensityModel, frame: DrawnFrame, shown: np.ndarray) -> FrameMeasurements:
    """Compare a frame with the intensity model; `shown` is that of `shown_cells`."""
    table, footprint, inner = log_light_table(), frame.footprint, frame.inner
    light = table[frame.values]
    beyond = np.flatnonzero((frame.mask > 0) & ~footprint.silhouette)
    known_cells = shown[footprint.cells]
    lacking = known_cells & ~frame.masked.reshape(-1)[footprint.pixels]

    expected = model.predict(footprint.cells, footprint.normals)
    rest = light - expected
    gain = _agreed_gain(rest[inner], 2.5 * model.scale)
    residual = channel_mean(np.abs(rest - gain.astype(np.float32)))
    skin = model.skin[footprint.cells]
    tint = _tint(light - skin - gain)
    colours = table[frame.image.reshape(-1, 3)[beyond]] - gain
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
        hidden=int(np.count_nonzero(lacking)) / max(int(np.count_nonzero(known_cells)), 1),
        misplacement=frame.misplacement,
        border=frame.border,
        motion=footprint.motion,
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
