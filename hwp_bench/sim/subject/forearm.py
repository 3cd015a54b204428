"""A bare forearm: skin that goes on behind the wrist, in one piece with the hand.

Its first ring is the hand's own rim, its paint is the hand's painter at places behind the wrist,
and both share the normals at the rim, so that no seam shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.surface import Material, Surface
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.atlas import SkinAtlas, kept
from hwp_bench.sim.subject.hand import FINE, anatomy_at, subject_hand
from hwp_bench.sim.subject.limb import ringed
from hwp_bench.sim.subject.painting import of_side, painted

# Rings along the arm, m behind the rim, and how much wider than the wrist they are.
_BACK = np.array(
    [
        *(0.0, 0.0015, 0.004, 0.008, 0.013, 0.019, 0.026, 0.034, 0.044, 0.056, 0.07, 0.088),
        *(0.11, 0.135, 0.165, 0.2, 0.24, 0.285, 0.33),
    ]
)
_PLACES = (0.0, 0.012, 0.03, 0.05, 0.08, 0.12, 0.17, 0.22, 0.33)
_WIDTHS = (1.0, 0.955, 0.935, 0.955, 1.04, 1.2, 1.38, 1.52, 1.58)
# Way in which the arm leaves the hand's direction for the elbow's, m.
_BEND = 0.075
# Way in which the rim's own outline becomes an ellipse, m.
_SETTLE = 0.09
# Rows and columns of the arm's texture; about 0.4 mm of skin each.
_TEXTURE = (768, 512)


@dataclass(frozen=True, eq=False)
class Rim:
    """The open wrist of a hand at one fineness, ready to carry an arm."""

    #: (K,) vertices around the rim, by rising angle.
    loop: np.ndarray
    #: (K,) their place around, 0-1, the same for both hands.
    around: np.ndarray


@lru_cache(maxsize=8)
def wrist_loop(subject: Subject, side: str, subdivisions: int = FINE) -> Rim:
    """The rim of a subject's hand.

    Args:
        subject: whose.
        side: `right` or `left`.
        subdivisions: of the hand's mesh.
    """
    hand = subject_hand(subject, side, subdivisions)
    rest = hand.rest
    loop = boundary_loop(hand.faces)
    mirror = 1.0 if side == "right" else -1.0
    places = (rest[loop] - rest[loop].mean(axis=0)) * np.array([mirror, 1.0, 1.0])
    angles = np.arctan2(places[:, 1], places[:, 2])
    order = np.argsort(angles)
    return Rim(loop[order], angles[order] / (2.0 * np.pi) + 0.5)


def forearm(
    rim: np.ndarray, around: np.ndarray, forward: np.ndarray, elbow: np.ndarray, skin: Material
) -> Surface:
    """Build an arm from the rim of a posed wrist towards the elbow.

    Args:
        rim: (K, 3) m, in the order of `Rim.loop`; the first K vertices of the arm.
        around: (K,) `Rim.around`.
        forward: (3,) unit vector from the wrist to the fingers.
        elbow: (3,) m.
        skin: what it is covered with.
    """
    vertices = _rings(rim, forward, elbow)
    # From the middle of the first row of texels to that of the last: textures repeat beyond.
    rows = _TEXTURE[0]
    down = (0.5 + _BACK / _BACK[-1] * (rows - 1)) / rows
    following = np.append(around[1:], around[0] + 1.0)
    return ringed(vertices, (around, following), 1.0 - down, skin)


def seamless(hand: Surface, arm: Surface, loop: np.ndarray) -> tuple[Surface, Surface]:
    """Hand and arm with common normals where they meet.

    Args:
        hand: the posed hand.
        arm: what `forearm` made of its rim.
        loop: (K,) `Rim.loop`.
    """
    common = unit(hand.normals[loop] + arm.normals[: len(loop)])
    of_hand, of_arm = hand.normals.copy(), arm.normals.copy()
    of_hand[loop] = common
    of_arm[: len(loop)] = common
    return replace(hand, normals=of_hand), replace(arm, normals=of_arm)


def arm_openness(rim: np.ndarray) -> np.ndarray:
    """Share of the sky that an arm sees: the rim's (K,) at its start, all of it from 5 cm on."""
    opening = np.clip(_BACK / 0.05, 0.0, 1.0)[:, None]
    return (rim + opening * (1.0 - rim)).ravel()


def near_wrist(spokes: int, back: float) -> np.ndarray:
    """Vertices of an arm with so many spokes in the rings around a distance behind the rim."""
    rings = np.flatnonzero(np.abs(_BACK - back) < 0.016)
    return (rings[:, None] * spokes + np.arange(spokes)).ravel()


@lru_cache(maxsize=8)
def rest_arm(subject: Subject, side: str, subdivisions: int = FINE) -> np.ndarray:
    """Vertices of the arm behind the rest hand, in the order of `forearm`: (A, 3) m."""
    hand = subject_hand(subject, side, subdivisions)
    loop = wrist_loop(subject, side, subdivisions).loop
    rim = hand.rest[loop]
    forward = unit(hand.joints[4] - hand.joints[0])
    return _rings(rim, forward, rim.mean(axis=0) - forward)


@lru_cache(maxsize=2)
def arm_atlas(subject: Subject) -> SkinAtlas:
    """Paint the forearm of a subject, or read it from the cache.

    Args:
        subject: as `painting.of_side` gives it; both arms share the painting, mirrored.
    """
    hand = subject_hand(subject, "right")

    def paint() -> SkinAtlas:
        rim = wrist_loop(subject, "right")
        vertices = rest_arm(subject, "right")
        arm = forearm(
            vertices[: len(rim.loop)],
            rim.around,
            unit(hand.joints[4] - hand.joints[0]),
            vertices[-len(rim.loop) :].mean(axis=0),
            Material(albedo=np.ones((1, 1, 3), dtype=np.float32)),
        )
        points = _spread(vertices, rim.around)
        normals = unit(_spread(arm.normals, rim.around))
        weights = np.zeros((len(points), hand.template.weights.shape[1]))
        weights[:, 0] = 1.0
        anatomy = anatomy_at(hand.template, hand.betas, points, normals, weights, hand.joints)
        skin = painted(anatomy, of_side(subject, "right"), fine=True)
        albedo, height, roughness = (
            np.ascontiguousarray(values.reshape(*_TEXTURE, *values.shape[1:]), dtype=np.float32)
            for values in (skin.albedo, skin.height, skin.roughness)
        )
        return SkinAtlas(albedo, height, roughness)

    return kept(hand, subject, f"arm {_TEXTURE}", paint)


def _spread(values: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Values at an arm's vertices, (A, 3), at the texels of its texture: (rows * columns, 3)."""
    rows, columns = _TEXTURE
    u = (np.arange(columns) + 0.5) / columns
    back = np.linspace(0.0, _BACK[-1], rows)
    rings = values.reshape(len(_BACK), len(around), 3)
    wide = np.stack(
        [[np.interp(u, around, ring[:, axis], period=1.0) for axis in range(3)] for ring in rings]
    )
    step = np.clip(np.searchsorted(_BACK, back, side="right") - 1, 0, len(_BACK) - 2)
    share = ((back - _BACK[step]) / (_BACK[step + 1] - _BACK[step]))[:, None, None]
    texels = wide[step] + share * (wide[step + 1] - wide[step])
    return texels.transpose(0, 2, 1).reshape(-1, 3)


def _rings(rim: np.ndarray, forward: np.ndarray, elbow: np.ndarray) -> np.ndarray:
    """(A, 3) m: a ring of the rim's length at each place of `_BACK`."""
    from scipy.interpolate import PchipInterpolator

    center = rim.mean(axis=0)
    offset = rim - center
    depth = offset @ forward
    flat = offset - depth[:, None] * forward
    # The outline's own axes, so that the ellipse lies as the wrist does.
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    x, y = axes[0], axes[1]
    a, b = flat @ x, flat @ y
    angle = np.arctan2(b / np.abs(b).max(), a / np.abs(a).max())
    wide, high = np.sqrt(2.0) * a.std(), np.sqrt(2.0) * b.std()
    arm = unit(elbow - center)
    widths = PchipInterpolator(_PLACES, _WIDTHS)
    rings, place, previous, heading = [], center, 0.0, -forward
    for back in _BACK:
        bend = min(back / _BEND, 1.0)
        turn = bend * bend * (3.0 - 2.0 * bend)
        ahead = unit(-forward + turn * (arm + forward))
        x, y = _carried(x, heading, ahead), _carried(y, heading, ahead)
        heading = ahead
        place = place + (back - previous) * heading
        previous = back
        settled = min(back / _SETTLE, 1.0)
        settled = settled * settled * (3.0 - 2.0 * settled)
        size = float(widths(back))
        # A forearm gets rounder towards the elbow.
        tall = high + np.interp(back, (0.05, 0.25), (0.0, 0.75)) * (wide - high)
        across = a + settled * (wide * np.cos(angle) - a)
        upward = b + settled * (tall * np.sin(angle) - b)
        rings.append(
            place
            + size * (across[:, None] * x + upward[:, None] * y)
            - (depth * max(1.0 - back / 0.02, 0.0))[:, None] * heading
        )
    rings[0] = rim
    return np.concatenate(rings)


def _carried(axis: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """An axis turned along with a heading, by the shortest rotation."""
    cross, cosine = np.cross(before, after), float(before @ after)
    turned = axis + np.cross(cross, axis)
    turned = turned + np.cross(cross, np.cross(cross, axis)) / max(1.0 + cosine, 1e-9)
    return unit(turned - (turned @ after) * after)
