"""Meshes of a frame's hands. Oracles: the skinning that every method uses, trimesh as reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.capture.convert import FORMATS, hand_meshes, write_meshes
from hwp_bench.cli.main import main
from hwp_bench.hands import pose_hand


@pytest.mark.parametrize("hands", ["right", "both"])
def test_meshes_are_the_posed_templates(hands: str, make_painted: Callable[..., Capture]) -> None:
    capture = make_painted(hands)
    meshes = hand_meshes(capture, 3)
    assert tuple(meshes) == capture.info.sides
    for side, mesh in meshes.items():
        template, hand = capture.template(side), capture.hands[side]
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(hand.pose[3:4].astype(np.float64)),
            torch.from_numpy(hand.betas.astype(np.float64)),
            torch.from_numpy(hand.transl[3:4].astype(np.float64)),
        )
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
    assert main(["hands", "export", root, str(tmp_path / "hand.glb"), "--frame", "2"]) == 0
    assert "right hand" in capsys.readouterr().out
    for words, problem in (
        ([root, str(tmp_path / "hand.xyz")], "Use one of .glb"),
        ([root, str(tmp_path / "hand.glb"), "--frame", "999"], "there is no frame 999"),
    ):
        assert main(["hands", "export", *words]) == 2
        assert problem in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["hand.glb"]


def test_truth_must_be_known(make_painted: Callable[..., Capture]) -> None:
    capture = make_painted("right")
    if capture.true_hands is None:
        with pytest.raises(UsageError, match="does not know the true"):
            hand_meshes(capture, 0, truth=True)
    else:
        hand = capture.true_hands["right"]
        mesh = hand_meshes(capture, 0, truth=True)["right"]
        assert np.isfinite(mesh.vertices).all()
        assert hand.valid[0]
