"""Settings of the fit with occluders."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import choice, number
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class OccluderSettings(FitSettings):
    """The plain fit's settings, and those of the occluders."""

    #: Gaussians before the camera in each frame.
    occluders: int = number(150, 1, 10_000)
    #: `mask`: the frame inside the visible-hand mask, as in the plain fit. `box`: the whole frame
    #: in the mask's bounding box, as DeSplat has it, with weight 1 everywhere in it.
    target: str = choice("mask", "box")
    #: Opacity of every occluder at the start.
    occluder_opacity: float = number(0.1, 0.01, 0.99)
    #: Weight of the occluders' mean coverage in the loss.
    occluder_weight: float = number(0.1, 0.0, 10.0)
    #: Weight of the mean share of the mask that the hand does not cover.
    hole_weight: float = number(0.01, 0.0, 10.0)
    #: Adam step of the occluders' places, px.
    occluder_place_rate: float = 0.05
    #: Adam step of the occluders' log scales and angles.
    occluder_shape_rate: float = 0.02
    #: Adam step of the occluders' logit opacities.
    occluder_opacity_rate: float = 0.2
    #: Adam step of the occluders' logit colours.
    occluder_color_rate: float = 0.03
