"""Files of Gaussians, read by a reader of the tests' own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wildghand.avatar.avatar import PosedGaussians
from wildghand.export.splats import SH_CONSTANT


def read_ply(path: Path) -> PosedGaussians:
    """A PLY in the layout of 3DGS: the properties by the names in the header."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    column = dict(zip(names, table.T, strict=True))

    def stacked(*keys: str) -> np.ndarray:
        return np.stack([column[key] for key in keys], axis=1)

    return PosedGaussians(
        means=stacked("x", "y", "z"),
        quats=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=np.exp(stacked("scale_0", "scale_1", "scale_2")),
        opacities=1.0 / (1.0 + np.exp(-column["opacity"])),
        colors=0.5 + SH_CONSTANT * stacked("f_dc_0", "f_dc_1", "f_dc_2"),
    )
