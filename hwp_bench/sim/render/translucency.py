"""Light of a lamp behind a hand that passes through thin parts of it, red more than blue."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.geometry.raycast import LIFT, Tracer
from hwp_bench.sim.render.samples import Samples
from hwp_bench.sim.scene.area_lights import AreaLight

#: Way in which light inside skin falls by e, m, linear red, green and blue. Source: effective
#: transport 1 / sqrt(3 a (a + s)) of "skin1" in Jensen et al., "A practical model for subsurface
#: light transport", 2001, with absorption a and reduced scattering s.
SKIN_REACH = (0.00368, 0.00136, 0.00068)
#: Way beyond which nothing is left that a camera sees, m.
THICKEST = 0.02


def light_through(samples: Samples, lamp: AreaLight, tracers: list[Tracer]) -> np.ndarray:
    """Radiance towards the camera of light that came through the hand: (H, 3) linear.

    A ray from each point that faces away goes through the hand to the middle of the lamp.

    Args:
        samples: the points.
        lamp: where the light is from.
        tracers: hands first, then whatever else may be in the way.
    """
    found = np.zeros((len(samples.ray), 3))
    ways = lamp.centre - samples.points
    squared = np.einsum("hk,hk->h", ways, ways)
    directions = ways / np.sqrt(squared)[:, None]
    away = np.einsum("hk,hk->h", samples.flat, directions) < 0.0
    mine = np.flatnonzero(away & samples.hand)
    inside = samples.points[mine] - 2.0 * LIFT * samples.flat[mine]
    hits = tracers[0].first_hits(inside, directions[mine], "through")
    thin = hits.distance < THICKEST
    rows, thickness = mine[hits.ray[thin]], hits.distance[thin]
    exits = inside[hits.ray[thin]] + (thickness + LIFT)[:, None] * directions[rows]
    for tracer in tracers:
        free = ~tracer.blocked(exits, directions[rows], "through")
        rows, thickness, exits = rows[free], thickness[free], exits[free]
    leaving = np.clip(-(directions[rows] @ lamp.facing), 0.0, 1.0)
    arrives = leaving * lamp.distance**2 / squared[rows]
    left = np.exp(-thickness[:, None] / np.array(SKIN_REACH))
    found[rows] = samples.albedo[rows] * left * arrives[:, None] * lamp.irradiance
    return lamp.through * found
