"""Settings of the fit with shadows."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number
from wildghand.gaussians.shading import MAX_DEGREE
from wildghand.plain.settings import FitSettings


@dataclass(frozen=True)
class ShadowSettings(FitSettings):
    """The plain fit's settings, and those of the light."""

    #: Degree of a light by spherical harmonics on top of the lamp: 0, none, as in HARP, to 3.
    shading_degree: int = number(0, 0, MAX_DEGREE)
    #: Whether the lamp casts shadows.
    shadows: bool = True
    #: Edge of the image of the hand that the lamp sees, px.
    shadow_size: int = number(256, 16, 2048)
    #: Share of the light that comes from everywhere at the start; sigmoid(0.4), as in HARP.
    ambient: float = number(0.6, 0.01, 0.99)
    #: Adam step of the lamp's place, m.
    lamp_rate: float = 0.03
    #: Adam step of the logit of the ambient share.
    ambient_rate: float = 0.03
    #: Weight of the roughness of the albedo over the surface.
    albedo_smoothness: float = number(0.0, 0.0, 1e4)
    #: Weight of the roughness of the offsets over the surface.
    offset_smoothness: float = number(0.0, 0.0, 1e4)
