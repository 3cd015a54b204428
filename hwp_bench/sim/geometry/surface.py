"""Surfaces that rays can hit: mesh arithmetic, materials, building blocks of things, and rays."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.rays import ray_mesh
from hwp_bench.hands.template import boundary_vertices

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from scipy.sparse import csr_matrix


def subdivision(faces: np.ndarray, vertex_count: int) -> tuple[csr_matrix, np.ndarray]:
    """One midpoint subdivision: its (4 F, 3) faces, after the (V', V) matrix of per-vertex values.

    The first V rows of the matrix leave the values as they are.
    """
    from scipy.sparse import csr_matrix

    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = (vertex_count + inverse.reshape(3, -1).T).astype(faces.dtype)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    fine = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=0)
    count = len(unique)
    rows = np.concatenate([np.arange(vertex_count), np.repeat(vertex_count + np.arange(count), 2)])
    columns = np.concatenate([np.arange(vertex_count), unique.reshape(-1)])
    values = np.concatenate([np.ones(vertex_count), np.full(2 * count, 0.5)])
    matrix = csr_matrix((values, (rows, columns)), shape=(vertex_count + count, vertex_count))
    return matrix, fine.transpose(0, 2, 1).reshape(-1, 3)


def smoothing(faces: np.ndarray, vertex_count: int, rounds: int) -> csr_matrix:
    """Taubin smoothing as one matrix: rounds facets off without shrinking; the boundary stays.

    Source: Taubin, "A signal processing approach to fair surface design" (lambda 0.5, mu -0.53).
    """
    from scipy.sparse import diags, identity

    adjacency = _adjacency(faces, vertex_count)
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    free = np.ones(vertex_count)
    free[boundary_vertices(faces)] = 0.0
    laplacian = diags(free) @ (diags(1.0 / np.maximum(degree, 1.0)) @ adjacency) - diags(free)
    one = identity(vertex_count, format="csr")
    step = (one - 0.53 * laplacian) @ (one + 0.5 * laplacian)
    matrix = one
    for _ in range(rounds):
        matrix = step @ matrix
    return matrix.tocsr()


def smoothing_step(faces: np.ndarray, vertex_count: int, share: float) -> csr_matrix:
    """(V, V) matrix that replaces a share of each value by the mean of its neighbours'."""
    from scipy.sparse import diags, identity

    adjacency = _adjacency(faces, vertex_count)
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    mean = diags(1.0 / np.maximum(degree, 1.0)) @ adjacency
    # A vertex without neighbours keeps its value.
    keep = 1.0 - share * (degree > 0)
    return (diags(keep) @ identity(vertex_count, format="csr") + share * mean).tocsr()


def normal_operator(faces: np.ndarray, vertex_count: int) -> csr_matrix:
    """(V, F) matrix that adds the faces' vectors up at their corners."""
    from scipy.sparse import csr_matrix

    rows = faces.reshape(-1)
    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(vertex_count, len(faces)))


def surface_normals(vertices: np.ndarray, faces: np.ndarray, operator: csr_matrix) -> np.ndarray:
    """Unit normals at the vertices, weighted by area: (V, 3)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return unit(operator @ np.cross(b - a, c - a))


def ease(x: np.ndarray | float) -> np.ndarray:
    """From 0 to 1 with zero slope at both ends: 3 x^2 - 2 x^3, constant outside of 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors at length 1; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    return vectors / np.maximum(length, 1e-12)


def perpendicular(vector: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Unit vector of what of a vector is perpendicular to a unit axis, (3,) each."""
    return unit(vector - (vector @ axis) * axis)


def best_turn(places: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that brings centred places (N, 3) nearest to others (N, 3).

    Source: the Kabsch algorithm.
    """
    u, _, vt = np.linalg.svd(target.T @ places)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def _adjacency(faces: np.ndarray, vertex_count: int) -> csr_matrix:
    from scipy.sparse import csr_matrix

    rows = np.concatenate([faces[:, i] for i in (0, 1, 2, 1, 2, 0)])
    columns = np.concatenate([faces[:, i] for i in (1, 2, 0, 0, 1, 2)])
    matrix = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(vertex_count,) * 2)
    matrix.data[:] = 1.0
    return matrix


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a surface; textures have row 0 at the top (v = 1)."""

    #: (H, W, 3) float32, linear reflectance.
    albedo: np.ndarray
    #: (H, W) float32 in 0-1, or None for `gloss` everywhere.
    roughness: np.ndarray | None = None
    #: Roughness of a material without a map.
    gloss: float = 0.6
    #: Reflectance at normal incidence.
    specular: float = 0.04
    #: (H, W) float32 m, or None for a smooth surface.
    height: np.ndarray | None = None
    #: Light that wraps around the terminator inside the material, per linear channel.
    wrap: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: Share of the albedo that the surface emits itself, such as a screen.
    glow: float = 0.0


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh with materials, in world metres."""

    #: (V, 3).
    vertices: np.ndarray
    #: (V, 3) unit normals.
    normals: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (F, 3, 2) texture coordinates of the corners.
    corner_uv: np.ndarray
    #: (F,) index into `materials`.
    material: np.ndarray
    #: What the faces are made of.
    materials: tuple[Material, ...]
    #: (F,) 1 where the face is hand, 0 elsewhere (sleeve, object).
    hand: np.ndarray
    #: (V,) share of the sky that each vertex sees, or None until known.
    openness: np.ndarray | None = None


def join(surfaces: list[Surface]) -> Surface:
    """Put surfaces together into one."""
    if len(surfaces) == 1:
        return surfaces[0]
    starts = np.cumsum([0, *(len(part.vertices) for part in surfaces)])
    first = np.cumsum([0, *(len(part.materials) for part in surfaces)])
    pairs = list(zip(surfaces, starts, first, strict=False))
    return Surface(
        vertices=np.concatenate([part.vertices for part in surfaces]),
        normals=np.concatenate([part.normals for part in surfaces]),
        faces=np.concatenate([part.faces + start for part, start, _ in pairs]),
        corner_uv=np.concatenate([part.corner_uv for part in surfaces]),
        material=np.concatenate([part.material + start for part, _, start in pairs]),
        materials=tuple(material for part in surfaces for material in part.materials),
        hand=np.concatenate([part.hand for part in surfaces]),
    )


def transformed(surface: Surface, transform: np.ndarray) -> Surface:
    """Move a surface by a (4, 4) rigid motion with uniform scale."""
    linear = transform[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    return replace(
        surface,
        vertices=surface.vertices @ linear.T + transform[:3, 3],
        normals=surface.normals @ (linear.T / scale),
    )


def rigid(turn: np.ndarray | None, place: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """(4, 4) rigid motion of a rotation (3, 3), if any, and then a way (3,) m."""
    move = np.eye(4)
    if turn is not None:
        move[:3, :3] = turn
    move[:3, 3] = place
    return move


def reversed_faces(surface: Surface) -> Surface:
    """A surface that looks to its other side."""
    return replace(
        surface,
        faces=np.ascontiguousarray(surface.faces[:, ::-1]),
        corner_uv=np.ascontiguousarray(surface.corner_uv[:, ::-1]),
        normals=-surface.normals,
    )


def plain(color: tuple[float, float, float] | np.ndarray, **settings: float) -> Material:
    """A material of one linear colour."""
    albedo = np.asarray(color, dtype=np.float32).reshape(1, 1, 3)
    return Material(albedo=albedo, **settings)  # type: ignore[arg-type]


def coat(color: Sequence[float] | np.ndarray, **settings: float) -> Material:
    """A material of one sRGB colour."""
    return plain(srgb_to_linear(np.array(color)), **settings)


def picture_material(image: np.ndarray, gloss: float) -> Material:
    """A material with the colours of a painted (H, W, 3) uint8 image."""
    return Material(albedo=albedo(image), gloss=gloss)


def shift(surface: Surface, place: tuple[float, float, float] | np.ndarray) -> Surface:
    """A surface moved by (3,) m."""
    return transformed(surface, rigid(None, place))


_Channel = Annotated[float, Meta(ge=0.0, le=1.0)]
#: An sRGB colour, 0-1 each.
Color = tuple[_Channel, _Channel, _Channel]


def shape(
    vertices: np.ndarray,
    faces: np.ndarray,
    corner_uv: np.ndarray,
    material: Material,
    *,
    smooth: bool,
) -> Surface:
    """Make a surface that is not a hand."""
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


def turned(profile: ArrayLike, material: Material, around: int = 28) -> Surface:
    """A solid of revolution about z, of rows of (radius, z) from one end to the other."""
    profile = np.asarray(profile, dtype=np.float64)
    radius, z = profile[:, :1], profile[:, 1:]
    vertices = around_z(radius, z, np.linspace(0.0, 2.0 * np.pi, around + 1))
    return grid(vertices, len(profile), around + 1, material, flip=profile[-1, 1] < profile[0, 1])


def around_z(
    radius: np.ndarray, z: np.ndarray, angles: np.ndarray, tall: np.ndarray | None = None
) -> np.ndarray:
    """Vertices of K rings about z at A angles: (K * A, 3).

    `radius` and `z`, and `tall`, the half axis along y of rings that are ellipses, are (K, A) or
    (K, 1).
    """
    x, y = radius * np.cos(angles), (radius if tall is None else tall) * np.sin(angles)
    return np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1).reshape(-1, 3)


def tube(spine: np.ndarray, radius: np.ndarray, material: Material, *, around: int = 12) -> Surface:
    """A tube with closed ends around a curve that runs along neither x nor y for long."""
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


def sheet(
    vertices: np.ndarray, rows: int, columns: int, material: Material, outward: np.ndarray
) -> Surface:
    """A `grid` that looks along the directions `outward`, (V, 3) or (3,), in the mean."""
    made = grid(vertices, rows, columns, material)
    looks_in = (made.normals * outward).sum() < 0
    return grid(vertices, rows, columns, material, flip=True) if looks_in else made


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


#: Distance by which secondary rays leave their surface, m; below it a hand shades itself.
LIFT = 4e-4


@dataclass(frozen=True)
class Hits:
    """The points where rays meet a mesh."""

    #: (H,) index of the ray.
    ray: np.ndarray
    #: (H,) face that was hit first.
    face: np.ndarray
    #: (H, 3) barycentric weights of the face's corners.
    weights: np.ndarray
    #: (H,) distance in lengths of the ray's direction.
    distance: np.ndarray


class Tracer:
    """One mesh, ready to be asked what rays meet."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, rays: Counter[str]) -> None:
        self._mesh = ray_mesh(vertices, faces)
        self._rays = rays

    def first_hits(self, origins: np.ndarray, directions: np.ndarray, purpose: str) -> Hits:
        """Find the first face on every ray."""
        self._rays[purpose] += len(directions)
        ray, face, u, v, distance = self._mesh.first_hits(origins, directions)
        return Hits(ray, face, np.stack([1.0 - u - v, u, v], axis=1), distance)

    def blocked(self, origins: np.ndarray, directions: np.ndarray, purpose: str) -> np.ndarray:
        """Tell for every ray whether anything is in its way: (N,) bool."""
        self._rays[purpose] += len(directions)
        return self._mesh.blocked(origins, directions)


@dataclass
class RenderCost:
    """Cost of rendering: seconds by pass, rays by purpose."""

    #: Processor seconds by pass; other work on the machine does not count.
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    #: Rays by purpose.
    rays: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Charge what happens inside to one pass."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start
