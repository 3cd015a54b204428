"""From what the network predicts to Gaussians in the world: bias, activation, motion."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from wildghand.dpd.dpd import Perturbation
from wildghand.dpd.temporal import scale_gradients
from wildghand.gaussians.attributes import Activation
from wildghand.gaussians.quaternions import quat_multiply, quat_rotate
from wildghand.gaussians.rig import AnchorPoses
from wildghand.model.terms import bias_size
from wildghand.network import NetworkOutput
from wildghand.splat.threads import kernels_take


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians in B frames, as `wildghand.splat.rasterize` takes them."""

    #: (B, N, 3) m, world.
    means: Tensor
    #: (B, N, 4) of length 1, world.
    quats: Tensor
    #: (N, 3) or (B, N, 3) m.
    scales: Tensor
    #: (N,) or (B, N) in (0, 1).
    opacities: Tensor
    #: (B, N, 3) sRGB.
    colors: Tensor


def dress(
    anchors: AnchorPoses,
    prediction: NetworkOutput,
    activation: Activation,
    perturbation: Perturbation | None = None,
    shares: Tensor | None = None,
) -> tuple[Gaussians, Tensor | None]:
    """Bring the Gaussians of one hand into the world.

    p' = p_g + v': the predicted offset from the vertex that heads iii and iv moved.

    Args:
        anchors: N anchors in B frames; orientations have no gradient.
        prediction: of the network in B frames.
        activation: of the raw attributes.
        perturbation: of the frames; None: they have no biases.
        shares: (B,) how much `prediction` learns from each frame; None: all.

    Returns:
        The Gaussians, and `wildghand.model.terms.bias_size` of their biases (None without).
    """
    if kernels_take(anchors.positions, prediction.raw.offsets, prediction.shadow):
        from wildghand.model.dress_cpu import dress_cpu

        made, size = dress_cpu(anchors, prediction, activation, perturbation, shares)
        return Gaussians(*made), size
    if shares is not None:
        prediction = scale_gradients(prediction, shares)
    raw, size = prediction.raw, None
    if perturbation is not None:
        biases = perturbation.biases(raw)
        raw, size = raw + biases, bias_size(biases)
    attributes = activation(raw)
    offsets = attributes.offsets + prediction.template_offsets
    gaussians = Gaussians(
        means=anchors.positions + quat_rotate(anchors.orientations, offsets),
        quats=quat_multiply(anchors.orientations, attributes.quats),
        scales=attributes.scales,
        opacities=attributes.opacities,
        colors=attributes.colors * prediction.shadow,
    )
    return gaussians, size
