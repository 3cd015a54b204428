"""Two hands touch and cross without running through each other.

Oracle: the signed distance to the nearest vertex of the other hand along its normal; hands are
about 25 mm thick, soft, and may press 12 mm into each other.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hwp_bench.sim.effects import hands_at
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.scene import scene_hands
from hwp_bench.sim.scene_files import load_scene, scene_names
from hwp_bench.sim.subject.hand import MOVING

INTERACTING = [name for name in scene_names() if load_scene(name).hands == "both"]
#: Deepest that one hand may press into the other, m.
TOUCH_DEEPEST = 0.012


def _distances(name: str, moment: float) -> tuple[float, float]:
    """How deep the left hand is inside the right one, and how near it is, m."""
    scene = load_scene(name)
    hands = scene_hands(scene, MOVING)
    parameters = Stage(scene, RenderCost()).parameters(hands_at(scene, moment * scene.duration))
    right, normals = hands["right"].pose(*parameters["right"])
    left, _ = hands["left"].pose(*parameters["left"])
    # Farther away than 30 mm the nearest normal tells nothing; there the distance is infinite.
    distance, nearest = cKDTree(right).query(left, distance_upper_bound=0.03)
    near = np.flatnonzero(np.isfinite(distance))
    away = left[near] - right[nearest[near]]
    inside = near[np.einsum("ni,ni->n", away, normals[nearest[near]]) < 0]
    return float(distance[inside].max(initial=0.0)), float(distance.min())


@pytest.mark.slow
@pytest.mark.parametrize("name", INTERACTING)
def test_hands_do_not_run_through_each_other(name: str) -> None:
    rows = [_distances(name, frame / 60) for frame in range(0, 60, 2)]
    depth, gap = np.array(rows).T
    assert depth.max() < TOUCH_DEEPEST
    assert gap.min() < 0.004  # and they touch at times
