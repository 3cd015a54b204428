"""Which frames are fitted, what a rendering is compared with, where the hands are."""

from __future__ import annotations

import dataclasses
import tracemalloc
import types

import numpy as np
import pytest
import torch
from painted import FRAMES, SIZE, TrainingMaker

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import write_image
from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.rig import make_rig
from wildghand.gaussians.training import (
    MOST_CHOOSING,
    FrameTable,
    TrainingClip,
    TrainingFrames,
    load_frames,
    load_judges,
    soft_weights,
)


def invalidate(training: TrainingCapture, side: str, frames: list[int]) -> None:
    hand = training.hands[side]
    valid = hand.valid.copy()
    valid[frames] = False
    training.hands[side] = dataclasses.replace(hand, valid=valid)


def test_every_training_frame_and_no_other(make_training: TrainingMaker) -> None:
    training = make_training()
    frames = load_frames(training)
    np.testing.assert_array_equal(frames.indices, np.arange(FRAMES * 8 // 10))
    np.testing.assert_array_equal(frames.images[3], training.frame(3))
    np.testing.assert_array_equal(frames.masks[3], training.mask(3))


def test_frames_without_valid_parameters_are_skipped(make_training: TrainingMaker) -> None:
    training = make_training("both")
    invalidate(training, "right", [0, 5])
    invalidate(training, "left", [5, 6])
    assert not {0, 5, 6} & set(load_frames(training).indices.tolist())


def test_frames_with_an_empty_mask_are_skipped(make_training: TrainingMaker) -> None:
    training = make_training()
    write_image(training.root / "masks" / "000002.png", np.zeros((SIZE, SIZE), np.uint8))
    assert 2 not in load_frames(training).indices


def test_a_capture_without_a_usable_frame_is_an_error(make_training: TrainingMaker) -> None:
    training = make_training()
    invalidate(training, "right", list(range(FRAMES)))
    with pytest.raises(BadInput, match="none of 32 training frames"):
        load_frames(training)


def test_the_frames_that_choose_are_spread_over_the_usable(make_training: TrainingMaker) -> None:
    """Half of 16 frames cannot be used, among them each that would be taken of all of them."""
    training = make_training()
    training.split = Split(training.id, FRAMES, (0, 20), (20, 36), (36, FRAMES))
    training._train = training.split.train
    validation = np.arange(20, 36)
    sound = load_judges(training)
    assert sound is not None
    taken = validation[evenly(16, MOST_CHOOSING)]
    np.testing.assert_array_equal(sound.indices, taken)
    invalidate(training, "right", taken[:7].tolist())
    empty = training.root / "masks" / f"{taken[7]:06d}.png"
    write_image(empty, np.zeros((SIZE, SIZE), np.uint8))
    judges = load_judges(training)
    assert judges is not None
    np.testing.assert_array_equal(judges.indices, np.setdiff1d(validation, taken))


def test_targets_are_black_and_light_outside_the_mask() -> None:
    """By hand: one pixel in the mask, one outside, one half in it."""
    frames = TrainingFrames(
        indices=np.array([0]),
        images=torch.tensor([[[[255, 51, 0], [255, 255, 255], [102, 102, 102]]]]).byte(),
        masks=torch.tensor([[[255, 0, 51]]]).byte(),
    )
    rows, cpu = torch.tensor([0]), torch.device("cpu")
    target, weights = frames.images_on(cpu)(rows), soft_weights(frames.masks_on(cpu)(rows), 0.1)
    np.testing.assert_allclose(target[0, 0], [[1.0, 0.2, 0.0], [0.0] * 3, [0.08] * 3], rtol=1e-6)
    np.testing.assert_allclose(weights[0, 0], [1.0, 0.1, 0.28], rtol=1e-6)


def test_a_table_of_frames_is_the_same_with_and_without_memory() -> None:
    def make(rows: torch.Tensor) -> torch.Tensor:
        return 2.0 * rows[:, None].expand(-1, 3)

    for memory in (0, 12 * 50):
        table = FrameTable(make, 50, 12, torch.device("cpu"), memory)
        for rows in ([3], [49, 0, 7]):
            expected = 2.0 * np.repeat(rows, 3).reshape(-1, 3)
            np.testing.assert_array_equal(table(torch.tensor(rows)), expected)


def test_a_table_of_a_long_clip_is_never_there_twice() -> None:
    def make(rows: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(np.full((len(rows), 512), 3.0))  # numpy's memory is counted

    table = FrameTable(make, 2000, 4096, torch.device("cpu"))
    tracemalloc.start()
    made = table(torch.tensor([0, 1999]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (made == 3.0).all()
    assert peak < 2000 * 4096 / 4


def test_frames_of_a_long_clip_are_never_there_twice() -> None:
    """2,000 frames that need no disk; oracle: the bytes of what is returned."""
    image = np.zeros((24, 32, 3), np.uint8)
    mask = np.full((24, 32), 255, np.uint8)
    clip = types.SimpleNamespace(
        hands={"right": types.SimpleNamespace(valid=np.ones(2000, bool))},
        train=np.arange(2000),
        height=24,
        width=32,
        mask=lambda frame: mask.copy(),
        frame=lambda frame: image.copy(),
    )
    tracemalloc.start()
    frames = load_frames(clip)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    kept = frames.images.numel() + frames.masks.numel()
    assert len(frames) == 2000
    assert kept <= peak < 1.25 * kept


def test_mean_color_is_over_the_mask_alone() -> None:
    frames = TrainingFrames(
        indices=np.array([0]),
        images=torch.tensor([[[[255, 51, 0], [0, 51, 0], [7, 7, 7]]]]).byte(),
        masks=torch.tensor([[[255, 255, 0]]]).byte(),
    )
    np.testing.assert_allclose(frames.mean_color(), [0.5, 0.2, 0.0], rtol=1e-6)


def test_anchors_are_the_same_with_and_without_the_cache(make_training: TrainingMaker) -> None:
    training = make_training("both")
    rigs = {side: make_rig(training.template(side), 30) for side in training.sides}
    indices, cpu = np.array([4, 7, 9]), torch.device("cpu")
    cached = TrainingClip(training, indices, rigs, cpu)
    posed = TrainingClip(training, indices, rigs, cpu, cache_bytes=0)
    rows = torch.tensor([2, 0])
    assert cached.poses(rows).positions.shape == (2, 60, 3)
    np.testing.assert_allclose(cached.poses(rows).positions, posed.poses(rows).positions, atol=1e-6)
    np.testing.assert_allclose(
        cached.poses(rows).orientations, posed.poses(rows).orientations, atol=1e-5
    )
    np.testing.assert_array_equal(cached.Ks[0], torch.from_numpy(training.cameras.Ks[4]).float())
