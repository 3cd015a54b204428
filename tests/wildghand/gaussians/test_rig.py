"""Oracle: `pose_hand` and the surface anchors themselves in float64; 1e-6 m, 1e-5."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from hwp_bench.hands import HandTemplate, load_template
from wildghand.gaussians.rig import CHUNK, make_rig


@pytest.fixture(scope="module")
def template() -> HandTemplate:
    return load_template()


def parameters(frames: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return (
        0.3 * torch.randn(frames, 16, 3, generator=random),
        torch.randn(10, generator=random),
        torch.randn(frames, 3, generator=random),
    )


def test_long_clips_are_posed_in_parts(template: HandTemplate) -> None:
    rig = make_rig(template, 20)
    pose, betas, transl = parameters(CHUNK + 2)
    together = rig.pose(pose, betas, transl)
    alone = rig.pose(pose[-1:], betas, transl[-1:])
    assert together.positions.shape == (CHUNK + 2, 20, 3)
    np.testing.assert_allclose(together.positions[-1], alone.positions[0], atol=1e-6)


def test_a_long_clip_takes_the_memory_of_its_result_and_one_part(template: HandTemplate) -> None:
    """What numpy allocates beyond the result, which is torch's, does not grow with the clip."""
    rig, peaks = make_rig(template, 3000), []
    for frames in (CHUNK, 2 * CHUNK, 8 * CHUNK):
        clip = parameters(frames)
        tracemalloc.start()
        rig.pose(*clip)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.1 * peaks[1]


def test_spacing_is_that_of_a_square_grid_of_equal_area(template: HandTemplate) -> None:
    corners = template.vertices[template.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1).sum()
    rig = make_rig(template, 400)
    assert rig.spacing**2 * len(rig) == pytest.approx(area, rel=1e-5)
