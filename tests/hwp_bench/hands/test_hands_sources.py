"""The MANO reader on synthetic files in the published format; the oracle is their content."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from synthetic_mano import as_published, mano_content, write_mano_folder

from hwp_bench.base.arrays import read_npz, write_npz
from hwp_bench.base.errors import BadHandModel, BadInput, HwpError, UnsafePickle, UsageError
from hwp_bench.hands import HandTemplate, load_template, to_trimesh
from hwp_bench.hands import sources as template_sources
from hwp_bench.hands.skeleton import FINGERS, PARENTS, finger_joints
from hwp_bench.hands.sources import load_mano


def test_right_hand_is_read_as_published(mano_right: HandTemplate) -> None:
    content = mano_content("right")
    assert mano_right.name == "mano"
    np.testing.assert_array_equal(mano_right.vertices, content["v_template"])
    np.testing.assert_array_equal(mano_right.faces, content["f"])
    np.testing.assert_array_equal(mano_right.shape_basis, content["shapedirs"][..., :10])
    np.testing.assert_array_equal(mano_right.pose_basis, content["posedirs"])
    np.testing.assert_allclose(mano_right.weights, content["weights"], atol=1e-15)
    np.testing.assert_array_equal(mano_right.mean_pose, content["hands_mean"])
    regressor = content["J_regressor"]
    np.testing.assert_allclose(mano_right.joints, regressor @ content["v_template"], atol=1e-15)
    shaped = content["v_template"] + content["shapedirs"][..., :10] @ np.arange(10.0)
    np.testing.assert_allclose(
        mano_right.joints + mano_right.joint_basis @ np.arange(10.0), regressor @ shaped, atol=1e-12
    )
    assert tuple(mano_right.parents) == PARENTS
    assert tuple(mano_right.fingertips) == (744, 320, 443, 554, 671)


def test_left_shape_basis_is_mended_in_x_only(mano_folder: str) -> None:
    left = load_template(f"mano:{mano_folder}", side="left")
    published = mano_content("left")["shapedirs"][..., :10]
    np.testing.assert_array_equal(left.shape_basis, published * np.array([[-1.0], [1.0], [1.0]]))
    assert left.side == "left"


def test_left_file_that_is_mended_already_is_kept(tmp_path: Path) -> None:
    content = mano_content("left")
    content["shapedirs"] = content["shapedirs"] * np.array([[-1.0], [1.0], [1.0]])
    write_mano_folder(tmp_path)
    (tmp_path / "MANO_LEFT.pkl").write_bytes(as_published(content))
    left = load_mano(tmp_path, "left")
    np.testing.assert_array_equal(left.shape_basis, content["shapedirs"][..., :10])


def test_left_file_alone_is_mended(tmp_path: Path) -> None:
    file = tmp_path / "MANO_LEFT.pkl"
    file.write_bytes(as_published(mano_content("left")))
    left = load_mano(file, "left")
    np.testing.assert_array_equal(
        left.shape_basis[:, 0], -mano_content("left")["shapedirs"][:, 0, :10]
    )


def test_one_file_leads_to_its_neighbour(mano_folder: str) -> None:
    file = Path(mano_folder) / "MANO_RIGHT.pkl"
    assert load_mano(file, "left").digest == load_mano(mano_folder, "left").digest
    assert load_mano(file, "right").side == "right"


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_plain_arrays_and_new_scipy_are_read_too(tmp_path: Path, protocol: int) -> None:
    content = mano_content("right")
    content["shapedirs"] = content["shapedirs"][..., :10]
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    plain = load_mano(tmp_path, "right")
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(
        as_published(mano_content("right"), scipy_module="scipy.sparse._csc")
    )
    assert plain.digest == load_mano(tmp_path, "right").digest


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("v_template", None),
        ("v_template", np.zeros((777, 3))),
        ("v_template", np.full((778, 3), np.nan)),
        ("shapedirs", np.zeros((778, 3, 9))),
        ("posedirs", np.zeros((778, 3, 134))),
        ("weights", np.zeros((778, 16))),
        ("f", np.full((1538, 3), 778)),
        ("kintree_table", np.zeros((2, 16))),
        ("hands_mean", "flat"),
        ("J_regressor", np.full((16, 778), np.inf)),
    ],
)
def test_a_bad_field_is_named(tmp_path: Path, field: str, value: object) -> None:
    content = mano_content("right")
    content["shapedirs"] = content["shapedirs"][..., :10]
    content[field] = value
    if value is None:
        del content[field]
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(BadHandModel) as caught:
        load_mano(tmp_path, "right")
    assert caught.value.field == field
    assert "MANO_RIGHT" in str(caught.value)


def test_a_selection_out_of_range_is_a_damaged_field(tmp_path: Path) -> None:
    content = mano_content("right")
    raw = as_published(content)
    content["shapedirs"] = content["shapedirs"][:, :, :4]  # fewer numbers than are selected
    broken = as_published(content)
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(broken)
    assert len(broken) < len(raw)
    with pytest.raises(BadHandModel) as caught:
        load_mano(tmp_path, "right")
    assert caught.value.field == "shapedirs"


def test_absent_files_and_foreign_content_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadHandModel, match=r"MANO_LEFT\.pkl"):
        load_mano(tmp_path, "left")
    file = tmp_path / "MANO_RIGHT.pkl"
    file.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(BadHandModel, match="named arrays"):
        load_mano(tmp_path, "right")
    file.write_bytes(pickle.dumps({"v_template": os.system}))
    with pytest.raises(UnsafePickle) as caught:
        load_mano(tmp_path, "right")
    assert caught.value.field == "posix.system"


def test_every_truncation_is_a_named_error(tmp_path: Path) -> None:
    raw = as_published(mano_content("right"))
    file = tmp_path / "MANO_RIGHT.pkl"
    for length in np.linspace(0, len(raw) - 1, 12).astype(int):
        file.write_bytes(raw[:length])
        with pytest.raises(HwpError) as caught:
            load_mano(tmp_path, "right")
        assert isinstance(caught.value, BadInput)


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


@pytest.mark.parametrize("source", ["smplx", "anny:x", "mano", "mano:", "mano-hd:", ""])
def test_unknown_sources_are_refused(source: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_template(source)
    assert caught.value.field == "source"
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
