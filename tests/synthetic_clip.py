"""A hand with known parameters, its landmarks as a tracker gives them, and its video."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.hands import HandParameters, HandTemplate, load_template
from hwp_bench.hands.articulation import joint_axes
from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.hands.template import boundary_vertices, rebuilt
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video import SolveSettings

WIDTH, HEIGHT, FOCAL, FPS = 320, 240, 260.0, 30.0
SKIN, WALL, CUP = (205, 150, 120), (90, 110, 140), (40, 160, 60)


def landmark_import(steps: int, outline_steps: int) -> SolveSettings:
    """An import that is only as good as the landmarks: few steps, no texture, no pictures."""
    return SolveSettings(
        start_steps=steps,
        landmark_steps=steps,
        contour_steps=outline_steps,
        contour_rounds=1,
        texture=False,
        picture_rounds=0,
    )


@functools.cache
def template(side: str = "right") -> HandTemplate:
    return load_template(side=side)


def with_correctives(hand: HandTemplate) -> HandTemplate:
    """The same hand, whose vertices move by millimetres with its pose."""
    basis = np.random.default_rng(0).normal(0, 1e-3, (len(hand.vertices), 3, 135))
    return rebuilt(hand, pose_basis=basis)


def disc(centre: np.ndarray, radius: float, corners: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (centre first) and faces of a disc."""
    angle = np.arange(corners) * 2 * np.pi / corners
    rim = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    index = np.arange(corners)
    faces = np.stack([0 * index, 1 + index, 1 + (index + 1) % corners], axis=1)
    return np.concatenate([centre[None], rim]), faces


@dataclass(frozen=True)
class SyntheticClip:
    """Truth, and what a perfect tracker would see of it."""

    template: HandTemplate
    hand: HandParameters
    vertices: np.ndarray
    vertex_pixels: np.ndarray
    joints: np.ndarray
    landmarks: Landmarks

    def silhouette(self, frame: int) -> np.ndarray:
        """(HEIGHT, WIDTH) uint8."""
        square = draw_silhouette(self.vertex_pixels[frame], self.template.faces, WIDTH)
        return square[:HEIGHT]

    def picture(self, frame: int) -> np.ndarray:
        """(HEIGHT, WIDTH, 3) uint8: a skin-coloured hand with its forearm before a wall."""
        noise = np.random.default_rng(frame).normal(0, 4, (HEIGHT, WIDTH, 3))
        picture = np.tile(np.array(WALL, float), (HEIGHT, WIDTH, 1))
        self.paint(picture, frame)
        return np.clip(picture + noise, 0, 255).astype(np.uint8)

    def paint(self, picture: np.ndarray, frame: int) -> None:
        """Draw hand and forearm into a picture, in place."""
        ring = self.vertex_pixels[frame][boundary_vertices(self.template.faces)]
        wrist, knuckle = ring.mean(axis=0), self.landmarks.image[frame, 9]
        along = (wrist - knuckle) / np.linalg.norm(wrist - knuckle)
        arm = np.concatenate([ring, ring + 300 * along]).astype(np.float32)
        hull = cv2.convexHull(arm).astype(np.int32)
        cv2.fillConvexPoly(picture, hull, SKIN)
        picture[self.silhouette(frame) > 0] = SKIN


def make_clip(
    frames: int = 30, *, side: str = "right", bend: float = 0.5, shift: np.ndarray | None = None
) -> SyntheticClip:
    """A hand, fingers up and palm to the camera, that opens, closes and turns a little.

    `shift` (F, 3) m is added to its place.
    """
    model = template(side)
    time = np.linspace(0, 2 * np.pi, frames)
    mirror = 1.0 if side == "right" else -1.0
    # The rest fingers point along -x (a left hand's along x) and the palm along -y.
    upright = cv2.Rodrigues(np.array([0.0, 0.0, mirror * np.pi / 2]))[0]
    facing = cv2.Rodrigues(np.array([0.0, mirror * np.pi / 2, 0.0]))[0]
    pose = np.zeros((frames, 16, 3))
    for frame, moment in enumerate(time):
        wobble = cv2.Rodrigues(np.array([0.15 * np.sin(moment), 0.3 * np.cos(moment), 0.0]))[0]
        pose[frame, 0] = cv2.Rodrigues(wobble @ facing @ upright)[0][:, 0]
    flexion = joint_axes(model)[:, :, 0]
    amount = bend * (0.5 - 0.5 * np.cos(time))
    pose[:, 1:] = amount[:, None, None] * flexion
    transl = np.stack([0.03 * np.sin(time), 0.05 + 0.02 * np.cos(time), 0.42 + 0.0 * time], axis=1)
    transl = transl if shift is None else transl + shift
    hand = HandParameters(pose, np.full(10, 0.3), transl, np.ones(frames, dtype=bool))
    posed = pose_parameters(model, hand)
    joints = posed.landmarks.numpy()
    world = joints - joints.mean(axis=1, keepdims=True)
    # A tracker sees the hand as if the camera looked straight at it.
    for frame, middle in enumerate(joints.mean(axis=1)):
        slope = middle[:2] / middle[2]
        axis = np.array([-slope[1], slope[0], 0.0])
        angle = np.arctan(np.linalg.norm(slope)) / max(np.linalg.norm(slope), 1e-9)
        world[frame] = world[frame] @ cv2.Rodrigues(axis * angle)[0]
    landmarks = Landmarks(to_pixels(joints), world, np.ones(frames), np.ones(frames, dtype=bool))
    vertices = posed.vertices.numpy()
    return SyntheticClip(model, hand, vertices, to_pixels(vertices), joints, landmarks)


def to_pixels(points: np.ndarray) -> np.ndarray:
    return points[..., :2] / points[..., 2:] * FOCAL + np.array([WIDTH / 2, HEIGHT / 2])


def write_video(path: Path, pictures: list[np.ndarray]) -> Path:
    """Motion JPEG in AVI, which OpenCV reads and writes on every machine."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def write_landmarks(path: Path, landmarks: Landmarks, **changes: np.ndarray) -> Path:
    arrays = {"image": landmarks.image, "world": landmarks.world, "score": landmarks.score}
    np.savez(path, **{**arrays, **changes})  # type: ignore[arg-type]
    return path
