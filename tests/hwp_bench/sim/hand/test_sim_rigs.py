"""Rigged glTF hands: the oracle is the free hand itself, written as glTF in another frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.rig_files import split_at_seams, write_rig
from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.sim.hand.rigs import WEBXR, load_rig, rig_path
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.scene import Scene

#: The joints as OpenXR rigs name them, without the side's suffix.
OPENXR = (
    "Wrist",
    *(
        f"{finger}_{part}"
        for finger in ("Index", "Middle", "Little", "Ring")
        for part in ("Proximal", "Intermediate", "Distal")
    ),
    *("Thumb_Metacarpal", "Thumb_Proximal", "Thumb_Distal"),
)


def write_gltf(path: Path, template: HandTemplate, names: tuple[str, ...]) -> Path:
    """Write a template as a binary glTF, its vertices split along the seams."""
    return write_rig(path, [split_at_seams(template)], names, template=template)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("scheme", ["webxr", "openxr"])
def test_a_rig_becomes_the_hand_that_it_was(tmp_path: Path, scheme: str, side: str) -> None:
    names = WEBXR if scheme == "webxr" else tuple(f"{name}_R" for name in OPENXR)
    path = write_gltf(tmp_path / "hand.glb", load_template("anny", "right"), names)
    model = load_template("anny", side)
    rig, texture = load_rig(str(path), side, model)
    assert texture is None
    assert rig.side == side
    np.testing.assert_allclose(rig.joints, model.joints, atol=1e-5)
    # Same vertices in another order: nearest neighbours, and the welded count.
    from scipy.spatial import cKDTree

    distance, pick = cKDTree(model.vertices).query(rig.vertices)
    assert len(rig.vertices) == len(model.vertices)
    assert distance.max() < 1e-5
    assert np.abs(rig.weights - model.weights[pick]).max() < 0.05
    np.testing.assert_allclose(
        rig.vertices[rig.fingertips], model.vertices[model.fingertips], atol=0.006
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_rig_that_ships_is_another_hand(side: str) -> None:
    path = rig_path("rig:generic-hand")
    assert path is not None
    model = load_template("anny", side)
    rig, texture = load_rig(path, side, model)
    assert texture is None
    assert rig.side == side
    assert len(rig.vertices) != len(model.vertices)
    # As large as the hand model, but no shape of it: the bones have other lengths.
    spans = [np.ptp(one.vertices, axis=0).max() for one in (rig, model)]
    assert spans[0] == pytest.approx(spans[1], rel=0.25)
    assert np.linalg.norm(rig.joints - model.joints, axis=1).max() > 0.003
    licence = Path(path).with_name("generic-hand.LICENSE.txt").read_text("utf-8")
    assert "MIT License" in licence


def test_models_without_a_rig_and_unknown_rigs() -> None:
    assert rig_path("anny") is None
    assert rig_path("gltf:some/hand.glb") == "some/hand.glb"
    with pytest.raises(UsageError, match="generic-hand"):
        rig_path("rig:nobody")


@pytest.mark.usefixtures("small_paintings")
def test_a_scene_shows_the_rig(tmp_path: Path, make_scene: Callable[..., Scene]) -> None:
    path = write_gltf(tmp_path / "hand_right.glb", load_template("anny", "right"), WEBXR)
    scene = make_scene(("age = 31.0", f'age = 31.0\nmodel = "gltf:{path}"'))
    result = render_frame(scene, 36, 40, 48)
    own = render_frame(make_scene(), 36, 40, 48)
    both = (result.coverage > 0.5) & (own.coverage > 0.5)
    either = (result.coverage > 0.5) | (own.coverage > 0.5)
    # The subject's shape is not the rig's, but the pose is.
    assert both.sum() / either.sum() > 0.7


def test_missing_joints_are_named(tmp_path: Path) -> None:
    names = (*WEBXR[:5], "tentacle", *WEBXR[6:])
    path = write_gltf(tmp_path / "hand.glb", load_template("anny", "right"), names)
    with pytest.raises(BadHandModel, match=WEBXR[5]):
        load_rig(str(path), "right", load_template("anny", "right"))
    with pytest.raises(BadHandModel, match="does not exist"):
        load_rig(str(tmp_path / "none.glb"), "right", load_template("anny", "right"))


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_damaged_files_are_refused_or_read(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("rig")
    model = load_template("anny", "right")
    path = write_gltf(folder / "hand.glb", model, WEBXR)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, 4000))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(100, len(raw)))])
    try:
        rig, _ = load_rig(str(path), "right", model)
    except BadHandModel:
        return
    assert np.isfinite(rig.vertices).all()
