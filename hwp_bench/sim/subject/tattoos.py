"""Tattoos: line art from a seed, laid onto the back of the rest hand or of its fingers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.looks import Tattoo
from hwp_bench.sim.subject.anatomy import Anatomy

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
        axis = finger_back(finger)
        axis = unit(axis - (axis @ bone) * bone)
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
