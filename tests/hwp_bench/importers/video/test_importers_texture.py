"""The texture's term. Oracle: a painted hand whose pose in every frame is known."""

from __future__ import annotations

import copy
import functools

import cv2
import numpy as np
import torch
from synthetic_clip import FOCAL, FPS, HEIGHT, WIDTH, SyntheticClip, make_clip

from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.windows import CropWindows, cut, follow_hands
from hwp_bench.importers.video.clip_model import posed_vertices
from hwp_bench.importers.video.contour import ContourEnergy, signed_distance
from hwp_bench.importers.video.fit_clip import FittedClip, Footage, fit_landmarks, fit_outline
from hwp_bench.importers.video.skin_texture import SkinTexture
from hwp_bench.importers.video.surface_motion import frame_variables
from hwp_bench.importers.video.texture_energy import TextureEnergy
from hwp_bench.importers.video.video_settings import FitSettings
from hwp_bench.importers.video.within import smooth_within

SETTINGS = FitSettings(start_steps=40, landmark_steps=80, contour_steps=50)
FRAMES, SIZE, HAND = 20, 160, 150.0


@functools.cache
def painting() -> np.ndarray:
    """(512, 512) grey, soft blots of about 8 px."""
    noise = np.random.default_rng(0).normal(0, 1, (512, 512))
    soft = cv2.GaussianBlur(noise, (0, 0), 8.0)
    return np.asarray(130 + 35 * soft / soft.std(), dtype=np.float32)


def picture(clip: SyntheticClip, frame: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8: the painted hand before black."""
    model = clip.template
    face, mix = draw_faces(
        clip.vertex_pixels[frame], clip.vertices[frame, :, 2], model.faces, (HEIGHT, WIDTH)
    )
    hand = face >= 0
    places = mix_corners(model.uv * 512, model.face_uv, face[hand], mix[hand])
    grey = np.zeros((HEIGHT, WIDTH), np.float32)
    grey[hand] = cv2.remap(painting(), *(part[:, None] for part in places.T), cv2.INTER_LINEAR)[
        :, 0
    ]
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@functools.cache
def footage() -> tuple[SyntheticClip, CropWindows, np.ndarray, np.ndarray]:
    clip = make_clip(FRAMES)
    windows = follow_hands([clip.landmarks], FPS, SIZE)

    def cropped(image: np.ndarray, frame: int) -> np.ndarray:
        return cv2.resize(
            cut(image, windows.corners[frame], windows.side), (SIZE, SIZE), cv2.INTER_AREA
        )

    images = np.stack([cropped(picture(clip, frame), frame) for frame in range(FRAMES)])
    masks = np.stack([cropped(clip.silhouette(frame), frame) for frame in range(FRAMES)])
    return clip, windows, images, masks


def fit_to_errors() -> FittedClip:
    """A fit of its own to landmarks with errors."""
    return copy.deepcopy(_fit_to_errors())


@functools.cache
def _fit_to_errors() -> FittedClip:
    """Landmarks that err by 1.5 px, slowly: no smoothness removes that."""
    clip = footage()[0]
    rng = np.random.default_rng(1)
    walk = cv2.GaussianBlur(rng.normal(0, 1, (FRAMES, 42)), (1, 0), sigmaX=0.01, sigmaY=3.0)
    image = clip.landmarks.image + 1.5 * (walk / walk.std()).reshape(FRAMES, 21, 2)
    tracked = Landmarks(image, clip.landmarks.world, clip.landmarks.score, clip.landmarks.detected)
    return fit_landmarks(tracked, clip.template, Footage(WIDTH, HEIGHT, FPS, FOCAL), SETTINGS)


def texture_of(fitted: FittedClip) -> TextureEnergy:
    clip, windows, images, masks = footage()
    return TextureEnergy(
        images, masks, clip.landmarks.detected, windows, SETTINGS, HAND, fitted.model
    )


def pixel_error(fitted: FittedClip) -> float:
    with torch.no_grad():
        pixels = fitted.model.pixels(torch.as_tensor(posed_vertices(fitted.model))).numpy()
    return float(np.linalg.norm(pixels - footage()[0].vertex_pixels, axis=-1).mean())


def test_a_painted_hand_comes_nearer_to_its_truth_than_by_its_outline() -> None:
    clip, windows, _, masks = footage()
    fields = np.stack([signed_distance(mask) for mask in masks])
    errors = []
    for painted in (False, True):
        fitted = fit_to_errors()
        contour = ContourEnergy(fields, clip.landmarks.detected, windows, SETTINGS, HAND)
        fit_outline(fitted, contour, texture=texture_of(fitted) if painted else None)
        errors.append(pixel_error(fitted))
    # 0.78 and 0.93 px when this was written.
    assert errors[1] < 0.92 * errors[0]


def test_the_energy_and_its_slope_are_those_of_the_linearisation() -> None:
    # Zero where it was linearised; one step down the slope lowers it. Twice gives the same bits.
    fitted = fit_to_errors()
    first, second = texture_of(fitted), texture_of(fitted)
    for energy in (first, second):
        energy.rematch(fitted.model)
    posed = fitted.model.posed()
    value = first(fitted.model, posed)
    assert float(value.detach()) == 0.0
    value.backward()
    slope = fitted.model.variables.turn.grad
    assert slope is not None
    assert float(slope.abs().max()) > 0
    with torch.no_grad():
        fitted.model.variables.turn.sub_(1e-3 * slope / slope.norm())
        assert float(first(fitted.model, posed)) < 0
        assert float(first(fitted.model, posed)) == float(second(fitted.model, posed))
    assert frame_variables(fitted.model.variables).shape == (FRAMES, 51)


def test_the_mean_texture_is_what_was_painted() -> None:
    # True poses: light removed from both, picture and mean agree to a correlation of 0.9.
    clip, windows, images, masks = footage()
    texture = SkinTexture(clip.template, 8.0)
    ratio = SIZE / windows.side
    pixels = ((clip.vertex_pixels - windows.corners[:, None]) * ratio).astype(np.float32)
    vertices = clip.vertices.astype(np.float32)
    views = [texture.view(*parts) for parts in zip(images, masks, vertices, pixels, strict=True)]
    for _ in range(2):
        for view, *hand in zip(views, vertices, pixels, strict=True):
            texture.add(*texture.seen(view, *hand))
        texture.finish()
    for view in views[::6]:
        expected, core = texture.expected(view)
        assert core.sum() > 0.3 * view.region.sum()
        assert np.corrcoef(expected[core], view.detail[core])[0, 1] > 0.9


def test_a_frame_without_a_hand_has_no_energy() -> None:
    clip, windows, images, masks = footage()
    fitted = fit_to_errors()
    energy = TextureEnergy(
        images, np.zeros_like(masks), clip.landmarks.detected, windows, SETTINGS, HAND, fitted.model
    )
    energy.rematch(fitted.model)
    with torch.no_grad():
        fitted.model.variables.turn.add_(0.1)
    assert float(energy(fitted.model, fitted.model.posed()).detach()) == 0.0


def test_smoothing_within_a_region_keeps_a_constant_and_reads_nothing_outside() -> None:
    region = np.zeros((40, 40), bool)
    region[10:30, 5:35] = True
    values = np.where(region, 0.7, 100.0).astype(np.float32)
    np.testing.assert_allclose(smooth_within(values, region, 3.0)[region], 0.7, atol=1e-5)
