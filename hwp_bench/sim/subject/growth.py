"""Nails and bones of a subject as geometry: what stands out of the smooth surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.scene.subject_anatomy import SubjectAnatomy
from hwp_bench.sim.subject.anatomy import Anatomy

# Half length along a finger of the swelling at its joints, and its reach around them, m.
_SWELL, _REACH = 0.006, 0.017
# Where the free edge of a nail begins and ends, in the plate's own coordinate; see `Anatomy`.
_EDGE, _END = 0.62, 1.0


@dataclass(frozen=True, eq=False)
class Nails:
    """Vertices that nails push forward, each with a finger's last joint."""

    #: (N,) rows of the fine mesh.
    rows: np.ndarray
    #: (N,) joint that they move with.
    joints: np.ndarray
    #: (N, 3) m, in the rest frame.
    offsets: np.ndarray

    def pushed(self, vertices: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """The mesh with its nails.

        Args:
            vertices: (V, 3) m, posed.
            turns: (16, 3, 3) rotation of each joint from the rest frame.
        """
        grown = vertices.copy()
        grown[self.rows] += np.einsum("nij,nj->ni", turns[self.joints], self.offsets)
        return grown


def bone_relief(places: Anatomy, anatomy: SubjectAnatomy) -> np.ndarray:
    """Height of thick finger joints and of bones under the back's skin: (N,) m.

    Args:
        places: where, at rest.
        anatomy: how much.
    """
    height = np.zeros(len(places.points))
    if not (anatomy.knuckles or anatomy.bony):
        return height
    back = places.back
    around, heads = np.zeros(len(height)), np.zeros(len(height))
    for row, finger in enumerate(FINGERS):
        first = FIRST_JOINT[finger]
        chain = np.vstack([places.joints[[0, first, first + 1, first + 2]], places.tips[row]])
        owned = places.weights[:, first : first + 3].sum(axis=1)
        for step in range(3):
            joint = chain[step + 1]
            along = unit(unit(chain[step + 2] - joint) + unit(joint - chain[step]))
            offset = places.points - joint
            near = np.exp(-((np.linalg.norm(offset, axis=1) / _REACH) ** 4))
            ring = np.exp(-((offset @ along / _SWELL) ** 2)) * near
            if step == 0:
                heads = np.maximum(heads, ring * back)
            else:
                around = np.maximum(around, ring * np.clip(2.0 * owned - 0.6, 0.0, 1.0))
    height += 0.001 * anatomy.knuckles * around * (0.65 + 0.35 * back)
    relief = np.maximum(heads, 0.6 * places.tendons() * back)
    return height + 0.001 * anatomy.bony * relief


def grown_nails(places: Anatomy, anatomy: SubjectAnatomy, mirror: np.ndarray) -> Nails | None:
    """Nails that stand out before the finger tips, or None.

    The free edge of the painted nail is drawn out forwards; the skin below it stays, so that the
    nail is a blade.

    Args:
        places: the fine mesh at rest.
        anatomy: length and shape.
        mirror: (3,) signs that turn the anatomy's right hand into the hand's own side.
    """
    if not anatomy.nail_length:
        return None
    rows, joints, offsets = [], [], []
    for row, finger in enumerate(FINGERS):
        s, w, top, owned = places.nail_coordinates(finger)
        edge = np.clip((s - _EDGE) / (_END - _EDGE), 0.0, 1.0)
        side = np.clip((1.0 - np.abs(w)) / 0.25, 0.0, 1.0) * (1.0 - anatomy.nail_taper * w * w)
        reach = edge * side * np.clip(2.0 * top * owned, 0.0, 1.0)
        found = np.flatnonzero((reach > 1e-3) & (s < 1.6))
        joint = FIRST_JOINT[finger] + 2
        forward = unit(places.tips[row] - places.joints[joint]) * mirror
        rows.append(found)
        joints.append(np.full(len(found), joint))
        offsets.append(0.001 * anatomy.nail_length * reach[found, None] * forward)
    return Nails(*(np.concatenate(part) for part in (rows, joints, offsets)))
