"""Things of a household: a remote control, a bottle, a brush, a notebook."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import Material, Surface, join, plain, transformed
from hwp_bench.sim.props.shapes import albedo, box, canvas, ink, turned

_COVERS = ((0.55, 0.13, 0.20), (0.12, 0.28, 0.24), (0.82, 0.68, 0.36))
_LABELS = ((0.12, 0.45, 0.28), (0.70, 0.42, 0.10), (0.25, 0.22, 0.50))


def build(name: str, variant: int) -> Surface:
    """Build a `remote`, a `bottle`, a `brush` or a `notebook`."""
    made = {"remote": _remote, "bottle": _bottle, "brush": _brush, "notebook": _notebook}
    return made[name](variant)


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
    shell = plain(srgb_to_linear(np.array([0.07] * 3 if dark else [0.72] * 3)), gloss=0.4)
    top = Material(albedo=albedo(face[::-1]), gloss=0.5)
    return join([box((0.045, 0.16, 0.018), shell), _above(box((0.042, 0.156, 0.001), top), 0.0095)])


def _bottle(variant: int) -> Surface:
    """A bottle of 17 cm along z with a label, its cap at +z."""
    import cv2

    color = _LABELS[variant % len(_LABELS)]
    label = canvas(128, 256, (0.94, 0.93, 0.90))
    label[20:108] = ink(color)
    cv2.putText(label, "No. 7", (20, 78), cv2.FONT_HERSHEY_DUPLEX, 1.4, ink((0.97, 0.95, 0.9)), 3)
    body = Material(albedo=albedo(label[::-1]), gloss=0.22)
    cap = plain(srgb_to_linear(np.array([0.15, 0.15, 0.16])), gloss=0.4)
    hull = np.array(
        [
            [0.0, -0.08],
            [0.024, -0.08],
            [0.027, -0.075],
            [0.027, 0.035],
            [0.022, 0.052],
            [0.01, 0.062],
        ]
    )
    lid = np.array([[0.012, 0.06], [0.0125, 0.082], [0.011, 0.085], [0.0, 0.085]])
    return join([turned(hull, body, 36), turned(lid, cap)])


def _brush(variant: int) -> Surface:
    """A hair brush of 20 cm along y: a handle, a head, and rows of bristles to +z."""
    tone = (0.40, 0.22, 0.12) if variant % 2 else (0.68, 0.50, 0.32)
    wood = plain(srgb_to_linear(np.array(tone)), gloss=0.5)
    dark = plain((0.03, 0.03, 0.03), gloss=0.7)
    parts = [_at(box((0.018, 0.11, 0.014), wood), (0.0, -0.05, 0.0))]
    parts.append(_at(box((0.05, 0.09, 0.012), wood), (0.0, 0.05, 0.0)))
    for row in range(7):
        for column in range(4):
            place = (-0.018 + 0.012 * column, 0.014 + 0.012 * row, 0.013)
            parts.append(_at(box((0.0025, 0.0025, 0.016), dark), place))
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
    pages = plain(srgb_to_linear(np.array([0.92, 0.90, 0.84])), gloss=0.8)
    lid = Material(albedo=albedo(np.ascontiguousarray(cover[::-1])), gloss=0.5)
    back = plain(srgb_to_linear(np.array(color)), gloss=0.5)
    return join(
        [
            box((0.088, 0.138, 0.011), pages),
            _above(box((0.09, 0.14, 0.001), lid), 0.006),
            _above(box((0.09, 0.14, 0.001), back), -0.006),
        ]
    )


def _above(surface: Surface, height: float) -> Surface:
    return _at(surface, (0.0, 0.0, height))


def _at(surface: Surface, place: tuple[float, float, float]) -> Surface:
    move = np.eye(4)
    move[:3, 3] = place
    return transformed(surface, move)
