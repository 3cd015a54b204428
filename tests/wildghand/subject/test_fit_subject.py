"""The person's hand from masks. Oracle: masks drawn of a hand that is known."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from unittest import mock

import numpy as np
import pytest
import torch

from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate, load_template, pose_hand, project
from hwp_bench.hands.raster import draw_silhouette
from wildghand.subject import SubjectShape, fit_subject
from wildghand.subject.outlines import ComparedFrames, MaskOutline, compare_outlines
from wildghand.subject.unknowns import hand_proportions

FRAMES, SIZE = 12, 96
MODULE = sys.modules[fit_subject.__module__]


@pytest.fixture(autouse=True, scope="module")
def _few_control_points() -> Iterator[None]:
    # The masks are exact: less noise is expected than in a clip.
    with (
        mock.patch("wildghand.subject.unknowns.NODES", 80),
        mock.patch.object(MODULE, "NOISE", 1.0),
    ):
        yield


def parameters(side: str) -> HandParameters:
    """A hand upright before the camera that turns about its length and bends its fingers."""
    random = np.random.default_rng(1)
    phase = 2 * np.pi * np.arange(FRAMES)[:, None, None] / FRAMES
    pose = 0.2 * np.sin(phase * random.uniform(0.5, 1.5, (16, 3)) + random.uniform(0, 6, (16, 3)))
    pose[:, 0] = [np.pi / 2, 0.0, 0.0]
    pose[:, 0, 1] += 0.5 * np.sin(phase[:, 0, 0])
    if side == "left":
        pose *= [1.0, -1.0, -1.0]
    transl = np.tile([0.09 if side == "right" else -0.09, 0.0, 0.4], (FRAMES, 1))
    return HandParameters(pose, np.zeros(10), transl, np.ones(FRAMES, dtype=bool))


def cameras() -> Cameras:
    K = np.array([[1.5 * SIZE, 0, SIZE / 2], [0, 1.5 * SIZE, SIZE / 2], [0, 0, 1.0]])
    return Cameras(np.repeat(K[None], FRAMES, 0), np.repeat(np.eye(4)[None], FRAMES, 0))


def projected(template: HandTemplate, scale: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depth of the vertices, in images that are `scale` times as large."""
    hand, clip = parameters(template.side), cameras()
    posed = pose_hand(
        template.to_torch(torch.float64),
        *(torch.from_numpy(part) for part in (hand.pose, hand.betas, hand.transl)),
    )
    pixels, depth = project(
        posed.vertices, torch.from_numpy(clip.viewmats), torch.from_numpy(clip.Ks)
    )
    return scale * pixels.numpy(), depth.numpy()


def masks_of(template: HandTemplate, scale: int = 1) -> np.ndarray:
    pixels, _ = projected(template, scale)
    return np.stack([draw_silhouette(frame, template.faces, scale * SIZE) for frame in pixels])


def gap(template: HandTemplate, truth: HandTemplate) -> float:
    """Mean distance of the outlines, px, read in images four times as large."""
    pixels, depth = projected(template, 4)
    seen = [
        compare_outlines(
            pixels[frame], depth[frame], template.faces, MaskOutline.of(mask > 127)
        ).gap
        for frame, mask in enumerate(masks_of(truth, 4))
    ]
    return float(np.abs(np.concatenate(seen)).mean()) / 4.0


def fitted(
    side: str,
    masks: np.ndarray,
    judged: np.ndarray | None = None,
) -> SubjectShape:
    """The shape from even frames and what odd frames judge; from all where none judge."""
    template, hand = {side: load_template("anny", side)}, {side: parameters(side)}
    if judged is None:
        return fit_subject(template, hand, cameras(), np.arange(FRAMES), masks)
    even, odd = np.arange(0, FRAMES, 2), np.arange(1, FRAMES, 2)
    judges = ComparedFrames(template, hand, cameras(), odd, judged[odd] > 127)
    return fit_subject(template, hand, cameras(), even, masks[even], judges=judges)


def fitted_to_even(masks: np.ndarray) -> SubjectShape:
    """The shape from even frames, which nothing judges."""
    template, hand = {"right": load_template("anny", "right")}, {"right": parameters("right")}
    even = np.arange(0, FRAMES, 2)
    return fit_subject(template, hand, cameras(), even, masks[even])


def person(side: str = "right") -> HandTemplate:
    """A hand that is 5 % longer and 10 % wider and thicker than the template."""
    template = load_template("anny", side)
    larger = np.array([1.05, 1.1, 1.1])
    return dataclasses.replace(
        template, vertices=template.vertices * larger, joints=template.joints * larger
    )


@pytest.fixture(scope="module")
def found() -> SubjectShape:
    return fitted("right", masks_of(person()))


def test_outlines_meet_those_of_another_hand(found: SubjectShape) -> None:
    template = load_template("anny", "right")
    before = gap(template, person())
    assert before > 0.8
    assert gap(found.applied(template), person()) < 0.5 * before
    # The vertices go where that hand's are, not anywhere along the rays.
    wanted = person().vertices - template.vertices
    assert np.linalg.norm(found.vertices - wanted, axis=1).mean() < (
        0.8 * np.linalg.norm(wanted, axis=1).mean()
    )
    np.testing.assert_allclose(found.joints[0], 0.0, atol=1e-6)


def test_a_hand_that_is_the_template_stays() -> None:
    shape = fitted("right", masks_of(load_template("anny", "right")))
    assert np.linalg.norm(shape.vertices, axis=1).mean() < 5e-4
    assert np.linalg.norm(shape.joints, axis=1).max() < 5e-4


def test_proportions_are_found() -> None:
    """Oracle: hands of other proportions, a tenth more or less of each."""
    template = load_template("anny", "right")
    known = hand_proportions(template)
    before, after = [], []
    for seed in range(4):
        change = 0.1 * np.random.default_rng(seed).choice([-1.0, 1.0], len(known.lengths))
        truth = SubjectShape(known.vertices @ change, known.joints @ change)
        masks = masks_of(truth.applied(template))
        shape = fitted("right", masks, masks)
        for errors, found in ((before, np.zeros_like(truth.joints)), (after, shape.joints)):
            errors.append(np.linalg.norm(found - truth.joints, axis=1).mean())
    assert np.mean(after) < 0.6 * np.mean(before)


def test_what_is_in_front_in_a_third_of_the_frames_changes_little(found: SubjectShape) -> None:
    masks = masks_of(person())
    masks[::3, 40:60, 30:50] = 0
    shape = fitted("right", masks)
    change = np.linalg.norm(shape.vertices - found.vertices, axis=1)
    assert change.mean() < 0.2 * np.linalg.norm(found.vertices, axis=1).mean()


def test_a_left_hand_is_the_mirror_of_a_right_one(found: SubjectShape) -> None:
    shape = fitted("left", masks_of(person("left")))
    # Pixels of mirrored images are rounded alike but for ties.
    change = np.linalg.norm(shape.vertices - found.vertices, axis=1)
    assert change.mean() < 0.1 * np.linalg.norm(found.vertices, axis=1).mean()


def test_nothing_to_compare_bends_nothing() -> None:
    shape = fitted("right", np.zeros((FRAMES, SIZE, SIZE), np.uint8))
    assert not shape.vertices.any()
    assert not shape.joints.any()
    assert shape.vertices.shape == load_template("anny", "right").vertices.shape


def test_other_frames_soften_a_hand_that_is_stiffer_than_they_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(MODULE, "NOISE", 3.0)
    masks = masks_of(person())
    shape, fixed = fitted("right", masks, masks), fitted_to_even(masks)
    template = load_template("anny", "right")
    chosen, before = (gap(one.applied(template), person()) for one in (shape, fixed))
    assert chosen < 0.8 * before
    off = [
        np.linalg.norm(person().vertices - one.applied(template).vertices, axis=1).mean()
        for one in (shape, fixed)
    ]
    assert off[0] < 0.9 * off[1]


def test_training_frames_that_are_not_compared_choose_where_no_others_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Oracle: the same frames, handed over."""
    masks = masks_of(person())
    template, hand = {"right": load_template("anny", "right")}, {"right": parameters("right")}
    monkeypatch.setattr(MODULE, "FRAMES", 6)
    every = np.arange(FRAMES)
    alone = fit_subject(template, hand, cameras(), every, masks)
    rows = np.unique(np.linspace(0, FRAMES - 1, 6).round().astype(int))
    others = np.setdiff1d(every, rows)
    judges = ComparedFrames(template, hand, cameras(), others, masks[others] > 127)
    given = fit_subject(template, hand, cameras(), rows, masks[rows], judges=judges)
    np.testing.assert_array_equal(alone.vertices, given.vertices)
    assert alone.vertices.any()


def test_frames_of_the_template_itself_keep_it() -> None:
    shape = fitted("right", masks_of(person()), masks_of(load_template("anny", "right")))
    assert not shape.vertices.any()
    assert not shape.joints.any()


def test_a_softer_hand_must_be_clearly_better(monkeypatch: pytest.MonkeyPatch) -> None:
    masks = masks_of(person())
    monkeypatch.setattr(MODULE, "_LEAST_GAIN", 1.0)
    shape = fitted("right", masks, masks)
    assert not shape.vertices.any()


def test_frames_without_an_outline_do_not_judge() -> None:
    masks = masks_of(person())
    shape = fitted("right", masks, np.zeros_like(masks))
    alone = fitted_to_even(masks)
    np.testing.assert_array_equal(shape.vertices, alone.vertices)


def test_the_misfit_of_a_known_hand_is_small_and_grows() -> None:
    template, hand = {"right": load_template("anny", "right")}, {"right": parameters("right")}
    masks = masks_of(template["right"]) > 127
    frames = ComparedFrames(template, hand, cameras(), np.arange(FRAMES), masks)
    own = SubjectShape(np.zeros_like(template["right"].vertices), np.zeros((16, 3)))
    other = SubjectShape(person().vertices - template["right"].vertices, own.joints)
    exact, apart = frames.misfit(own, 1.5), frames.misfit(other, 1.5)
    assert exact is not None
    assert apart is not None
    # Both outlines are rounded to the same pixels.
    assert exact < 1e-6
    assert 0.2 < apart < 1.5**2
