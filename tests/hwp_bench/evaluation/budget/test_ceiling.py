"""What a perfect avatar scores at given poses. Oracles: poses that are exact, and a known shift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.capture import Capture, CaptureWriter, open_capture
from hwp_bench.evaluation.budget.surface import Ceiling, Pair, at_given_poses, surfaces_of
from hwp_bench.hands import HandParameters
from hwp_bench.metrics.protocol import PSNR_CAP

FRAME = 2


def with_estimates(
    painted: Capture, folder: Path, estimates: dict[str, HandParameters], *, truth: bool = True
) -> Capture:
    """The painted capture with other estimates; its own parameters are the truth."""
    info = replace(painted.info, id="given", source={"kind": "test"})
    with CaptureWriter(folder, info, estimates, painted.cameras) as writer:
        for frame in range(len(painted)):
            writer.frame(frame, painted.frame(frame))
            writer.mask(frame, painted.mask(frame))
            if truth:
                writer.true_mask(frame, painted.mask(frame))
        if truth:
            writer.true_hands(painted.hands)
    return open_capture(folder)


def pair_of(capture: Capture) -> Pair:
    """The truth of the frame next to a black prediction."""
    target = capture.frame(FRAME) / 255.0
    region = capture.mask(FRAME) > 250
    return Pair(np.zeros_like(target), target, region, np.zeros_like(target))


def test_at_exact_poses_it_is_the_truth(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    painted = make_painted()
    capture = with_estimates(painted, tmp_path / "exact", dict(painted.hands))
    moved = at_given_poses(capture, FRAME, surfaces_of(capture))
    assert moved is not None
    inside = painted.mask(FRAME) > 250
    # Sources are rounded to 1/32 px by OpenCV.
    np.testing.assert_allclose(moved[inside], painted.frame(FRAME)[inside] / 255.0, atol=0.02)
    ceiling = Ceiling.of(capture)
    assert ceiling is not None
    assert 45.0 < ceiling.psnr(FRAME, pair_of(capture), 20.0) <= PSNR_CAP
    # A frame that the method failed on keeps its penalty, as in every row.
    assert ceiling.psnr(FRAME, None, 0.0) == 0.0


def test_a_wrong_place_moves_the_image_by_as_much(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    painted = make_painted()
    hand, K = painted.hands["right"], painted.cameras.Ks[FRAME]
    # Four pixels to the right, at the depth of the hand.
    camera = painted.cameras.viewmats[FRAME]
    depth = float((camera[:3, :3] @ hand.transl[FRAME] + camera[:3, 3])[2])
    aside = camera[:3, :3].T @ np.array([4.0 * depth / K[0, 0], 0.0, 0.0])
    estimates = {"right": replace(hand, transl=hand.transl + aside)}
    capture = with_estimates(painted, tmp_path / "aside", estimates)
    moved = at_given_poses(capture, FRAME, surfaces_of(capture))
    assert moved is not None
    shifted = np.roll(painted.frame(FRAME), 4, axis=1) / 255.0
    inside = np.roll(painted.mask(FRAME), 4, axis=1) > 250
    # The hand is not flat: parts that are nearer move a little more.
    assert np.abs(moved - shifted)[inside].mean() < 0.02
    assert np.abs(moved - painted.frame(FRAME) / 255.0)[inside].mean() > 0.02
    ceiling, exact = Ceiling.of(capture), 45.0
    assert ceiling is not None
    assert ceiling.psnr(FRAME, pair_of(capture), 20.0) < exact


def test_what_is_not_known_has_no_ceiling(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    painted = make_painted()
    without = with_estimates(painted, tmp_path / "without", dict(painted.hands), truth=False)
    assert Ceiling.of(without) is None
    valid = painted.hands["right"].valid.copy()
    valid[FRAME] = False
    lost = {"right": replace(painted.hands["right"], valid=valid)}
    capture = with_estimates(painted, tmp_path / "lost", lost)
    ceiling = Ceiling.of(capture)
    assert ceiling is not None
    assert ceiling.psnr(FRAME, pair_of(capture), 21.5) == 21.5
