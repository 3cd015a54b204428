"""Rows of the linear problem. Oracle: finite differences of posed and projected points."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest

from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, load_template
from hwp_bench.hands.raster import draw_silhouette
from wildghand.subject.outlines import ComparedFrames, PosedFrames
from wildghand.subject.unknowns import Unknowns, outline_rows

SIZE, FRAMES = 96, 2
# Of every unknown; the change of a pixel is linear in it up to its square.
STEP = 1e-5


def frames_of(sides: tuple[str, ...]) -> ComparedFrames:
    """Two hands next to each other, bent, seen from a turned camera."""
    random = np.random.default_rng(3)
    hands = {}
    for side in sides:
        pose = random.normal(0.0, 0.25, (FRAMES, 16, 3))
        pose[:, 0] = [np.pi / 2, 0.1, 0.2]
        transl = np.tile([0.1 if side == "right" else -0.1, 0.01, 0.5], (FRAMES, 1))
        betas = random.normal(0.0, 0.3, 10)
        hands[side] = HandParameters(pose, betas, transl, np.ones(FRAMES, dtype=bool))
    K = np.array([[1.2 * SIZE, 0, SIZE / 2], [0, 1.3 * SIZE, SIZE / 2], [0, 0, 1.0]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[0.98, 0.0, 0.198997], [0.0, 1.0, 0.0], [-0.198997, 0.0, 0.98]]
    cameras = Cameras(np.repeat(K[None], FRAMES, 0), np.repeat(viewmat[None], FRAMES, 0))
    templates = {side: load_template("anny", side) for side in sides}
    blank = np.zeros((FRAMES, SIZE, SIZE), dtype=bool)
    frames = ComparedFrames(templates, hands, cameras, np.arange(FRAMES), blank)
    # Compared with their own outline, so that many points are.
    unknowns = unknowns_of(frames)
    posed = frames.posed(unknowns.shape(np.zeros(len(unknowns))))
    masks = [draw_silhouette(pixels, frames.faces, SIZE) > 127 for pixels in posed.pixels]
    return ComparedFrames(templates, hands, cameras, np.arange(FRAMES), np.stack(masks))


def unknowns_of(frames: ComparedFrames) -> Unknowns:
    template = next(iter(frames.templates.values()))
    with mock.patch("wildghand.subject.unknowns.NODES", 60):
        return Unknowns.of(template, len(frames.templates), len(frames))


def posed_at(frames: ComparedFrames, unknowns: Unknowns, values: np.ndarray) -> PosedFrames:
    return frames.posed(unknowns.shape(values), unknowns.moves(values))


def free(unknowns: Unknowns) -> np.ndarray:
    """1 for every unknown but the wrist's three, which stay."""
    result = np.ones(len(unknowns))
    result[unknowns.cuts[0] :][:3] = 0.0
    return result


@pytest.mark.parametrize("sides", [("right",), ("left",), ("right", "left")])
def test_rows_are_the_derivatives_of_the_points(sides: tuple[str, ...]) -> None:
    frames = frames_of(sides)
    unknowns = unknowns_of(frames)
    random = np.random.default_rng(1)
    values = 1e-3 * random.normal(size=len(unknowns)) * free(unknowns)
    posed = posed_at(frames, unknowns, values)
    frame = 1
    seen = frames.compare(posed, frame)
    assert len(seen.gap) > 60
    rows = outline_rows(unknowns, frames, posed, frame, seen)
    K, viewmat = frames.Ks[frame], frames.viewmats[frame]

    def outward(changed: np.ndarray) -> np.ndarray:
        """How far out the same points of the surface lie in the image, px."""
        corners = posed_at(frames, unknowns, changed).meshes[frame][frames.faces[seen.face]]
        place = np.einsum("mc,mck->mk", seen.mix, corners) @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = place[:, :2] / place[:, 2:] * [K[0, 0], K[1, 1]]
        found: np.ndarray = (pixels * seen.outward).sum(axis=1)
        return found

    for _ in range(12):
        # All unknowns at once, each about as far as it moves a point by as much.
        way = random.normal(size=len(unknowns)) * free(unknowns)
        difference = (outward(values + STEP * way) - outward(values - STEP * way)) / (2.0 * STEP)
        np.testing.assert_allclose(rows @ way, difference, rtol=1e-3, atol=1e-3 * abs(rows).max())


def test_the_wrist_stays_and_other_frames_have_no_part() -> None:
    frames = frames_of(("right",))
    unknowns = unknowns_of(frames)
    values = np.zeros(len(unknowns))
    posed = posed_at(frames, unknowns, values)
    seen = frames.compare(posed, 0)
    rows = outline_rows(unknowns, frames, posed, 0, seen)
    nodes, _, proportions = unknowns.cuts
    assert not rows[:, nodes : nodes + 3].any()
    assert rows[:, proportions : proportions + 3].any()
    assert not rows[:, proportions + 3 :].any()
