"""Objects that hands hold: looked up by name, built in metres around their own origin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadInput
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import (
    Material,
    Surface,
    albedo,
    around_z,
    box,
    canvas,
    coat,
    grid,
    ink,
    join,
    picture_material,
    plain,
    reversed_faces,
    sheet,
    shift,
    tube,
    turned,
)
from hwp_bench.sim.subject.wear import wrist_watch

_BLOCK_COLORS = ((0.85, 0.16, 0.14), (0.12, 0.38, 0.80), (0.95, 0.75, 0.10), (0.15, 0.58, 0.26))
_BLOCK_SIZES = ((0.045,) * 3, (0.085, 0.042, 0.042), (0.05,) * 3, (0.06, 0.04, 0.04))
_BLOCK_PX = 128
_BARRELS = ((0.08, 0.14, 0.55), (0.75, 0.08, 0.10), (0.05, 0.05, 0.06))
_PHONE_SIZE = (0.07, 0.145, 0.008)


def _block(variant: int) -> Surface:
    """Build a block; the variant chooses colour, size and letter."""
    import cv2

    color = _BLOCK_COLORS[variant % len(_BLOCK_COLORS)]
    image = canvas(_BLOCK_PX, _BLOCK_PX, color)
    cv2.rectangle(image, (14, 14), (_BLOCK_PX - 15, _BLOCK_PX - 15), ink((0.87, 0.72, 0.52)), -1)
    letter = "ABCDEFGH"[variant % 8]
    cv2.putText(image, letter, (34, 96), cv2.FONT_HERSHEY_DUPLEX, 3.0, ink(color), 12, cv2.LINE_AA)
    ticks = np.linspace(0.0, 1.0, _BLOCK_PX)
    grain = 1.0 + 0.05 * np.sin(60.0 * ticks + 3.0 * np.sin(5.0 * ticks))
    reflectance = np.clip(albedo(image) * grain[:, None, None], 0.0, 1.0).astype(np.float32)
    material = Material(albedo=reflectance, gloss=0.45)
    return box(_BLOCK_SIZES[variant % len(_BLOCK_SIZES)], material)


def _pen(variant: int) -> Surface:
    """Build a pen of 15 cm along z and 17 mm across, its tip at -z."""
    barrel = coat(_BARRELS[variant % len(_BARRELS)], gloss=0.25)
    rubber = plain((0.02, 0.02, 0.02), gloss=0.8)
    metal = plain((0.55, 0.55, 0.57), gloss=0.2, specular=0.6)
    shaft = [(0.0, 0.076), (0.007, 0.076), (0.0082, 0.072), (0.0084, -0.03)]
    grip = [(0.0084, -0.03), (0.009, -0.035), (0.0086, -0.052), (0.0072, -0.06)]
    tip = [(0.0072, -0.06), (0.0032, -0.07), (0.002, -0.076), (0.0, -0.0765)]
    clip = shift(box((0.004, 0.0022, 0.045), metal), (0.0, 0.0096, 0.05))
    return join([turned(shaft, barrel), turned(grip, rubber), turned(tip, metal), clip])


def _phone(variant: int) -> Surface:
    """Build a phone, screen to +z, its top at +y; the variant scrolls the page."""
    body = box(_PHONE_SIZE, plain((0.03, 0.03, 0.035), gloss=0.3))
    page = srgb_to_linear(_page(variant)).astype(np.float32)
    screen = Material(albedo=page, gloss=0.12, glow=0.6)
    half = _PHONE_SIZE[2] / 2
    glass = shift(box((0.065, 0.136, 0.0004), screen), (0.0, 0.0, half))
    lens = box((0.024, 0.03, 0.002), plain((0.01, 0.01, 0.015), gloss=0.08))
    return join([body, glass, shift(lens, (0.018, 0.05, -half))])


def _page(variant: int) -> np.ndarray:
    """(256, 128, 3) sRGB: a feed, scrolled by a fifth of the screen for each variant."""
    height, width = 256, 128
    rng = generator(7, "feed")
    page = np.full((height * 3, width, 3), 0.97)
    top = 8
    while top < len(page) - 90:
        color = rng.uniform(0.2, 0.9, 3)
        shade = np.linspace(1.0, 0.6, 50)[:, None, None]
        page[top : top + 50, 8:-8] = color * shade
        for line in range(3):
            end = 120 - int(rng.uniform(0, 50))
            page[top + 58 + 8 * line : top + 61 + 8 * line, 10:end] = 0.45
        top += 88
    start = int(variant * height / 5) % (height * 2)
    screen = page[start : start + height].copy()
    screen[:18] = (0.16, 0.32, 0.62)
    return screen


_STICKERS = ((0.98, 0.83, 0.12), (0.90, 0.25, 0.45), (0.20, 0.65, 0.85), (0.35, 0.75, 0.30))
_RADIUS = 0.022
_SUITS = ("heart", "spade", "diamond", "club")
_RED, _BLACK = (0.78, 0.08, 0.10), (0.06, 0.06, 0.08)


def _sticker(variant: int) -> Surface:
    """A round sticker of 44 mm, facing +z."""
    radius, angle = np.meshgrid(np.linspace(1e-3, 1.0, 4), np.linspace(0, 2 * np.pi, 33))
    place = _RADIUS * radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([place, 0.002 * radius[..., None] ** 2], axis=-1).reshape(-1, 3)
    front = grid(vertices, 33, 4, picture_material(_sticker_front(variant), 0.4))
    flat = vertices[front.faces][..., :2] / (2.0 * _RADIUS) + 0.5
    back = grid(vertices, 33, 4, picture_material(canvas(4, 4, (0.93, 0.93, 0.93)), 0.4))
    return _two_sided(replace(front, corner_uv=flat), back)


def _card(variant: int) -> Surface:
    """A playing card of 58 x 89 mm, facing +z."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 7))
    z = 0.006 * (1.0 - 4.0 * x * x)
    vertices = np.stack([x * 0.058, y * 0.089, z], axis=-1).reshape(-1, 3)
    pictures = (_card_front(variant), _card_back())
    return _two_sided(*(grid(vertices, 7, 7, picture_material(side, 0.4)) for side in pictures))


def _two_sided(front: Surface, back: Surface) -> Surface:
    """Two like sheets, the back below the front and turned away from +z."""
    top = reversed_faces(front) if front.normals[:, 2].mean() < 0 else front
    under = reversed_faces(shift(back, (0.0, 0.0, -0.0004)))
    return join([top, reversed_faces(under) if under.normals[:, 2].mean() > 0 else under])


def _sticker_front(variant: int) -> np.ndarray:
    import cv2

    image = canvas(128, 128, (0.95, 0.95, 0.95))
    color = ink(_STICKERS[variant % len(_STICKERS)])
    cv2.circle(image, (64, 64), 56, color, -1, cv2.LINE_AA)
    dark = ink((0.12, 0.10, 0.10))
    if variant % 2 == 0:
        for x in (44, 84):
            cv2.circle(image, (x, 50), 8, dark, -1, cv2.LINE_AA)
        cv2.ellipse(image, (64, 68), (28, 24), 0, 15, 165, dark, 6, cv2.LINE_AA)
    else:
        angles = np.pi / 2 + np.arange(10) * np.pi / 5
        radius = np.where(np.arange(10) % 2 == 0, 44, 18)
        star = np.stack([64 + radius * np.cos(angles), 64 + radius * np.sin(angles)], axis=1)
        cv2.fillPoly(image, [star.astype(np.int32)], ink((1.0, 1.0, 0.96)), cv2.LINE_AA)
    return image[::-1]


def _card_front(variant: int) -> np.ndarray:
    import cv2

    image = canvas(192, 128, (0.96, 0.96, 0.96))
    cv2.rectangle(image, (0, 0), (127, 191), ink((0.75, 0.75, 0.78)), 2)
    suit = _SUITS[variant % 4]
    color = ink(_RED if suit in ("heart", "diamond") else _BLACK)
    rank = "A23456789JQK"[variant % 12]
    cv2.putText(image, rank, (8, 34), cv2.FONT_HERSHEY_DUPLEX, 1.1, color, 3, cv2.LINE_AA)
    _pip(image, suit, (20, 54), 9, color)
    _pip(image, suit, (64, 96), 34, color)
    turned = image[::-1, ::-1].copy()
    image[110:] = turned[110:]
    return image


def _pip(
    image: np.ndarray, suit: str, place: tuple[int, int], size: int, color: tuple[int, int, int]
) -> None:
    import cv2

    x, y = place
    if suit == "diamond":
        corners = np.array([[x, y - size], [x + 0.7 * size, y], [x, y + size], [x - 0.7 * size, y]])
        cv2.fillPoly(image, [corners.astype(np.int32)], color, cv2.LINE_AA)
        return
    sign = 1 if suit == "heart" else -1
    if suit == "club":
        for dx, dy in ((0, -0.5), (-0.5, 0.25), (0.5, 0.25)):
            cv2.circle(image, (int(x + dx * size), int(y + dy * size)), size // 2, color, -1)
    else:
        for dx in (-0.45, 0.45):
            center = (int(x + dx * size), int(y - sign * 0.3 * size))
            cv2.circle(image, center, int(0.5 * size), color, -1, cv2.LINE_AA)
        wide, high = 0.9 * size, y - sign * 0.12 * size
        corners = np.array([[x - wide, high], [x + wide, high], [x, y + sign * size]])
        cv2.fillPoly(image, [corners.astype(np.int32)], color, cv2.LINE_AA)
    if suit in ("spade", "club"):
        foot = np.array([[x, y], [x - 0.35 * size, y + size], [x + 0.35 * size, y + size]])
        cv2.fillPoly(image, [foot.astype(np.int32)], color, cv2.LINE_AA)


def _card_back() -> np.ndarray:
    y, x = np.mgrid[0:192, 0:128]
    lattice = ((x + y) // 8 + (x - y) // 8) % 2
    image = canvas(192, 128, (0.72, 0.10, 0.14))
    image[lattice == 1] = ink((0.90, 0.86, 0.84))
    image[(x < 8) | (x > 119) | (y < 8) | (y > 183)] = ink((0.96, 0.96, 0.96))
    return image


_LABEL_TEXTURE = 128
# Half axes of the wrist, m, and half the width of the strap.
_WRIST = (0.036, 0.026)


def _tube(variant: int) -> Surface:
    """A tube of 14 cm along z, its cap at -z."""
    import cv2

    label = canvas(_LABEL_TEXTURE, _LABEL_TEXTURE, (0.93, 0.95, 0.96))
    label[70:100] = ink((0.20, 0.55, 0.62))
    cv2.putText(label, "care", (22, 52), cv2.FONT_HERSHEY_DUPLEX, 1.2, ink((0.1, 0.3, 0.4)), 3)
    skin = picture_material(label, 0.3)
    ticks = np.linspace(0.0, 1.0, 12)[:, None]
    angles = np.linspace(0.0, 2.0 * np.pi, 33)
    wide, flat = 1.0 + 0.25 * ticks**1.5, 1.0 - 0.93 * ticks**1.5
    vertices = around_z(0.019 * wide, -0.05 + 0.12 * ticks, angles, tall=0.019 * flat)
    cap = coat((0.15, 0.42, 0.5), gloss=0.35)
    lid = [(0.0, -0.072), (0.016, -0.072), (0.0165, -0.052), (0.019, -0.05)]
    return join([grid(vertices, len(ticks), len(angles), skin), turned(lid, cap)])


def _dollop(variant: int) -> Surface:
    """A dollop of cream about 4 cm wide."""
    rng = generator(11, "dollop", variant)
    cream = plain((0.88, 0.87, 0.84), gloss=0.28, specular=0.05)
    through = np.linspace(0.0, 1.0, 9)[:, None]
    angles = np.linspace(0.0, 2.0 * np.pi, 33)
    waves = sum(
        rng.normal(0.0, 0.18 / k) * np.cos(k * angles + rng.uniform(0, 6.3)) for k in (2, 3, 5)
    )
    radius = np.sin(through * np.pi / 2) * (0.02 * (1.0 + waves))
    swirl = 0.0012 * np.sin(3 * angles + 9.0 * through) * (1 - through)
    height = 0.006 * np.cos(through * np.pi / 2) ** 0.7 + swirl - 0.0015
    vertices = around_z(radius, height, angles)
    return sheet(vertices, len(through), len(angles), cream, np.array([0.0, 0.0, 1.0]))


def _watch(variant: int) -> Surface:
    return wrist_watch(_WRIST, (0.32, 0.18, 0.10))


_MUGS = ((0.86, 0.84, 0.78), (0.16, 0.32, 0.36), (0.72, 0.30, 0.18))
_BALLS = (((0.9, 0.9, 0.88), (0.1, 0.1, 0.12)), ((0.85, 0.2, 0.15), (0.95, 0.85, 0.3)))


def _mug(variant: int) -> Surface:
    """A mug of 9 cm along z, open at +z, its handle at +x."""
    import cv2

    color = _MUGS[variant % len(_MUGS)]
    image = canvas(96, 256, color)
    band = (0.55 * color[0], 0.55 * color[1], 0.55 * color[2])
    image[64:74] = ink(band)
    rng = generator(21, "mug", variant)
    for _ in range(9):
        place = (int(rng.integers(12, 244)), int(rng.integers(18, 54)))
        cv2.circle(image, place, int(rng.integers(3, 9)), ink(band), -1, cv2.LINE_AA)
    glaze = picture_material(image, 0.18)
    inside = coat((0.93, 0.92, 0.88), gloss=0.2)
    outer = [(0.0, -0.045), (0.034, -0.045), (0.039, -0.04), (0.041, 0.043)]
    inner = [(0.041, 0.043), (0.038, 0.045), (0.0365, 0.04), (0.034, -0.038), (0.0, -0.04)]
    bend = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 15)
    bow = (0.039 + 0.026 * np.cos(bend), np.zeros_like(bend), 0.027 * np.sin(bend))
    spine = np.stack(bow, axis=1)
    handle = tube(spine, np.full(len(spine), 0.0055), glaze)
    return join([turned(outer, glaze, 40), turned(inner, inside, 40), handle])


def _ball(variant: int) -> Surface:
    """A ball of 62 mm with patches of two colours."""
    import cv2

    base, patch = _BALLS[variant % len(_BALLS)]
    image = canvas(128, 256, base)
    for row, count in ((24, 3), (64, 6), (104, 3)):
        for k in range(count):
            place = (int(256 * (k + 0.5 * (row == 64)) / count), row)
            cv2.ellipse(image, place, (14, 11), 0, 0, 360, ink(patch), -1, cv2.LINE_AA)
    along = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    profile = 0.031 * np.stack([np.cos(along), np.sin(along)], axis=1)
    return turned(profile, picture_material(image, 0.35), 40)


def _spoon(variant: int) -> Surface:
    """A wooden or steel spoon of 19 cm along z, its bowl at +z, hollow to +y."""
    wood = coat((0.62, 0.42, 0.24), gloss=0.6)
    steel = plain((0.58, 0.58, 0.6), gloss=0.2, specular=0.6)
    material = steel if variant % 2 else wood
    along = np.linspace(0.0, 1.0, 25)
    spine = np.stack([np.zeros(25), -0.006 * along**2, -0.1 + 0.135 * along], axis=1)
    shaft = tube(spine, 0.0045 - 0.0012 * along, material)
    across = np.linspace(0.0, np.pi, 17)
    # Half of an ellipsoid: a turned profile about z, flattened along y.
    bowl = turned(np.stack([0.02 * np.sin(across), 0.03 * np.cos(across)], axis=1), material, 32)
    flat = bowl.vertices * np.array([1.0, 0.32, 1.0])
    flat[:, 1] = np.where(flat[:, 1] > 0.0, 0.45 * flat[:, 1], flat[:, 1])
    vertices = flat + np.array([0.0, -0.006, 0.062])
    normals = bowl.normals * np.array([1.0, 3.0, 1.0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return join([shaft, replace(bowl, vertices=vertices, normals=normals)])


def _banana(variant: int) -> Surface:
    """A banana of 17 cm, bent in the plane of y and z."""
    rng = generator(22, "banana", variant)
    image = canvas(64, 256, (0.93, 0.78, 0.22))
    for _ in range(30 + 40 * (variant % 2)):
        row, column = int(rng.integers(0, 64)), int(rng.integers(0, 256))
        image[row : row + 2, column : column + int(rng.integers(2, 9))] = ink((0.45, 0.30, 0.12))
    image[:, :5] = image[:, -7:] = ink((0.35, 0.26, 0.12))
    peel = picture_material(np.ascontiguousarray(image.transpose(1, 0, 2)), 0.45)
    along = np.linspace(0.0, 1.0, 31)
    angle = 1.25 * (along - 0.5)
    spine = np.stack([np.zeros(31), 0.13 * (1.0 - np.cos(angle)), 0.13 * np.sin(angle)], axis=1)
    radius = 0.018 * np.sqrt(np.clip(4.0 * along * (1.0 - along), 0.06, 1.0))
    return tube(spine, radius, peel, around=20)


_COVERS = ((0.55, 0.13, 0.20), (0.12, 0.28, 0.24), (0.82, 0.68, 0.36))
_LABELS = ((0.12, 0.45, 0.28), (0.70, 0.42, 0.10), (0.25, 0.22, 0.50))


def _remote(variant: int) -> Surface:
    """A remote control of 16 cm along y, its buttons to +z."""
    import cv2

    dark = variant % 2 == 0
    face = canvas(256, 64, (0.09, 0.09, 0.10) if dark else (0.80, 0.80, 0.78))
    key = ink((0.62, 0.62, 0.60) if dark else (0.22, 0.22, 0.25))
    cv2.circle(face, (14, 18), 7, ink((0.75, 0.12, 0.10)), -1, cv2.LINE_AA)
    cv2.circle(face, (32, 84), 20, key, 4, cv2.LINE_AA)
    cv2.circle(face, (32, 84), 8, key, -1, cv2.LINE_AA)
    for row in range(5):
        for column in range(3):
            cv2.circle(face, (14 + 18 * column, 128 + 22 * row), 6, key, -1, cv2.LINE_AA)
    shell = coat((0.07,) * 3 if dark else (0.72,) * 3, gloss=0.4)
    top = picture_material(face[::-1], 0.5)
    keys = shift(box((0.042, 0.156, 0.001), top), (0.0, 0.0, 0.0095))
    return join([box((0.045, 0.16, 0.018), shell), keys])


def _bottle(variant: int) -> Surface:
    """A bottle of 17 cm along z with a label, its cap at +z."""
    import cv2

    color = _LABELS[variant % len(_LABELS)]
    label = canvas(128, 256, (0.94, 0.93, 0.90))
    label[20:108] = ink(color)
    cv2.putText(label, "No. 7", (20, 78), cv2.FONT_HERSHEY_DUPLEX, 1.4, ink((0.97, 0.95, 0.9)), 3)
    body = picture_material(label[::-1], 0.22)
    cap = coat((0.15, 0.15, 0.16), gloss=0.4)
    hull = [(0.0, -0.08), (0.024, -0.08), (0.027, -0.075), (0.027, 0.035)]
    hull += [(0.022, 0.052), (0.01, 0.062)]
    lid = [(0.012, 0.06), (0.0125, 0.082), (0.011, 0.085), (0.0, 0.085)]
    return join([turned(hull, body, 36), turned(lid, cap)])


def _brush(variant: int) -> Surface:
    """A hair brush of 20 cm along y: a handle, a head, and rows of bristles to +z."""
    tone = (0.40, 0.22, 0.12) if variant % 2 else (0.68, 0.50, 0.32)
    wood = coat(tone, gloss=0.5)
    dark = plain((0.03, 0.03, 0.03), gloss=0.7)
    parts = [shift(box((0.018, 0.11, 0.014), wood), (0.0, -0.05, 0.0))]
    parts.append(shift(box((0.05, 0.09, 0.012), wood), (0.0, 0.05, 0.0)))
    for row in range(7):
        for column in range(4):
            place = (-0.018 + 0.012 * column, 0.014 + 0.012 * row, 0.013)
            parts.append(shift(box((0.0025, 0.0025, 0.016), dark), place))
    return join(parts)


def _notebook(variant: int) -> Surface:
    """A notebook of 9 x 14 cm, its cover to +z."""
    import cv2

    color = _COVERS[variant % len(_COVERS)]
    cover = canvas(192, 128, color)
    rng = generator(23, "notebook", variant)
    speckle = rng.integers(-9, 10, cover.shape[:2])[..., None]
    cover = np.clip(cover.astype(np.int64) + speckle, 0, 255).astype(np.uint8)
    cv2.rectangle(cover, (34, 40), (112, 84), ink((0.93, 0.90, 0.82)), -1)
    for line in (54, 66):
        cv2.line(cover, (42, line), (102, line), ink((0.4, 0.38, 0.36)), 1)
    cover[:, 14:18] = ink((0.08, 0.08, 0.09))
    pages = coat((0.92, 0.90, 0.84), gloss=0.8)
    lid = picture_material(np.ascontiguousarray(cover[::-1]), 0.5)
    sides = ((lid, 0.006), (coat(color, gloss=0.5), -0.006))
    covers = [shift(box((0.09, 0.14, 0.001), side), (0.0, 0.0, z)) for side, z in sides]
    return join([box((0.088, 0.138, 0.011), pages), *covers])


_APPLES = ((0.72, 0.10, 0.10), (0.46, 0.62, 0.16))
_LIDS = ((0.70, 0.16, 0.14), (0.16, 0.30, 0.52))
_CASES = ((0.90, 0.52, 0.08), (0.14, 0.16, 0.18))


def _apple(variant: int) -> Surface:
    """An apple of 7.5 cm, its stalk along z."""
    import cv2

    rng = generator(24, "apple", variant)
    image = canvas(128, 256, _APPLES[variant % len(_APPLES)])
    for _ in range(160):
        place = (int(rng.integers(0, 256)), int(rng.integers(8, 120)))
        cv2.ellipse(image, place, (1, int(rng.integers(2, 12))), 0, 0, 360, ink((0.85, 0.66, 0.3)))
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33)
    # A dent at either end.
    dent = 0.06 * np.maximum(np.abs(np.sin(angle)) - 0.9, 0.0) * np.sign(np.sin(angle))
    profile = np.stack([0.0375 * np.cos(angle) ** 0.8, 0.035 * np.sin(angle) - dent], axis=1)
    profile[[0, -1], 0] = 0.0
    stalk = np.stack([np.zeros(7), 0.002 * np.linspace(0, 1, 7) ** 2, np.linspace(0.025, 0.042, 7)])
    brown = coat((0.25, 0.16, 0.08), gloss=0.7)
    skin = turned(profile, picture_material(image, 0.25), 40)
    return join([skin, tube(stalk.T, np.full(7, 0.0018), brown)])


def _jar(variant: int) -> Surface:
    """A jar of 11 cm along z with a paper label, its lid at +z."""
    import cv2

    lid = coat(_LIDS[variant % len(_LIDS)], gloss=0.3)
    label = canvas(128, 256, (0.45, 0.24, 0.14))
    label[30:104] = ink((0.92, 0.90, 0.82))
    cv2.putText(label, "plum", (18, 80), cv2.FONT_HERSHEY_DUPLEX, 1.5, ink((0.3, 0.12, 0.3)), 3)
    cv2.putText(label, "1,2 kg", (146, 76), cv2.FONT_HERSHEY_DUPLEX, 0.9, ink((0.2, 0.2, 0.2)), 2)
    glass = picture_material(label[::-1], 0.12)
    hull = [(0.0, -0.055), (0.034, -0.055), (0.037, -0.05), (0.037, 0.03), (0.032, 0.04)]
    top = [(0.034, 0.036), (0.034, 0.054), (0.032, 0.056), (0.0, 0.056)]
    return join([turned(hull, glass, 40), turned(top, lid, 40)])


def _torch(variant: int) -> Surface:
    """A torch of 15 cm along z, its lamp at +z."""
    case = coat(_CASES[variant % len(_CASES)], gloss=0.35)
    rubber = plain((0.03, 0.03, 0.03), gloss=0.8)
    lens = plain((0.75, 0.78, 0.8), gloss=0.05, specular=0.4)
    grip = [(0.0, -0.075), (0.015, -0.075), (0.017, -0.07), (0.017, 0.02)]
    head = [(0.017, 0.02), (0.027, 0.04), (0.029, 0.07), (0.026, 0.073)]
    front = [(0.026, 0.073), (0.025, 0.069), (0.0, 0.069)]
    button = shift(box((0.009, 0.005, 0.018), rubber), (0.0, 0.0175, 0.0))
    rings = [
        turned([(0.0172, z), (0.0185, z + 0.003), (0.0172, z + 0.006)], rubber)
        for z in (-0.06, -0.045, -0.03)
    ]
    return join([turned(grip, case), turned(head, case), turned(front, lens), button, *rings])


# What builds each object; the variant chooses among its colours, sizes and pictures.
_BUILDERS: Mapping[str, Callable[[int], Surface]] = MappingProxyType(
    {
        "block": _block,
        "pen": _pen,
        "sticker": _sticker,
        "lotion_tube": _tube,
        "lotion": _dollop,
        "watch": _watch,
        "phone": _phone,
        "card": _card,
        "mug": _mug,
        "ball": _ball,
        "spoon": _spoon,
        "banana": _banana,
        "remote": _remote,
        "bottle": _bottle,
        "brush": _brush,
        "notebook": _notebook,
        "apple": _apple,
        "jar": _jar,
        "torch": _torch,
    }
)


def object_names() -> tuple[str, ...]:
    """Names of the objects that a scene can show."""
    return tuple(_BUILDERS)


def check_object(name: str) -> None:
    """Refuse an object that does not exist."""
    if name not in _BUILDERS:
        known = f"Known: {', '.join(_BUILDERS)}."
        raise BadInput(f"there is no object {name!r}", field="object", remedy=known)


@lru_cache(maxsize=64)
def build_object(name: str, variant: int = 0) -> Surface:
    """Build an object around its own origin, in metres."""
    check_object(name)
    return _BUILDERS[name](variant)
