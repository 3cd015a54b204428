"""The video of a painted hand whose pose in every frame is known, and fits that err."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from synthetic_clip import FOCAL, FPS, HEIGHT, WIDTH, SyntheticClip, make_clip

from hwp_bench.hands.anchors import vertex_normals
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.importers.shared.frames import CropWindows, cut, follow_hands
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.model import pose_vertices
from hwp_bench.importers.video.pictures import HandPictures, PictureResidual, TextureResidual
from hwp_bench.importers.video.solve import FittedClip, Footage, SolveSettings, fit_landmarks

SETTINGS = SolveSettings(start_steps=40, landmark_steps=80, contour_steps=50, picture_rounds=2)
FRAMES, SIZE, HAND = 20, 160, 150.0
#: What the paint is multiplied by in each channel.
TINT = np.array([1.0, 0.8, 0.65], np.float32)


@functools.cache
def painting() -> np.ndarray:
    """(512, 512) grey, soft blots of about 8 px."""
    noise = np.random.default_rng(0).normal(0, 1, (512, 512))
    soft = cv2.GaussianBlur(noise, (0, 0), 8.0)
    return np.asarray(130 + 35 * soft / soft.std(), dtype=np.float32)


def lamp(frame: int) -> np.ndarray:
    """(3,) logarithm of the gain by each axis of the normal: a lamp that goes round."""
    angle = 2.0 * np.pi * frame / FRAMES
    return np.array([0.4 * np.cos(angle), 0.4 * np.sin(angle), -0.2], np.float32)


def picture(clip: SyntheticClip, frame: int, *, lit: bool = False) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8: the painted hand before black; grey, or tinted and lit."""
    model = clip.template
    face, mix = draw_faces(
        clip.vertex_pixels[frame], clip.vertices[frame, :, 2], model.faces, (HEIGHT, WIDTH)
    )
    hand = face >= 0
    places = mix_corners(model.uv * 512, model.face_uv, face[hand], mix[hand])
    colors = cv2.remap(painting(), *(part[:, None] for part in places.T), cv2.INTER_LINEAR)
    if lit:
        faces = torch.as_tensor(model.faces)
        normals = vertex_normals(torch.as_tensor(clip.vertices[frame]), faces).numpy()
        shown = mix_corners(normals, model.faces, face[hand], mix[hand])
        shown /= np.linalg.norm(shown, axis=1, keepdims=True)
        colors = colors * np.exp(shown @ lamp(frame))[:, None] * TINT
    drawn = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    drawn[hand] = colors
    return np.clip(drawn, 0, 255).astype(np.uint8)


@functools.cache
def footage(*, lit: bool = False) -> tuple[SyntheticClip, CropWindows, np.ndarray, np.ndarray]:
    """The clip, its windows, and (FRAMES, SIZE, SIZE, 3) images with their masks."""
    clip = make_clip(FRAMES)
    windows = follow_hands([clip.landmarks], FPS, SIZE)

    def cropped(image: np.ndarray, frame: int) -> np.ndarray:
        return cv2.resize(
            cut(image, windows.corners[frame], windows.side), (SIZE, SIZE), cv2.INTER_AREA
        )

    images = np.stack([cropped(picture(clip, frame, lit=lit), frame) for frame in range(FRAMES)])
    masks = np.stack([cropped(clip.silhouette(frame), frame) for frame in range(FRAMES)])
    return clip, windows, images, masks


def pictures(*, lit: bool = False) -> HandPictures:
    """The same as the fit sees it."""
    clip, windows, images, masks = footage(lit=lit)
    return HandPictures(images, masks, clip.landmarks.detected, windows, HAND)


def true_pixels() -> np.ndarray:
    """(FRAMES, V, 2) where the vertices truly lie in the images, px."""
    clip, windows = footage()[:2]
    ratio = SIZE / windows.side
    return np.asarray((clip.vertex_pixels - windows.corners[:, None]) * ratio, np.float32)


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


def pixel_error(fitted: FittedClip) -> float:
    """Mean distance of the vertices from their true places, px of the whole frame."""
    with torch.no_grad():
        pixels = fitted.model.pixels(torch.as_tensor(pose_vertices(fitted.model))).numpy()
    return float(np.linalg.norm(pixels - footage()[0].vertex_pixels, axis=-1).mean())


def assert_slopes_lead_down(
    fitted: FittedClip, energies: Sequence[TextureResidual | PictureResidual]
) -> None:
    """Two energies alike: zero where linearised, lower a step down the slope, bit for bit equal."""
    first, second = energies
    for energy in (first, second):
        energy.rematch(fitted.model)
    value, slope = surface_energy(first, fitted)
    assert value == 0.0
    assert np.abs(slope["turn"]).max() > 0
    with torch.no_grad():
        down = 1e-3 * slope["turn"] / np.linalg.norm(slope["turn"])
        fitted.model.variables.turn.sub_(torch.as_tensor(down))
    assert surface_energy(first, fitted)[0] < 0
    assert surface_energy(first, fitted)[0] == surface_energy(second, fitted)[0]


def assert_says_nothing(fitted: FittedClip, energy: TextureResidual | PictureResidual) -> None:
    """The energy is zero wherever the hand goes."""
    energy.rematch(fitted.model)
    with torch.no_grad():
        fitted.model.variables.turn.add_(0.1)
    value, slopes = surface_energy(energy, fitted)
    assert value == 0.0
    assert not any(slope.any() for slope in slopes.values())


def surface_energy(
    energy: TextureResidual | PictureResidual, fitted: FittedClip
) -> tuple[float, dict[str, np.ndarray]]:
    """The energy of the fit as it is now, and its derivatives."""
    free = fitted.model.variables.read()
    slopes = {name: np.zeros_like(value) for name, value in free.items()}
    return energy.add(free, slopes), slopes
