"""Rasterize a mesh: the nearest face at every pixel, and the silhouette.

OpenCV's polygons cannot replace this: they also fill pixels that the outline only touches, which
makes every hand half a pixel too thick.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.base.kernels import compiled

# Faces with a corner nearer to the camera than this, m, are left out.
_NEAR = 1e-3
# Faces of less area than this, px^2, cover nothing.
_FLAT = 1e-12
# Bits of fractions of a pixel in what OpenCV draws, and the farthest place in them.
_SHIFT, _FAR = 4, 2**20


def draw_faces(
    pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest face at every pixel centre.

    Args:
        pixels: (V, 2) float, px; pixel centres at +0.5.
        depth: (V,) float, m along the viewing axis.
        faces: (T, 3) int, either orientation.

    Returns:
        (H, W) int32 face, -1 where there is none; (H, W, 2) float32 barycentric coordinates of
        its second and third corner. Faces that reach behind the camera or have a corner that is
        not finite are left out.
    """
    face = np.full(size, -1, dtype=np.int32)
    mix = np.zeros((*size, 2), dtype=np.float32)
    nearest = np.full(size, np.inf)
    _draw(
        np.ascontiguousarray(pixels, dtype=np.float64),
        np.ascontiguousarray(depth, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int64),
        face,
        mix,
        nearest,
    )
    return face, mix


def draw_silhouette(pixels: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Draw the area that a mesh covers, (size, size) uint8, 255 where a pixel's centre is in it.

    Vertices are (V, 2) px. Triangles with a corner that is not finite are left out.
    """
    face, _ = draw_faces(pixels, np.ones(len(pixels)), faces, (size, size))
    return np.where(face >= 0, 255, 0).astype(np.uint8)


def mix_corners(
    values: np.ndarray, faces: np.ndarray, face: np.ndarray, mix: np.ndarray
) -> np.ndarray:
    """Interpolate values of the vertices (V, C) at P points of the surface: (P, C) float32.

    `face` (P,) and `mix` (P, 2) are as `draw_faces` returns them.
    """
    result = np.empty((len(face), values.shape[1]), dtype=np.float32)
    _mix(np.ascontiguousarray(values, dtype=np.float32), faces, face, mix, result)
    return result


def fixed_point(pixels: np.ndarray) -> tuple[list[tuple[int, int]], int]:
    """Places (P, 2) px as OpenCV draws them: integers, pixel centres at 0, and its `shift`.

    What is far off or NaN is drawn outside of every image.
    """
    scaled = np.nan_to_num((pixels - 0.5) * 2**_SHIFT, nan=_FAR)
    return [(x, y) for x, y in np.clip(scaled, -_FAR, _FAR).round().astype(int).tolist()], _SHIFT


def draw_dots(
    canvas: np.ndarray, points: np.ndarray, colour: tuple[int, int, int], radius: float
) -> None:
    """Draw discs at points (P, 2) px, with a radius in px, into an image (H, W, 3) uint8."""
    import cv2

    places, shift = fixed_point(points)
    for place in places:
        cv2.circle(canvas, place, round(radius * 2**shift), colour, -1, cv2.LINE_AA, shift)


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two bool arrays; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return 1.0 if union == 0 else np.count_nonzero(first & second) / union


@compiled(nogil=True)
def _draw(
    pixels: np.ndarray,
    depth: np.ndarray,
    faces: np.ndarray,
    face: np.ndarray,
    mix: np.ndarray,
    nearest: np.ndarray,
) -> None:
    height, width = face.shape
    for t in range(faces.shape[0]):
        a, b, c = faces[t]
        if not (depth[a] > _NEAR and depth[b] > _NEAR and depth[c] > _NEAR):
            continue
        x0, y0 = pixels[a]
        x1, y1 = pixels[b]
        x2, y2 = pixels[c]
        area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
        if not abs(area) > _FLAT or not np.isfinite(area):
            continue
        sign = 1.0 if area > 0.0 else -1.0
        left = int(max(np.floor(min(x0, x1, x2) - 0.5), 0.0))
        right = int(min(np.ceil(max(x0, x1, x2) - 0.5), width - 1.0))
        top = int(max(np.floor(min(y0, y1, y2) - 0.5), 0.0))
        bottom = int(min(np.ceil(max(y0, y1, y2) - 0.5), height - 1.0))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                # Signs of the edge functions, before any division: a pixel centre on the edge
                # of two faces is covered by both, and no crack opens between them.
                along = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
                if (
                    sign * along < 0.0
                    or sign * ((x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)) < 0.0
                    or sign * ((x0 - x2) * (y - y2) - (y0 - y2) * (x - x2)) < 0.0
                ):
                    continue
                second = ((x - x0) * (y2 - y0) - (y - y0) * (x2 - x0)) / area
                third = along / area
                first = 1.0 - second - third
                z = first * depth[a] + second * depth[b] + third * depth[c]
                if z < nearest[row, column]:
                    nearest[row, column] = z
                    face[row, column] = t
                    mix[row, column, 0] = second
                    mix[row, column, 1] = third


@compiled(nogil=True)
def _mix(
    values: np.ndarray, faces: np.ndarray, face: np.ndarray, mix: np.ndarray, result: np.ndarray
) -> None:
    for p in range(len(face)):
        a, b, c = faces[face[p]]
        second, third = mix[p, 0], mix[p, 1]
        for k in range(values.shape[1]):
            result[p, k] = (
                (1.0 - second - third) * values[a, k] + second * values[b, k] + third * values[c, k]
            )
