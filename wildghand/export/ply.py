"""Gaussians in the PLY layout of 3DGS, which viewers read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wildghand.avatar.avatar import PosedGaussians

#: Value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
SH_CONSTANT = 0.28209479177387814
#: Viewers take logits and logarithms: an opacity of 1 or a scale of 0 would be infinite.
OPACITIES = (1e-6, 1.0 - 1e-6)
#: Smallest standard deviation, m.
SMALLEST_SCALE = 1e-12
_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)


def ply_bytes(splats: PosedGaussians, comments: Sequence[str] = ()) -> bytes:
    """Return N Gaussians as binary little-endian PLY.

    Args:
        splats: colours are those of any direction (harmonics of degree 0 only).
        comments: lines for the header, such as the unit; ASCII.

    Source: the layout of the 3DGS authors' point clouds: logit opacities, logarithms of the
    scales, colour = 0.5 + constant harmonic * f_dc.
    """
    count = len(splats)
    visible = np.clip(splats.opacities, *OPACITIES)
    table = np.concatenate(
        (
            splats.means,
            np.zeros((count, 3)),
            (splats.colors - 0.5) / SH_CONSTANT,
            np.log(visible / (1.0 - visible))[:, None],
            np.log(np.maximum(splats.scales, SMALLEST_SCALE)),
            splats.quats,
        ),
        axis=1,
    ).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in _FIELDS] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()
