"""The Gaussians that the authors' code draws in one pose.

Their checkpoints (`.ckpt`) hold the weights of a network and no Gaussians: it makes Gaussians again
for every pose, as a named tuple (`out["3dgs_input"][0]` in their test step). What is read here is
that tuple, saved with `torch.save(out["3dgs_input"][0]._asdict(), "frame649.pth")`.
"""

from __future__ import annotations

import os

import numpy as np
import torch

from hwp_bench.base.arrays import read_tensors, take
from hwp_bench.base.errors import BadInput
from wildghand.avatar.avatar import PosedGaussians

#: Largest file, and most Gaussians: two of their hands have 98,562, in 6 MB.
MAX_BYTES, MAX_GAUSSIANS = 256 << 20, 2_000_000
#: Largest distance from the camera and largest standard deviation, m.
FAR, WIDE = 1e4, 1e2
#: Shapes of one Gaussian in the file: m; standard deviations, m; (w, x, y, z); in [0, 1]; sRGB.
SHAPES = {"xyz": (3,), "scaling": (3,), "rotation": (4,), "opacity": (1,), "shs": (1, 3)}
_LIMITS = {"xyz": FAR, "scaling": WIDE, "rotation": 1e6, "opacity": 1.0, "shs": 1.0}
_REMEDY = (
    'Save the Gaussians of a frame with torch.save(out["3dgs_input"][0]._asdict(), FILE) in their '
    "test step; docs/export.md shows where."
)


def read_official_gaussians(path: str | os.PathLike[str]) -> PosedGaussians:
    """Read Gaussians that the authors' code has made for one pose; nothing in the file is run.

    They lie in the axes of the camera: x to the right, y down, z forward, as in an imported
    capture's world. Colours are sRGB: their configurations set `use_rgb`, so that `shs` holds no
    spherical harmonics.

    Raises:
        BadInput: the file is too large, damaged, or not of that form, such as a checkpoint of
            their network.
    """
    try:
        tensors = read_tensors(path, MAX_BYTES)
    except BadInput as error:
        raise BadInput(error.problem, where=path, remedy=_REMEDY) from error
    missing = [name for name in SHAPES if name not in tensors]
    if missing:
        raise BadInput(
            f"holds no Gaussians: {', '.join(missing)} are missing"
            if len(missing) > 1
            else f"holds no {missing[0]}",
            where=path,
            remedy=_REMEDY,
        )
    count = len(tensors["xyz"]) if tensors["xyz"].ndim else 0
    if not 1 <= count <= MAX_GAUSSIANS:
        problem = f"has {count} rows, where 1 to {MAX_GAUSSIANS} Gaussians are expected"
        raise BadInput(problem, where=path, field="xyz")
    arrays = {
        name: _checked(tensors[name], name, (count, *shape), path) for name, shape in SHAPES.items()
    }
    lengths = np.linalg.norm(arrays["rotation"], axis=1, keepdims=True)
    for name, bad, problem in (
        ("rotation", lengths[:, 0] < 1e-6, "has length 0"),
        ("scaling", (arrays["scaling"] <= 0.0).any(axis=1), "is not above 0"),
        ("opacity", arrays["opacity"][:, 0] < 0.0, "is below 0"),
        ("shs", (arrays["shs"] < 0.0).any(axis=(1, 2)), "is below 0"),
    ):
        if bad.any():
            raise BadInput(f"{problem} in row {int(bad.argmax())}", where=path, field=name)
    made = {
        "means": arrays["xyz"],
        "quats": arrays["rotation"] / lengths,
        "scales": arrays["scaling"],
        "opacities": arrays["opacity"][:, 0],
        "colors": arrays["shs"][:, 0],
    }
    splats = PosedGaussians(**{name: value.astype(np.float32) for name, value in made.items()})
    splats.require_finite()
    return splats


def _checked(
    tensor: torch.Tensor, name: str, shape: tuple[int, ...], path: str | os.PathLike[str]
) -> np.ndarray:
    """A tensor as float64 of a shape; nothing large is made before the shape is known."""
    if tensor.shape != shape:
        problem = f"has shape {tuple(tensor.shape)} where {shape} is expected"
        remedy = (
            "Colours as spherical harmonics are not read: set use_rgb." if name == "shs" else ""
        )
        raise BadInput(problem, where=path, field=name, remedy=remedy or None)
    if tensor.layout != torch.strided or not tensor.dtype.is_floating_point:
        raise BadInput(f"holds {tensor.dtype}, not floats", where=path, field=name)
    array = {name: tensor.detach().double().numpy()}
    return take(array, name, shape, where=path, most=_LIMITS[name])
