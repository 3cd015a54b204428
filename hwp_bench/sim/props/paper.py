"""Flat things: stickers and playing cards, slightly bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.sim.geometry.surface import Material, Surface, join, transformed
from hwp_bench.sim.props.shapes import albedo, canvas, grid, ink

_STICKERS = ((0.98, 0.83, 0.12), (0.90, 0.25, 0.45), (0.20, 0.65, 0.85), (0.35, 0.75, 0.30))
_RADIUS = 0.022
_SUITS = ("heart", "spade", "diamond", "club")
_RED, _BLACK = (0.78, 0.08, 0.10), (0.06, 0.06, 0.08)


def build(name: str, variant: int) -> Surface:
    """Build a sticker (44 mm, round) or a playing card (58 x 89 mm), facing +z."""
    if name == "sticker":
        front, back = _sticker(variant), canvas(4, 4, (0.93, 0.93, 0.93))
        return _disc(front, back)
    return _sheet(_card(variant), _card_back(), (0.058, 0.089), bend=0.006)


def _material(image: np.ndarray) -> Material:
    return Material(albedo=albedo(image), gloss=0.4)


def _sheet(front: np.ndarray, back: np.ndarray, size: tuple[float, float], bend: float) -> Surface:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 7))
    z = bend * (1.0 - 4.0 * x * x)
    vertices = np.stack([x * size[0], y * size[1], z], axis=-1).reshape(-1, 3)
    return _two_sided(vertices, front, back)


def _disc(front: np.ndarray, back: np.ndarray) -> Surface:
    radius, angle = np.meshgrid(np.linspace(1e-3, 1.0, 4), np.linspace(0, 2 * np.pi, 33))
    place = _RADIUS * radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([place, 0.002 * radius[..., None] ** 2], axis=-1).reshape(-1, 3)
    return _two_sided(vertices, front, back, columns=4)


def _two_sided(
    vertices: np.ndarray, front: np.ndarray, back: np.ndarray, columns: int = 7
) -> Surface:
    rows = len(vertices) // columns
    top = grid(vertices, rows, columns, _material(front))
    if columns == 4:
        flat = vertices[top.faces][..., :2] / (2.0 * _RADIUS) + 0.5
        top = replace(top, corner_uv=flat)
    if top.normals[:, 2].mean() < 0:
        top = _reversed(top)
    under = _reversed(transformed(grid(vertices, rows, columns, _material(back)), _lowered()))
    if under.normals[:, 2].mean() > 0:
        under = _reversed(under)
    return join([top, under])


def _lowered() -> np.ndarray:
    move = np.eye(4)
    move[2, 3] = -0.0004
    return move


def _reversed(surface: Surface) -> Surface:
    return replace(
        surface,
        faces=np.ascontiguousarray(surface.faces[:, ::-1]),
        corner_uv=np.ascontiguousarray(surface.corner_uv[:, ::-1]),
        normals=-surface.normals,
    )


def _sticker(variant: int) -> np.ndarray:
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


def _card(variant: int) -> np.ndarray:
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
        corners = np.array(
            [
                [x - 0.9 * size, y - sign * 0.12 * size],
                [x + 0.9 * size, y - sign * 0.12 * size],
                [x, y + sign * size],
            ]
        )
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
