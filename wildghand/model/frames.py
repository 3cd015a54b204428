"""Pictures of the model: hands in one picture, training frames as explained, unknown light."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses
from wildghand.light import KnownLight
from wildghand.model.dress import Gaussians
from wildghand.network import NetworkOutput
from wildghand.splat import rasterize
from wildghand.visibility.count import facing_of


@dataclass(frozen=True, eq=False)
class HandState:
    """State of one hand in B training frames; the regularisers read it."""

    #: Output of the network.
    prediction: NetworkOutput
    #: Mean over Gaussians and frames of the sum of |bias| over the channels, a scalar; None while
    #: perturbations are not modelled.
    bias_size: Tensor | None
    #: (B,) temporal weight of the paper's lambda_u: 0 in frames whose biases are left out; zeros
    #: while perturbations are not modelled.
    omega: Tensor
    #: (B, N) opacities that were drawn.
    opacities: Tensor


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """B training frames as the model explains them."""

    #: (B, H, W, 3) sRGB over black, with the frames' gains.
    image: Tensor
    #: (B, H, W, 1) coverage.
    coverage: Tensor
    #: By side.
    hands: Mapping[str, HandState]

    @property
    def omega(self) -> Tensor:
        """(B,) the temporal weight of largest magnitude among the hands."""
        return largest([hand.omega for hand in self.hands.values()])


def largest(omegas: Sequence[Tensor]) -> Tensor:
    """The temporal weights of largest magnitude among the hands, (B,).

    Args:
        omegas: (B,) of each hand, at least one.
    """
    if len(omegas) == 1:
        return omegas[0]
    weights = torch.stack([*omegas])
    chosen = weights.abs().argmax(dim=0, keepdim=True)
    return weights.gather(0, chosen)[0]


def rasterize_hands(
    parts: list[Gaussians], viewmats: Tensor, Ks: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Draw the Gaussians of hands together in B frames.

    Args:
        viewmats: (B, 4, 4).
        Ks: (B, 3, 3) px.
        width, height: px.

    Returns:
        (B, H, W, 3) sRGB over black and (B, H, W, 1) coverage.
    """

    def joined(name: str, shared: int) -> Tensor:
        tensors = [getattr(part, name) for part in parts]
        if len(tensors) == 1:
            return tensors[0]
        if any(tensor.dim() > shared for tensor in tensors):
            tensors = [
                tensor if tensor.dim() > shared else tensor.expand(len(viewmats), *tensor.shape)
                for tensor in tensors
            ]
        return torch.cat(tensors, dim=tensors[0].dim() - shared)

    image, coverage, _ = rasterize(
        joined("means", 2),
        joined("quats", 2),
        joined("scales", 2),
        joined("opacities", 1),
        joined("colors", 2),
        viewmats,
        Ks,
        width,
        height,
    )
    return image, coverage


def relit(
    prediction: NetworkOutput,
    light: KnownLight,
    network: Callable[[Tensor], NetworkOutput],
    anchors: AnchorPoses,
    viewmats: Tensor,
) -> NetworkOutput:
    """A prediction with colours at unknown normals carried on from known ones.

    Args:
        network: from (B, N, 3) normals to what the network predicts for them in these frames.
        viewmats: (B, 4, 4) of the cameras. Skin that does not face them stays as it is.
    """
    normals = quat_third_axis(anchors.orientations)
    share = light.unknown(normals, facing_of(anchors, viewmats))
    if not bool((share > 0.0).any()):
        return prediction
    known = light.nearest_known(normals)
    return carried_on(prediction, network(known), light.ratio(normals, known), share)


def carried_on(
    prediction: NetworkOutput, known: NetworkOutput, ratio: Tensor, share: Tensor
) -> NetworkOutput:
    """A prediction whose colours are, by a share, those at known normals under another light.

    Args:
        ratio: (B, N) factor from these to the own ones.
        share: (B, N) in [0, 1].
    """
    mix = share[..., None]
    colors = torch.lerp(
        prediction.raw.logit_colors.expand(*share.shape, 3),
        known.raw.logit_colors.expand(*share.shape, 3),
        mix,
    )
    dark = (prediction.shadow.clamp(min=1e-4), (known.shadow * ratio[..., None]).clamp(min=1e-4))
    shadow = torch.lerp(dark[0].log(), dark[1].log(), mix).exp()
    attributes = {**dict(prediction.raw.items()), "logit_colors": colors}
    return replace(prediction, raw=RawAttributes(**attributes), shadow=shadow)
