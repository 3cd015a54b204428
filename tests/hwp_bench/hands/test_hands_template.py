"""Templates and parameters refuse what cannot be posed, and name the field."""

from __future__ import annotations

import inspect
import subprocess
import sys

import numpy as np
import pytest

import hwp_bench.hands
from hwp_bench.base.errors import BadHandModel, BadInput
from hwp_bench.hands import HandParameters, HandTemplate, mirror_template
from hwp_bench.hands.template import make_template, rebuilt

FIELDS = inspect.signature(make_template).parameters.keys() - {"where"}


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


def test_mirroring_twice_gives_the_hand_back(tiny_template: HandTemplate) -> None:
    twice = mirror_template(mirror_template(tiny_template))
    assert twice.digest == tiny_template.digest
    np.testing.assert_array_equal(twice.pose_basis, tiny_template.pose_basis)


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
