"""Rings, watches and bracelets of a subject: fitted to the rest hand, carried by the posed one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.sim.geometry.mesh import surface_normals, unit
from hwp_bench.sim.geometry.surface import Surface, join, plain, transformed
from hwp_bench.sim.props.jewellery import angles, band, beads, metal, stone
from hwp_bench.sim.props.worn import wrist_watch
from hwp_bench.sim.scene.looks import Ring, WristWear
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.forearm import near_wrist, rest_arm, wrist_loop
from hwp_bench.sim.subject.hand import SubjectHand, subject_hand
from hwp_bench.sim.subject.painting import of_side

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
        """The thing on the posed hand (or arm), moved by the best rigid motion of its skin.

        Args:
            vertices: (V, 3) m of the posed hand, or of the arm.

        Source: the Kabsch algorithm.
        """
        now = vertices[self.near]
        a, b = self.places - self.places.mean(axis=0), now - now.mean(axis=0)
        u, _, vt = np.linalg.svd(b.T @ a)
        move = np.eye(4)
        move[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        move[:3, 3] = now.mean(axis=0) - move[:3, :3] @ self.places.mean(axis=0)
        return transformed(self.thing, move)


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
    """Watch and bracelets of one wrist.

    Args:
        subject: whose.
        side: `right` or `left`.
        subdivisions: of the hand's mesh; the arm has vertices for each.
    """
    looks = of_side(subject, side).looks
    return tuple(_wrist_mount(subject, side, item, subdivisions) for item in looks.wrist)


def _ring_mount(hand: SubjectHand, ring: Ring) -> Mount:
    mirror = np.array([1.0 if hand.template.side == "right" else -1.0, 1.0, 1.0])
    first = FIRST_JOINT[ring.finger]
    start = first + (1 if ring.finger == "thumb" else 0)
    bone = unit(hand.joints[start + 1] - hand.joints[start])
    share = _ON_BONE.get(ring.finger, _ON_FINGER)
    place = hand.joints[start] + share * (hand.joints[start + 1] - hand.joints[start])
    axis = finger_back(ring.finger) * mirror
    axis = unit(axis - (axis @ bone) * bone)
    frame = np.stack([np.cross(axis, bone), axis, bone], axis=1)
    rest = _rest_skin(hand)
    owned = hand.lift @ hand.template.weights[:, first : first + 3].sum(axis=1) > 0.5
    local = (rest - place) @ frame
    belt = owned & (np.abs(local[:, 2]) < 0.5 * ring.width + _BELT)
    middle = 0.5 * (local[belt, :2].max(axis=0) + local[belt, :2].min(axis=0))
    place = place + frame[:, :2] @ middle
    outline = _outline(local[belt, :2] - middle) + _AIR
    material = metal(ring.metal)
    parts = [band(outline, ring.width, _THICKNESS, material)]
    if ring.stone:
        top = np.eye(4)
        # z of the stone to y of the ring, on the back of the finger.
        top[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        top[1, 3] = np.interp(0.5 * np.pi, angles(), outline) + _THICKNESS
        parts.append(transformed(stone(ring.stone, ring.stone_color, material), top))
    count = len(hand.template.vertices)
    near = np.flatnonzero(owned[:count] & (np.abs(local[:count, 2]) < 0.007))
    return Mount(_placed(join(parts), frame, place, hand=True), near, rest[near], on_arm=False)


def _wrist_mount(subject: Subject, side: str, item: WristWear, subdivisions: int) -> Mount:
    hand = subject_hand(subject, side, subdivisions)
    loop = wrist_loop(subject, side, subdivisions).loop
    rest = _rest_skin(hand)
    rim = rest[loop].mean(axis=0)
    bare = subject.looks.arm == "bare"
    forward = unit(hand.joints[4] - hand.joints[0])
    back = unit(np.array([0.0, 1.0, 0.0]) - forward[1] * forward)
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


def _rest_skin(hand: SubjectHand) -> np.ndarray:
    """The rest hand with its relief: (V, 3) m."""
    smooth = hand.rest
    normals = surface_normals(smooth, hand.faces, hand.normal_sum)
    return smooth + hand.relief[:, None] * normals


def _outline(points: np.ndarray) -> np.ndarray:
    """Radius of a section at `angles()`: (AROUND,) m, smooth, at most 5 % inside any point.

    Args:
        points: (N, 2) m around the origin.
    """
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
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = frame, place
    moved = transformed(thing, move)
    return replace(moved, hand=np.full(len(moved.faces), hand))
