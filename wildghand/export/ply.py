"""Gaussians in the PLY layout of 3DGS, which viewers read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wildghand.avatar.avatar import PosedGaussians
from wildghand.export.all_round import SH_CONSTANT

#: Viewers take logits and logarithms: an opacity of 1 or a scale of 0 would be infinite.
OPACITIES = (1e-6, 1.0 - 1e-6)
#: Smallest standard deviation, m.
SMALLEST_SCALE = 1e-12


def ply_bytes(
    splats: PosedGaussians, comments: Sequence[str] = (), harmonics: np.ndarray | None = None
) -> bytes:
    """Return N Gaussians as binary little-endian PLY.

    Args:
        splats: the Gaussians.
        comments: lines for the header, such as the unit; ASCII.
        harmonics: (N, K, 3) of their colours (`wildghand.export.all_round`); None: the colours of
            the Gaussians in every direction.

    Source: the layout of the 3DGS authors' point clouds: logit opacities, logarithms of the
    scales, colour = 0.5 + constant harmonic * f_dc + the others * f_rest, channel by channel.
    """
    count = len(splats)
    visible = np.clip(splats.opacities, *OPACITIES)
    if harmonics is None:
        harmonics = ((splats.colors - 0.5) / SH_CONSTANT)[:, None]
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics.shape[1] - 1))
    table = np.concatenate(
        (
            splats.means,
            np.zeros((count, 3)),
            harmonics[:, 0],
            rest,
            np.log(visible / (1.0 - visible))[:, None],
            np.log(np.maximum(splats.scales, SMALLEST_SCALE)),
            splats.quats,
        ),
        axis=1,
    ).astype("<f4")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{number}" for number in range(rest.shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()
