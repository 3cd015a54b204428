"""Crop, mask and intrinsics of the frames: computed correctly, or as the released loader does.

The released loader (`wildghand/data_single.py`, `data_multi.py`) differs in these points:

- It sends the pair of focal lengths through the crop's affine map as if it were a point. A focal
  length scales and does not shift, so its fx and fy are off by the map's translation
  (-scale * corner) and differ from each other.
- It makes the box square in integer arithmetic, which rounds centre and corner down.
- Its affine map puts the pixel centres of the image at integers, while the principal point
  is half the size, which is a half-pixel convention: image and camera differ by up to half
  a pixel of the crop.
- It samples the large frame at single points (bilinear, no low-pass), so crops are aliased.
- It changes the box in the loaded data in place: a frame that is read twice by one process has
  another crop the second time. `official_crop` gives the first.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.importers.official.release_records import OfficialRecords
from hwp_bench.importers.shared.windows import cut, resample

#: A mask pixel above this is hand, as in the released loader.
MASK_THRESHOLD = 100
#: The joints' box is enlarged by this, as where the release has a box.
BOX_SCALE = 1.5


@dataclass(frozen=True, eq=False)
class CroppedFrame:
    """One frame of the capture.

    Attributes:
        image: (S, S, 3) uint8 sRGB.
        mask: (S, S) uint8, 255 = hand.
        K: (3, 3) px of the crop.
        corner: (2,) px of the whole frame, top left corner of the crop.
        side: edge of the crop, px of the whole frame.
    """

    image: np.ndarray
    mask: np.ndarray
    K: np.ndarray
    corner: np.ndarray
    side: float


def crop_frames(
    records: OfficialRecords, size: int, *, compat: bool
) -> tuple[list[CroppedFrame], np.ndarray]:
    """Read and crop every frame of a capture.

    Args:
        records: of the capture.
        size: edge of the crops, px.
        compat: crop as the released loader does.

    Returns:
        The crops, and (F, 2) half the size of the whole frames, px.

    Raises:
        BadInput: an image or a mask is unusable, or a frame has neither a box nor a hand.
    """

    def one(frame: int) -> tuple[CroppedFrame, tuple[float, float]]:
        image = read_rgb(records.images[frame])
        mask = read_gray(records.masks[frame], image.shape[:2])
        box = records.boxes[frame]
        if box is None and compat:
            # The loader then halves the intrinsics and leaves the frame as it is, which no
            # network of 256 px can take.
            raise BadInput(
                "has no bbox_inter, without which the released loader does not crop",
                where=records.images[frame],
                remedy="Import it without --official-compat.",
            )
        if box is None:
            seen = [hand.landmarks[frame] for hand in records.sides.values() if hand.valid[frame]]
            if not seen:
                raise BadInput("has neither a box nor a hand", where=records.images[frame])
            box = box_of_landmarks(np.concatenate(seen))
        crop = official_crop if compat else correct_crop
        height, width = image.shape[:2]
        cropped = crop(image, mask, box, float(records.focal[frame]), size)
        return cropped, (width / 2.0, height / 2.0)

    count = len(records.images)
    with ThreadPoolExecutor(4) as pool, progress("cropping frames", count) as update:
        crops, centres = [], []
        for done, (crop, centre) in enumerate(pool.map(one, range(count)), start=1):
            crops.append(crop)
            centres.append(centre)
            update(done)
    return crops, np.array(centres)


def tracked_joints(
    records: OfficialRecords, sides: tuple[str, ...], crops: list[CroppedFrame], size: int
) -> np.ndarray:
    """Return the tracker's joints in the crops: (F, 21 * sides, 2) px, NaN where not valid."""
    corners = np.array([crop.corner for crop in crops], dtype=np.float64)
    scales = size / np.array([crop.side for crop in crops], dtype=np.float64)
    points = []
    for side in sides:
        hand = records.sides[side]
        moved = (hand.landmarks - corners[:, None]) * scales[:, None, None]
        points.append(np.where(hand.valid[:, None, None], moved, np.nan))
    return np.concatenate(points, axis=1)


def box_of_landmarks(landmarks: np.ndarray) -> np.ndarray:
    """The box that the release's pre-processing makes of joints.

    Args:
        landmarks: (N, 2) px, of all hands.

    Returns:
        (4,) int64 x1, y1, x2, y2: the joints' box, 1.5 times as large about its centre.
    """
    low, high = landmarks.min(axis=0), landmarks.max(axis=0)
    centre, half = (low + high) / 2, (high - low) * BOX_SCALE // 2
    return np.concatenate([centre - half, centre + half]).astype(np.int64)


def correct_crop(
    image: np.ndarray, mask: np.ndarray, box: np.ndarray, focal: float, size: int
) -> CroppedFrame:
    """Cut the smallest square of whole pixels about a box, black outside the image.

    Args:
        image: (H, W, 3) uint8.
        mask: (H, W) uint8 as stored.
        box: (4,) x1, y1, x2, y2, px.
        focal: px of the whole frame; the principal point is its centre.
        size: edge of the crop after resampling (by area), px.
    """
    height, width = image.shape[:2]
    box = np.asarray(box, dtype=np.float64)
    side = int(np.ceil(max(box[2] - box[0], box[3] - box[1], 2.0)))
    corner = np.round((box[:2] + box[2:]) / 2 - side / 2).astype(np.int64)
    scale = size / side
    K = np.array([[focal * scale, 0, 0], [0, focal * scale, 0], [0, 0, 1.0]])
    K[:2, 2] = (np.array([width / 2, height / 2]) - corner) * scale
    binary = np.where(mask > MASK_THRESHOLD, 255, 0).astype(np.uint8)
    return CroppedFrame(
        resample(cut(image, corner, side), size),
        resample(cut(binary, corner, side), size),
        K,
        corner,
        side,
    )


def official_crop(
    image: np.ndarray, mask: np.ndarray, box: np.ndarray, focal: float, size: int
) -> CroppedFrame:
    """Crop as the released loader does; the top of the module lists its mistakes.

    Args:
        (all): as for `correct_crop`; of `box` the type matters, as in the loader.
    """
    import cv2

    height, width = image.shape[:2]
    square = np.array(box)
    square[2:] -= square[:2]
    edge = square[2:].max()
    centre = square[:2] + square[2:] / 2.0
    square[2:] = edge
    square[:2] = centre - edge / 2.0  # integers drop the half
    corner, side = square[:2].astype(np.float64), float(edge)
    scale = size / side
    shift = -scale * corner
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], dtype=np.float32)

    def warp(pixels: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(pixels, matrix, (size, size), flags=cv2.INTER_LINEAR)

    hand = warp((mask > MASK_THRESHOLD).astype(np.uint8)) > 0
    warped = np.round(warp(image.astype(np.float32))).clip(0, 255).astype(np.uint8)
    K = np.eye(3)
    K[0, 0], K[1, 1] = scale * focal + shift
    K[:2, 2] = scale * np.array([width / 2, height / 2]) + shift
    return CroppedFrame(
        np.where(hand[:, :, None], warped, 0).astype(np.uint8),
        np.where(hand, 255, 0).astype(np.uint8),
        K,
        corner,
        side,
    )
