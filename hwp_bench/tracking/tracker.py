"""Follows up to two hands from frame to frame.

A hand that was seen in the last frame is looked for around the place where it was; palms are
searched only while fewer hands are followed than may be there. Source: MediaPipe's graph
`hand_landmark_tracking_cpu`. Two tracks that end on one hand are made one here, which only the
newer Tasks of MediaPipe do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.tracking.hand_landmarks import HAND_EDGE, SeenHand, place_reading
from hwp_bench.tracking.networks import HandNetworks
from hwp_bench.tracking.palms import decode, palm_input, place_in_image, suppress
from hwp_bench.tracking.regions import Region, cut_region, overlap

#: Two regions with more overlap than this show one hand.
_SAME_REGION = 0.5
#: Two hands are one if their landmarks differ by less than this share of their size, on average.
_SAME_HAND = 0.2


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the tracker; the defaults are MediaPipe's."""

    #: Most hands in a frame, 1 or 2.
    hands: int = 2
    #: Palms below this score are left out.
    min_palm_score: float = 0.5
    #: Hands below this presence are lost.
    min_presence: float = 0.5

    def __post_init__(self) -> None:
        if self.hands not in (1, 2):
            raise UsageError(f"is {self.hands}", field="hands", remedy="Use 1 or 2.")
        for name in ("min_palm_score", "min_presence"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise UsageError(f"is {value}", field=name, remedy="Use a number between 0 and 1.")


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """A hand in a frame.

    Attributes:
        track: number of the track, a stretch of frames without a gap; counts from 0.
        hand: what was seen.
    """

    track: int
    hand: SeenHand


class HandTracker:
    """Follows hands through consecutive frames.

    Args:
        networks: find palms and landmarks.
        settings: thresholds.
    """

    def __init__(self, networks: HandNetworks, settings: TrackerSettings | None = None) -> None:
        self._networks = networks
        self._settings = settings or TrackerSettings()
        self._followed: list[TrackedHand] = []
        self._tracks = 0

    def step(self, frame: np.ndarray) -> list[TrackedHand]:
        """Find the hands of the next frame, (H, W, 3) uint8 RGB.

        Returns:
            At most `hands` of them. A hand that was seen in the last frame keeps its track.
        """
        seen: list[tuple[TrackedHand, float]] = []
        for region, before in self._regions(frame):
            image = cut_region(frame, region, HAND_EDGE, outside_black=False)
            reading = self._networks.hand(image)
            values = (reading.presence, reading.right)
            if not np.isfinite(values).all() or reading.presence < self._settings.min_presence:
                continue
            hand = place_reading(reading, region)
            if not (np.isfinite(hand.image).all() and np.isfinite(hand.world).all()):
                continue
            moved = np.inf if before is None else _distance(hand, before.hand)
            track = -1 if before is None else before.track
            seen.append((TrackedHand(track, hand), moved))
        found = _without_doubles(seen)[: self._settings.hands]
        self._followed = [self._numbered(hand) for hand in found]
        return list(self._followed)

    def _regions(self, frame: np.ndarray) -> list[tuple[Region, TrackedHand | None]]:
        """Regions to look at, with the hand that each of them follows."""
        followed: list[tuple[Region, TrackedHand | None]] = []
        for hand in self._followed:
            region = hand.hand.next_region()
            if _is_sound(region, frame):
                followed = [one for one in followed if overlap(one[0], region) <= _SAME_REGION]
                followed.append((region, hand))
        for region in self._new_regions(frame) if len(followed) < self._settings.hands else ():
            if all(overlap(region, other) <= _SAME_REGION for other, _ in followed):
                followed.append((region, None))
        return followed

    def _new_regions(self, frame: np.ndarray) -> list[Region]:
        """Regions of the palms in a frame, best first."""
        height, width = frame.shape[:2]
        values, logits = self._networks.palms(palm_input(frame))
        palms = suppress(decode(values, logits, self._settings.min_palm_score))
        regions = [place_in_image(palm, width, height).hand_region() for palm in palms]
        return [region for region in regions[: self._settings.hands] if _is_sound(region, frame)]

    def _numbered(self, hand: TrackedHand) -> TrackedHand:
        """The hand, with a new track if it has none."""
        if hand.track >= 0:
            return hand
        self._tracks += 1
        return TrackedHand(self._tracks - 1, hand.hand)


def _without_doubles(seen: list[tuple[TrackedHand, float]]) -> list[TrackedHand]:
    """Hands without those that are another hand again; what moved least comes first and is kept."""
    kept: list[TrackedHand] = []
    for hand, _ in sorted(seen, key=lambda pair: pair[1]):
        size = hand.hand.size()
        if all(
            _distance(hand.hand, other.hand) > _SAME_HAND * max(size, other.hand.size())
            for other in kept
        ):
            kept.append(hand)
    return kept


def _distance(one: SeenHand, other: SeenHand) -> float:
    """Mean distance of the landmarks of two hands, px."""
    return float(np.linalg.norm(one.image[:, :2] - other.image[:, :2], axis=1).mean())


def _is_sound(region: Region, frame: np.ndarray) -> bool:
    """Whether a region can be looked at: of a size, and not far outside of the frame."""
    height, width = frame.shape[:2]
    longest = max(width, height)
    return (
        2 <= region.width <= 8 * longest
        and 2 <= region.height <= 8 * longest
        and -longest <= region.x <= width + longest
        and -longest <= region.y <= height + longest
    )
