"""Novelty of test pixels. Oracle: hands that turn by a known angle, masks that hide places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hwp_bench.analysis.novelty import measure_novelty
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands.articulation import axis_angle_to_matrix


@pytest.fixture
def still(make_painted: Callable[..., Capture]) -> Capture:
    """The painted capture with the hand at rest in every frame."""
    painted = make_painted()
    hands = {
        side: replace(hand, pose=np.repeat(hand.pose[:1], len(hand.pose), axis=0))
        for side, hand in painted.hands.items()
    }
    return Capture(painted.root, painted.info, hands, painted.cameras)


def turned(capture: Capture, frames: list[int], degrees: float) -> Capture:
    """The capture with the hand turned about the viewing axis in some frames."""
    import torch
    from scipy.spatial.transform import Rotation

    (side, hand), pose = next(iter(capture.hands.items())), next(iter(capture.hands.values())).pose
    turn = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, np.radians(degrees)]])).numpy()[0]
    pose = pose.copy()
    for frame in frames:
        pose[frame, 0] = Rotation.from_matrix(
            turn @ Rotation.from_rotvec(pose[frame, 0]).as_matrix()
        ).as_rotvec()
    return Capture(capture.root, capture.info, {side: replace(hand, pose=pose)}, capture.cameras)


def test_a_hand_that_stands_still_shows_nothing_new(still: Capture) -> None:
    split = contiguous_split(still.info.id, len(still))
    novelty = next(measure_novelty(still, split, [int(split.test[0])]))
    drawn = ~np.isnan(novelty.angle)
    inside = drawn & (still.mask(int(split.train[0])) > 127)
    assert inside.sum() > 200
    # Masks are of a hand that moves a little, so that each place is in some of them.
    assert np.median(novelty.angle[inside]) < 0.5
    assert np.median(novelty.seen[inside]) > 0.9
    assert np.isnan(novelty.seen[~drawn]).all()


def test_the_angle_is_that_of_the_turn(still: Capture) -> None:
    split = contiguous_split(still.info.id, len(still))
    test = int(split.test[0])
    capture = turned(still, [test], 30.0)
    novelty = next(measure_novelty(capture, split, [test]))
    known = (novelty.seen > 0.5) & ~np.isnan(novelty.angle)
    assert known.sum() > 200
    # A normal turns by as much as its part across the axis; none turns further than the hand.
    angles = novelty.angle[known]
    assert np.quantile(angles, 0.98) < 33.0
    assert np.median(angles) > 5.0
    # Turned by as much in one training frame, the pose is known.
    again = turned(still, [test, int(split.train[3])], 30.0)
    found = next(measure_novelty(again, split, [test]))
    same = found.angle[known & ~np.isnan(found.angle)]
    assert np.median(same) < np.median(angles)


def test_places_that_no_mask_shows_are_never_seen(
    still: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = contiguous_split(still.info.id, len(still))
    half = np.zeros(still.size, dtype=np.uint8)
    half[:, : still.size[1] // 2] = 255
    monkeypatch.setattr(Capture, "mask", lambda self, frame: half)
    novelty = next(measure_novelty(still, split, [int(split.test[0])]))
    columns = np.broadcast_to(np.arange(still.size[1]), still.size)
    drawn = ~np.isnan(novelty.angle)
    far = drawn & (columns > still.size[1] // 2 + 4)
    near = drawn & (columns < still.size[1] // 2 - 1)
    assert (novelty.seen[near] == 1.0).all()
    # The rear of a finger's cell may lie over the border; all others are new.
    assert np.mean(novelty.seen[far] == 0.0) > 0.9
    assert (novelty.angle[novelty.seen == 0.0] == 180.0).all()
