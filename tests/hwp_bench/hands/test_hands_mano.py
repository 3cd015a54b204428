"""The MANO reader on synthetic files in the published format; the oracle is their content."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from synthetic_mano import as_published, mano_content, write_mano_folder

from hwp_bench.base.errors import BadHandModel, BadInput, HwpError, UnsafePickle
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.skeleton import PARENTS
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


def test_a_mesh_without_extent_is_refused(tmp_path: Path) -> None:
    content = mano_content("right") | {"v_template": np.zeros((778, 3))}
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(as_published(content))
    with pytest.raises(BadHandModel, match="one line"):
        load_mano(tmp_path, "right")


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
    for length in np.linspace(0, len(raw) - 1, 25).astype(int):
        file.write_bytes(raw[:length])
        with pytest.raises(HwpError) as caught:
            load_mano(tmp_path, "right")
        assert isinstance(caught.value, BadInput)
