"""One sheet of texture for the parts of a mesh, which may have textures of their own or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb, srgb_to_linear

#: Largest edge of a part's texture where several share a sheet, px.
TILE = 1024
# Edge in px of the grid on which overlaps are looked for, and the share that counts as one.
_GRID, _OVERLAP = 512, 1.15
# Least share of the sheet that usable coordinates cover.
_LEAST = 0.02
# Edge of a cell that two packed triangles share, of which the rest is margin.
_INNER = 0.84


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles with one material."""

    #: (V, 3) vertices.
    vertices: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (V, 2) texture coordinates, origin at the bottom left, or None.
    uv: np.ndarray | None
    #: (H, W, 3) uint8 sRGB, or None.
    texture: np.ndarray | None
    #: (3,) linear factor on the texture, or the colour where there is none.
    tint: np.ndarray


@dataclass(frozen=True, eq=False)
class Sheet:
    """Texture coordinates of all triangles, and the texture that they refer to."""

    #: (T, 2) coordinates, origin at the bottom left.
    uv: np.ndarray
    #: (F, 3) indices into `uv`.
    faces: np.ndarray
    #: (H, W, 3) uint8 sRGB, or None where nothing has a texture.
    texture: np.ndarray | None


def joined_sheet(parts: list[Part]) -> Sheet:
    """Put textures side by side, and coordinates with them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    blank = [np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv for part in parts]
    uv = np.concatenate(blank)
    if all(part.texture is None for part in parts):
        return Sheet(uv, faces, None)
    if len(parts) == 1:
        return Sheet(uv, faces, _tinted(parts[0]))
    corners = []
    for column, (part, own) in enumerate(zip(parts, blank, strict=True)):
        corner = own[part.faces]
        corner = corner - np.floor(corner.min(axis=1, keepdims=True) + 1e-9)
        corner = np.clip(corner, 0.0, 1.0)
        corner[..., 0] = (column + corner[..., 0]) / len(parts)
        corners.append(corner)
    joined = np.concatenate(corners)
    return Sheet(
        joined.reshape(-1, 2),
        np.arange(3 * len(joined)).reshape(-1, 3),
        _side_by_side([_tinted(part) for part in parts]),
    )


def paintable(uv: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates to paint skin on: these if every triangle has its own place, else packed ones.

    Args:
        uv: (T, 2) coordinates of a whole mesh, after it was cut and closed.
        faces: (F, 3) indices into them.
    """
    return (uv, faces) if _apart(uv[faces]) else packed(len(faces))


def packed(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in which every triangle has a place of its own.

    Args:
        count: F, triangles.

    Returns:
        (3 F, 2) coordinates in [0, 1], and (F, 3) indices into them.
    """
    edge = int(np.ceil(np.sqrt((count + 1) // 2)))
    cell = np.arange(count) // 2
    start = np.stack([cell % edge, cell // edge], axis=1)[:, None]
    low, high = (1.0 - _INNER) / 2, (1.0 + _INNER) / 2
    gap = (1.0 - _INNER) / 2
    lower = np.array([[low, low], [high - gap, low], [low, high - gap]])
    upper = np.array([[high, high], [low + gap, high], [high, low + gap]])
    shape = np.where((np.arange(count) % 2 == 0)[:, None, None], lower, upper)
    return ((start + shape) / edge).reshape(-1, 2), np.arange(3 * count).reshape(-1, 3)


def _apart(corners: np.ndarray) -> bool:
    """Whether triangles (F, 3, 2) lie in the unit square without covering one another much."""
    import cv2

    if not np.isfinite(corners).all() or corners.min() < -1e-3 or corners.max() > 1.0 + 1e-3:
        return False
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2.0
    image = np.zeros((_GRID, _GRID), dtype=np.uint8)
    for corner in np.round(corners * (_GRID - 1) * 16).astype(np.int32):
        cv2.fillConvexPoly(image, corner, 1, shift=4)
    return area > _LEAST and area <= _OVERLAP * float(image.mean())


def _tinted(part: Part) -> np.ndarray:
    """The part's colour in sRGB, (H, W, 3) uint8."""
    if part.texture is None:
        texture = np.full((1, 1, 3), 255, dtype=np.uint8)
    elif (part.tint >= 1.0).all():
        return part.texture
    else:
        texture = part.texture
    return eight_bit_srgb(srgb_to_linear(texture / 255.0) * part.tint)


def _side_by_side(textures: list[np.ndarray]) -> np.ndarray:
    import cv2

    edge = min(TILE, max(max(texture.shape[:2]) for texture in textures))
    edge = max(edge, 16)
    return np.concatenate(
        [
            cv2.resize(texture, (edge, edge), interpolation=cv2.INTER_AREA).reshape(edge, edge, 3)
            for texture in textures
        ],
        axis=1,
    )
