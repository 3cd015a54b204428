"""Whether tracked landmarks follow the convention that the import reads them by, and belong to it.

Landmarks of another convention are numbers like all others: a fit to them runs for minutes and
follows no frame. Three things tell beforehand. The joints of a hand are near each other along its
fingers, in one order only. Its landmarks in the image look like its landmarks in space, seen from
the front. And skin has other colours than what is around it, so that landmarks that lie on a hand
separate the colours on them from those around them better than any that lie elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput
from hwp_bench.importers.shared.hand_tracks import read_hand_tracks
from hwp_bench.importers.shared.landmarks import LANDMARK_EDGES, Landmarks
from hwp_bench.importers.video.decode import read_frames
from hwp_bench.importers.video.source import VideoSource
from hwp_bench.importers.video.video_settings import FrameRange

#: A fit that follows the landmarks in a smaller share of the frames than this has failed.
LEAST_FITTED = 0.1
#: One that follows them in a smaller share than this is warned of.
FEW_FITTED = 0.5
#: So is a smaller mean overlap of mesh and mask; sound clips have 0.9 and more.
LOW_OVERLAP = 0.85
#: What landmarks must be, for messages.
CONVENTION = (
    "Landmarks are 21 joints in MediaPipe's order, one row for each frame of this video; `image` "
    "in px of the whole frame, x to the right and y down; `world` in m, the same axes, z away "
    "from the camera."
)

#: Other orders of the 21 joints: for each of ours, the row that holds it there.
_ORDERS = {
    # Wrist, index, middle, little, ring finger and thumb with three joints each, then the tips.
    "MANO's order": (*(0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20),),
    # Each finger from its tip to its base, the wrist last.
    "InterHand2.6M's order": (
        *(20, 3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12, 19, 18, 17, 16),
    ),
}
# Another order is believed if it makes the hand's bones together shorter than this share of what
# ours makes them.
_SHORTER = 0.8
# Landmarks in space, seen from the front, as the image may have them: what multiplies x and y.
_AXES = {
    "x and y of {} are exchanged": ((0, 1), (1, 0)),
    "y of {} points up": ((1, 0), (0, -1)),
    "{} is mirrored": ((-1, 0), (0, 1)),
    "{} is turned by 180 degrees": ((-1, 0), (0, -1)),
    "{} is turned by a quarter": ((0, -1), (1, 0)),
    "{} is turned by a quarter, the other way": ((0, 1), (-1, 0)),
}
# Correlation of landmarks in the image with those in space. Of sound ones it is 0.9 and more.
_ALIKE, _UNLIKE = 0.8, 0.5
# `world` is `image` over the image's size if both differ by less than this share of the hand.
_EQUAL = 0.003
# Frames whose colours are looked at.
_LOOKED_AT = 12
# Edge of the image that a hand is reduced to for that, px: its noise goes, its fingers stay.
_HAND_EDGE = 80.0
# Frames by which landmarks may come late or early.
_SHIFTS = (1, 2, 3, 4, 6, 8, 10, 12, 15)
# Landmarks lie elsewhere for certain if colours are then separated this well, with this share of
# the errors, and better by this much (those of the next frame lie almost as well).
_SEPARATED, _ERRORS, _BETTER, _BETTER_SHIFT = 0.85, 0.5, 0.1, 0.015
# Places along each bone, and edges of the grid around the hand.
_ALONG, _AROUND = 5, 24
_PALM = ((0, 9), (0, 13), (1, 5), (5, 9), (9, 13), (13, 17))
_BONES = np.array([*LANDMARK_EDGES, *_PALM])

_Move = Callable[[np.ndarray], np.ndarray]


def refuse_other_units(source: VideoSource) -> None:
    """Refuse landmarks that are of another size of this video, or not in space at all.

    Raises:
        BadInput: the tracker saw frames of another size; or `world` holds the landmarks in the
            image, divided by its size.
    """
    width, height = source.video.width, source.video.height
    tracks = read_hand_tracks(source.landmarks_path)
    if tracks is not None and tracks.size != (width, height):
        raise BadInput(
            f"was tracked at {tracks.size[0]}x{tracks.size[1]}, the video is {width}x{height}",
            where=source.landmarks_path,
            field="size",
            remedy="Track exactly this video.",
        )
    for landmarks in source.hands.values():
        image = landmarks.image[landmarks.detected] / (width, height)
        world = landmarks.world[landmarks.detected][:, :, :2]
        apart = _centred(image) - _centred(world)
        if np.abs(apart).max() < _EQUAL * np.ptp(world, axis=1).max():
            raise BadInput(
                "holds `image` divided by the image's size: normalised landmarks, not metres",
                where=source.landmarks_path,
                field="world",
                remedy="Use the tracker's world landmarks (MediaPipe: hand_world_landmarks).",
            )


def landmark_doubts(source: VideoSource) -> tuple[str, ...]:
    """Say what the numbers and the pictures tell against landmarks; nothing if all is well."""
    found: list[str] = []
    for landmarks in source.hands.values():
        order = doubts_of_order(landmarks)
        place, lies_well = ([], False) if order else _doubts_of_pictures(source, landmarks)
        # Where the image's are in place, those in space are wrong.
        axes = doubts_of_axes(landmarks, "`world`" if lies_well else "`image` or `world`")
        found += order or place or axes
    return tuple(dict.fromkeys(found))


def doubts_of_order(landmarks: Landmarks) -> list[str]:
    """Say which order of joints makes a hand's bones shorter than ours makes them."""
    found: dict[str, list[str]] = {}
    for name in ("image", "world"):
        points = getattr(landmarks, name)[landmarks.detected]
        lengths = {order: _length(points[:, list(rows)]) for order, rows in _ORDERS.items()}
        order = min(lengths, key=lambda one: lengths[one])
        if lengths[order] < _SHORTER * _length(points):
            found.setdefault(order, []).append(f"`{name}`")
    return [
        f"the joints of {' and '.join(names)} are in {order}, not in MediaPipe's"
        for order, names in found.items()
    ]


def doubts_of_axes(landmarks: Landmarks, which: str = "`image` or `world`") -> list[str]:
    """Say how the axes of the image differ from those of space, and in `which` array."""
    image = _centred(landmarks.image[landmarks.detected])
    world = _centred(landmarks.world[landmarks.detected][:, :, :2])
    image, world = (
        each / np.maximum(np.sqrt((each**2).sum(axis=(1, 2), keepdims=True)), 1e-12)
        for each in (image, world)
    )

    def alike(axes: Sequence[Sequence[float]]) -> float:
        return float((image * (world @ np.array(axes, float).T)).sum(axis=(1, 2)).mean())

    as_given = alike(((1, 0), (0, 1)))
    scores = {name: alike(axes) for name, axes in _AXES.items()}
    best = max(scores, key=lambda name: scores[name])
    if as_given < _UNLIKE and scores[best] > max(_ALIKE, as_given):
        return [best.format(which)]
    if as_given < _UNLIKE:
        return ["`image` and `world` do not show the same hand in the same frames"]
    return []


def _doubts_of_pictures(source: VideoSource, landmarks: Landmarks) -> tuple[list[str], bool]:
    """Say where a hand's landmarks would lie on it, and whether that is where they are."""
    width, height = source.video.width, source.video.height
    places: dict[str, _Move] = {
        "x and y of `image` are exchanged": lambda p: p[..., ::-1],
        "y of `image` points up": lambda p: p * (1, -1) + (0, height),
        "`image` is mirrored": lambda p: p * (-1, 1) + (width, 0),
        "`image` is turned by 180 degrees": lambda p: p * (-1, -1) + (width, height),
        "`image` is of a video of half this size": lambda p: 2.0 * p,
        "`image` is of a video of twice this size": lambda p: 0.5 * p,
        "`image` is of a video of two thirds of this size": lambda p: 1.5 * p,
        "`image` is of a video of one and a half times this size": lambda p: p / 1.5,
    }
    rows, pictures = _pictures(source, landmarks)
    points = landmarks.image[rows]
    as_given = _separation(pictures, points)
    moved = {name: _separation(pictures, move(points)) for name, move in places.items()}
    best = max(moved, key=lambda name: moved[name])
    if _clearly(moved[best], as_given, _BETTER):
        return [best], False
    late = {
        shift * sign: _separation_of_frames(pictures, landmarks, rows, shift * sign)
        for shift in _SHIFTS
        for sign in (1, -1)
    }
    shift = max(late, key=lambda one: late[one])
    if _clearly(late[shift], as_given, _BETTER_SHIFT):
        frames = abs(shift) * int(np.diff(source.indices).min())
        when = "late" if shift > 0 else "early"
        return [f"the landmarks come about {frames} frames too {when}"], False
    return [], as_given > _SEPARATED


def _clearly(better: float, as_given: float, least: float) -> bool:
    errors = 1.0 - better < _ERRORS * (1.0 - as_given)
    return errors and better > _SEPARATED and better - as_given > least


def _pictures(source: VideoSource, landmarks: Landmarks) -> tuple[list[int], list[np.ndarray]]:
    """Some frames in which a hand is seen, reduced, as (rows, pictures of floats in Lab)."""
    import cv2

    seen = np.flatnonzero(landmarks.detected)
    chosen = [int(row) for row in seen[evenly(len(seen), _LOOKED_AT)]]
    numbers = {int(source.indices[row]): row for row in chosen}
    extent = np.median(np.ptp(landmarks.image[seen], axis=1).max(axis=1))
    blur = max(float(extent) / _HAND_EDGE, 0.5)
    rows, pictures = [], []
    first, last = min(numbers), max(numbers)
    for number, image in read_frames(source.video, FrameRange(first, last + 1)):
        if number in numbers:
            soft = cv2.GaussianBlur(image, (0, 0), blur)
            rows.append(numbers[number])
            pictures.append(cv2.cvtColor(soft, cv2.COLOR_RGB2LAB))
    return rows, pictures


def _separation_of_frames(
    pictures: Sequence[np.ndarray], landmarks: Landmarks, rows: Sequence[int], shift: int
) -> float:
    """Separation by the landmarks of later (or earlier) frames; 0 where too few are seen."""
    other = np.array(rows) + shift
    good = (other >= 0) & (other < len(landmarks.detected))
    good[good] &= landmarks.detected[other[good]]
    if good.sum() < max(len(rows) // 2, 3):
        return 0.0
    used = [picture for picture, one in zip(pictures, good, strict=True) if one]
    return _separation(used, landmarks.image[other[good]])


def _separation(pictures: Sequence[np.ndarray], points: np.ndarray) -> float:
    """How well a line through colours tells those on the landmarks from those around them.

    Args:
        pictures: (H, W, 3) uint8 each.
        points: (F, 21, 2) px.

    Returns:
        Mean probability over the frames that a colour on the hand lies on its side of one around
        it: 0.5 by chance, 1 where all do.
    """
    found = []
    for picture, hand in zip(pictures, points, strict=True):
        along = np.linspace(0.0, 1.0, _ALONG)[:, None, None]
        on = (hand[_BONES[:, 0]] * (1.0 - along) + hand[_BONES[:, 1]] * along).reshape(-1, 2)
        size = np.ptp(hand, axis=0).max()
        sides = [
            np.linspace(hand[:, axis].min() - 0.45 * size, hand[:, axis].max() + 0.45 * size, n)
            for axis, n in ((0, _AROUND), (1, _AROUND))
        ]
        grid = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        apart = np.linalg.norm(grid[:, None] - on[None], axis=-1).min(axis=1)
        hand_colors, share = _colors(picture, on)
        others, _ = _colors(picture, grid[apart > 0.18 * size])
        if share < 0.5 or min(len(hand_colors), len(others)) < 20:
            found.append(0.5)
            continue
        spread = (np.cov(hand_colors.T) + np.cov(others.T)) / 2 + 25.0 * np.eye(3)
        way = np.linalg.solve(spread, hand_colors.mean(axis=0) - others.mean(axis=0))
        told = (hand_colors @ way)[:, None] > (others @ way)[None]
        found.append(share * float(told.mean()) + (1.0 - share) * 0.5)
    return float(np.mean(found))


def _colors(picture: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float]:
    """Colours at points inside of a picture, and the share of points that are."""
    height, width = picture.shape[:2]
    x, y = np.floor(points).clip(-1, 1e6).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return picture[y[inside], x[inside]].astype(np.float64), inside.sum() / max(len(inside), 1)


def _length(points: np.ndarray) -> float:
    """Mean length of all bones together."""
    bones = np.array(LANDMARK_EDGES)
    apart = points[:, bones[:, 0]] - points[:, bones[:, 1]]
    return float(np.linalg.norm(apart, axis=-1).sum(axis=1).mean())


def _centred(points: np.ndarray) -> np.ndarray:
    return np.asarray(points - points.mean(axis=1, keepdims=True))


def refuse_unfitted(
    fitted: Mapping[str, np.ndarray], source: VideoSource, doubts: Sequence[str]
) -> None:
    """Refuse a fit that follows (nearly) no frame of a hand.

    Args:
        fitted: (F,) bool by side, frames in which the hand model follows the landmarks.
        source: the inputs.
        doubts: what tells against the landmarks.

    Raises:
        BadInput: nothing or nearly nothing of a hand is fitted; with what is likely wrong.
    """
    for side, good in fitted.items():
        seen = source.hands[side].detected
        count, total = int((good & seen).sum()), int(seen.sum())
        if count >= max(LEAST_FITTED * total, 1):
            continue
        likely = f"; it seems that {'; '.join(doubts)}" if doubts else ""
        others = [other for other in fitted if other != side]
        alone = f" Or import the other hand alone: --side {others[0]}." if others else ""
        raise BadInput(
            f"no {side} hand can follow these landmarks: the hand model does in {count} of {total} "
            f"frames{likely}",
            where=source.landmarks_path,
            remedy=CONVENTION + alone,
        )


def fit_warnings(fitted: Mapping[str, np.ndarray], seen: Mapping[str, np.ndarray]) -> list[str]:
    """Say of which hands few frames are fitted.

    Args:
        fitted: (F,) bool by side, frames in which the hand model follows the landmarks.
        seen: (F,) bool by side, frames in which the hand is detected.
    """
    return [
        f"the {side} hand is fitted in {int(good.sum())} of the {int(seen[side].sum())} frames "
        "that show it"
        for side, good in fitted.items()
        if good.sum() < FEW_FITTED * seen[side].sum()
    ]


def overlap_warning(overlap: float) -> list[str]:
    """Say that meshes and masks do not lie on each other, where that is so."""
    if overlap >= LOW_OVERLAP:
        return []
    return [f"the overlap of mesh and mask is {overlap:.2f}, of a sound clip 0.9 and more"]
