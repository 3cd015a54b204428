"""Settings of the shadows that hands cast."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number


@dataclass(frozen=True)
class ShadowSettings:
    """How the light that casts shadows is found, and how hands are drawn in it."""

    #: Find a light before the first step, and darken Gaussians that the hands keep it from.
    enabled: bool = True
    #: Frames that are read at most, spread over the clip.
    frames: int = number(96, 1, 1000)
    #: Places on each hand that are read.
    places: int = number(400, 10, 100_000)
    #: Lamps at most.
    lamps: int = number(4, 0, 32)
    #: Directions, evenly spread over the sphere, among which a lamp is sought.
    directions: int = number(162, 12, 4096)
    #: Share of the misfit that a further lamp must take away.
    least_gain: float = number(0.006, 0.0, 1.0)
    #: Half the angle over which a lamp is spread, degrees.
    softness: float = number(12.0, 0.0, 60.0)
    #: The light also says how bright a normal is with nothing in the way; the network says what is
    #: left. Else the network alone does.
    shading: bool = True
    #: Share of the light that is left in the darkest shadow.
    darkest: float = number(0.15, 0.0, 1.0)
