"""Landmarks on a rest hand: where creases, tendons, veins and nails lie.

All distances are in metres on the right hand in its rest frame (fingers along -x, back of the
hand +y, thumb's side +z).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hwp_bench.hands.poses import FIRST_JOINT, finger_back
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import fractal_noise

# Palm lines as rows of (along, across): 0-1 from the wrist to the middle knuckle, and from the
# little finger's knuckle to the index finger's.
_PALM_LINES = (
    ((0.80, -0.12), (0.84, 0.25), (0.90, 0.55), (1.02, 0.78)),
    ((0.50, 0.02), (0.60, 0.35), (0.70, 0.70), (0.80, 1.12)),
    ((0.80, 1.14), (0.62, 0.80), (0.40, 0.62), (0.16, 0.55), (0.02, 0.55)),
)

# exp(-x) of a larger x is lost in any sum of the numbers here, so that it need not be computed.
_LOST = 48.0
# Places that are compared with a whole line at once: what they need stays in the processor's cache.
_BLOCK = 8192


@dataclass(frozen=True, eq=False)
class Anatomy:
    """N places on a rest hand, and what the landmarks are at each of them."""

    #: (N, 3) m.
    points: np.ndarray
    #: (N, 3) unit normals.
    normals: np.ndarray
    #: (N, 16) skinning weights.
    weights: np.ndarray
    #: (16, 3) rest joints, m.
    joints: np.ndarray
    #: (5, 3) finger tips, rows in the order of `FINGERS`.
    tips: np.ndarray

    @property
    def back(self) -> np.ndarray:
        """1 on the back of the hand, 0 on the palm side, soft between: (N,)."""
        thumb = self.weights[:, 13:16].sum(axis=1)[:, None]
        axis = unit((1.0 - thumb) * finger_back("index") + thumb * finger_back("thumb"))
        facing = np.einsum("ni,ni->n", self.normals, axis)
        x = np.clip((facing + 0.35) / 0.6, 0.0, 1.0)
        return x * x * (3.0 - 2.0 * x)

    def joint_creases(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Wrinkles across the finger joints, and the swelling of the knuckles: (N,), 0-1 each."""
        lines = np.zeros(len(self.points))
        swell = np.zeros(len(self.points))
        wobble = fractal_noise(self.points, 0.006, rng, octaves=2) * 0.0006
        back = self.back
        for finger in FINGERS:
            first = FIRST_JOINT[finger]
            chain = np.vstack([self.joints[0], self.joints[first : first + 3], self._tip(finger)])
            for step in range(3):
                joint = chain[step + 1]
                along = unit(unit(chain[step + 2] - joint) + unit(joint - chain[step]))
                rows, near = self._around(joint, 0.017)
                s = (self.points[rows] - joint) @ along
                knuckle = step == 0
                swell[rows] += np.exp(-((s / 0.008) ** 2)) * near * (0.7 if knuckle else 1.0)
                count = 2 if knuckle else 5
                places = np.linspace(-0.0045, 0.0045, count) + rng.normal(0, 0.0004, count)
                for place in places:
                    depth = rng.uniform(0.4, 1.0) * (0.35 if knuckle else 1.0)
                    line = np.exp(-(((s - place + wobble[rows]) / 0.00042) ** 2))
                    lines[rows] += depth * line * near * back[rows]
                if knuckle and finger != "thumb":
                    # The palm side folds at the finger's root, beyond the joint.
                    rows, near = self._around(joint + 0.02 * along, 0.02)
                    s = (self.points[rows] - joint) @ along
                    s = s - 0.42 * np.linalg.norm(chain[2] - joint)
                owned = self.weights[rows, first : first + 3].sum(axis=1)
                for place in (-0.0011, 0.0013) if step == 1 else (0.0,):
                    line = np.exp(-(((s - place + 0.7 * wobble[rows]) / 0.0005) ** 2))
                    lines[rows] += 1.3 * line * near * (1.0 - back[rows]) * np.clip(owned * 2, 0, 1)
        return np.clip(lines, 0.0, 1.5), np.clip(swell, 0.0, 1.0)

    def _around(self, middle: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the places around one, and there 1 in its middle, which fades at a radius."""
        power = (np.linalg.norm(self.points - middle, axis=1) / radius) ** 4
        rows = np.flatnonzero(power < _LOST)
        return rows, np.exp(-power[rows])

    def palm_creases(self, rng: np.random.Generator) -> np.ndarray:
        """The three lines of the palm and finer ones: (N,), 0-1."""
        along, across = self.palm_coordinates()
        wobble = fractal_noise(self.points, 0.012, rng, octaves=2) * 0.012
        place = np.stack([along + wobble, across + wobble], axis=1)
        total = np.zeros(len(self.points))
        width = 0.011
        for line in _PALM_LINES:
            bends = np.array(line) + rng.normal(0.0, 0.02, (len(line), 2))
            total += _drawn(place, _rounded(bends), width)
        for _ in range(14):
            start = rng.uniform([0.1, 0.0], [0.95, 1.0])
            end = start + rng.normal(0.0, 0.16, 2)
            total += 0.35 * _drawn(place, np.array([start, end]), 0.6 * width)
        owned = self.weights[:, 0] + 0.6 * self.weights[:, [1, 4, 7, 10, 13]].sum(axis=1)
        return np.clip(total, 0.0, 1.3) * np.clip(1.6 * owned - 0.3, 0.0, 1.0)

    def tendons(self) -> np.ndarray:
        """Ridges from the wrist to the knuckles: (N,), 0-1."""
        wrist = self.joints[0] + np.array([0.0, 0.012, 0.0])
        total = np.zeros(len(self.points))
        for finger in FINGERS:
            knuckle = self.joints[FIRST_JOINT[finger] + (1 if finger == "thumb" else 0)]
            start = wrist + 0.3 * (knuckle - wrist) * np.array([0.6, 0.0, 1.0])
            distance, through = _to_segment(self.points[:, [0, 2]], start[[0, 2]], knuckle[[0, 2]])
            fade = np.clip(4.0 * through, 0.0, 1.0) * np.clip(6.0 * (1.05 - through), 0.0, 1.0)
            total += np.exp(-((distance / 0.0023) ** 2)) * fade
        return np.clip(total, 0.0, 1.0)

    def veins(self, rng: np.random.Generator) -> np.ndarray:
        """A few winding veins on the back of the hand: (N,), 0-1."""
        along, across = self.palm_coordinates()
        wobble = fractal_noise(self.points, 0.02, rng, octaves=2) * 0.035
        place = np.stack([along + wobble, across - wobble], axis=1)
        total = np.zeros(len(self.points))
        for lane in (0.12, 0.38, 0.62, 0.88):
            bends = np.array(
                [[x, 0.5 + (lane - 0.5) * (0.55 + 0.6 * x)] for x in (-0.1, 0.2, 0.45, 0.7, 0.95)]
            )
            bends[:, 1] += rng.normal(0.0, 0.06, len(bends))
            line = _drawn(place, _rounded(bends), 0.022)
            total = np.maximum(total, rng.uniform(0.5, 1.0) * line)
        owned = np.clip(2.0 * self.weights[:, 0] - 0.2, 0.0, 1.0)
        return total * owned

    def flushed(self) -> np.ndarray:
        """Where blood shows: finger tips and the heel of the palm: (N,), 0-1."""
        total = np.zeros(len(self.points))
        for row in range(len(FINGERS)):
            distance = np.linalg.norm(self.points - self.tips[row], axis=1)
            total += np.exp(-((distance / 0.016) ** 2))
        along, across = self.palm_coordinates()
        heel = np.exp(-(((along - 0.3) / 0.25) ** 2)) * (1.0 - self.back)
        return np.clip(total + 0.5 * heel * np.abs(2.0 * across - 1.0), 0.0, 1.0)

    def nails(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nail plate, its white half-moon, its free edge, and the groove around it: (N,) each."""
        plate, moon, edge, groove = (np.zeros(len(self.points)) for _ in range(4))
        for finger in FINGERS:
            s, w, top, owned = self.nail_coordinates(finger)
            radius = (np.abs(s) ** 3 + np.abs(w) ** 3) ** (1 / 3)
            inside = _step((1.0 - radius) / 0.08 + 0.5) * top * owned
            plate = np.maximum(plate, inside)
            moon = np.maximum(moon, inside * _step((-0.62 - s - 0.35 * w * w) / 0.15 + 0.5))
            edge = np.maximum(edge, inside * _step((s - 0.74 + 0.2 * w * w) / 0.1 + 0.5))
            rim = np.exp(-(((radius - 1.04) / 0.07) ** 2)) * top * owned
            groove = np.maximum(groove, rim * _step((0.6 - s) / 0.3 + 0.5))
        return plate, moon, edge, groove

    def nail_coordinates(
        self, finger: str
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where places lie on a finger's nail: (N,) each.

        Args:
            finger: its name.

        Returns:
            Along the plate from -1 to 1 at its free edge, across it from -1 to 1, 1 on top of the
            finger, and 1 on its last segment.
        """
        joint = self.joints[FIRST_JOINT[finger] + 2]
        tip = self._tip(finger)
        along = unit(tip - joint)
        length = np.linalg.norm(tip - joint)
        axis = finger_back(finger)
        axis = unit(axis - (axis @ along) * along)
        across = np.cross(along, axis)
        offset = (self.points - joint) / length
        s = (offset @ along - 0.70) / 0.27
        w = (offset @ across) / (0.27 if finger == "thumb" else 0.235)
        top = np.clip((self.normals @ axis - 0.15) * 6.0, 0.0, 1.0)
        owned = np.clip(3.0 * self.weights[:, FIRST_JOINT[finger] + 2] - 0.5, 0.0, 1.0)
        return s, w, top, owned

    def _tip(self, finger: str) -> np.ndarray:
        return self.tips[FINGERS.index(finger)]

    def palm_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Along (0 at the wrist, 1 at the middle knuckle) and across (0 at the little finger's
        knuckle, 1 at the index finger's): (N,) each.
        """
        wrist, index, middle, little = (self.joints[i] for i in (0, 1, 4, 7))
        forward = middle - wrist
        sideways = index - little
        offset = (self.points - wrist)[:, [0, 2]]
        basis = np.stack([forward[[0, 2]], sideways[[0, 2]]], axis=1)
        along, across = np.linalg.solve(basis, offset.T)
        start = np.linalg.solve(basis, (0.5 * (index + little) - wrist)[[0, 2]])
        return along, across - start[1] + 0.5


def _step(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _rounded(bends: np.ndarray, samples: int = 24) -> np.ndarray:
    """Points along a smooth curve through the bends."""
    from scipy.interpolate import PchipInterpolator

    knots = np.arange(len(bends))
    return PchipInterpolator(knots, bends, axis=0)(np.linspace(0, len(bends) - 1, samples))


def _drawn(places: np.ndarray, line: np.ndarray, width: float) -> np.ndarray:
    """A line with soft borders: 1 on it, exp(-1) at `width` from it: (N,).

    Args:
        places: (N, 2).
        line: (K, 2) points joined by segments.
        width: in the unit of both.
    """
    reach = width * np.sqrt(_LOST)
    low, high = line.min(axis=0) - reach, line.max(axis=0) + reach
    found = np.zeros(len(places))
    rows = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
    for first in range(0, len(rows), _BLOCK):
        block = rows[first : first + _BLOCK]
        x, y = places[block].T.copy()
        nearest = np.full(len(block), np.inf)
        for (x0, y0), (x1, y1) in pairwise(line):
            dx, dy = x1 - x0, y1 - y0
            along = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-18)
            along = np.clip(along, 0.0, 1.0)
            off_x, off_y = x - (x0 + along * dx), y - (y0 + along * dy)
            nearest = np.minimum(nearest, off_x * off_x + off_y * off_y)
        found[block] = np.exp(-nearest / width**2)
    return found


def _to_segment(
    places: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of (N, D) places to a segment, and how far along it: (N,) each."""
    direction = end - start
    through = (places - start) @ direction / max(float(direction @ direction), 1e-18)
    nearest = start + np.clip(through, 0.0, 1.0)[:, None] * direction
    return np.linalg.norm(places - nearest, axis=1), through
