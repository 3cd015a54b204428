"""Texture coordinates for a template that brings none: the back and the palm, side by side."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.palm import palm_directions

# Space between a chart and the border of its half, in texture units.
_MARGIN = 0.01


def two_chart_uv(
    vertices: np.ndarray, faces: np.ndarray, joints: np.ndarray, side: str
) -> tuple[np.ndarray, np.ndarray]:
    """Flatten the back of a hand into the left half of the atlas, its palm into the right half.

    A face belongs to the side that it looks to; both charts are the same parallel projection
    onto the palm's plane, fingers up, at one scale, so that no face is turned over and lengths
    in the atlas compare. Faces seen edge-on become thin.

    Args:
        vertices: (V, 3) rest vertices, m.
        faces: (F, 3).
        joints: (16, 3) rest joints.
        side: "right" or "left".

    Returns:
        uv: (T, 2) in [0, 1], origin at the bottom left.
        face_uv: (F, 3) indices into `uv`.
    """
    palm = palm_directions(joints, side)
    # Seen from behind, the thumb of a right hand is on the left; from its palm, on the right.
    from_behind = -palm.thumbward if side == "right" else palm.thumbward
    height = vertices @ palm.forward
    width = vertices @ from_behind
    extent = max(np.ptp(height) / (1.0 - 2.0 * _MARGIN), np.ptp(width) / (0.5 - 2.0 * _MARGIN))
    v = _MARGIN + (height - height.min()) / extent
    u_back = _MARGIN + (width - width.min()) / extent
    u_palm = 0.5 + _MARGIN + (width.max() - width) / extent
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_palm = normals @ palm.palmar > 0.0
    count = len(vertices)
    both = np.concatenate([np.stack([u_back, v], axis=1), np.stack([u_palm, v], axis=1)])
    used, face_uv = np.unique(faces + count * is_palm[:, None], return_inverse=True)
    return both[used], face_uv.reshape(faces.shape).astype(np.int64)
