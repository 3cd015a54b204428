"""Layers of a page: biases of frames, weights of the fit. Oracles: the model, cv2.projectPoints.

Tolerance of pictures: 30 dB over the hand's box, as in `test_avatar_page.py`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser import open_page
from tiny_fits import TINY

import wildghand
from hwp_bench.capture import Capture
from wildghand.avatar import WildGHandAvatar, load_avatar, save_avatar
from wildghand.fitting.fit import Fit
from wildghand.model.settings import read_settings
from wildghand.page import bake_hand, write_page
from wildghand.page.bake import bake_biases
from wildghand.page.poses import PageSettings, mean_weights
from wildghand.splat import rasterize

QUICK: dict[str, Any] = {**TINY, "gaussians": 600}
SMALL = PageSettings(clip_samples=16, random_samples=12, still_size=48)


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    """An avatar whose biases and gains are large, as those of a dark frame would be."""
    capture = make_painted()
    made = wildghand.fit(capture.root, settings=QUICK, steps=30, all_frames=True)
    avatar = copy.deepcopy(made)
    with torch.no_grad():
        avatar.model.biases_of("right").psi.bias.fill_(1.0)
        avatar.model.log_gains.copy_(
            torch.linspace(-0.5, 0.2, made.model.log_gains.numel()).reshape(
                made.model.log_gains.shape
            )
        )
    return avatar, capture


def biased(avatar: WildGHandAvatar, capture: Capture, frame: int) -> np.ndarray:
    """(H, W, 4) of the model's Gaussians with the biases of a training frame."""
    given = avatar.posed({"right": capture.hand_poses(frame)["right"]})["right"]
    rows, camera = torch.tensor([avatar.record.frames.index(frame)]), capture.camera(frame)
    with torch.no_grad():
        made, _ = avatar.model.gaussians("right", *given, rows=rows)
        image, cover, _ = rasterize(
            made.means,
            made.quats,
            made.scales,
            made.opacities,
            made.colors,
            torch.as_tensor(camera.viewmat[None], dtype=torch.float32),
            torch.as_tensor(camera.K[None], dtype=torch.float32),
            camera.width,
            camera.height,
        )
    return torch.cat([image, cover], dim=-1)[0].clamp(0.0, 1.0).numpy()


def psnr(found: np.ndarray, truth: np.ndarray, coverage: np.ndarray) -> float:
    seen = np.argwhere(coverage > 0.5)
    box = tuple(slice(a, b + 1) for a, b in zip(seen.min(0), seen.max(0), strict=True))
    return float(-10.0 * np.log10(np.square(found[box] - truth[box]).mean() + 1e-12))


def test_gaussians_of_a_frame_are_those_that_the_fit_draws(make_training: Any) -> None:
    training = make_training("right")
    settings = read_settings({**QUICK, "evidence.enabled": False, "light.enabled": False})
    fit = Fit(training, settings, 0, torch.device("cpu"))
    with torch.no_grad():
        fit.model.biases_of("right").psi.bias.fill_(1.0)
        fit.model.log_gains.fill_(-0.3)
        row = torch.tensor([4])
        drawn = fit.draw(row)
        frame = int(fit.frames.indices[4])
        avatar = fit.avatar(0)
        given = avatar.posed({"right": training.hand_poses(frame)["right"]})["right"]
        made, _ = fit.model.gaussians("right", *given, rows=row)
        camera = training.camera(frame)
        image, _, _ = rasterize(
            made.means,
            made.quats,
            made.scales,
            made.opacities,
            made.colors,
            fit.clip.viewmats[row],
            fit.clip.Ks[row],
            camera.width,
            camera.height,
        )
    np.testing.assert_allclose(image.numpy(), drawn.image.numpy(), atol=2e-4)
    assert float(drawn.image.max()) > 0.1


def test_baked_biases_are_the_models(fitted) -> None:
    avatar, capture = fitted
    frames = avatar.record.frames[:9]
    hands = [capture.hand_poses(frame)["right"] for frame in frames]
    motion = np.stack([np.append(hand.pose.ravel(), hand.transl) for hand in hands])
    hand = bake_hand(avatar, "right", hands[0].pose[None], geometry_rank=2, color_rank=2)
    # As many components as frames: what is left is the rounding to 8 bits.
    found = bake_biases(avatar, "right", hand, frames, motion, rank=9)
    assert found is not None
    clean = avatar.pose({"right": hands[4]})
    given = avatar.posed({"right": hands[4]})["right"]
    with torch.no_grad():
        truth, _ = avatar.model.gaussians("right", *given, rows=torch.tensor([4]))
    skin = len(avatar.model.rigs["right"])
    added, wall = np.split(found.at(4), [skin])
    assert len(wall) == len(avatar.model.wall("right"))
    assert not wall.any()
    np.testing.assert_allclose(added[:, 3:6], truth.colors[0].numpy() - clean.colors, atol=0.01)
    np.testing.assert_allclose(
        added[:, 6], truth.opacities.reshape(-1).numpy() - clean.opacities, atol=0.01
    )
    assert np.abs(added[:, 3:6]).max() > 0.05
    off = copy.deepcopy(avatar)
    off.model.perturbation.clear()
    assert bake_biases(off, "right", hand, frames, motion, rank=9) is None


@pytest.fixture(scope="module")
def folder(fitted, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_avatar(fitted[0], tmp_path_factory.mktemp("layers") / "avatar")


@pytest.fixture(scope="module")
def opened(fitted, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    out = folder.parent / "avatar.html"
    write_page(folder, out, capture=fitted[1], settings=SMALL)
    with open_page(out, tmp_path_factory.mktemp("profile"), webgl=True) as driver:
        driver.execute_script("avatar.setBackground('#000000')")
        yield driver


def drawn(driver: Any, capture: Capture, frame: int) -> np.ndarray:
    camera = capture.camera(frame)
    given = camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height
    driver.execute_script("avatar.setCamera(...arguments)", *given)
    pixels = driver.execute_script("return avatar.pixels()")
    return np.array(pixels).reshape(camera.height, camera.width, 3) / 255.0


def test_the_page_draws_a_frame_with_its_biases(opened, fitted) -> None:
    avatar, capture = fitted
    frames = avatar.record.frames
    for row in (2, len(frames) - 3):
        opened.execute_script("avatar.setFrame(arguments[0])", row)
        pictures = {}
        for kind in ("clean", "biases"):
            opened.execute_script("avatar.setShown(arguments[0])", kind)
            pictures[kind] = drawn(opened, capture, frames[row])
        truth = biased(avatar, capture, frames[row])
        assert psnr(pictures["biases"], truth[..., :3], truth[..., 3]) > 30.0
        assert psnr(pictures["clean"], truth[..., :3], truth[..., 3]) < 28.0
    opened.execute_script("avatar.setShown('clean')")


def test_the_page_draws_weights_in_their_colours(opened, fitted) -> None:
    _, capture = fitted
    opened.execute_script("avatar.setFrame(0); avatar.setShown('weights')")
    seen = opened.execute_script(
        "return ['biased', 'weighed'].map(id => document.getElementById(id).checkVisibility())"
    )
    assert seen == [False, True]
    picture = drawn(opened, capture, 0)
    opened.execute_script("avatar.setShown('clean')")
    assert np.abs(picture - drawn(opened, capture, 0)).max() > 0.2


def test_weights_are_those_of_the_places_in_the_masks(fitted, folder: Path) -> None:
    avatar, capture = fitted
    frame = avatar.record.frames[0]
    camera, hand = capture.camera(frame), capture.hand_poses(frame)["right"]
    mask = np.zeros((camera.height, camera.width), np.uint8)
    middle = camera.width // 2
    mask[:, middle:] = 255
    found = mean_weights(avatar, capture, {frame: mask})["right"]
    shown = np.isfinite(found)
    assert 0.2 < shown.mean() < 0.8
    anchors = avatar.model.rigs["right"].pose(*avatar.posed({"right": hand})["right"])
    turn, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    places = anchors.positions[0].double().numpy()
    pixels, _ = cv2.projectPoints(places, cv2.Rodrigues(turn)[0], shift, camera.K, None)
    x = pixels[shown, 0, 0]
    # A pixel away from the edge the weight is exactly that of the mask's half.
    assert (found[shown][x > middle + 1] == 1.0).all()
    assert (found[shown][x < middle - 1] == 0.0).all()
    assert mean_weights(avatar, capture, {}) == {}
    # A folder remembers the masks of its fit.
    kept, known = load_avatar(folder).weight_masks, avatar.weight_masks
    assert sorted(kept) == sorted(known)
    np.testing.assert_array_equal(kept[frame], known[frame])
