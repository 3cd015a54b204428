"""Building blocks of objects: boxes, solids of revolution, sheets, and painted textures."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.mesh import normal_operator, surface_normals
from hwp_bench.sim.geometry.surface import Material, Surface

Color = tuple[float, float, float]


def shape(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uv: np.ndarray,
    material: Material,
    *,
    smooth: bool,
) -> Surface:
    """Make a surface that is not a hand.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3), counter-clockwise seen from outside.
        corner_uv: (F, 3, 2).
        material: what all of it is made of.
        smooth: share normals between faces, or give every face its own.
    """
    if not smooth:
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    normals = surface_normals(vertices, faces, normal_operator(faces, len(vertices)))
    return Surface(
        vertices=vertices,
        normals=normals,
        faces=faces,
        corner_uv=corner_uv,
        material=np.zeros(len(faces), dtype=np.int64),
        materials=(material,),
        hand=np.zeros(len(faces), dtype=bool),
    )


def box(size: tuple[float, float, float], material: Material) -> Surface:
    """A box around the origin; each side shows the whole texture, +z upright."""
    x, y, z = (edge / 2 for edge in size)
    sides = (
        ((-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)),
        ((x, -y, -z), (-x, -y, -z), (-x, y, -z), (x, y, -z)),
        ((x, -y, z), (x, -y, -z), (x, y, -z), (x, y, z)),
        ((-x, -y, -z), (-x, -y, z), (-x, y, z), (-x, y, -z)),
        ((-x, y, z), (x, y, z), (x, y, -z), (-x, y, -z)),
        ((-x, -y, -z), (x, -y, -z), (x, -y, z), (-x, -y, z)),
    )
    vertices = np.array(sides, dtype=np.float64).reshape(-1, 3)
    start = np.arange(6)[:, None] * 4
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (start + halves[:, None]).reshape(-1, 3)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    uv = np.concatenate(
        [np.tile(corners[[0, 1, 2]], (6, 1, 1)), np.tile(corners[[0, 2, 3]], (6, 1, 1))]
    )
    return shape(vertices, faces, uv, material, smooth=False)


def turned(profile: np.ndarray, material: Material, around: int = 28) -> Surface:
    """A solid of revolution about z.

    Args:
        profile: (K, 2) rows of (radius, z) from one end to the other.
        material: its material; u runs around, v along.
        around: number of faces around.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, around + 1)
    radius, z = profile[:, 0], profile[:, 1]
    vertices = np.stack(
        [
            radius[:, None] * np.cos(angles),
            radius[:, None] * np.sin(angles),
            np.broadcast_to(z[:, None], (len(z), len(angles))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return grid(vertices, len(profile), around + 1, material, flip=z[-1] < z[0])


def tube(spine: np.ndarray, radius: np.ndarray, material: Material, *, around: int = 12) -> Surface:
    """A tube with closed ends around a curve that runs along neither x nor y for long.

    Args:
        spine: (K, 3) m.
        radius: (K,) m at each of its points.
        material: its material; u runs around, v along.
        around: number of faces around.
    """
    way = np.gradient(spine, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    # The same axis everywhere, so that the tube does not twist.
    still = np.array([1.0, 0.0, 0.0]) if abs(way[:, 0]).max() < 0.9 else np.array([0.0, 1.0, 0.0])
    first = still - (way @ still)[:, None] * way
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(way, first)
    angles = np.linspace(0.0, 2.0 * np.pi, around + 1)
    rings = spine[:, None] + radius[:, None, None] * (
        first[:, None] * np.cos(angles)[None, :, None]
        + second[:, None] * np.sin(angles)[None, :, None]
    )
    first_end, last_end = (np.repeat(spine[None, None, k], around + 1, 1) for k in (0, -1))
    closed = np.concatenate([first_end, rings, last_end])
    return grid(closed.reshape(-1, 3), len(closed), around + 1, material)


def grid(
    vertices: np.ndarray, rows: int, columns: int, material: Material, *, flip: bool = False
) -> Surface:
    """A sheet of (rows, columns) vertices; v runs along the rows, u along the columns."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (row * columns + column).ravel()
    quads = np.stack([a, a + 1, a + columns + 1, a + columns], axis=1)
    uv = np.stack([quads % columns / (columns - 1), quads // columns / (rows - 1)], axis=-1)
    order = ([0, 1, 2], [0, 2, 3]) if not flip else ([0, 2, 1], [0, 3, 2])
    faces = np.concatenate([quads[:, pick] for pick in order])
    corner_uv = np.concatenate([uv[:, pick] for pick in order])
    return shape(vertices, faces, corner_uv, material, smooth=True)


def canvas(height: int, width: int, color: Color) -> np.ndarray:
    """An image of one colour: (H, W, 3) uint8."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = ink(color)
    return image


def ink(color: Color) -> tuple[int, int, int]:
    """A colour in 0-1 as OpenCV's brushes take it."""
    red, green, blue = (round(255 * channel) for channel in color)
    return red, green, blue


def albedo(image: np.ndarray) -> np.ndarray:
    """Linear reflectance of a painted (H, W, 3) uint8 image: float32."""
    return srgb_to_linear(image / 255.0).astype(np.float32)
