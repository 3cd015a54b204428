"""Settings of the light that an avatar is drawn in where no frame has shown any."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number


@dataclass(frozen=True)
class LightSettings:
    """How light is carried on beyond the normals of a clip."""

    #: Fit a light at the end of a fit, and draw unknown normals by it.
    enabled: bool = True
    #: Directions from which light may come, evenly spread over the sphere.
    directions: int = number(32, 6, 512)
    #: Ridge on their strengths, in the mean size of the normal matrix's diagonal.
    ridge: float = number(0.03, 0.0, 100.0)
    #: Share of the normals that frames show at the border of what they show; it counts as unknown.
    border: float = number(0.25, 0.0, 0.9)
    #: Samples from which the light is fitted, at most.
    samples: int = number(40_000, 100, 10_000_000)
