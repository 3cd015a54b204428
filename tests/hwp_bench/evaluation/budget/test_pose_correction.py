"""The correction `pose`. Oracle: textured templates drawn in a known pose, and in a wrong one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from hwp_bench.base.colors import linear_to_srgb, srgb_to_linear
from hwp_bench.evaluation.budget.budget import measure_gain
from hwp_bench.evaluation.budget.corrections import motion, pose
from hwp_bench.evaluation.budget.surface import MovingSurface, Pair
from hwp_bench.hands import load_template
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.hands.skeleton import Camera, HandPose
from hwp_bench.hands.skinning import pose_hand, project

SIZE = 64
CAMERA = Camera(
    np.array([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1.0]]),
    np.eye(4),
    SIZE,
    SIZE,
)
TEMPLATES = {side: load_template("anny", side) for side in ("right", "left")}


def hand(side: str = "right", *, shift: float = 0.0, bend: float = 0.25) -> HandPose:
    """A hand upright before the camera with its fingers a little bent."""
    angles = np.zeros((16, 3))
    angles[0] = [np.pi / 2, 0.0, 0.0]
    angles[1:, 2] = bend if side == "right" else -bend
    towards = 1.0 if side == "right" else -1.0
    return HandPose(side, angles, np.zeros(10), np.array([0.08 * towards + shift, 0.0, 0.36]))


def wrong(given: HandPose, seed: int, angle: float = 0.08, way: float = 0.003) -> HandPose:
    """The same hand with an error of every joint and of the place, in rad and m (deviations)."""
    random = np.random.default_rng(seed)
    errors = random.normal(0.0, angle, (16, 3))
    errors[0] *= 0.5
    return replace(
        given, pose=given.pose + errors, transl=given.transl + random.normal(0.0, way, 3)
    )


def drawn(hands: Mapping[str, HandPose]) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) picture over black, drawn without this package's correction; (H, W) silhouette."""
    places, depths, faces, colors, start = [], [], [], [], 0
    for side, given in hands.items():
        template = TEMPLATES[side]
        vertices = pose_hand(
            template.to_torch(torch.float64),
            torch.as_tensor(given.pose)[None],
            torch.as_tensor(given.betas),
            torch.as_tensor(given.transl)[None],
        ).vertices
        place, depth = project(
            vertices, torch.as_tensor(CAMERA.viewmat)[None], torch.as_tensor(CAMERA.K)[None]
        )
        places.append(place[0].numpy())
        depths.append(depth[0].numpy())
        faces.append(template.faces + start)
        start += len(template.vertices)
        waves = np.sin(90.0 * template.vertices)
        colors.append(0.5 + 0.12 * waves + 0.1 * waves[:, [1, 2, 0]] * waves[:, [2, 0, 1]])
    all_faces = np.concatenate(faces)
    face, mix = draw_faces(np.concatenate(places), np.concatenate(depths), all_faces, (SIZE, SIZE))
    image = np.zeros((SIZE, SIZE, 3))
    inside = face >= 0
    image[inside] = mix_corners(np.concatenate(colors), all_faces, face[inside], mix[inside])
    return image, inside


def pair_of(
    true: Mapping[str, HandPose], estimated: Mapping[str, HandPose], image: np.ndarray | None = None
) -> Pair:
    """The frame of a method whose only error is the pose, or which predicts an image."""
    target, region = drawn(true)
    prediction = drawn(estimated)[0] if image is None else image
    surface = MovingSurface(TEMPLATES, estimated, CAMERA)
    return Pair(prediction, target, region, np.zeros((SIZE, SIZE, 3)), surface)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_pose_is_brought_back(seed: int) -> None:
    pair = pair_of({"right": hand()}, {"right": wrong(hand(), seed)})
    # The error falls by a factor of ten; what is left is resampling, at borders most.
    assert measure_gain(pose(pair), pair) > 10.0
    assert measure_gain(pose(pair), pair) > measure_gain(motion(pair), pair)


def test_one_bent_finger_is_beyond_an_affine_motion() -> None:
    estimated = hand()
    estimated.pose[4:7, 2] += 0.15
    pair = pair_of({"right": hand()}, {"right": estimated})
    assert measure_gain(pose(pair), pair) > 10.0
    assert measure_gain(motion(pair), pair) < 5.0


def test_each_of_two_hands_is_brought_back() -> None:
    true = {"right": hand(shift=0.06), "left": hand("left", shift=-0.06)}
    pair = pair_of(true, {side: wrong(given, 5) for side, given in true.items()})
    assert len(MovingSurface(TEMPLATES, true, CAMERA).scales) == 2 * 51
    assert measure_gain(pose(pair), pair) > 8.0


def test_what_is_no_error_of_the_pose_is_not_explained_by_it() -> None:
    true = {"right": hand()}
    sharp = drawn(true)[0]
    # As smooth as errors of methods are: motion by parts of a pixel averages white noise away.
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(0.0, 0.4, sharp.shape), (0, 0), 2.0)
    for image in (
        np.clip(sharp + noise, 0.0, 1.0),
        linear_to_srgb(srgb_to_linear(sharp) * np.exp([0.3, -0.2, 0.25])),
    ):
        pair = pair_of(true, true, image)
        assert measure_gain(pose(pair), pair) < 0.5
    exact = pair_of(true, true)
    assert pose(exact) == pytest.approx(exact.prediction, abs=1e-4)


def test_pixels_come_from_where_the_surface_was() -> None:
    """Oracle: a hand that goes to the right in a plane of one depth moves each pixel alike."""
    flat = hand(bend=0.0)
    surface = MovingSurface(TEMPLATES, {"right": flat}, CAMERA)
    change = np.zeros(51)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    here = np.stack([columns, rows], axis=-1)
    assert surface.sources(change) == pytest.approx(here, abs=1e-3)
    change[48] = 0.01
    ways = here - surface.sources(change)
    # A hand's surface is 26 to 38 cm away.
    nearest, farthest = 1.6 * SIZE * 0.01 / 0.26, 1.6 * SIZE * 0.01 / 0.38
    assert ways[..., 0].min() > farthest
    assert ways[..., 0].max() < nearest
    assert ways[..., 1] == pytest.approx(0.0, abs=1e-3)
    region = drawn({"right": flat})[1]
    slopes = surface.moves(np.zeros(51), region)
    assert np.mean(slopes[:, 0, 48] * 0.01) == pytest.approx(ways[region, 0].mean(), rel=0.02)
    assert slopes[:, 1, 48] == pytest.approx(0.0, abs=1e-2)


def test_a_hand_out_of_sight_moves_nothing() -> None:
    away = {"right": replace(hand(), transl=np.array([0.0, 0.0, -1.0]))}
    surface = MovingSurface(TEMPLATES, away, CAMERA)
    region = np.ones((SIZE, SIZE), dtype=bool)
    assert not surface.moves(np.zeros(51), region).any()
    target, region = drawn({"right": hand()})
    pair = Pair(0.5 * target, target, region, np.zeros((SIZE, SIZE, 3)), surface)
    assert np.array_equal(pose(pair), pair.prediction)
    assert np.array_equal(pose(replace(pair, surface=None)), pair.prediction)
