"""Things that a subject's hands carry: a sleeve or a bare forearm, rings, watches and bracelets.

The forearm's first ring is the hand's own rim, its paint is the hand's painter at places behind
the wrist, and both share the normals at the rim, so that no seam shows. What is worn is fitted to
the rest hand and carried by the posed one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import (
    Material,
    Surface,
    best_turn,
    ease,
    join,
    perpendicular,
    plain,
    reversed_faces,
    rigid,
    shape,
    transformed,
    unit,
)
from hwp_bench.sim.subject.hand import (
    FINE,
    SubjectHand,
    kept,
    of_side,
    painted,
    skin_material,
    subject_hand,
)
from hwp_bench.sim.subject.subject import Subject
from hwp_bench.sim.subject.wear import (
    UPRIGHT,
    Ring,
    WristWear,
    angles,
    band,
    beads,
    metal,
    stone,
    wrist_watch,
)

if TYPE_CHECKING:
    from hwp_bench.hands import HandTemplate


def ringed(
    vertices: np.ndarray,
    around: tuple[np.ndarray, np.ndarray],
    along: np.ndarray,
    material: Material,
) -> Surface:
    """Join rings (R * K, 3) behind one another to a surface that looks outward and is not a hand.

    Takes texture coordinates, `around` of each vertex of a ring (K,) and of the next one, and
    `along` of each ring (R,).
    """
    count, spokes = len(along), len(around[0])
    ring, spoke = np.meshgrid(np.arange(count - 1), np.arange(spokes), indexing="ij")
    a = (ring * spokes + spoke).ravel()
    b = (ring * spokes + (spoke + 1) % spokes).ravel()
    c, d = a + spokes, b + spokes
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    left, right = (side[spoke.ravel()] for side in around)
    near, far = (along[ring.ravel() + step] for step in (0, 1))
    uv = [np.stack(at, axis=1) for at in ((left, near), (right, near), (left, far), (right, far))]
    halves = [np.stack([uv[corner] for corner in half], 1) for half in ((0, 2, 1), (1, 2, 3))]
    corner_uv = np.concatenate(halves)
    made = shape(vertices, faces, corner_uv, material, smooth=True)
    middles = vertices.reshape(count, spokes, 3).mean(axis=1)
    outward = vertices - np.repeat(middles, spokes, axis=0)
    looks_in = np.einsum("ni,ni->n", made.normals, outward).sum() < 0
    return reversed_faces(made) if looks_in else made


# Rings along the arm, m behind the wrist's rim; the first two make the cuff's fold.
_CUFF_RINGS = (0.006, -0.003, -0.004, 0.002, 0.014, 0.032, 0.06, 0.1, 0.15, 0.22, 0.3)
_CUFF_WIDTHS = (1.02, 1.06, 1.17, 1.22, 1.2, 1.22, 1.25, 1.3, 1.36, 1.45, 1.55)
_SPOKES = 40
_CLOTH = 256


@lru_cache(maxsize=2)
def sleeve_material(color: tuple[float, float, float], seed: int) -> Material:
    """Knitted cloth in one colour (sRGB), with ribs and mottling."""
    ticks = np.linspace(0.0, 1.0, _CLOTH, endpoint=False)
    u, v = np.meshgrid(ticks, ticks)
    ribs = 0.5 + 0.5 * np.cos(2.0 * np.pi * 28.0 * u)
    points = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    mottle = fractal_noise(points, 0.08, generator(seed, "sleeve")).reshape(u.shape)
    shade = 0.8 + 0.2 * ribs + 0.08 * mottle
    albedo = srgb_to_linear(np.array(color))[None, None] * shade[..., None]
    return Material(
        albedo=np.clip(albedo, 0.0, 1.0).astype(np.float32),
        gloss=0.9,
        specular=0.02,
        height=(0.0006 * ribs).astype(np.float32),
    )


@lru_cache(maxsize=4)
def wrist_rim(template: HandTemplate) -> np.ndarray:
    """Indices of the template's vertices around its open wrist, in order."""
    return boundary_loop(template.faces)


def sleeve(rim: np.ndarray, forward: np.ndarray, elbow: np.ndarray, material: Material) -> Surface:
    """Build a sleeve from the rim (R, 3) of a posed wrist towards the elbow."""
    center = rim.mean(axis=0)
    side = perpendicular(rim[0] - center, forward)
    third = np.cross(forward, side)
    angles = np.arctan2((rim - center) @ third, (rim - center) @ side)
    order = np.argsort(angles)
    around = np.linspace(-np.pi, np.pi, _SPOKES, endpoint=False)
    radius = np.interp(
        around, angles[order], np.linalg.norm(rim - center, axis=1)[order], period=2 * np.pi
    )
    arm = unit(elbow - center)
    rings = []
    place, previous = center.copy(), 0.0
    for step, (back, width) in enumerate(zip(_CUFF_RINGS, _CUFF_WIDTHS, strict=True)):
        bend = np.clip(back / 0.12, 0.0, 1.0)
        heading = unit(-forward + bend * (arm + forward))
        place = center + back * -forward if step < 4 else place + (back - previous) * heading
        previous = back
        x = perpendicular(side, heading)
        y = np.cross(x, heading)
        if y @ third < 0:
            y = -y
        round_up = np.clip(back / 0.15, 0.0, 1.0)
        size = width * (radius + round_up * (radius.mean() - radius))
        rings.append(
            place + size[:, None] * (np.cos(around)[:, None] * x + np.sin(around)[:, None] * y)
        )
    count = len(rings)
    spokes = np.arange(_SPOKES)
    along = np.arange(count) / (count - 1) * 2.0
    around_uv = (spokes / _SPOKES, (spokes + 1) / _SPOKES)
    return ringed(np.concatenate(rings), around_uv, along, material)


# Rings along the arm, m behind the rim, and how much wider than the wrist they are.
_RING_PLACES = np.array(
    [
        *(0.0, 0.0015, 0.004, 0.008, 0.013, 0.019, 0.026, 0.034, 0.044, 0.056, 0.07, 0.088),
        *(0.11, 0.135, 0.165, 0.2, 0.24, 0.285, 0.33),
    ]
)
_ARM_PLACES = (0.0, 0.012, 0.03, 0.05, 0.08, 0.12, 0.17, 0.22, 0.33)
_ARM_WIDTHS = (1.0, 0.955, 0.935, 0.955, 1.04, 1.2, 1.38, 1.52, 1.58)
# Way in which the arm leaves the hand's direction for the elbow's, m.
_BEND = 0.075
# Way in which the rim's own outline becomes an ellipse, m.
_SETTLE = 0.09
# Rows and columns of the arm's texture; about 0.4 mm of skin each.
_ARM_TEXELS = (768, 512)


@dataclass(frozen=True, eq=False)
class Rim:
    """The open wrist of a hand at one fineness, ready to carry an arm."""

    #: (K,) vertices around the rim, by rising angle.
    loop: np.ndarray
    #: (K,) their place around, 0-1, the same for both hands.
    around: np.ndarray


@lru_cache(maxsize=8)
def wrist_loop(subject: Subject, side: str, subdivisions: int = FINE) -> Rim:
    """The rim of a subject's hand."""
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
    """Build an arm from the rim (K, 3) of a posed wrist towards the elbow."""
    vertices = _arm_rings(rim, forward, elbow)
    # From the middle of the first row of texels to that of the last: textures repeat beyond.
    rows = _ARM_TEXELS[0]
    down = (0.5 + _RING_PLACES / _RING_PLACES[-1] * (rows - 1)) / rows
    following = np.append(around[1:], around[0] + 1.0)
    return ringed(vertices, (around, following), 1.0 - down, skin)


def seamless(hand: Surface, arm: Surface, loop: np.ndarray) -> tuple[Surface, Surface]:
    """Hand and arm with common normals where they meet, at the rim's `loop`."""
    common = unit(hand.normals[loop] + arm.normals[: len(loop)])
    of_hand, of_arm = hand.normals.copy(), arm.normals.copy()
    of_hand[loop] = common
    of_arm[: len(loop)] = common
    return replace(hand, normals=of_hand), replace(arm, normals=of_arm)


def arm_openness(rim: np.ndarray) -> np.ndarray:
    """Share of the sky that an arm sees: the rim's (K,) at its start, all of it from 5 cm on."""
    opening = np.clip(_RING_PLACES / 0.05, 0.0, 1.0)[:, None]
    return (rim + opening * (1.0 - rim)).ravel()


def near_wrist(spokes: int, back: float) -> np.ndarray:
    """Vertices of an arm with so many spokes in the rings around a distance behind the rim."""
    rings = np.flatnonzero(np.abs(_RING_PLACES - back) < 0.016)
    return (rings[:, None] * spokes + np.arange(spokes)).ravel()


@lru_cache(maxsize=8)
def rest_arm(subject: Subject, side: str, subdivisions: int = FINE) -> np.ndarray:
    """Vertices of the arm behind the rest hand, in the order of `forearm`: (A, 3) m."""
    hand = subject_hand(subject, side, subdivisions)
    loop = wrist_loop(subject, side, subdivisions).loop
    rim = hand.rest[loop]
    forward = unit(hand.joints[4] - hand.joints[0])
    return _arm_rings(rim, forward, rim.mean(axis=0) - forward)


@lru_cache(maxsize=4)
def arm_atlas(subject: Subject) -> Material:
    """Paint the forearm of a subject, or read it from the cache."""
    hand = subject_hand(subject, "right")

    def paint() -> Material:
        rim = wrist_loop(subject, "right")
        vertices = rest_arm(subject, "right")
        arm = forearm(
            vertices[: len(rim.loop)],
            rim.around,
            unit(hand.joints[4] - hand.joints[0]),
            vertices[-len(rim.loop) :].mean(axis=0),
            Material(albedo=np.ones((1, 1, 3), dtype=np.float32)),
        )
        points = _spread_over_arm(vertices, rim.around)
        normals = unit(_spread_over_arm(arm.normals, rim.around))
        weights = np.zeros((len(points), hand.template.weights.shape[1]))
        weights[:, 0] = 1.0
        anatomy = hand.anatomy(points, normals, weights)
        skin = painted(anatomy, of_side(subject, "right"), fine=True)
        parts = (skin.albedo, skin.height, skin.roughness)
        return skin_material(*(part.reshape(*_ARM_TEXELS, *part.shape[1:]) for part in parts))

    return kept(hand, subject, f"arm {_ARM_TEXELS}", paint)


def _spread_over_arm(values: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Values at an arm's vertices, (A, 3), at the texels of its texture: (rows * columns, 3)."""
    rows, columns = _ARM_TEXELS
    u = (np.arange(columns) + 0.5) / columns
    back = np.linspace(0.0, _RING_PLACES[-1], rows)
    rings = values.reshape(len(_RING_PLACES), len(around), 3)
    wide = np.stack(
        [[np.interp(u, around, ring[:, axis], period=1.0) for axis in range(3)] for ring in rings]
    )
    step = np.clip(np.searchsorted(_RING_PLACES, back, side="right") - 1, 0, len(_RING_PLACES) - 2)
    share = ((back - _RING_PLACES[step]) / (_RING_PLACES[step + 1] - _RING_PLACES[step]))[
        :, None, None
    ]
    texels = wide[step] + share * (wide[step + 1] - wide[step])
    return texels.transpose(0, 2, 1).reshape(-1, 3)


def _arm_rings(rim: np.ndarray, forward: np.ndarray, elbow: np.ndarray) -> np.ndarray:
    """(A, 3) m: a ring of the rim's length at each place of `_RING_PLACES`."""
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
    widths = PchipInterpolator(_ARM_PLACES, _ARM_WIDTHS)
    rings, place, previous, heading = [], center, 0.0, -forward
    for back in _RING_PLACES:
        ahead = unit(-forward + ease(back / _BEND) * (arm + forward))
        x, y = _carried(x, heading, ahead), _carried(y, heading, ahead)
        heading = ahead
        place = place + (back - previous) * heading
        previous = back
        settled = ease(back / _SETTLE)
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
    return perpendicular(turned, after)


# Where a ring sits on the first bone, as a share of it.
_ON_BONE = {"thumb": 0.5}
_ON_FINGER = 0.66
# Half the width of the skin that a band is fitted to, m, and the air below it.
_BELT, _AIR = 0.003, 0.0003
_THICKNESS = 0.0014
# Where a wrist is worn on, m in front of the rim: with a sleeve, and on a bare arm.
_BEFORE_SLEEVE = {"watch": 0.0155, "bangle": 0.009, "beads": 0.010}
_ON_ARM = {"watch": -0.020, "bangle": -0.014, "beads": -0.016}


@dataclass(frozen=True, eq=False)
class Mount:
    """A worn thing on the rest hand, and the skin that carries it."""

    #: The thing, fitted to the rest hand.
    thing: Surface
    #: (N,) vertices of hand or arm around it.
    near: np.ndarray
    #: (N, 3) m, where they are at rest.
    places: np.ndarray
    #: Whether the arm carries it.
    on_arm: bool

    def carried(self, vertices: np.ndarray) -> Surface:
        """The thing on the posed hand (or arm), moved by the best rigid motion of its skin."""
        now = vertices[self.near]
        middle, place = self.places.mean(axis=0), now.mean(axis=0)
        turn = best_turn(self.places - middle, now - place)
        return transformed(self.thing, rigid(turn, place - turn @ middle))


@lru_cache(maxsize=8)
def ring_mounts(subject: Subject, side: str) -> tuple[Mount, ...]:
    """The rings of one hand; they count as hand."""
    looks = of_side(subject, side).looks
    if not looks.rings:
        return ()
    hand = subject_hand(subject, side)
    return tuple(_ring_mount(hand, ring) for ring in looks.rings)


@lru_cache(maxsize=8)
def wrist_mounts(subject: Subject, side: str, subdivisions: int) -> tuple[Mount, ...]:
    """Watch and bracelets of one wrist."""
    looks = of_side(subject, side).looks
    return tuple(_wrist_mount(subject, side, item, subdivisions) for item in looks.wrist)


def _ring_mount(hand: SubjectHand, ring: Ring) -> Mount:
    mirror = np.array([1.0 if hand.template.side == "right" else -1.0, 1.0, 1.0])
    first = FIRST_JOINT[ring.finger]
    start = first + (1 if ring.finger == "thumb" else 0)
    bone = unit(hand.joints[start + 1] - hand.joints[start])
    share = _ON_BONE.get(ring.finger, _ON_FINGER)
    place = hand.joints[start] + share * (hand.joints[start + 1] - hand.joints[start])
    axis = perpendicular(finger_back(ring.finger) * mirror, bone)
    frame = np.stack([np.cross(axis, bone), axis, bone], axis=1)
    rest = hand.rest_skin
    owned = hand.lift @ hand.template.weights[:, first : first + 3].sum(axis=1) > 0.5
    local = (rest - place) @ frame
    belt = owned & (np.abs(local[:, 2]) < 0.5 * ring.width + _BELT)
    middle = 0.5 * (local[belt, :2].max(axis=0) + local[belt, :2].min(axis=0))
    place = place + frame[:, :2] @ middle
    outline = _outline(local[belt, :2] - middle) + _AIR
    material = metal(ring.metal)
    parts = [band(outline, ring.width, _THICKNESS, material)]
    if ring.stone:
        top = np.interp(0.5 * np.pi, angles(), outline) + _THICKNESS
        gem = stone(ring.stone, ring.stone_color, material)
        parts.append(transformed(gem, rigid(UPRIGHT, (0.0, top, 0.0))))
    count = len(hand.template.vertices)
    near = np.flatnonzero(owned[:count] & (np.abs(local[:count, 2]) < 0.007))
    return Mount(_placed(join(parts), frame, place, hand=True), near, rest[near], on_arm=False)


def _wrist_mount(subject: Subject, side: str, item: WristWear, subdivisions: int) -> Mount:
    hand = subject_hand(subject, side, subdivisions)
    loop = wrist_loop(subject, side, subdivisions).loop
    rest = hand.rest_skin
    rim = rest[loop].mean(axis=0)
    bare = subject.looks.arm == "bare"
    forward = unit(hand.joints[4] - hand.joints[0])
    back = perpendicular(np.array([0.0, 1.0, 0.0]), forward)
    frame = np.stack([np.cross(back, forward), back, forward], axis=1)
    ahead = (_ON_ARM if bare else _BEFORE_SLEEVE)[item.kind]
    skin = rest_arm(subject, side, subdivisions) if bare else rest
    local = (skin - rim) @ frame
    belt = np.abs(local[:, 2] - ahead) < 0.0045
    middle = 0.5 * (local[belt, :2].max(axis=0) + local[belt, :2].min(axis=0))
    outline = _outline(local[belt, :2] - middle)
    place = rim + frame @ np.array([*middle, ahead])
    color = srgb_to_linear(np.array(item.color))
    if item.kind == "watch":
        wide, high = 0.5 * np.ptp(local[belt, :2], axis=0) + 0.0008
        made = wrist_watch((float(wide), float(high)), item.color)
        # The watch lies around x with its dial to y.
        frame = np.stack([frame[:, 2], frame[:, 1], np.cross(frame[:, 2], frame[:, 1])], axis=1)
    elif item.kind == "bangle":
        made = band(outline + 0.0012, 0.007, 0.0025, plain(color, gloss=0.22, specular=0.5))
    else:
        made = beads(outline + 0.0008, 0.0085, plain(color, gloss=0.3, specular=0.06))
    if bare:
        near = near_wrist(len(loop), -ahead)
    else:
        near = np.flatnonzero(np.abs(local[: len(hand.template.vertices), 2] - ahead) < 0.012)
    return Mount(_placed(made, frame, place, hand=False), near, skin[near], on_arm=bare)


def _outline(points: np.ndarray) -> np.ndarray:
    """Radius of (N, 2) points at `angles()`: (AROUND,) m, smooth, at most 5 % inside any point."""
    turn = np.arctan2(points[:, 1], points[:, 0])
    radius = np.linalg.norm(points, axis=1)

    def waves(at: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.ones_like(at), *(f(k * at) for k in (1, 2) for f in (np.cos, np.sin))], axis=1
        )

    fitted = np.linalg.lstsq(waves(turn), radius, rcond=None)[0]
    # A band lies on what stands out.
    proud = float(np.quantile(radius - waves(turn) @ fitted, 0.9))
    return waves(angles()) @ fitted + max(proud, 0.0)


def _placed(thing: Surface, frame: np.ndarray, place: np.ndarray, *, hand: bool) -> Surface:
    moved = transformed(thing, rigid(frame, place))
    return replace(moved, hand=np.full(len(moved.faces), hand))
