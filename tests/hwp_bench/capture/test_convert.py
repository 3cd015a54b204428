"""Hands between models. Oracles: a model converted to itself, and vertices moved by hand."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from small_captures import CaptureMaker, hand_parameters

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import Capture, HandModelId, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.convert import (
    FORMATS,
    convert_capture,
    convert_hand,
    hand_meshes,
    with_one_shape,
    write_meshes,
)
from hwp_bench.capture.folder import (
    identify_hand_model,
    load_matching_template,
    rewrite_capture,
)
from hwp_bench.cli.main import main
from hwp_bench.hands import HandParameters, HandTemplate, load_template, pose_hand
from hwp_bench.run.sandbox.confinement import hand_model_files


def bent(frames: int = 3) -> HandParameters:
    """Fingers that bend inside their anatomical range, the wrist turned, half a metre away."""
    rng = np.random.default_rng(1)
    pose = 0.03 * rng.normal(size=(frames, 16, 3))
    pose[:, 1:13, 2] += np.linspace(0.1, 0.5, frames)[:, None]
    pose[:, 0] = [0.4, -0.3, 0.2]
    transl = np.array([0.02, -0.01, 0.5]) + 0.01 * rng.normal(size=(frames, 3))
    valid = np.ones(frames, dtype=bool)
    valid[1] = False
    return HandParameters(pose, 0.8 * rng.normal(size=10), transl, valid)


def test_a_model_converted_to_itself_keeps_its_skin(free_right: HandTemplate) -> None:
    hand = bent()
    made, error = convert_hand(hand, free_right, free_right)
    # The shape is found from the mean hand: within a millimetre of the skin.
    assert error.skin_mm < 1.0
    assert error.landmark_mm < 2.5
    np.testing.assert_array_equal(made.valid, hand.valid)
    tensors = free_right.to_torch(torch.float64)
    before, after = (
        pose_hand(tensors, *map(torch.from_numpy, (h.pose, h.betas, h.transl))).vertices[hand.valid]
        for h in (hand, made)
    )
    assert (before - after).norm(dim=-1).mean() < 2.5e-3


def test_mano_and_the_free_hand_reach_each_other(
    free_right: HandTemplate, mano_right: HandTemplate
) -> None:
    # The synthetic MANO is an ellipsoid with joints: no hand comes closer than some millimetres.
    for source, target in ((mano_right, free_right), (free_right, mano_right)):
        made, error = convert_hand(bent(), source, target)
        assert error.skin_mm < 6.0
        assert error.landmark_mm < 15.0
        assert error.worst_skin_mm >= error.skin_mm
        assert np.isfinite(made.pose).all()


def test_sides_are_not_mixed(free_right: HandTemplate, free_left: HandTemplate) -> None:
    with pytest.raises(UsageError, match="right hand is not a left hand"):
        convert_hand(bent(), free_right, free_left)


def test_a_hand_that_is_never_valid_is_refused(free_right: HandTemplate) -> None:
    hand = hand_parameters(3)
    nowhere = HandParameters(hand.pose, hand.betas, hand.transl, np.zeros(3, dtype=bool))
    with pytest.raises(BadInput, match="no frame is valid"):
        convert_hand(nowhere, free_right, free_right)


def test_one_shape_keeps_vertices_in_place(mano_right: HandTemplate) -> None:
    rng = np.random.default_rng(2)
    hand = bent()
    betas = np.tile(hand.betas, (3, 1))
    exact, error = with_one_shape(mano_right, hand.pose, betas, hand.transl, hand.valid)
    np.testing.assert_allclose(exact.transl[hand.valid], hand.transl[hand.valid], atol=1e-12)
    assert np.isnan(error[1])
    assert np.nanmax(error) < 1e-9
    spread = betas + 0.1 * rng.normal(size=betas.shape)
    made, error = with_one_shape(mano_right, hand.pose, spread, hand.transl, hand.valid)
    tensors = mano_right.to_torch(torch.float64)
    pose = torch.from_numpy(hand.pose)
    own = pose_hand(tensors, pose, torch.from_numpy(spread), torch.from_numpy(hand.transl))
    shared = pose_hand(tensors, pose, torch.from_numpy(made.betas), torch.from_numpy(made.transl))
    gap = (own.vertices - shared.vertices)[hand.valid]
    assert gap.mean(dim=1).abs().max() < 1e-12
    expected = 1000 * gap.norm(dim=-1).mean(dim=1).numpy()
    np.testing.assert_allclose(error[hand.valid], expected, rtol=1e-9)


def test_the_command_rewrites_a_capture(
    make_capture: CaptureMaker, free_right: HandTemplate, mano_folder: str, tmp_path: Path, capsys
) -> None:
    from dataclasses import replace

    plain = make_capture(frames=10, truth=True)
    info = replace(plain.info, hand_model=HandModelId(free_right.name, free_right.digest))
    rewrite_capture(plain, tmp_path / "sound", info, {"right": bent(10)})
    of_clip = replace(info, id="tiny-free")
    rewrite_capture(plain, tmp_path / "sound" / "free", of_clip, {"right": bent(10)})
    source, out = str(tmp_path / "sound"), str(tmp_path / "as_mano")
    words = ["data", "convert", source, "-o", out, "--hand-model"]
    assert main([*words, f"mano:{mano_folder}", "--json"]) == 0
    error = json.loads(capsys.readouterr().out)["right"]
    assert 0 < error["skin_mm"] <= error["worst_skin_mm"]
    made = open_capture(out)
    assert check_capture(out).ok
    assert made.info.hand_model.name == "mano"
    assert made.info.source["converted"]["from"] == "anny-1"
    assert made.true_hands is None
    np.testing.assert_array_equal(made.frame(3), plain.frame(3))
    # The free-view clip goes along, in the same shape.
    free = made.free_view
    assert free is not None
    np.testing.assert_array_equal(free.hands["right"].betas, made.hands["right"].betas)
    np.testing.assert_array_equal(free.frame(3), plain.frame(3))
    told = free.info.source["converted"]["error"]["right"]
    assert told["skin_mm"] == pytest.approx(error["skin_mm"], rel=0.2)
    assert main([*words, "anny"]) == 2
    old = replace(plain.info, hand_model=HandModelId(free_right.name, "0" * 64))
    rewrite_capture(plain, tmp_path / "old", old, {"right": bent(10)})
    words = ["data", "convert", str(tmp_path / "old"), "-o", str(tmp_path / "x")]
    assert main([*words, "--hand-model", "anny"]) == 1
    assert "another edition of hand model anny-1" in capsys.readouterr().err


def test_another_hand_model_is_refused_by_name_and_by_content(
    free_right: HandTemplate, mano_right: HandTemplate, mano_folder: str
) -> None:
    sides = ("right", "left")
    good = HandModelId(free_right.name, free_right.digest)
    assert load_matching_template(good, sides, "left", where="c").side == "left"
    for model in (
        HandModelId("mano", mano_right.digest, "anny"),
        HandModelId("anny-1", free_right.digest, f"mano:{mano_folder}"),
        HandModelId("anny-1", "0" * 64),
        HandModelId("mano", "1" * 64, f"mano:{mano_folder}"),
    ):
        with pytest.raises(BadInput, match="data convert") as caught:
            load_matching_template(model, sides, "right", where="my_capture")
        assert "my_capture: hand_model" in str(caught.value)


def test_the_hand_model_is_found_from_every_folder(
    mano_folder: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Oracle: a method runs in another folder, and is shown files of absolute paths."""
    place = Path(mano_folder)
    monkeypatch.chdir(place.parent)
    model = identify_hand_model(f"mano:{place.name}", "right")
    assert identify_hand_model("anny", "right").source == "anny"
    monkeypatch.chdir(tmp_path)
    assert load_template(model.source).digest == model.digest
    assert len(hand_model_files(model.source)) == 2


def test_clean_frames_without_masks_are_copied(make_capture: CaptureMaker, tmp_path: Path) -> None:
    plain = make_capture(frames=10, truth=True)
    shutil.rmtree(plain.root / "truth" / "clean_masks")
    rewrite_capture(plain, tmp_path / "out", plain.info, plain.hands)
    made = open_capture(tmp_path / "out")
    np.testing.assert_array_equal(made.clean(3), plain.clean(3))
    assert check_capture(made.root).ok


def test_a_hand_that_a_frame_does_not_show_has_no_mesh(make_capture: CaptureMaker) -> None:
    capture = make_capture(hands="both", frames=10)
    capture.hands["left"].valid[4] = False
    assert tuple(hand_meshes(capture, 4)) == ("right",)
    capture.hands["right"].valid[4] = False
    with pytest.raises(UsageError, match="shows no hand in frame 4"):
        hand_meshes(capture, 4)


@pytest.mark.parametrize("hands", ["right", "both"])
def test_meshes_are_the_posed_templates(hands: str, make_painted: Callable[..., Capture]) -> None:
    capture = make_painted(hands)
    meshes = hand_meshes(capture, 3)
    assert tuple(meshes) == capture.info.sides
    for side, mesh in meshes.items():
        template, hand = capture.template(side), capture.hands[side]
        given = (hand.pose[3:4], hand.betas, hand.transl[3:4])
        posed = pose_hand(template.to_torch(torch.float64), *map(torch.from_numpy, given))
        np.testing.assert_allclose(mesh.vertices, posed.vertices[0].numpy(), atol=1e-12)
        np.testing.assert_array_equal(mesh.faces, template.faces)


@pytest.mark.parametrize("ending", FORMATS)
def test_other_programs_read_the_files(
    ending: str, make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    meshes = hand_meshes(make_painted("both"), 0)
    read = trimesh.load(write_meshes(meshes, tmp_path / f"hands{ending}"), force="mesh")
    corners = np.concatenate([mesh.vertices for mesh in meshes.values()])
    # 32-bit floats, and .obj with eight digits.
    np.testing.assert_allclose(read.bounds, [corners.min(0), corners.max(0)], atol=1e-6)
    assert len(read.faces) == sum(len(mesh.faces) for mesh in meshes.values())
    if ending == ".glb":
        names = set(trimesh.load(tmp_path / "hands.glb").geometry)
        assert names == {"right_hand", "left_hand"}


def test_the_command_writes_a_mesh_and_names_what_is_wrong(
    make_painted: Callable[..., Capture], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = str(make_painted("right").root)
    assert main(["data", "export", root, "-o", str(tmp_path / "hand.glb"), "--frame", "2"]) == 0
    assert "right hand" in capsys.readouterr().out
    read = trimesh.load(tmp_path / "hand.glb", force="mesh")
    corners = hand_meshes(make_painted("right"), 2)["right"].vertices
    np.testing.assert_allclose(read.bounds, [corners.min(0), corners.max(0)], atol=1e-6)
    for words, problem in (
        ([root, "-o", str(tmp_path / "hand.xyz")], "Use one of .glb"),
        ([root, "-o", str(tmp_path / "hand.glb"), "--frame", "999"], "there is no frame 999"),
    ):
        assert main(["data", "export", *words]) == 2
        assert problem in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["hand.glb"]


def test_truth_must_be_known(make_capture: CaptureMaker) -> None:
    with pytest.raises(UsageError, match="does not know the true"):
        hand_meshes(make_capture("a", frames=10), 0, truth=True)
    known = make_capture("b", frames=10, truth=True)
    assert known.true_hands is not None
    known.true_hands["right"].transl[3] += 0.5
    true, given = (hand_meshes(known, 3, truth=one)["right"].vertices for one in (True, False))
    np.testing.assert_allclose(true - given, 0.5, atol=1e-9)


def test_the_truth_has_a_hand_where_the_estimator_failed(make_capture: CaptureMaker) -> None:
    capture = make_capture(hands="both", frames=10, truth=True)
    for side in ("left", "right"):
        capture.hands[side].valid[4] = False
        assert tuple(hand_meshes(capture, 4, truth=True)) == ("right", "left")


def test_an_existing_output_is_refused_before_the_fit(
    make_capture: CaptureMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = make_capture("one", frames=10), make_capture("two", frames=10)
    monkeypatch.setattr("hwp_bench.capture.convert.convert_hand", lambda *_: pytest.fail("fitted"))
    with pytest.raises(UsageError, match="--overwrite"):
        convert_capture(one, other.root, "anny")
