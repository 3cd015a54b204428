"""The scene behind the hands: backdrops, and people and things that move before them.

Backdrops are rooms out of focus, or planes close behind in colours of skin. Places of what moves
are in halves of the picture: x from -1 (left) to 1 (right), y from -1 (top) to 1 (bottom).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadInput
from hwp_bench.base.records import Seed, number
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import unit
from hwp_bench.sim.subject.hand import skin_color

_Rgb = tuple[float, float, float]
_Tone = Annotated[float, Meta(ge=-0.4, le=1.4)]
_Place = Annotated[float, Meta(ge=-2.0, le=2.0)]
#: Edge of a texture in texels, over slopes -1 to 1.
PLANE_TEXTURE = 1024
# Width of the soft focus, texels.
_PLANE_BLUR = 1.3


def plane_names() -> tuple[str, ...]:
    """Names of these backdrops."""
    return tuple(_PAINTERS)


def plane_texture(name: str, seed: int) -> np.ndarray:
    """Paint a backdrop: (PLANE_TEXTURE, PLANE_TEXTURE, 3) float32 linear."""
    import cv2

    ticks = np.linspace(-1.0, 1.0, PLANE_TEXTURE)
    x, y = np.meshgrid(ticks, ticks)
    image = _PAINTERS[name](x, y, generator(seed, "plane", name))
    linear = srgb_to_linear(np.clip(image, 0.02, 1.0)).astype(np.float32)
    return cv2.GaussianBlur(linear, (0, 0), _PLANE_BLUR)


def _noise(x: np.ndarray, y: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return fractal_noise(points, scale, rng).reshape(x.shape)


def _wood(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Boards that run from left to right, with grain and gaps."""
    board = 0.17
    row = np.floor(y / board + 50.0).astype(int)
    tint = rng.normal(0.0, 0.05, 200)[row % 200]
    shift = rng.uniform(0.0, 4.0, 200)[row % 200]
    bend = _noise(0.35 * x + shift, 2.0 * y, 0.4, rng)
    grain = np.cos(2.0 * np.pi * (y / 0.016 + 1.5 * bend)) * (0.5 + 0.3 * bend)
    fine = _noise(0.08 * x + shift, y, 0.006, rng)
    gap = np.exp(-(((y / board + 50.0) % 1.0 / 0.022) ** 2))
    shade = 1.0 + tint + 0.045 * grain + 0.035 * fine
    color = np.array([0.76, 0.57, 0.42])
    return color * shade[..., None] ** np.array([1.0, 1.25, 1.5]) * (1.0 - 0.45 * gap)[..., None]


def _cardboard(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flutes that show through, fibres, and a fold."""
    flutes = np.cos(2.0 * np.pi * x / 0.02)
    fibres = _noise(x, 0.3 * y, 0.008, rng)
    stain = _noise(x, y, 0.35, rng)
    place = rng.uniform(-0.12, 0.12)
    fold = (y - place - 0.03 * x) / 0.006
    crease = -0.12 * np.exp(-(fold**2)) + 0.06 * np.exp(-((fold - 2.0) ** 2))
    shade = 1.0 + 0.02 * flutes + 0.03 * fibres + 0.035 * stain + crease
    return np.array([0.74, 0.59, 0.46]) * shade[..., None]


def _sand(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ripples and grains."""
    bend = _noise(x, y, 0.3, rng)
    ripples = np.sin(2.0 * np.pi * (y / 0.11 + 0.5 * bend))
    grains = rng.normal(0.0, 1.0, x.shape)
    lumps = _noise(x, y, 0.02, rng)
    shade = 1.0 + 0.07 * ripples + 0.13 * grains + 0.03 * lumps
    return np.array([0.83, 0.70, 0.57]) * shade[..., None]


def _beige_wall(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rough plaster, brighter on one side."""
    rough = _noise(x, y, 0.012, rng)
    stain = _noise(x, y, 0.6, rng)
    shade = 0.97 + 0.018 * rough + 0.025 * stain + 0.10 * x
    return np.array([0.86, 0.73, 0.64]) * shade[..., None]


_PAINTERS: Mapping[str, Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]] = (
    MappingProxyType(
        {"wood": _wood, "cardboard": _cardboard, "sand": _sand, "beige_wall": _beige_wall}
    )
)

# Edge of a room's texture in texels.
_TEXTURE = 384
# Walls and tables, both blurred by the distance: their sRGB, how far below the centre of the image
# the table's edge is, as a slope, and the number of things that stand around.
_ROOMS: Mapping[str, tuple[_Rgb, _Rgb, float, int]] = MappingProxyType(
    {
        "office": ((0.72, 0.74, 0.76), (0.55, 0.42, 0.30), 0.10, 9),
        "kitchen": ((0.84, 0.80, 0.72), (0.80, 0.79, 0.77), 0.06, 12),
        "study": ((0.42, 0.45, 0.42), (0.36, 0.24, 0.16), 0.12, 14),
        "studio": ((0.58, 0.62, 0.68), (0.64, 0.66, 0.70), 0.16, 3),
        "living": ((0.66, 0.56, 0.48), (0.48, 0.36, 0.28), 0.08, 11),
        "workshop": ((0.50, 0.50, 0.44), (0.62, 0.48, 0.32), 0.11, 16),
        "bedroom": ((0.78, 0.68, 0.70), (0.70, 0.62, 0.58), 0.13, 6),
        "garden": ((0.34, 0.46, 0.28), (0.46, 0.42, 0.32), 0.07, 18),
        "bathroom": ((0.80, 0.88, 0.90), (0.90, 0.90, 0.88), 0.09, 7),
        "garage": ((0.44, 0.42, 0.46), (0.30, 0.30, 0.32), 0.12, 15),
        "cafe": ((0.52, 0.34, 0.26), (0.26, 0.16, 0.11), 0.08, 13),
        "corridor": ((0.70, 0.72, 0.66), (0.50, 0.46, 0.42), 0.14, 4),
        "classroom": ((0.82, 0.82, 0.70), (0.66, 0.54, 0.36), 0.10, 10),
        "library": ((0.46, 0.36, 0.28), (0.40, 0.28, 0.18), 0.09, 18),
        "balcony": ((0.60, 0.70, 0.80), (0.58, 0.55, 0.50), 0.10, 8),
        "laundry": ((0.76, 0.80, 0.84), (0.60, 0.64, 0.66), 0.12, 10),
        "nursery": ((0.88, 0.78, 0.60), (0.74, 0.66, 0.56), 0.08, 12),
        "greenhouse": ((0.42, 0.58, 0.44), (0.36, 0.34, 0.28), 0.09, 17),
        "cellar": ((0.32, 0.31, 0.30), (0.40, 0.38, 0.36), 0.13, 12),
        "music_room": ((0.48, 0.30, 0.34), (0.32, 0.20, 0.14), 0.10, 9),
        "shop": ((0.72, 0.66, 0.78), (0.56, 0.50, 0.46), 0.07, 20),
        "attic": ((0.62, 0.52, 0.38), (0.50, 0.40, 0.26), 0.15, 7),
    }
)


def backdrop_names() -> tuple[str, ...]:
    """Names of the backdrops that a scene can name."""
    return (*_ROOMS, *plane_names())


def check_backdrop(name: str, where: str) -> None:
    """Refuse an unknown backdrop."""
    if name not in backdrop_names():
        known = f"Known: {', '.join(backdrop_names())}."
        raise BadInput(f"is {name!r}", where=where, field="background", remedy=known)


@lru_cache(maxsize=2)
def _texture(name: str, seed: int) -> np.ndarray:
    """(T, T, 3) float32 linear, over slopes -1..1 in both directions."""
    import cv2

    if name not in _ROOMS:
        return plane_texture(name, seed)
    wall_color, table_color, edge, clutter = _ROOMS[name]
    rng = generator(seed, "backdrop", name)
    ticks = np.linspace(-1.0, 1.0, _TEXTURE)
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x.ravel(), 3.0 * y.ravel(), np.zeros(x.size)], axis=1)
    grain = fractal_noise(points * [1.0, 4.0, 1.0], 0.25, rng).reshape(x.shape)
    stain = fractal_noise(points, 0.5, rng).reshape(x.shape)
    wall = np.array(wall_color) * (1.0 + 0.04 * stain + 0.1 * x)[..., None]
    table = np.array(table_color) * (1.0 + 0.08 * grain)[..., None]
    image = np.clip(wall, 0.02, 1.0)
    for _ in range(clutter):
        left, width = rng.uniform(-0.6, 0.55), rng.uniform(0.04, 0.2)
        bottom = edge + rng.uniform(-0.02, 0.03)
        top = bottom - rng.uniform(0.06, 0.4)
        color = np.clip(rng.uniform(0.1, 0.85, 3) * 0.6 + 0.2 * rng.uniform(), 0.05, 0.9)
        inside = (x > left) & (x < left + width) & (y > top) & (y < bottom)
        shade = 1.0 + 0.25 * (x - left) / width
        image = np.where(inside[..., None], np.clip(color * shade[..., None], 0, 1), image)
    on_table = (y > edge + 0.03 * x)[..., None]
    image = np.where(on_table, np.clip(table, 0.02, 1.0), image)
    linear = srgb_to_linear(image).astype(np.float32)
    return cv2.GaussianBlur(linear, (0, 0), 4.0)


def backdrop_colors(name: str, seed: int, directions: np.ndarray) -> np.ndarray:
    """The backdrop in each viewing direction, under white light: (H, W, 3) linear reflectance."""
    import cv2

    slope = directions[..., :2] / np.maximum(directions[..., 2:], 1e-3)
    slope += 1.0
    slope /= 2.0
    texture = _texture(name, seed)
    slope *= len(texture) - 1
    x, y = (np.ascontiguousarray(slope[..., axis], dtype=np.float32) for axis in (0, 1))
    return cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


#: Opacity and shade at places relative to the shape: right and down, (h, w) each.
Cover = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Canvas:
    """The picture at one moment."""

    #: (H, W, 3) linear, is painted on.
    image: np.ndarray
    #: (H, W) right and (H, W) down, halves of the picture.
    places: tuple[np.ndarray, np.ndarray]
    #: Time of the capture, s.
    seconds: float
    #: Skin tone of the subject.
    tone: float

    def paint(self, at: tuple[float, float], reach: float, color: np.ndarray, cover: Cover) -> None:
        """Paint one shape in a linear colour (3,)."""
        x, y = self.places
        rows = np.flatnonzero(np.abs(y[:, [0, -1]] - at[1]).min(axis=1) < reach)
        columns = np.flatnonzero(np.abs(x[[0, -1]] - at[0]).min(axis=0) < reach)
        if not len(rows) or not len(columns):
            return
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        opacity, shade = cover(x[part] - at[0], y[part] - at[1])
        target = self.image[part]
        target += opacity[..., None] * (shade[..., None] * color - target)


# Share of the objects in colours of skin, and the ends of those colours in sRGB.
_SKIN_LIKE = 0.34
_SKINS = np.array([[0.92, 0.75, 0.62], [0.45, 0.30, 0.21]])
# Width over which objects drift before they come back at the other border, and their soft edge.
_WIDE, _THING_EDGE = 3.4, 0.05


@dataclass(frozen=True)
class Clutter:
    """Objects that drift past, a third of them in colours of skin."""

    #: How many.
    count: int = number(8, 1, 60)
    #: Speed, halves of the picture a second.
    speed: float = number(0.25, 0.0, 3.0)
    #: Which ones, and where they start.
    seed: Seed = 0

    def draw(self, canvas: Canvas) -> None:
        """Draw the objects of a moment."""
        rng = generator(self.seed, "clutter")
        drifted = canvas.seconds * self.speed
        for _ in range(self.count):
            color = rng.uniform(0.08, 0.9, 3)
            if rng.uniform() < _SKIN_LIKE:
                color = _SKINS[0] + rng.uniform() * (_SKINS[1] - _SKINS[0])
            size = rng.uniform(0.10, 0.32)
            kind = int(rng.integers(3))
            ratio = (rng.uniform(0.6, 1.0), 1.0, rng.uniform(0.16, 0.3))[kind]
            way = rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.6)
            half, corner = (size, size * ratio), (0.02, size, 0.9 * size * ratio)[kind]
            start_x, start_y = rng.uniform(-1.0, 1.0, 2) * [_WIDE / 2.0, 0.85]
            rng.normal(0.0, 0.2)
            angle, spin = rng.uniform(0.0, 2.0 * np.pi), rng.normal(0.0, 1.2)
            phase = rng.uniform(0.0, 2.0 * np.pi)
            x = (start_x + drifted * way + _WIDE / 2.0) % _WIDE - _WIDE / 2.0
            y = start_y + 0.12 * np.sin(2.0 * self.speed * canvas.seconds + phase)
            cover = _rounded_box(half, corner, angle + self.speed * spin * canvas.seconds)
            reach = 1.45 * max(half) + _THING_EDGE
            canvas.paint((x, y), reach, srgb_to_linear(np.array(color)), cover)


def _rounded_box(half: tuple[float, float], corner: float, turn: float) -> Cover:
    cosine, sine = np.cos(turn), np.sin(turn)

    def cover(right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = np.abs(cosine * right + sine * down) - half[0] + corner
        b = np.abs(cosine * down - sine * right) - half[1] + corner
        outside = np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0))
        distance = outside + np.minimum(np.maximum(a, b), 0.0) - corner
        shade = 0.75 - 0.35 * (right + 1.4 * down) / half[0]
        return np.clip(0.5 - distance / _THING_EDGE, 0.0, 1.0), np.clip(shade, 0.25, 1.3)

    return cover


# Limbs from elbow to fist as rows of (along, across, along, across, radius, radius), in halves of
# the picture; the wrist is the origin.
_LIMBS = (
    (-2.4, 0.0, -0.9, 0.0, 0.34, 0.26),
    (-0.95, 0.0, 0.0, 0.0, 0.265, 0.165),
    (-0.02, 0.0, 0.20, 0.0, 0.17, 0.21),
    (0.16, -0.13, 0.36, -0.13, 0.085, 0.08),
    (0.16, -0.045, 0.40, -0.045, 0.085, 0.08),
    (0.16, 0.045, 0.40, 0.045, 0.085, 0.08),
    (0.16, 0.13, 0.35, 0.13, 0.08, 0.075),
    (0.05, -0.18, 0.24, -0.20, 0.085, 0.07),
)
_LIMB_EDGE = 0.035
_ARM_LIGHT = unit(np.array([-0.35, -0.75, 0.56]))


@dataclass(frozen=True)
class OtherArm:
    """A forearm with a closed hand that reaches into the picture and back."""

    #: Skin tone as the subject has one; the subject's if None.
    tone: _Tone | None = None
    #: The border that it comes from.
    side: Literal["left", "right"] = "left"
    #: How far it reaches in, in the mean.
    reach: float = number(0.9, 0.0, 2.0)
    #: How far it moves.
    sway: float = number(0.35, 0.0, 1.0)
    #: Rounds of its motion a second.
    pace: float = number(0.22, 0.0, 3.0)
    #: Phase and marks.
    seed: Seed = 0

    def draw(self, canvas: Canvas) -> None:
        """Draw the arm at one moment."""
        color = srgb_to_linear(skin_color(canvas.tone if self.tone is None else self.tone))
        rng = generator(self.seed, "other arm")
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        turn = 2.0 * np.pi * self.pace * canvas.seconds
        side = -1.0 if self.side == "left" else 1.0
        inside = self.reach + self.sway * np.sin(turn + phases[0])
        lift = rng.uniform(-0.05, 0.45) + 0.6 * self.sway * np.sin(0.73 * turn + phases[1])
        angle = rng.uniform(-0.5, 0.05) + 0.5 * self.sway * np.sin(1.31 * turn + phases[2])
        along = np.array([-side * np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]]) * -side
        wrist = np.array([side * (1.0 - inside), lift])
        for a0, c0, a1, c1, r0, r1 in _LIMBS:
            start = wrist + a0 * along + c0 * across
            end = wrist + a1 * along + c1 * across
            middle, way = 0.5 * (start + end), end - start
            far = 0.5 * np.sqrt(float(way @ way)) + max(r0, r1) + _LIMB_EDGE
            cover = _limb(middle, start, way, (r0, r1))
            canvas.paint((float(middle[0]), float(middle[1])), far, color, cover)


def _limb(
    middle: np.ndarray, start: np.ndarray, way: np.ndarray, radius: tuple[float, float]
) -> Cover:
    """A tapered limb with round ends, shaded as if it were a body."""
    square = float(way @ way)

    def cover(right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = right + middle[0] - start[0], down + middle[1] - start[1]
        through = np.clip((x * way[0] + y * way[1]) / square, 0.0, 1.0)
        width = radius[0] + through * (radius[1] - radius[0])
        off_x, off_y = (x - through * way[0]) / width, (y - through * way[1]) / width
        out = np.hypot(off_x, off_y)
        front = np.sqrt(np.clip(1.0 - out * out, 0.0, 1.0))
        facing = off_x * _ARM_LIGHT[0] + off_y * _ARM_LIGHT[1] + front * _ARM_LIGHT[2]
        shade = 0.36 + 0.70 * np.clip((facing + 0.2) / 1.2, 0.0, None)
        return np.clip(0.5 + (1.0 - out) * width / _LIMB_EDGE, 0.0, 1.0), shade

    return cover


#: Rows and columns of the picture.
_ROWS, _COLUMNS = 420, 360
#: What it covers, in halves of the head's height: left, right, top, bottom.
_FRAME = (-1.3, 1.3, -1.2, 1.83)
# Width of the blur, of half the head's height.
_BLUR = 0.022
_FACE_LIGHT = unit(np.array([-0.45, -0.65, 0.62]))
_LIPS = (0.62, 0.30, 0.30)
_HAIR_COLORS = ((0.10, 0.07, 0.05), (0.26, 0.16, 0.09), (0.55, 0.42, 0.25))
# Paints a part, (_ROWS, _COLUMNS) 0-1, in a linear colour.
_Over = Callable[[np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class _Grid:
    """Places of the picture: u to the right and v down, in halves of the head's height."""

    u: np.ndarray
    v: np.ndarray

    def spot(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """A soft round spot, 1 in its middle."""
        return np.exp(-(((self.u - u) / wide) ** 2) - ((self.v - v) / tall) ** 2)

    def pair(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """A spot on either side of the face."""
        return self.spot(-u, v, wide, tall) + self.spot(u, v, wide, tall)

    def disc(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """An ellipse, 1 inside."""
        radius = np.hypot((self.u - u) / wide, (self.v - v) / tall)
        return np.clip((1.0 - radius) * min(wide, tall) / 0.014 + 0.5, 0.0, 1.0)


@lru_cache(maxsize=4)
def face_picture(skin: tuple[float, float, float], seed: int, closed: bool) -> np.ndarray:
    """Paint a face: (_ROWS, _COLUMNS, 4) float32, linear reflectance times opacity, and opacity."""
    import cv2

    rng = generator(seed, "face")
    wide, long_hair = rng.uniform(0.70, 0.80), rng.uniform() < 0.5
    u, v = np.meshgrid(
        np.linspace(_FRAME[0], _FRAME[1], _COLUMNS), np.linspace(_FRAME[2], _FRAME[3], _ROWS)
    )
    grid = _Grid(u, v)
    color = np.zeros((_ROWS, _COLUMNS, 3))
    alpha = np.zeros((_ROWS, _COLUMNS))

    def over(part: np.ndarray, linear: np.ndarray) -> None:
        nonlocal color, alpha
        color = color + part[..., None] * (linear - color)
        alpha = alpha + part * (1.0 - alpha)

    hair = srgb_to_linear(np.array(_HAIR_COLORS[int(rng.integers(len(_HAIR_COLORS)))]))
    strands = fractal_noise(
        np.stack([u.ravel(), 0.12 * v.ravel(), 0.0 * u.ravel()], axis=1), 0.05, rng
    ).reshape(u.shape)
    tress = hair * (1.0 + 0.25 * strands + 0.5 * grid.spot(-0.3, -0.75, 0.35, 0.25))[..., None]
    back = grid.disc(0.0, -0.12, wide + 0.14, 0.98)
    if long_hair:
        back = np.maximum(back, grid.disc(0.0, 0.25, wide + 0.16, 1.0))
    over(back, tress * 0.7)
    cloth = srgb_to_linear(rng.uniform(0.1, 0.7, 3))
    over(grid.disc(0.0, 2.15, 1.45, 0.98), cloth * (1.0 - 0.3 * np.abs(u))[..., None])
    neck = np.clip((0.33 - np.abs(u)) / 0.03 + 0.5, 0, 1) * ((v > 0.5) & (v < 1.35))
    base = srgb_to_linear(np.array(skin))
    over(neck, base * (0.5 - 0.35 * np.clip(1.1 - v, 0, 0.5) + 0.2 * (0.33 - np.abs(u)))[..., None])
    for side in (-1.0, 1.0):
        over(grid.disc(side * (wide + 0.02), 0.02, 0.09, 0.19), base * 0.55)
    # The jaw narrows towards the chin.
    jaw = wide * (1.0 - 0.24 * np.clip(v - 0.1, 0.0, 1.0) ** 1.3)
    inside = np.hypot(u / jaw, v / 0.98)
    over(np.clip((1.0 - inside) / 0.02 + 0.5, 0.0, 1.0), _face_skin(grid, base, inside, rng))
    _features(grid, over, base, hair, closed)
    top = -0.52 + 0.42 * (np.abs(u) / wide) ** 2.6 + 0.03 * strands
    if long_hair:
        top = np.maximum(top, np.where(np.abs(u) > wide - 0.10, 1.1, -1.0))
    fringe = np.clip((top - v) / 0.03 + 0.5, 0, 1) * grid.disc(0.0, -0.10, wide + 0.13, 0.99)
    if long_hair:
        fringe = np.maximum(fringe, np.clip((top - v) / 0.03 + 0.5, 0, 1) * back * (v > 0))
    over(fringe, tress)
    picture = np.concatenate([np.clip(color, 0.0, None), alpha[..., None]], axis=2)
    sigma = _BLUR * _ROWS / (_FRAME[3] - _FRAME[2])
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma)


def _face_skin(
    grid: _Grid, base: np.ndarray, inside: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The lit relief of the face: (_ROWS, _COLUMNS, 3) linear."""
    u, v = grid.u, grid.v
    bridge = np.clip((v + 0.28) / 0.5, 0.0, 1.0) * np.clip((0.30 - v) / 0.06, 0.0, 1.0)
    relief = (
        0.75 * np.sqrt(np.clip(1.0 - inside**2, 0.0, 1.0))
        + 0.17 * np.exp(-((u / (0.06 + 0.05 * bridge)) ** 2)) * bridge
        + 0.05 * grid.pair(0.11, 0.24, 0.06, 0.06)
        - 0.09 * grid.pair(0.28, -0.10, 0.16, 0.11)
        + 0.05 * grid.pair(0.27, -0.27, 0.22, 0.07)
        + 0.06 * grid.pair(0.38, 0.20, 0.18, 0.18)
        + 0.05 * grid.spot(0.0, 0.50, 0.22, 0.07)
        - 0.05 * grid.spot(0.0, 0.64, 0.20, 0.05)
        + 0.07 * grid.spot(0.0, 0.80, 0.20, 0.12)
    )
    step = (_FRAME[1] - _FRAME[0]) / (_COLUMNS - 1)
    down, right = np.gradient(relief, step)
    normals = unit(np.stack([-right, -down, np.ones_like(u)], axis=-1))
    light = 0.34 + 0.72 * np.clip((normals @ _FACE_LIGHT + 0.15) / 1.15, 0.0, None)
    blood = 0.6 * grid.pair(0.42, 0.22, 0.2, 0.17) + 0.7 * grid.spot(0.0, 0.22, 0.12, 0.1)
    mottle = rng.normal(0.0, 0.02, u.shape)
    flushed = np.exp(-(blood + mottle)[..., None] * np.array([-0.02, 0.32, 0.26]))
    return base * light[..., None] * flushed


def _features(grid: _Grid, over: _Over, base: np.ndarray, hair: np.ndarray, closed: bool) -> None:
    """Eyes, brows, nostrils and mouth."""
    dark = 0.18 * base
    for side in (-1.0, 1.0):
        at = side * 0.29
        arch = grid.v + 0.30 - 0.5 * (grid.u - at * 0.93) ** 2 * 3.0
        near = np.abs(grid.u - at) < 0.19
        over(np.exp(-((arch / 0.035) ** 2)) * near * 0.85, hair)
        if not closed:
            eye = grid.disc(at, -0.10, 0.135, 0.062)
            over(eye, np.array([0.72, 0.70, 0.68]))
            over(eye * grid.disc(at, -0.105, 0.066, 0.066), np.array([0.06, 0.045, 0.035]))
            over(grid.disc(at - 0.02, -0.13, 0.016, 0.016), np.array([0.8, 0.8, 0.8]))
        high, bent = (0.05, -1.0) if closed else (0.165, 1.6)
        lid = grid.v + high - bent * (grid.u - at) ** 2
        over(np.exp(-((lid / 0.018) ** 2)) * (np.abs(grid.u - at) < 0.15) * 0.9, dark)
        over(0.75 * grid.disc(side * 0.075, 0.285, 0.038, 0.022), dark)
    lips = srgb_to_linear(np.array(_LIPS)) * 0.5 + 0.4 * base * np.array([1.0, 0.55, 0.55])
    over(0.8 * grid.disc(0.0, 0.50, 0.235, 0.075), lips)
    line = grid.v - 0.495 + 0.25 * grid.u**2
    over(np.exp(-((line / 0.014) ** 2)) * (np.abs(grid.u) < 0.235) * 0.85, dark)


# Share of the time in which eyes are closed.
_BLINK = 0.06


@dataclass(frozen=True)
class Face:
    """A face out of focus that looks around and blinks."""

    #: Skin tone as the subject has one; the subject's if None.
    tone: _Tone | None = None
    #: Which face: proportions, hair, clothes.
    seed: Seed = 0
    #: Where its middle is.
    place: tuple[_Place, _Place] = (0.25, -0.25)
    #: Half of the head's height.
    size: float = number(0.75, 0.1, 3.0)
    #: How far it moves, of its size.
    sway: float = number(0.12, 0.0, 1.0)

    def draw(self, canvas: Canvas) -> None:
        """Draw the face at one moment."""
        import cv2

        rng = generator(self.seed, "face moves")
        rates, phases = rng.uniform(0.5, 1.9, 3), rng.uniform(0.0, 2.0 * np.pi, 4)
        waves = np.sin(rates * canvas.seconds + phases[:3])
        closed = (0.31 * canvas.seconds + phases[3]) % 1.0 < _BLINK
        red, green, blue = skin_color(canvas.tone if self.tone is None else self.tone).tolist()
        picture = face_picture((red, green, blue), self.seed, bool(closed))
        sway = self.sway * self.size
        x = (canvas.places[0] - self.place[0] - sway * waves[0]) / self.size
        y = (canvas.places[1] - self.place[1] - 0.5 * sway * waves[1]) / self.size
        tilt = 0.7 * self.sway * waves[2]
        u = np.cos(tilt) * x + np.sin(tilt) * y
        v = np.cos(tilt) * y - np.sin(tilt) * x
        columns = (u - _FRAME[0]) / (_FRAME[1] - _FRAME[0]) * (_COLUMNS - 1)
        rows = (v - _FRAME[2]) / (_FRAME[3] - _FRAME[2]) * (_ROWS - 1)
        # Below the frame the shoulders continue.
        rows = np.where(rows > _ROWS - 1, np.minimum(rows, _ROWS - 1.0), rows)
        at = (columns.astype(np.float32), rows.astype(np.float32))
        seen = cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        canvas.image[:] = canvas.image * (1.0 - seen[..., 3:]) + seen[..., :3]


@dataclass(frozen=True)
class Behind:
    """The table `behind`; the defaults show nothing."""

    #: Things that drift past.
    clutter: Clutter | None = None
    #: Somebody's face.
    face: Face | None = None
    #: Another arm of the person.
    arm: OtherArm | None = None

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the passes that every frame needs because of what is behind."""
        there = {"clutter": self.clutter, "face": self.face, "other_arm": self.arm}
        return tuple(name for name, what in there.items() if what is not None)


#: Behind the hands there is the backdrop alone.
NOTHING = Behind()


def draw_behind(
    behind: Behind,
    tone: float,
    field_of_view: float,
    directions: np.ndarray,
    seconds: float,
    image: np.ndarray,
) -> np.ndarray:
    """Draw clutter, face and arm over a backdrop, the nearest last: (H, W, 3) linear."""
    half = float(np.tan(np.radians(field_of_view) / 2.0))
    slope = directions[..., :2] / np.maximum(directions[..., 2:], 1e-3) / half
    canvas = Canvas(image.astype(np.float64), (slope[..., 0], slope[..., 1]), seconds, tone)
    for thing in (behind.clutter, behind.face, behind.arm):
        if thing is not None:
            thing.draw(canvas)
    return canvas.image
