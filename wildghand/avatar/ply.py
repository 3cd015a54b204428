"""Writing Gaussians in the PLY layout of 3DGS, which viewers read."""

from __future__ import annotations

import os

import numpy as np

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.base.files import atomic_write

#: Value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
SH_CONSTANT = 0.28209479177387814
# Viewers take logits and logarithms: an opacity of 1 or a scale of 0 would be infinite.
_OPACITIES = (1e-6, 1.0 - 1e-6)
_SMALLEST_SCALE = 1e-12
_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(
    path: str | os.PathLike[str],
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
) -> None:
    """Write N Gaussians as binary little-endian PLY.

    Args:
        path: the file, replaced if it is there.
        means: (N, 3) m.
        quats: (N, 4) of length 1, (w, x, y, z).
        scales: (N, 3) m, not negative.
        opacities: (N,) in [0, 1].
        colors: (N, 3) sRGB in [0, 1]; of any direction (harmonics of degree 0 only).

    Raises:
        ShapeMismatch: the arrays do not describe the same Gaussians.
        UsageError: a value that is not finite.

    Source: the layout of the 3DGS authors' point clouds: logit opacities, logarithms of the
    scales, colour = 0.5 + constant harmonic * f_dc.
    """
    count = len(means)
    arrays = {"means": means, "quats": quats, "scales": scales, "colors": colors}
    arrays["opacities"] = opacities
    shapes = {"means": 3, "quats": 4, "scales": 3, "colors": 3}
    for name, array in arrays.items():
        expected = (count, shapes[name]) if name in shapes else (count,)
        if np.shape(array) != expected:
            raise ShapeMismatch(f"has shape {np.shape(array)}, not {expected}", field=name)
        if not np.isfinite(array).all():
            raise UsageError("holds a value that is not finite", field=name)
    visible = np.clip(opacities, *_OPACITIES)
    table = np.concatenate(
        (
            means,
            np.zeros((count, 3)),
            (np.asarray(colors) - 0.5) / SH_CONSTANT,
            np.log(visible / (1.0 - visible))[:, None],
            np.log(np.maximum(scales, _SMALLEST_SCALE)),
            quats,
        ),
        axis=1,
    ).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in _FIELDS] + ["end_header", ""]
    atomic_write(path, "\n".join(header).encode() + table.tobytes())
