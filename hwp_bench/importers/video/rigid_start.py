"""The start of the fit: one rigid pose for each frame, in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.importers.shared.landmarks import Landmarks

#: Landmarks that move with the palm: wrist, thumb base, and the four knuckles.
PALM = (0, 1, 5, 9, 13, 17)


@dataclass(frozen=True)
class RigidStart:
    """Rigid motion of a hand in F frames.

    Attributes:
        rotation: (F, 3, 3) template rest frame to camera.
        wrist: (F, 3) m, the wrist joint in the camera frame.
        world: (F, 21, 3) m, the tracker's world landmarks turned into the camera frame.
    """

    rotation: np.ndarray
    wrist: np.ndarray
    world: np.ndarray


def rigid_start(
    landmarks: Landmarks, rest: np.ndarray, focal: float, centre: np.ndarray
) -> RigidStart:
    """Estimate the rigid pose of every frame from its world and image landmarks.

    The tracker sees a crop around the hand and assumes that the camera looks straight at it,
    so its world landmarks are first turned by the angle between the optical axis and the ray
    through the hand. The rotation is the orthogonal Procrustes solution on the palm, the place
    the least-squares solution of the pinhole equations, which are linear in it. Frames without
    a detection are interpolated.

    Args:
        landmarks: of the clip.
        rest: (21, 3) m, the template's landmarks at rest.
        focal: px.
        centre: (2,) principal point, px.
    """
    from scipy.spatial.transform import Rotation

    seen = np.flatnonzero(landmarks.detected)
    pixels = landmarks.image[seen]
    turn = _ray_rotation(pixels.mean(axis=1), focal, centre)
    world = np.einsum("fij,fkj->fki", turn, landmarks.world[seen])
    palm = list(PALM)
    rotation = _procrustes(rest[palm], world[:, palm])
    wrist = _place(world - world[:, :1], (pixels - centre) / focal)
    return RigidStart(
        rotation=_interpolate_rotations(Rotation.from_matrix(rotation), seen, landmarks.score.size),
        wrist=interpolate(wrist, seen, landmarks.score.size),
        world=interpolate(world, seen, landmarks.score.size),
    )


def interpolate(values: np.ndarray, seen: np.ndarray, count: int) -> np.ndarray:
    """Fill frames between those seen linearly, and those outside with the nearest.

    Args:
        values: (S, ...) at the frames `seen`.
        seen: (S,) increasing frame numbers, at least one.
        count: number of frames F.

    Returns:
        (F, ...).
    """
    flat = values.reshape(len(seen), -1)
    columns = [np.interp(np.arange(count), seen, column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(count, *values.shape[1:])


def _interpolate_rotations(rotations: object, seen: np.ndarray, count: int) -> np.ndarray:
    from scipy.spatial.transform import Slerp

    if len(seen) == 1:
        return np.repeat(rotations.as_matrix(), count, axis=0)  # type: ignore[attr-defined]
    frames = np.clip(np.arange(count), seen[0], seen[-1])
    return Slerp(seen, rotations)(frames).as_matrix()


def _ray_rotation(pixels: np.ndarray, focal: float, centre: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns the optical axis to the ray through each pixel."""
    from scipy.spatial.transform import Rotation

    slope = (pixels - centre) / focal
    angle = np.arctan(np.linalg.norm(slope, axis=1, keepdims=True))
    axis = np.stack([-slope[:, 1], slope[:, 0], np.zeros(len(slope))], axis=1)
    length = np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    return Rotation.from_rotvec(axis / length * angle).as_matrix()


def _procrustes(rest: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Rotations (F, 3, 3) that take centred `rest` (P, 3) closest to `observed` (F, P, 3)."""
    source = rest - rest.mean(axis=0)
    target = observed - observed.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("fpi,pj->fij", target, source))
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _place(shape: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Translations (F, 3) with (shape + t) on the rays: x (Z + tz) = X + tx, and so for y."""
    one, zero = np.ones_like(rays[..., 0]), np.zeros_like(rays[..., 0])
    rows_x = np.stack([one, zero, -rays[..., 0]], axis=-1)
    rows_y = np.stack([zero, one, -rays[..., 1]], axis=-1)
    matrix = np.concatenate([rows_x, rows_y], axis=1)
    right = np.concatenate(
        [
            rays[..., 0] * shape[..., 2] - shape[..., 0],
            rays[..., 1] * shape[..., 2] - shape[..., 1],
        ],
        axis=1,
    )
    place = np.einsum("fij,fj->fi", np.linalg.pinv(matrix), right)
    # A flat or noisy frame may land at or behind the camera; the fit needs it in front.
    extent = np.linalg.norm(shape, axis=-1).max(axis=1)
    place[:, 2] = np.maximum(place[:, 2], np.maximum(1.5 * extent, 0.01))
    return place
