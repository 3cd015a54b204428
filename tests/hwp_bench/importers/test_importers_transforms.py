"""nerfstudio's transforms.json. Oracles: cameras computed by hand; the capture that was written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker, free_hand, hand_parameters, hand_picture

import hwp_bench
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, open_capture

#: Degrees that the camera of a frame is turned about the vertical.
STEP = 10.0


@pytest.fixture
def turning(tmp_path: Path) -> Path:
    """A capture of 12 frames whose camera walks around the hand, with a focal length of its own
    in every frame."""
    frames, size, angles = 12, 24, np.radians(STEP * np.arange(12))
    Ks, viewmats = np.tile(np.eye(3), (frames, 1, 1)), np.tile(np.eye(4), (frames, 1, 1))
    for frame, angle in enumerate(angles):
        Ks[frame, :2] = [[20.0 + frame, 0, 11.5], [0, 21.0 + frame, 12.25]]
        cos, sin = np.cos(angle), np.sin(angle)
        viewmats[frame, :3] = [[cos, 0, -sin, 0.1], [0, 1, 0, 0.02 * frame], [sin, 0, cos, 0.3]]
    info = CaptureInfo(
        **{"id": "turning", "hands": "both", "action": "Waving", "device": "Test", "fps": 25.0},
        **{"width": size, "height": size, "frame_count": frames, "hand_model": free_hand("both")},
        **{"perturbations": {"motion_blur": (3, *[0] * 11)}, "source": {}, "licence": "CC0"},
    )
    hands = {side: hand_parameters(frames, i) for i, side in enumerate(info.sides)}
    with CaptureWriter(tmp_path / "turning", info, hands, Cameras(Ks, viewmats)) as writer:
        for frame in range(frames):
            picture, mask = hand_picture(frame, size)
            writer.frame(frame, picture)
            writer.mask(frame, mask)
    return tmp_path / "turning"


def test_a_capture_comes_back(turning: Path, tmp_path: Path) -> None:
    capture = open_capture(turning)
    file = hwp_bench.export_transforms(capture, tmp_path / "scene")
    back = hwp_bench.import_transforms(file, tmp_path / "back")
    assert len(back) == 12
    for frame in range(12):
        np.testing.assert_array_equal(back.frame(frame), capture.frame(frame))
        np.testing.assert_array_equal(back.mask(frame), capture.mask(frame))
    np.testing.assert_array_equal(back.cameras.Ks, capture.cameras.Ks)
    # A matrix is inverted on both ways.
    np.testing.assert_allclose(back.cameras.viewmats, capture.cameras.viewmats, atol=1e-14)
    for side, hand in capture.hands.items():
        for name in ("pose", "betas", "transl", "valid"):
            np.testing.assert_array_equal(getattr(back.hands[side], name), getattr(hand, name))
    for name in ("id", "hands", "action", "fps", "hand_model", "perturbations", "licence"):
        assert getattr(back.info, name) == getattr(capture.info, name)
    assert back.info.made_by == "transforms 1"


def test_a_camera_computed_by_hand(turning: Path, tmp_path: Path) -> None:
    content = json.loads(
        hwp_bench.export_transforms(open_capture(turning), tmp_path / "scene").read_text()
    )
    first, later = content["frames"][0], content["frames"][9]
    assert first["file_path"] == "images/000000.png"
    assert [first[name] for name in ("fl_x", "fl_y", "cx", "cy")] == [20.0, 21.0, 11.5, 12.25]
    assert (content["w"], content["h"], content["camera_model"]) == (24, 24, "OPENCV")
    # Frame 0 stands at (-0.1, 0, -0.3), looks along +z with y down. In the file's world, where
    # (x, y, z) has become (x, z, -y), it looks along +y: its own z axis, backwards, is -y, and its
    # y axis, up, is +z.
    expected = [[1, 0, 0, -0.1], [0, 0, -1, -0.3], [0, 1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(first["transform_matrix"], expected, atol=1e-14)
    # Frame 9 is turned by 90 degrees: x_cam = -z + 0.1, y_cam = y + 0.18, z_cam = x + 0.3.
    # It stands at (-0.3, -0.18, 0.1), its right is -z and it looks along +x.
    expected = [[0, 0, -1, -0.3], [-1, 0, 0, 0.1], [0, 1, 0, 0.18], [0, 0, 0, 1]]
    np.testing.assert_allclose(later["transform_matrix"], expected, atol=1e-14)
    assert content["train_filenames"] == [f"images/{n:06d}.png" for n in range(9)]
    assert content["test_filenames"] == [f"images/{n:06d}.png" for n in (10, 11)]


@pytest.fixture
def scene(turning: Path, tmp_path: Path) -> Callable[..., Path]:
    """A function that exports the capture, changes its file, and returns the folder."""

    def make(change: Callable[[dict[str, Any]], object]) -> Path:
        file = hwp_bench.export_transforms(
            open_capture(turning), tmp_path / "scene", overwrite=True
        )
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))
        return file.parent

    return make


def test_an_export_replaces_nothing_but_an_export(turning: Path, tmp_path: Path) -> None:
    capture, mine = open_capture(turning), tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("a year")
    for place in (turning, turning / "scene", mine, tmp_path):
        with pytest.raises(UsageError):
            hwp_bench.export_transforms(capture, place, overwrite=True)
    assert open_capture(turning).digest == capture.digest
    assert (mine / "notes.txt").read_text() == "a year"


def test_a_file_of_another_program_is_read(scene: Callable[..., Path], tmp_path: Path) -> None:
    # Intrinsics at the top, an applied scale, no facts of ours, the world as it is.
    def change(content: dict[str, Any]) -> None:
        for name in ("hwp", "applied_transform"):
            del content[name]
        content |= {"fl_x": 30.0, "fl_y": 30.0, "cx": 12.0, "cy": 12.0, "applied_scale": 2.0}
        content["w"] = content["h"] = 24.0
        for frame in content["frames"]:
            for name in ("fl_x", "fl_y", "cx", "cy"):
                del frame[name]
            frame["transform_matrix"] = [
                [1, 0, 0, 0.5],
                [0, -1, 0, 0],
                [0, 0, -1, -1],
                [0, 0, 0, 1],
            ]

    capture = hwp_bench.import_transforms(scene(change), tmp_path / "back")
    assert (capture.info.id, capture.info.hands, capture.info.fps) == ("scene", "both", 30.0)
    assert capture.camera(4).K.tolist() == [[30, 0, 12], [0, 30, 12], [0, 0, 1]]
    # It stands at (0.25, 0, -0.5) m and has OpenCV's axes.
    viewmat = [[1, 0, 0, -0.25], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(capture.camera(4).viewmat, viewmat, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: c.update(frames=[]), "frames: .*expected a list of 1 to 100,000 entries"),
        (lambda c: c.update(frames=[3]), r"frames\[0\]: must be a table"),
        (lambda c: c.update(k1=0.1), "camera_model: the lens is distorted"),
        (lambda c: c.update(camera_model="FISHEYE"), "camera_model: the lens is distorted"),
        (lambda c: c.update(applied_scale=0), "applied_scale: is 0, expected a finite number"),
        (lambda c: c.update(applied_transform=[[0.0] * 4] * 3), "not a rigid pinhole"),
        (lambda c: c.update(w="wide"), "w: is 'wide', expected a finite number"),
        (lambda c: c.update(w=25), "images/000000.png: .*24"),
        (lambda c: c["frames"][2].pop("fl_x"), r"frames\[2\].fl_x: is missing"),
        (lambda c: c["frames"][2].update(fl_x=-3.0), "a focal length that is not above 0"),
        (lambda c: c["frames"][2].update(fl_x=1e300), r"frames\[2\].fl_x: is 1e\+300"),
        (lambda c: c["frames"][2].update(transform_matrix=[[1]]), "transform_matrix"),
        (lambda c: c["frames"][2].pop("mask_path"), r"frames\[2\].mask_path: is missing"),
        (lambda c: c["frames"][2].update(file_path="../x.png"), "leads out of the folder"),
        (lambda c: c["hwp"].update(fps=-1), "fps"),
    ],
)
def test_faults_are_named(
    change: Callable[[dict[str, Any]], object],
    problem: str,
    scene: Callable[..., Path],
    tmp_path: Path,
) -> None:
    folder = scene(change)
    with pytest.raises(HwpError, match=problem):
        hwp_bench.import_transforms(folder, tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_hands_have_to_be_there(scene: Callable[..., Path], tmp_path: Path) -> None:
    folder = scene(lambda content: None)
    (folder / "hands.npz").unlink()
    with pytest.raises(BadInput, match=r"hands.npz: is missing. Write the pose"):
        hwp_bench.import_transforms(folder, tmp_path / "back")


def test_few_frames_have_no_split_and_an_output_is_not_replaced(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    file = hwp_bench.export_transforms(make_capture(frames=6), tmp_path / "scene")
    assert "train_filenames" not in json.loads(file.read_text())
    assert len(hwp_bench.import_transforms(file.parent, tmp_path / "back")) == 6
    with pytest.raises(HwpError, match="back: exists already"):
        hwp_bench.import_transforms(file.parent, tmp_path / "back")
    assert len(hwp_bench.import_transforms(file, tmp_path / "back", overwrite=True)) == 6
