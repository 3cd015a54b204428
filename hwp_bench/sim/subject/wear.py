"""Things that a person has on skin and fingers: settings and pictures, or meshes, of each thing.

Tattoos, nail polish and gloves change the skin; rings, watches and bracelets are meshes that
`mounts` fits to a hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Literal

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import Seed, number
from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import (
    Color,
    Material,
    Surface,
    around_z,
    canvas,
    coat,
    ease,
    ink,
    join,
    perpendicular,
    picture_material,
    plain,
    rigid,
    sheet,
    shift,
    transformed,
    turned,
    unit,
)
from hwp_bench.sim.hand.anatomy import Anatomy

_EDGE = 512
# Fixed-point bits of OpenCV's coordinates.
_BITS = 4
# Half the size of a drawing, m, on the back of the hand and on a finger.
_HALF = {"back": 0.034, "fingers": 0.0085}
_LETTERS = "HOPELOVESTAYTRUECALMWILD"


def tattoo_cover(anatomy: Anatomy, tattoo: Tattoo) -> np.ndarray:
    """Share of ink at each place of an anatomy: (N,), 0-1."""
    total = np.zeros(len(anatomy.points))
    back = np.clip(1.6 * anatomy.back - 0.5, 0.0, 1.0)
    half = _HALF[tattoo.place] * tattoo.size
    if tattoo.place == "back":
        wrist, index, middle, little = (anatomy.joints[i] for i in (0, 1, 4, 7))
        along, across = anatomy.palm_coordinates()
        x = (across - 0.5) * np.linalg.norm(index - little)
        y = (along - 0.58) * np.linalg.norm(middle - wrist)
        return _read(_drawing(tattoo.motif, tattoo.seed), x / half, y / half) * back
    for row, finger in enumerate(FINGERS):
        first = FIRST_JOINT[finger] + (1 if finger == "thumb" else 0)
        start, end = anatomy.joints[first], anatomy.joints[first + 1]
        bone = unit(end - start)
        axis = perpendicular(finger_back(finger), bone)
        offset = anatomy.points - 0.5 * (start + end)
        x, y = offset @ np.cross(axis, bone), offset @ bone
        owned = anatomy.weights[:, FIRST_JOINT[finger] : FIRST_JOINT[finger] + 3].sum(axis=1)
        drawing = _drawing(tattoo.motif, tattoo.seed + row)
        total = np.maximum(total, _read(drawing, x / half, y / half) * back * (owned > 0.5))
    return total


def _read(drawing: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The drawing at places from -1 to 1, x to the right and y up: (N,), 0 outside."""
    from scipy.ndimage import map_coordinates

    rows = (0.5 - 0.5 * y) * (_EDGE - 1)
    columns = (0.5 + 0.5 * x) * (_EDGE - 1)
    return map_coordinates(drawing, np.stack([rows, columns]), order=1, mode="constant")


@lru_cache(maxsize=16)
def _drawing(motif: str, seed: int) -> np.ndarray:
    """(_EDGE, _EDGE) float64, 0 (skin) to 1 (ink), row 0 towards the finger tips."""
    import cv2

    image = np.zeros((_EDGE, _EDGE), dtype=np.uint8)
    rng = generator(seed, "tattoo", motif)
    if motif == "letters":
        letter = _LETTERS[seed % len(_LETTERS)]
        cv2.putText(image, letter, (96, 420), cv2.FONT_HERSHEY_TRIPLEX, 13.5, 255, 34, cv2.LINE_AA)
    else:
        draw = {"mandala": _mandala, "vine": _vine, "polygons": _polygons, "bands": _bands}[motif]
        for points, width, closed in draw(rng):
            fixed = np.round((points + 1.0) / 2.0 * (_EDGE - 1) * 2**_BITS).astype(np.int32)
            cv2.polylines(image, [fixed], closed, 255, width, cv2.LINE_AA, _BITS)
    return cv2.GaussianBlur(image, (0, 0), 1.5) / 255.0


#: A line: points (K, 2) from -1 to 1, its width in texels, and whether it is closed.
Line = tuple[np.ndarray, int, bool]


def _circle(radius: float, at: np.ndarray, sides: int = 48, turn: float = 0.0) -> np.ndarray:
    angles = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False) + turn
    return at + radius * np.stack([np.sin(angles), -np.cos(angles)], axis=1)


def _petal(inner: float, outer: float, angle: float, width: float) -> np.ndarray:
    through = np.linspace(0.0, 1.0, 20)
    radius = inner + (outer - inner) * np.concatenate([through, through[::-1]])
    bulge = width * np.sin(np.pi * np.concatenate([through, through[::-1]]))
    sides = angle + np.repeat([1.0, -1.0], 20) * bulge
    return np.stack([radius * np.sin(sides), -radius * np.cos(sides)], axis=1)


def _mandala(rng: np.random.Generator) -> list[Line]:
    fold = int(rng.integers(6, 11))
    lines: list[Line] = [(_circle(0.10, np.zeros(2)), 9, True)]
    inner = 0.14
    for ring in range(3):
        outer = inner + rng.uniform(0.20, 0.28)
        turn = ring % 2 * np.pi / fold
        for step in range(fold):
            angle = 2.0 * np.pi * step / fold + turn
            width = rng.uniform(0.75, 0.8) * np.pi / fold
            lines.append((_petal(inner, outer, angle, width), 9, True))
            lines.append((_petal(inner, 0.5 * (inner + outer), angle, 0.5 * width), 6, True))
            dot = outer * np.array([np.sin(angle + np.pi / fold), -np.cos(angle + np.pi / fold)])
            lines.append((_circle(0.016, dot, 10), 7, True))
        inner = outer + 0.02
    return lines


def _vine(rng: np.random.Generator) -> list[Line]:
    y = np.linspace(-0.95, 0.95, 120)
    wave = rng.uniform(4.5, 6.5)
    phase = rng.uniform(0.0, 6.3)
    x = 0.22 * np.sin(wave * y + phase) + 0.25 * y
    stem = np.stack([x, y], axis=1)
    lines: list[Line] = [(stem, 12, False)]
    for at in np.linspace(6, 113, 13).astype(int):
        side = 1.0 if at % 2 else -1.0
        angle = side * rng.uniform(0.7, 1.4)
        size = rng.uniform(0.28, 0.42)
        leaf = _petal(0.02, size, angle, 0.42)
        lines.append((stem[at] + leaf, 9, True))
        rib = np.linspace(0.03, 0.85 * size, 8)[:, None]
        lines.append((stem[at] + rib * np.array([np.sin(angle), -np.cos(angle)]), 6, False))
    return lines


def _polygons(rng: np.random.Generator) -> list[Line]:
    lines: list[Line] = []
    for _ in range(5):
        at = rng.uniform(-0.45, 0.45, 2)
        sides = int(rng.integers(3, 7))
        turn = rng.uniform(0.0, 6.3)
        size = rng.uniform(0.25, 0.5)
        for share in (1.0, 0.75, 0.45):
            lines.append((_circle(share * size, at, sides, turn), 10, True))
        for corner in _circle(size, at, sides, turn):
            lines.append((np.stack([at, corner]), 6, False))
    return lines


def _bands(rng: np.random.Generator) -> list[Line]:
    lines: list[Line] = []
    for y in np.sort(rng.uniform(-0.8, 0.8, 4)):
        width = int(rng.integers(10, 34))
        lines.append((np.array([[-1.0, y], [1.0, y]]), width, False))
        zigzag = np.stack([np.linspace(-1.0, 1.0, 25), y + 0.10 + 0.05 * (np.arange(25) % 2)], 1)
        lines.append((zigzag, 8, False))
    return lines


@dataclass(frozen=True)
class SkinSample:
    """Skin at N places."""

    #: (N, 3) linear reflectance, 0-1.
    albedo: np.ndarray
    #: (N,) m outwards of the smooth surface.
    height: np.ndarray
    #: (N,) 0 (mirror) to 1 (matt).
    roughness: np.ndarray


#: The hands that wear something.
Wearing = Literal["both", "right", "left"]


@dataclass(frozen=True)
class Tattoo:
    """A drawing under the skin."""

    #: What is drawn; the seed varies it.
    motif: Literal["mandala", "vine", "polygons", "bands", "letters"]
    #: Where: the back of the hand, or the backs of the fingers.
    place: Literal["back", "fingers"] = "back"
    #: Which drawing of its kind.
    seed: Seed = 0
    #: Size relative to the place.
    size: float = number(1.0, 0.3, 2.0)
    #: sRGB of the ink.
    ink: Color = (0.10, 0.14, 0.18)
    #: The hands that have it.
    side: Wearing = "both"


@dataclass(frozen=True)
class Polish:
    """Nail polish."""

    #: sRGB: one for all nails, or five from the thumb to the little finger.
    colors: tuple[Color, ...]
    #: 0 (matt) to 1 (wet).
    gloss: float = number(0.8, 0.0, 1.0)
    #: The hands that wear it.
    side: Wearing = "both"

    def __post_init__(self) -> None:
        if len(self.colors) not in (1, 5):
            raise UsageError(
                f"holds {len(self.colors)} colours", field="colors", remedy="Give one or five."
            )


def _polished(anatomy: Anatomy, polish: Polish, skin: SkinSample) -> SkinSample:
    plate = np.clip(1.4 * anatomy.nails()[0], 0.0, 1.0)
    owned = [
        anatomy.weights[:, FIRST_JOINT[finger] : FIRST_JOINT[finger] + 3].sum(axis=1)
        for finger in FINGERS
    ]
    colors = srgb_to_linear(np.array(polish.colors))
    color = colors[np.argmax(owned, axis=0)] if len(colors) > 1 else colors[0]
    return SkinSample(
        albedo=skin.albedo + 0.97 * plate[:, None] * (color - skin.albedo),
        height=skin.height + 0.00008 * plate,
        roughness=skin.roughness + plate * (0.6 - 0.45 * polish.gloss - skin.roughness),
    )


#: How far a glove reaches behind the wrist, m.
CUFF = 0.045
# Share of the first finger bone that a fingerless glove covers.
_COVERED = 0.62
# Width of the rim's step and of its hem, m.
_RIM, _HEM = 0.0009, 0.0055
# Distance of the cloth's threads, m.
_THREAD = 0.0021


def inside_glove(anatomy: Anatomy, glove: Glove) -> np.ndarray:
    """Distance from the glove's rim, m: (N,), positive where it covers the hand."""
    forward = unit(anatomy.joints[4] - anatomy.joints[0])
    inside = (anatomy.points - anatomy.joints[0]) @ forward + CUFF
    if glove.kind == "work":
        return inside
    for finger in FINGERS:
        first = FIRST_JOINT[finger]
        start = first + (1 if finger == "thumb" else 0)
        bone = anatomy.joints[start + 1] - anatomy.joints[start]
        length = float(np.linalg.norm(bone))
        beyond = (anatomy.points - anatomy.joints[start]) @ bone / length - _COVERED * length
        owned = anatomy.weights[:, first : first + 3].sum(axis=1) > 0.5
        inside = np.where(owned, np.minimum(inside, -beyond), inside)
    return inside


def covered(anatomy: Anatomy, glove: Glove) -> np.ndarray:
    """Share of glove at each place: (N,), 0-1, soft at the rim."""
    return ease(inside_glove(anatomy, glove) / _RIM + 0.5)


def gloved(anatomy: Anatomy, glove: Glove, skin: SkinSample, *, fine: bool) -> SkinSample:
    """Put a glove over skin."""
    inside = inside_glove(anatomy, glove)
    cover = ease(inside / _RIM + 0.5)
    rng = generator(glove.seed, "glove")
    coarse, middle, grain = (
        fractal_noise(anatomy.points, scale, rng) for scale in (0.03, 0.012, 0.0025)
    )
    back = anatomy.back
    hem = ease(1.5 - np.abs(inside / _HEM - 0.5) * 2.0)
    grip = ease((0.45 - back) / 0.16 + 0.5)
    fingers = 1.0 - anatomy.weights[:, 0]
    seam = np.exp(-(((back - 0.55) / 0.10) ** 2)) * ease(2.0 * fingers - 0.4)
    forward = unit(anatomy.joints[4] - anatomy.joints[0])
    along = (anatomy.points - anatomy.joints[0]) @ forward
    cuff = ease((0.012 - along) / 0.002 + 0.5) if glove.kind == "work" else np.zeros(len(along))
    height = glove.thickness + 0.00025 * coarse + 0.00018 * middle + 0.0005 * hem - 0.0004 * seam
    cloth, leather = srgb_to_linear(np.array(glove.color)), srgb_to_linear(np.array(glove.palm))
    color = cloth + grip[:, None] * (leather - cloth)
    color = color + (cuff * 0.75)[:, None] * (0.45 * cloth + 0.02 - color)
    shade = 0.9 + 0.10 * coarse + 0.08 * middle - 0.18 * np.clip(coarse + 0.5 * grain - 0.9, 0, 1)
    shade = shade * (1.0 - 0.45 * seam) * (1.0 - 0.15 * hem)
    if fine:
        rows = np.cos(2.0 * np.pi * anatomy.points[:, 0] / _THREAD)
        columns = np.cos(
            2.0 * np.pi * (anatomy.points[:, 2] - 0.5 * anatomy.points[:, 1]) / _THREAD
        )
        knit = rows * columns * (1.0 - grip)
        ribs = np.cos(2.0 * np.pi * anatomy.points[:, 2] / 0.004) * cuff
        stitch = np.exp(-(((inside - _HEM) / 0.0005) ** 2)) * (columns + rows > 0.0)
        shade = shade * (1.0 + 0.07 * knit + 0.12 * ribs + 0.03 * grain - 0.4 * stitch)
        height = height + 0.00008 * knit + 0.0002 * ribs + 0.00004 * grain - 0.0002 * stitch
    color = color * np.clip(shade, 0.2, 1.5)[:, None]
    matt = 0.88 - 0.26 * grip
    return SkinSample(
        albedo=np.clip(skin.albedo + cover[:, None] * (color - skin.albedo), 0.01, 0.95),
        height=skin.height + cover * (height - skin.height),
        roughness=skin.roughness + cover * (matt - skin.roughness),
    )


@dataclass(frozen=True)
class Glove:
    """A glove; covered skin shows nothing of itself."""

    #: Over the whole hand, or open from the middle of the first finger bones.
    kind: Literal["work", "fingerless"]
    #: sRGB of the cloth.
    color: Color = (0.42, 0.40, 0.36)
    #: sRGB of the grip on the palm side.
    palm: Color = (0.30, 0.24, 0.18)
    #: How far it lifts the surface, m.
    thickness: float = number(0.0012, 0.0002, 0.003)
    #: Which glove of its kind: weave and stains.
    seed: Seed = 0
    #: The hands that wear it.
    side: Wearing = "both"


#: Points around a band; its first and last are the same.
AROUND = 49
# Points of a band's section.
_SECTION = 13
#: sRGB and roughness of metals.
METALS: Mapping[str, tuple[tuple[float, float, float], float]] = MappingProxyType(
    {
        "gold": ((0.83, 0.62, 0.28), 0.22),
        "silver": ((0.80, 0.80, 0.79), 0.20),
        "steel": ((0.58, 0.59, 0.61), 0.26),
        "black": ((0.10, 0.10, 0.11), 0.30),
    }
)


def metal(name: str) -> Material:
    """A polished metal by its name in `METALS`."""
    color, roughness = METALS[name]
    return coat(color, gloss=roughness, specular=0.55)


def angles() -> np.ndarray:
    """The angles at which a band's outline is given: (AROUND,) rad, from x towards y."""
    return np.linspace(0.0, 2.0 * np.pi, AROUND)


def band(outline: np.ndarray, width: float, thickness: float, material: Material) -> Surface:
    """A closed band with a rounded section, its `outline` m from the axis at `angles()`."""
    turn = np.linspace(0.0, 2.0 * np.pi, _SECTION)
    # A superellipse: flat outside, round at the edges.
    along = 0.5 * width * np.sign(np.cos(turn)) * np.abs(np.cos(turn)) ** 0.6
    out = 0.5 * thickness * (1.0 + np.sign(np.sin(turn)) * np.abs(np.sin(turn)) ** 0.6)
    around = angles()
    vertices = around_z(outline[None] + out[:, None], along[:, None], around)
    center = np.stack([outline * np.cos(around), outline * np.sin(around), 0.0 * around], axis=1)
    away = vertices - np.tile(center + 0.5 * thickness * center / outline[:, None], (_SECTION, 1))
    return sheet(vertices, _SECTION, AROUND, material, away)


def stone(diameter: float, color: tuple[float, float, float], setting: Material) -> Surface:
    """A cut stone in its setting, on the plane z = 0."""
    r = 0.5 * diameter
    cup = [(0.75 * r, -0.3 * r), (1.12 * r, 0.35 * r), (0.95 * r, 0.45 * r)]
    cut = [(1.0 * r, 0.3 * r), (0.98 * r, 0.5 * r), (0.6 * r, 0.85 * r), (1e-5, 0.86 * r)]
    gem = coat(color, gloss=0.08, specular=0.12)
    return join([turned(cup, setting), turned(cut, gem, around=8)])


def beads(outline: np.ndarray, diameter: float, material: Material) -> Surface:
    """A string of beads along an outline as in `band`."""
    way = np.linspace(0.0, np.pi, 7)
    profile = 0.5 * diameter * np.stack([np.sin(way) + 1e-6, -np.cos(way)], axis=1)
    ball = turned(profile, material, 10)
    length = 2.0 * np.pi * float(np.mean(outline)) + np.pi * diameter
    count = int(length / (1.03 * diameter))
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    radius = np.interp(turns, angles(), outline) + 0.5 * diameter
    places = np.stack([radius * np.cos(turns), radius * np.sin(turns), 0.0 * turns], axis=1)
    return join([shift(ball, place) for place in places])


#: A finger.
Finger = Literal["thumb", "index", "middle", "ring", "little"]


@dataclass(frozen=True)
class Ring:
    """A ring around the first bone of a finger."""

    #: Which finger.
    finger: Finger
    #: What it is made of.
    metal: Literal["gold", "silver", "steel", "black"] = "gold"
    #: Width along the finger, m.
    width: float = number(0.004, 0.0015, 0.012)
    #: Diameter of a stone on the back, m; 0 for none.
    stone: float = number(0.0, 0.0, 0.012)
    #: sRGB of the stone.
    stone_color: Color = (0.75, 0.85, 0.95)
    #: The hand that wears it.
    side: Wearing = "both"


@dataclass(frozen=True)
class WristWear:
    """A watch or a bracelet; it does not count as hand."""

    #: A watch on a strap, a smooth bangle, or a string of beads.
    kind: Literal["watch", "bangle", "beads"]
    #: sRGB of strap, bangle or beads.
    color: Color = (0.32, 0.18, 0.10)
    #: The hand that wears it.
    side: Wearing = "left"


#: Rotation of what stands on z to y.
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_STRAP = 0.011


def wrist_watch(wrist: tuple[float, float], color: tuple[float, float, float]) -> Surface:
    """Build a watch around the x axis, its dial to +y."""
    leather = coat(color, gloss=0.55)
    steel = plain((0.6, 0.6, 0.62), gloss=0.18, specular=0.6)
    angles = np.linspace(0.0, 2.0 * np.pi, 41)
    rows = []
    for side, lift in ((-1.0, 0.0), (-1.0, 0.0028), (1.0, 0.0028), (1.0, 0.0)):
        y, z = (wrist[1] + lift) * np.cos(angles), (wrist[0] + lift) * np.sin(angles)
        rows.append(np.stack([np.full_like(angles, side * _STRAP), y, z], axis=1))
    vertices = np.concatenate(rows)
    strap = sheet(vertices, len(rows), len(angles), leather, vertices * np.array([0.0, 1.0, 1.0]))
    case = turned([(0.0, 0.0), (0.019, 0.0), (0.02, 0.003), (0.02, 0.007), (0.018, 0.009)], steel)
    radius, height = 0.0182, 0.0088
    dial = turned([(radius, height - 1e-4), (1e-4, height)], picture_material(_dial(), 0.15))
    uv = dial.vertices[dial.faces][..., :2] / (2.0 * radius) + 0.5
    flat = np.tile([0.0, 0.0, 1.0], (len(dial.vertices), 1))
    on_top = rigid(UPRIGHT, (0.0, wrist[1] + 0.001, 0.0))
    parts = (case, replace(dial, corner_uv=uv, normals=flat))
    return join([strap, *(transformed(part, on_top) for part in parts)])


def _dial() -> np.ndarray:
    import cv2

    image = canvas(128, 128, (0.05, 0.09, 0.2))
    white = ink((0.95, 0.95, 0.9))
    for hour in range(12):
        angle = hour * np.pi / 6
        start = (int(64 + 50 * np.cos(angle)), int(64 + 50 * np.sin(angle)))
        end = (int(64 + 58 * np.cos(angle)), int(64 + 58 * np.sin(angle)))
        cv2.line(image, start, end, white, 4, cv2.LINE_AA)
    cv2.line(image, (64, 64), (64, 26), white, 4, cv2.LINE_AA)
    cv2.line(image, (64, 64), (90, 76), white, 5, cv2.LINE_AA)
    return image
