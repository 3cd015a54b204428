"""A scanned hand. Oracles: counting, OpenCV's remap, a known texture, a lamp at the camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from fitted_parts import material_of, scores_of
from formed import over, training_of
from hypothesis import given
from hypothesis import strategies as st
from painted import (
    FRAMES,
    QUICK,
    SIZE,
    cameras,
    hand_parameters,
    painted_avatar,
    painted_info,
    write_drawn,
)

from hwp_bench.base.images import as_uint8
from hwp_bench.capture import Cameras, Capture, CaptureWriter
from hwp_bench.capture.folder import open_capture
from hwp_bench.hands.skeleton import HandParameters
from plain_fit.method import PlainMethod
from scan_texture_fit.method import (
    ScanMethod,
    ScanRecipe,
    ScanSettings,
    _two_columns,
    nearest_anchor,
    read_pixels,
    total_variation,
    weighted_median,
)
from wildghand.gaussians.quaternions import quat_third_axis

#: A texture that is fine enough for the small captures of these tests.
SMALL = {**QUICK, "gaussians": 1500, "texture_size": 64, "steps": 140}


@given(st.integers(1, 9), st.integers(0, 2**31))
def test_the_weighted_median_has_half_of_the_weight_on_either_side(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    values = torch.from_numpy(random.integers(0, 5, (count, 3, 2)).astype(np.float32))
    weights = torch.from_numpy(random.integers(0, 3, (count, 3)).astype(np.float32))
    found = weighted_median(values, weights)
    for place in range(3):
        own, weight = values[:, place], weights[:, place]
        for channel in range(2):
            median = found[place, channel]
            if weight.sum() == 0:
                assert median == 0.0
                continue
            at_most = weight[own[:, channel] <= median].sum()
            below = weight[own[:, channel] < median].sum()
            assert at_most >= 0.5 * weight.sum() > below


def test_pixels_are_read_as_opencv_reads_them() -> None:
    random = np.random.default_rng(0)
    image = random.random((20, 30, 3)).astype(np.float32)
    # OpenCV counts from the centre of the first pixel.
    places = random.uniform((1.0, 1.0), (29.0, 19.0), (50, 2)).astype(np.float32)
    oracle = cv2.remap(image, places[:, 0] - 0.5, places[:, 1] - 0.5, cv2.INTER_LINEAR)
    oracle = oracle.reshape(50, 3)
    found = read_pixels(torch.from_numpy(image)[None], torch.from_numpy(places)[None])[0]
    # OpenCV has 5 bits of a pixel's fraction.
    np.testing.assert_allclose(found.numpy(), oracle, atol=1.0 / 32.0)


def test_texels_belong_to_the_anchor_beside_them() -> None:
    uv = torch.tensor([[0.1, 0.9], [0.9, 0.1]])
    index = nearest_anchor(uv, 4).reshape(4, 4)
    assert index[0, 0] == 0  # row 0 is the top, v = 1
    assert index[3, 3] == 1
    assert index[0, 1] == 0


def test_total_variation_counts_steps_where_it_is_asked() -> None:
    plane = torch.zeros(1, 4, 4)
    plane[:, :, 2:] = 3.0
    assert float(total_variation(plane)) == pytest.approx(3.0 * 4 / 12)
    where = torch.zeros(4, 4)
    where[:2] = 1.0
    assert float(total_variation(plane, where)) == pytest.approx(3.0 * 2 / 12)


def test_turns_are_rotations() -> None:
    """Oracle: OpenCV's Rodrigues."""
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    found = _two_columns(torch.from_numpy(vectors)).reshape(-1, 3, 2).numpy()
    oracle = np.stack([cv2.Rodrigues(one)[0][:, :2] for one in vectors])
    np.testing.assert_allclose(found, oracle, atol=1e-12)


def orbit() -> Cameras:
    """A camera that goes half way around the hand while the hand waves."""
    clip = cameras()
    centre = np.array([0.0, 0.0, 0.45])
    viewmats = clip.viewmats.copy()
    for frame, angle in enumerate(np.linspace(-1.2, 1.2, FRAMES)):
        turn = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        viewmats[frame, :3, :3] = turn
        viewmats[frame, :3, 3] = centre - turn @ centre
    return replace(clip, viewmats=viewmats)


def headlamp_capture(path: Path, hand: HandParameters) -> Capture:
    """The painted hand under a lamp at a camera that goes around it, in no other light."""
    model, clip = painted_avatar(("right",)).model, orbit()
    rig, info = model.rigs["right"], painted_info("headlamp")

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    with torch.no_grad(), CaptureWriter(path, info, {"right": hand}, clip) as writer:
        for frame in range(FRAMES):
            row = slice(frame, frame + 1)
            poses = rig.pose(tensor(hand.pose[row]), tensor(hand.betas), tensor(hand.transl[row]))
            view = tensor(clip.viewmats[row])
            eye = -(view[0, :3, :3].T @ view[0, :3, 3])
            towards = torch.nn.functional.normalize(eye - poses.positions, dim=-1)
            facing = (quat_third_axis(poses.orientations) * towards).sum(dim=-1).relu()
            colors = model.gaussians.logit_colors.sigmoid() * (0.2 + 0.8 * facing[..., None])
            image, cover = model.rasterized(colors, poses, view, tensor(clip.Ks[row]), SIZE, SIZE)
            rgba = torch.cat((image, cover), dim=-1)[0].double().numpy()
            writer.frame(frame, as_uint8(over(rgba)))
            writer.mask(frame, np.where(rgba[..., 3] > 0.5, 255, 0).astype(np.uint8))
    return open_capture(path)


@pytest.mark.slow
def test_a_lamp_that_moves_with_the_camera_is_a_shadow_of_the_view(tmp_path: Path) -> None:
    """What UHM is made for: phone scans, whose light follows the view. The plain fit's light
    stays in the world and must miss by 1 dB at least what the shadows of the view explain."""
    capture = headlamp_capture(tmp_path / "lamp", hand_parameters("right", 4))
    training = training_of(capture, tmp_path / "request")
    plain = PlainMethod({**QUICK, "gaussians": 1500, "steps": 140}, 0)
    scores = scores_of(training, capture, plain, ScanMethod(SMALL, 0))
    assert scores[1] > scores[0] + 1.0, scores


def made_recipe(capture: Capture, place: Path, **settings: object) -> ScanRecipe:
    training = training_of(capture, place)
    chosen = ScanSettings(**{**SMALL, **settings})  # type: ignore[arg-type]
    return ScanRecipe(material_of(training), chosen)


def test_frames_are_unwrapped_into_the_texture_that_they_show(tmp_path: Path) -> None:
    """Frames are drawn with a known texture in full light; places that many frames show agree
    with it to 27 dB, and places that none shows have the colour of the skin."""
    hand = hand_parameters("right", 4)
    drawn = made_recipe(headlamp_capture(tmp_path / "any", hand), tmp_path / "a")
    known = drawn.model.hand("right")
    with torch.no_grad():
        v, u = torch.meshgrid(torch.linspace(0, 4, 64), torch.linspace(0, 4, 64), indexing="ij")
        waves = torch.stack((u.sin(), v.cos(), (u + v).sin()), dim=-1)
        known.texture.copy_(0.5 + 0.2 * waves.reshape(-1, 3))
        # In full light everywhere.
        known.shadow.last.weight.zero_()
        known.shadow.last.bias.fill_(30.0)
        drawn.model.textured.fill_(1.0)
    info = painted_info("known")
    capture = write_drawn(tmp_path / "known", info, {"right": hand}, drawn.avatar(0))
    recipe = made_recipe(capture, tmp_path / "b")
    fresh = recipe.model.hand("right")
    with torch.no_grad():
        fresh.shadow.load_state_dict(known.shadow.state_dict())
    recipe.unwrap()
    shown = recipe.shown["right"]
    assert 300 < int((shown > 4.0).sum()) < 1500
    error = (fresh.albedo() - known.albedo())[shown > 4.0].detach()
    assert -10.0 * math.log10(float(error.square().mean())) > 27.0
    seen = recipe.unseen["right"].flatten() == 0.0
    assert 0.2 < float(seen.float().mean()) < 1.0
    unseen = fresh.texture.detach()[~seen]
    torch.testing.assert_close(unseen, recipe.model.color.detach().expand_as(unseen))


def test_a_state_of_the_first_stage_is_drawn_without_texture(tmp_path: Path) -> None:
    capture = headlamp_capture(tmp_path / "any", hand_parameters("right", 4))
    recipe = made_recipe(capture, tmp_path / "a")
    before = recipe.snapshot()
    recipe.unwrap()
    assert bool(recipe.model.textured)
    recipe.restore(before)
    assert not bool(recipe.model.textured)


def test_the_texture_waits_for_the_second_stage(tmp_path: Path) -> None:
    capture = headlamp_capture(tmp_path / "any", hand_parameters("right", 4))
    recipe = made_recipe(capture, tmp_path / "a")
    share = recipe.settings.shape_share
    texture, betas = "texture.right", "betas.right"
    assert recipe.rate(texture, 0.5 * share) == 0.0 < recipe.rate(texture, share)
    assert recipe.rate(betas, share) < 0.2 * recipe.rate(betas, 0.99 * share)
    assert set(recipe.rates()) == set(recipe.parameters())
