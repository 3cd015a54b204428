"""InterHand2.6M. Oracles: the fixture's own posing and the data set's projection formula."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from interhand_release import FRAMES, HEIGHT, WIDTH, camera, project, write_interhand
from synthetic_mano import write_mirrored_mano

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main
from hwp_bench.hands import load_template, pose_hand
from hwp_bench.importers.interhand import (
    PAPER_SEQUENCES,
    InterHandImport,
    find_sequence,
    import_interhand,
)
from hwp_bench.importers.shared.output import project_hand

SEQUENCE = PAPER_SEQUENCES["touchrom-15"]


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mirrored_mano(tmp_path_factory.mktemp("mano"))


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory, mano: Path) -> tuple[Path, dict]:
    root = tmp_path_factory.mktemp("ih") / "InterHand2.6M"
    templates = {side: load_template(f"mano:{mano}", side) for side in ("right", "left")}
    return root, write_interhand(root, templates)


def test_the_papers_sequences_and_paths_are_found() -> None:
    assert {str(s.camera) for s in PAPER_SEQUENCES.values()} == {"400015", "400016"}
    assert find_sequence("touchrom-15") is SEQUENCE
    found = find_sequence("test/Capture0/ROM01_No_Interaction/cam400262")
    assert (found.split, found.capture, found.camera) == ("test", 0, "400262")
    for name in ("nothing", "Capture1/../cam2", "Capture1/a/b/cam2"):
        with pytest.raises(UsageError, match="touchrom-15"):
            find_sequence(name)


def test_mano_hands_lie_on_the_images(
    release: tuple[Path, dict], mano: Path, tmp_path: Path
) -> None:
    root, truth = release
    facts = import_interhand(root, SEQUENCE, tmp_path / "c", InterHandImport(mano=mano))
    capture = open_capture(tmp_path / "c")
    assert check_capture(capture.root).ok
    assert capture.info.source["frames"] == list(FRAMES)
    assert (capture.info.fps, capture.info.times) == (5.0, None)
    assert capture.info.hands == "both"
    assert facts["errors"]["right"]["joints_mm"] < 0.01
    np.testing.assert_array_equal(capture.hands["left"].valid, np.arange(12) != 4)
    crop = None
    for side, hand in capture.hands.items():
        template = load_template(capture.info.hand_model.source, side)
        clip = project_hand(template, hand, capture.cameras)
        for frame in np.flatnonzero(hand.valid):
            # Scale and shift from whole image to crop are read off the intrinsics.
            K = capture.cameras.Ks[frame]
            scale = K[0, 0] / 1270.0
            expected = (project(truth[side][frame]) - (170.0, 250.0)) * scale + K[:2, 2]
            # The stored rotation has six digits.
            assert np.abs(clip.pixels[frame] - expected).max() < 0.05
            crop = capture.frame(frame)
    # The hands reach over the frame's edge: no mask beyond it, where the crop is black.
    assert not capture.mask(11)[:, :2].any()
    # Masks are on skin: the picture is bright where they are and dark where not.
    mask = capture.mask(11) > 0
    assert crop[mask].mean() > 130
    assert crop[~mask].mean() < 60


def test_the_free_hand_is_fitted_to_the_joints(
    release: tuple[Path, dict], tmp_path: Path, capsys
) -> None:
    root, _ = release
    words = ["data", "import", "interhand26m", str(root), "touchrom-15", "-o", str(tmp_path / "c")]
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    # The synthetic MANO is no hand: its joints cannot be met exactly.
    assert facts["errors"]["right"]["joints_mm"] < 10.0
    capture = open_capture(tmp_path / "c")
    assert capture.info.hand_model.name == "anny-1"
    assert main(words) == 2
    assert "exists already" in capsys.readouterr().err
    hand = capture.hands["right"]
    posed = pose_hand(
        load_template().to_torch(torch.float64),
        *map(torch.from_numpy, (hand.pose, hand.betas, hand.transl)),
    )
    assert np.isfinite(posed.vertices.numpy()).all()


def edit(root: Path, kind: str, change) -> None:
    path = root / "annotations" / "test" / f"InterHand2.6M_test_{kind}.json"
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("camera", lambda v: v["21"]["focal"].pop("400015"), "21.focal.400015"),
        (
            "camera",
            lambda v: v["21"]["camrot"].update({"400015": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}),
            "not a rotation",
        ),
        ("camera", lambda v: v.pop("21"), "21"),
        ("joint_3d", lambda v: v["21"]["7"].update(world_coord=[[1, 2]]), "21.7.world_coord"),
        (
            "MANO_NeuralAnnot",
            lambda v: v["21"]["7"]["right"].update(pose=[0.0] * 47),
            "21.7.right.pose",
        ),
        ("MANO_NeuralAnnot", lambda v: v["21"]["7"].update(right="x"), "21.7.right"),
        ("data", lambda v: v["images"][0].update(file_name="../../../../etc/passwd"), "leads out"),
        ("data", lambda v: v["images"][0].update(frame_idx="x"), "frame_idx"),
        ("data", lambda v: v["images"][1].update(frame_idx=7), "twice"),
        ("data", lambda v: v.update(images={}), "images"),
        ("data", lambda v: v["images"][0].update(id=[0]), r"data\.json: id: is '\[0\]', not a"),
        ("data", lambda v: v["annotations"][0].update(image_id=[0]), r"image_id: is '\[0\]', not"),
        ("data", lambda v: v["images"][0].update(file_name="a\0.jpg"), "holds a zero character"),
    ],
)
def test_damaged_annotations_are_named(
    release: tuple[Path, dict], mano: Path, tmp_path: Path, kind: str, change, message: str
) -> None:
    root = tmp_path / "ih"
    shutil.copytree(release[0], root)
    edit(root, kind, change)
    with pytest.raises(BadInput, match=message):
        import_interhand(root, SEQUENCE, tmp_path / "c", InterHandImport(mano=mano))
    assert not (tmp_path / "c").exists()


def copied(root: Path, tmp_path: Path) -> Path:
    shutil.copytree(root, tmp_path / "copy")
    return tmp_path / "copy"


def annotation(root: Path, kind: str) -> Path:
    return root / "annotations" / "test" / f"InterHand2.6M_test_{kind}.json"


def test_black_images_are_named_and_left_out(
    release: tuple[Path, dict], mano: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """https://github.com/facebookresearch/InterHand2.6M/issues/125"""
    root = copied(release[0], tmp_path)
    images = root / "images" / "test" / "Capture21" / "0390_dh_touchROM" / "cam400015"
    black = np.random.default_rng(0).integers(0, 4, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for frame in FRAMES[2], FRAMES[11]:
        cv2.imwrite(str(images / f"image{frame}.jpg"), black)
    facts = import_interhand(root, SEQUENCE, tmp_path / "c", InterHandImport(mano=mano, size=64))
    kept = [frame for frame in FRAMES if frame not in (FRAMES[2], FRAMES[11])]
    assert facts["black_frames"] == [FRAMES[2], FRAMES[11]]
    assert "2 of 12 frames are black, or of one colour, and are left out: 13, 40." in (
        capsys.readouterr().err
    )
    capture = open_capture(tmp_path / "c")
    assert capture.info.source["frames"] == kept
    assert capture.info.source["import"]["black_frames"] == [FRAMES[2], FRAMES[11]]
    # Five frames a second, in the places that they have among all of them.
    assert capture.info.times == (0.0, 0.2, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
    assert capture.info.fps == pytest.approx(4.5)
    # The frame in which the left hand is missing is one earlier.
    np.testing.assert_array_equal(capture.hands["left"].valid, np.arange(10) != 3)
    for frame in FRAMES[:10]:
        cv2.imwrite(str(images / f"image{frame}.jpg"), black)
    with pytest.raises(BadInput, match="11 of 12 images of the sequence are black"):
        import_interhand(root, SEQUENCE, tmp_path / "d")


@pytest.fixture(scope="module")
def sound_crop(
    release: tuple[Path, dict], mano: Path, tmp_path_factory: pytest.TempPathFactory
) -> int:
    out = tmp_path_factory.mktemp("sound") / "c"
    options = InterHandImport(mano=mano, size=64)
    return int(import_interhand(release[0], SEQUENCE, out, options)["crop_px"])


@pytest.mark.parametrize(
    ("model", "place"),
    [
        ("mano", "far off"),
        ("mano", "in the camera's plane"),
        ("mano", "beside the image"),
        ("free", "far off"),
    ],
)
def test_a_hand_that_is_annotated_outside_is_not_seen_there(
    release: tuple[Path, dict], mano: Path, tmp_path: Path, sound_crop: int,
    capsys: pytest.CaptureFixture[str], model: str, place: str,
) -> None:  # fmt: skip
    """One wrong frame of one hand. Oracle: the window of the sound annotations, within 10 %."""
    root = copied(release[0], tmp_path)
    options = InterHandImport(size=64, mano=mano if model == "mano" else None)
    rotation, position = camera()
    ways = {"far off": 3.0 * rotation[0], "beside the image": -0.2 * rotation[0]}
    move = ways.get(place, position / 1000.0)

    def spoil(tables: dict) -> None:
        frame = tables["21"]["10"]
        if model == "mano":
            frame["right"]["trans"] = (np.array(frame["right"]["trans"]) + move).tolist()
        else:
            frame["world_coord"][:21] = (np.array(frame["world_coord"][:21]) + 1e3 * move).tolist()

    edit(root, "MANO_NeuralAnnot" if model == "mano" else "joint_3d", spoil)
    facts = import_interhand(root, SEQUENCE, tmp_path / "c", options)
    said = "the right hand is annotated outside of the image, and counts as not seen, in 1 of"
    assert f"{said} 12 frames: 10." in capsys.readouterr().err
    assert facts["errors"]["right"]["far_frames"] == [10]
    assert facts["crop_px"] == pytest.approx(sound_crop, rel=0.1)
    capture = open_capture(tmp_path / "c")
    np.testing.assert_array_equal(capture.hands["right"].valid, np.arange(12) != 1)
    assert check_capture(capture.root).ok


def test_a_hand_that_is_never_annotated_is_left_out_on_request(
    release: tuple[Path, dict], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """https://github.com/facebookresearch/InterHand2.6M/issues/33, without the MANO file."""
    root = copied(release[0], tmp_path)
    annotation(root, "MANO_NeuralAnnot").unlink()
    joints = json.loads(annotation(root, "joint_3d").read_text())
    for frame in joints["21"].values():
        frame["joint_valid"][21:] = [[0]] * 21
    annotation(root, "joint_3d").write_text(json.dumps(joints))
    words = ["data", "import", "interhand26m", str(root), "touchrom-15", "--size", "64"]
    assert main([*words, "-o", str(tmp_path / "both")]) == 1
    said = capsys.readouterr().err
    assert "the left hand has no joints in any frame. Import the other hand alone: --side r" in said
    assert main([*words, "-o", str(tmp_path / "right"), "--side", "right"]) == 0
    capture = open_capture(tmp_path / "right")
    assert capture.info.hands == "right"
    assert capture.hands["right"].valid.all()
    assert check_capture(capture.root).ok
    # With MANO the file is needed, and it is named.
    with pytest.raises(BadInput, match=r"MANO_NeuralAnnot.json: does not exist"):
        import_interhand(root, SEQUENCE, tmp_path / "m", InterHandImport(mano=tmp_path))


def test_a_hand_that_the_sequence_does_not_show_is_refused(mano: Path, tmp_path: Path) -> None:
    write_interhand(tmp_path, {"left": load_template(f"mano:{mano}", "left")})
    with pytest.raises(BadInput, match="--side: shows the left hand only"):
        import_interhand(tmp_path, SEQUENCE, tmp_path / "c", InterHandImport(side="both"))
    with pytest.raises(UsageError, match="--side: must be one of auto, right, left, both"):
        InterHandImport(side="up")


def test_an_absent_sequence_is_named(release: tuple[Path, dict], tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="0286_handscratch"):
        import_interhand(release[0], PAPER_SEQUENCES["handscratch-16"], tmp_path / "c")
