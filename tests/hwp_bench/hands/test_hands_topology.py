"""Edges and subdivision: the counts of MANO-HD, trimesh as oracle for midpoints (1e-12)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from hwp_bench.base.errors import UsageError
from hwp_bench.hands import HandTemplate, load_template, pose_hand, subdivide
from hwp_bench.hands.template import MAX_TIMES, boundary_vertices, mano_hd, open_loops


def boundary_count(faces: np.ndarray) -> int:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


@pytest.mark.parametrize(("times", "vertices"), [(0, 778), (1, 3093), (2, 12337)])
def test_counts_of_mano(mano_right: HandTemplate, times: int, vertices: int) -> None:
    fine = subdivide(mano_right, times)
    assert len(fine.vertices) == vertices
    assert len(fine.faces) == 1538 * 4**times
    assert boundary_count(fine.faces) == 16 * 2**times


def test_midpoints_agree_with_trimesh(free_right: HandTemplate) -> None:
    fine = subdivide(free_right)
    vertices, faces = trimesh.remesh.subdivide(free_right.vertices, free_right.faces)

    def sorted_centres(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        centres = points[triangles].mean(axis=1).round(12)
        return centres[np.lexsort(centres.T)]

    np.testing.assert_allclose(
        sorted_centres(fine.vertices, fine.faces), sorted_centres(vertices, faces), atol=1e-11
    )
    before = trimesh.Trimesh(free_right.vertices, free_right.faces, process=False)
    after = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    np.testing.assert_allclose(after.area, before.area, rtol=1e-12)
    np.testing.assert_allclose(after.volume, before.volume, rtol=1e-12)


def test_each_new_vertex_carries_the_mean_of_an_edge(tiny_template: HandTemplate) -> None:
    fine = subdivide(tiny_template)
    count = len(tiny_template.vertices)
    np.testing.assert_array_equal(fine.vertices[:count], tiny_template.vertices)
    ends = {
        tuple(np.round(0.5 * (tiny_template.vertices[a] + tiny_template.vertices[b]), 12)): (a, b)
        for face in tiny_template.faces
        for a, b in zip(face, np.roll(face, 1), strict=True)
    }
    for new in range(count, len(fine.vertices)):
        edge = list(ends[tuple(np.round(fine.vertices[new], 12))])
        for field in ("shape_basis", "pose_basis", "weights"):
            values = getattr(tiny_template, field)
            expected = 0.5 * (values[edge[0]] + values[edge[1]])
            np.testing.assert_allclose(getattr(fine, field)[new], expected, atol=1e-15)
    np.testing.assert_array_equal(fine.joints, tiny_template.joints)


def test_texture_follows_the_faces(free_right: HandTemplate) -> None:
    fine = subdivide(free_right)

    def uv_area(template: HandTemplate) -> np.ndarray:
        a, b, c = np.moveaxis(template.uv[template.face_uv], 1, 0)
        return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])

    # Each face becomes four in a row, each a quarter of it.
    np.testing.assert_allclose(
        uv_area(fine).reshape(-1, 4), np.repeat(uv_area(free_right)[:, None] / 4, 4, 1), atol=1e-15
    )
    assert fine.name == "anny-1+1"
    assert fine.digest != free_right.digest


def test_mano_hd_has_the_papers_counts_and_smooths_what_it_shapes(mano_folder: str) -> None:
    template = load_template(f"mano-hd:{mano_folder}")
    assert template.name == "mano-hd"
    assert template.vertices.shape == (49281, 3)
    assert template.faces.shape == (98432, 3)
    np.testing.assert_allclose(template.weights.sum(axis=1), 1.0, atol=1e-12)


def test_averaging_takes_each_vertex_and_its_neighbours(tiny_template: HandTemplate) -> None:
    fine = subdivide(tiny_template, 3)
    smooth = mano_hd(tiny_template)
    neighbours: list[set[int]] = [{i} for i in range(len(fine.vertices))]
    for face in fine.faces:
        for corner in face:
            neighbours[corner] |= set(face.tolist())
    for field in ("vertices", "shape_basis", "weights"):
        values = getattr(fine, field)
        expected = np.array([values[sorted(group)].mean(axis=0) for group in neighbours])
        np.testing.assert_allclose(getattr(smooth, field), expected, atol=1e-12)


def test_posing_and_splitting_commute_where_weights_agree(tiny_template: HandTemplate) -> None:
    """A rigid motion of the whole hand commutes with subdivision exactly."""
    pose = torch.zeros(1, 16, 3, dtype=torch.float64)
    pose[0, 0] = torch.tensor([0.3, -1.0, 2.0])
    betas = torch.linspace(-1, 1, 10, dtype=torch.float64)
    transl = torch.ones(1, 3, dtype=torch.float64)
    coarse = pose_hand(tiny_template.to_torch(torch.float64), pose, betas, transl)
    fine_template = subdivide(tiny_template)
    fine = pose_hand(fine_template.to_torch(torch.float64), pose, betas, transl)
    split, _ = trimesh.remesh.subdivide(coarse.vertices[0].numpy(), tiny_template.faces)
    ours = fine.vertices[0].numpy()
    np.testing.assert_allclose(
        np.sort(ours @ [1.0, 2.0, 3.0]), np.sort(split @ [1.0, 2.0, 3.0]), atol=1e-12
    )


@pytest.mark.parametrize("times", [-1, MAX_TIMES + 1])
def test_too_many_times_are_refused(tiny_template: HandTemplate, times: int) -> None:
    with pytest.raises(UsageError) as caught:
        subdivide(tiny_template, times)
    assert caught.value.field == "times"


def test_the_open_end_is_the_wrist() -> None:
    hand = load_template()
    ring = boundary_vertices(hand.faces)
    assert 8 <= len(ring) <= 40
    # All of it lies near the wrist joint, far from any finger.
    assert np.linalg.norm(hand.vertices[ring] - hand.joints[0], axis=1).max() < 0.06


def test_the_open_end_is_one_loop_along_edges_of_the_mesh() -> None:
    hand = load_template()
    (loop,) = open_loops(hand.faces)
    np.testing.assert_array_equal(np.sort(loop), boundary_vertices(hand.faces))
    # Oracle: trimesh's own edges, each with the number of its faces.
    edges = trimesh.Trimesh(hand.vertices, hand.faces, process=False).edges
    directed = {(int(a), int(b)) for a, b in edges}
    for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
        assert (a, b) in directed
        assert (b, a) not in directed


def test_every_open_end_is_a_loop_and_a_closed_mesh_has_none() -> None:
    tube = trimesh.creation.cylinder(1.0, 2.0, sections=12)
    assert open_loops(np.asarray(tube.faces)) == []
    # Without its two lids, whose faces are those that look up or down.
    walls = np.asarray(tube.faces)[np.abs(tube.face_normals[:, 2]) < 0.5]
    assert [len(loop) for loop in open_loops(walls)] == [12, 12]
    assert open_loops(np.zeros((0, 3), dtype=np.int64)) == []
