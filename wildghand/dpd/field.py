"""A field of biases of low rank over the hand: by place on the skin, and by the posed normal."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.gaussians.attributes import CHANNELS
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.shading import sh_basis, sh_count

#: Joints whose skinning weights say where on the hand a Gaussian is.
_JOINTS = 16
#: Degree of the harmonics of the normal; light of degree 2 is enough for a matte surface.
_DEGREE = 2
#: Numbers of one place: the skinning weights, which add up to a constant, and the harmonics
#: without theirs.
PLACE_CHANNELS = _JOINTS + sh_count(_DEGREE) - 1


class BiasField(nn.Module):
    """F_l(x) = sum_k a_k(z_l) B_k x for every frame of a clip: 14 numbers at each Gaussian.

    x is the place: which bones move the Gaussian, and where its normal points in this frame. A
    light from the side is a field of colours over normals, a wrong finger one of offsets over
    bones. B starts at zero, hence F.

    Args:
        rank: K, at least 1.
        width: of the temporal embedding z.

    Raises:
        UsageError: `rank` is below 1.

    Source: ours; the paper's bias has the same shift for all Gaussians of a frame.
    """

    def __init__(self, rank: int, width: int) -> None:
        super().__init__()
        if rank < 1:
            raise UsageError(f"is {rank}", field="rank", remedy="Use 1 or more.")
        self.codes = nn.Linear(width, rank)
        self.maps = nn.Parameter(torch.zeros(rank, PLACE_CHANNELS, CHANNELS))

    def forward(self, z: Tensor, bones: Tensor, normals: Tensor) -> Tensor:
        """Evaluate the field.

        Args:
            z: (B, width) temporal embedding.
            bones: (N, 16) as from `bone_features`.
            normals: (B, N, 3) of length 1: the posed surface's, without gradient.

        Returns:
            (B, N, 14), in the order of the attributes.

        Raises:
            ShapeMismatch: the arguments do not describe the same Gaussians and frames.
        """
        if normals.shape != (len(z), len(bones), 3) or bones.shape[1] != _JOINTS:
            raise ShapeMismatch(
                f"are {tuple(z.shape)}, {tuple(bones.shape)} and {tuple(normals.shape)}",
                field="z, bones, normals",
            )
        # The sum over k first: one small matrix for each frame.
        maps = torch.einsum("bk,kpc->bpc", self.codes(z), self.maps)
        by_bone, by_normal = maps.split([_JOINTS, PLACE_CHANNELS - _JOINTS], dim=1)
        harmonics = sh_basis(normals, _DEGREE)[..., 1:]
        return torch.baddbmm(bones @ by_bone, harmonics, by_normal)


def bone_features(rig: HandRig) -> Tensor:
    """How far each bone moves each anchor, scaled so that a single bone counts 4.

    With 4, the square root of 16, their mean square is at most that of the harmonics, 1.

    Args:
        rig: N anchors.

    Returns:
        (N, 16) float32, rows sum to 4.
    """
    corners = rig.template.weights[rig.template.faces[rig.anchors.face_index]]
    barycentric = torch.as_tensor(rig.anchors.barycentric).to(corners)
    return math.sqrt(_JOINTS) * torch.einsum("ncj,nc->nj", corners, barycentric)
