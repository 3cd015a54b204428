"""Second cameras. Oracle: the true camera of simulated pairs, and of a fixture of InterHand2.6M.

`test_sim_free_view.py` compares scores with those of the simulator's own free view.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from interhand_release import camera as interhand_camera
from interhand_release import project as interhand_project
from interhand_release import write_interhand
from small_captures import free_hand
from synthetic_clip import make_clip, template
from synthetic_mano import write_mirrored_mano

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.schema import image_path
from hwp_bench.cli.main import main
from hwp_bench.hands import HandParameters, load_template
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.second_view import (
    MAX_BYTES,
    TwoCameras,
    add_second_view,
    read_calibration,
)
from hwp_bench.importers.shared.frames import CropWindows

COUNT, SIZE, SIDE, OFFSET = 16, 64, 200, 3
#: Intrinsics of the whole frames, px: no principal point lies in the middle.
FIRST = np.array([[260.0, 0, 164.0], [0, 260.0, 117.0], [0, 0, 1]])
SECOND = np.array([[300.0, 0, 150.0], [0, 302.0, 128.0], [0, 0, 1]])
#: A metre of the captures in metres.
SCALE = 1.13


def motion() -> np.ndarray:
    """From the first camera's axes to the second's, in metres of the captures."""
    found = np.eye(4)
    found[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.9, -0.05]))[0]
    found[:3, 3] = np.array([-0.33, 0.02, 0.17])
    return found


def seen_from(hand: HandParameters, move: np.ndarray) -> HandParameters:
    """The same hand in the axes of another camera."""
    posed = pose_parameters(template(), hand)
    wrist = posed.joints[:, 0].numpy()
    pose = hand.pose.copy()
    for frame, turn in enumerate(hand.pose[:, 0]):
        pose[frame, 0] = cv2.Rodrigues(move[:3, :3] @ cv2.Rodrigues(turn)[0])[0][:, 0]
    transl = wrist @ move[:3, :3].T + move[:3, 3] - (wrist - hand.transl)
    return replace(hand, pose=pose, transl=transl)


def landmarks(hand: HandParameters) -> np.ndarray:
    return pose_parameters(template(), hand).landmarks.numpy()


def in_image(points: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    flat = np.einsum("fij,fpj->fpi", Ks, points)
    return flat[..., :2] / flat[..., 2:]


def imported(path: Path, hand: HandParameters, K: np.ndarray, start: int) -> Capture:
    """A capture as an import of a video makes it: in the axes of its camera, cropped."""
    middles = in_image(landmarks(hand), np.tile(K, (COUNT, 1, 1))).mean(axis=1)
    corners = np.round(middles - SIDE / 2).astype(np.int64)
    info = CaptureInfo(
        *(path.name, "right", "turns", "camera", 30.0, SIZE, SIZE, COUNT, free_hand("right"), {}),
        source={
            "kind": "video",
            "frames": [start + 2 * frame for frame in range(COUNT)],
            "crop": {"side": SIDE, "corners": corners.tolist()},
        },
        licence="CC0-1.0",
        times=tuple(0.07 * frame + 0.01 * (frame % 2) for frame in range(COUNT)),
    )
    cameras = Cameras(
        CropWindows(corners, SIDE, SIZE).intrinsics(K), np.tile(np.eye(4), (COUNT, 1, 1))
    )
    with CaptureWriter(path, info, {"right": hand}, cameras) as writer:
        for frame in range(COUNT):
            writer.frame(frame, np.full((SIZE, SIZE, 3), (10 * frame, start, 0), np.uint8))
            writer.mask(frame, np.full((SIZE, SIZE), 255, np.uint8))
    return open_capture(path)


def calibration(**changes: object) -> TwoCameras:
    scaled = motion()
    scaled[:3, 3] *= SCALE
    given = TwoCameras(FIRST.tolist(), SECOND.tolist(), scaled.tolist(), OFFSET)
    return replace(given, **changes)  # type: ignore[arg-type]


Pair = Callable[..., tuple[Capture, Capture]]


@pytest.fixture
def pair(tmp_path: Path) -> Pair:
    """Two imports of one hand that is before both cameras.

    Each puts the hand at a wrong place along its rays: a share `wrong` (standard deviation) of the
    distance, in each frame.
    """

    def make(wrong: float = 0.0) -> tuple[Capture, Capture]:
        hand, rng = make_clip(COUNT).hand, np.random.default_rng(5)
        captures = []
        for name, K, move, start in (
            ("front", FIRST, np.eye(4), 10),
            ("side", SECOND, motion(), 10 + OFFSET),
        ):
            own = seen_from(hand, move)
            middle = landmarks(own).mean(axis=1)
            moved = own.transl + middle * rng.normal(0, wrong, (COUNT, 1))
            captures.append(imported(tmp_path / name, replace(own, transl=moved), K, start))
        return captures[0], captures[1]

    return make


def test_a_frame_whose_mask_is_empty_is_no_novel_view(pair: Pair) -> None:
    front, side = pair()
    write_image(image_path(side.root, "masks", 5), np.zeros((SIZE, SIZE), np.uint8))
    made = add_second_view(front, side, calibration())
    assert made.second_frames == [frame for frame in range(COUNT) if frame != 5]


@pytest.mark.parametrize(("wrong", "millimetres", "pixels"), [(0.0, 0.01, 0.01), (0.03, 4.0, 0.6)])
def test_the_second_camera_and_the_hands_are_found(
    pair: Pair, wrong: float, millimetres: float, pixels: float
) -> None:
    front, side = pair(wrong)
    before = front.digest
    made = add_second_view(front, side, calibration())
    assert made.frames == made.second_frames == list(range(COUNT))
    assert made.scale == pytest.approx(SCALE, rel=0.01 if wrong else 1e-5)
    front = open_capture(front.root)
    clip = front.free_view
    assert clip is not None
    assert check_capture(front.root).ok
    # It is no part of the capture, and has the pixels of the second camera.
    assert front.digest == before
    assert [clip.frame(i)[0, 0, 0] for i in range(3)] == [0, 10, 20]
    assert clip.info.source["digest"] == side.digest
    # The camera: its turn is given, its place is right in metres of the capture.
    apart = clip.cameras.viewmats - motion()
    assert np.abs(apart[:, :3, :3]).max() < 1e-9
    assert 1e3 * np.linalg.norm(apart[:, :3, 3], axis=1).max() < millimetres
    # The hands are where the true hand is in the second camera's frames.
    true = landmarks(seen_from(make_clip(COUNT).hand, motion()))
    here = landmarks(clip.hands["right"]) @ motion()[:3, :3].T + clip.cameras.viewmats[0, :3, 3]
    gaps = in_image(here, clip.cameras.Ks) - in_image(true, side.cameras.Ks)
    assert np.linalg.norm(gaps, axis=-1).mean() < pixels
    # As the import alone had them they are not.
    alone = landmarks(front.hands["right"]) @ motion()[:3, :3].T + motion()[:3, 3]
    off = in_image(alone, clip.cameras.Ks) - in_image(true, side.cameras.Ks)
    assert np.linalg.norm(off, axis=-1).mean() > 2 * pixels or wrong == 0.0


def test_what_contradicts_the_calibration_is_refused(pair: Pair, tmp_path: Path) -> None:
    front, side = pair()
    turned = motion()
    turned[:3, :3] = turned[:3, :3].T
    with pytest.raises(BadInput, match="Check the calibration, its axes"):
        add_second_view(front, side, calibration(motion=turned.tolist()))
    assert front.free_view is None
    with pytest.raises(UsageError, match="has no frame at the time"):
        add_second_view(front, side, calibration(offset=OFFSET + 1))
    add_second_view(front, side, calibration())
    with pytest.raises(UsageError, match="--overwrite"):
        add_second_view(front, side, calibration())
    made = add_second_view(front, side, calibration(offset=OFFSET + 20), overwrite=True)
    # Fewer frames than the capture, whose times are not the clip's.
    assert open_capture(front.root).free_view.info.times is None
    assert (made.frames[0], made.second_frames[0]) == (0, 10)
    model = replace(side.info.hand_model, digest="0" * 64)
    edition = replace(side, info=replace(side.info, hand_model=model))
    with pytest.raises(BadInput, match="belongs to another edition of hand model"):
        add_second_view(front, edition, calibration(), overwrite=True)
    # A capture that was not cropped from a video has no whole frames to calibrate.
    other = imported(tmp_path / "other", front.hands["right"], FIRST, 11)
    numbered = {"frames": other.info.source["frames"]}
    bare = replace(other, info=replace(other.info, source=numbered))
    with pytest.raises(UsageError, match="how its frames were cropped"):
        add_second_view(front, bare, calibration(offset=1), overwrite=True)


def test_captures_of_videos_need_a_calibration(pair: Pair) -> None:
    """Also where the second camera is so near that its own hands lie on those of the first."""
    front, _ = pair()
    with pytest.raises(UsageError, match="--calibration: captures of videos share no world"):
        add_second_view(front, front)
    assert front.free_view is None


def test_cameras_of_different_rates_are_refused(pair: Pair) -> None:
    """Frames are paired by their numbers; every second one is taken here of about 28 a second."""
    front, side = pair()
    times = tuple(1.2 * time for time in side.info.frame_times())
    slow = replace(side, info=replace(side.info, times=times))
    with pytest.raises(UsageError, match=r"side: has 23\.\d+ frames per second, .*front 28\.\d"):
        add_second_view(front, slow, calibration())
    even = replace(side, info=replace(side.info, times=None, fps=14.15))
    add_second_view(front, even, calibration())


def test_a_capture_is_not_its_own_second_camera(pair: Pair, tmp_path: Path) -> None:
    front, side = pair()
    again = imported(tmp_path / "again", front.hands["right"], FIRST, 10)
    infos = [
        replace(one.info, source={**one.info.source, "video": {"sha256": "1" * 64}})
        for one in (front, side)
    ]
    of_one = replace(front, info=infos[0]), replace(side, info=infos[1])
    for two in ((front, again), of_one):
        with pytest.raises(UsageError, match=r"shows the pictures of .*front\. Name a capture of"):
            add_second_view(*two, calibration(offset=0))
    assert front.free_view is None


def text(**changes: str) -> str:
    fields = {
        "schema": '"hwp-two-cameras/1"',
        "first": json.dumps(FIRST.tolist()),
        "second": json.dumps(SECOND.tolist()),
        "motion": json.dumps(motion().tolist()),
        "offset": "3",
    }
    return "\n".join(f"{name} = {value}" for name, value in {**fields, **changes}.items() if value)


def test_a_calibration_is_read_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "cameras.toml"
    path.write_text(text())
    found = read_calibration(path)
    assert (np.array(found.motion) == motion()).all()
    assert found.offset == 3
    for field, value, said in (
        ("first", "[[1.0, 0.0], [0.0], [0.0]]", "has rows of several lengths"),
        ("second", "[[0, 0, 1], [0, 1, 1], [0, 0, 1]]", "has a focal length"),
        ("motion", "[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "has a rotation"),
        ("motion", "[[1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "has rows of several"),
        ("motion", "[[1], [0], [0], [0]]", "has shape"),
        ("motion", "", ""),
        ("schema", '"hwp-two-cameras/2"', ""),
        ("offset", "0.5", ""),
    ):
        path.write_text(text(**{field: value}))
        with pytest.raises(BadInput, match=f"{field}: {said}"):
            read_calibration(path)
    with pytest.raises(BadInput, match="cannot be read"):
        read_calibration(tmp_path / "none.toml")
    path.write_text(text() + "\n" * MAX_BYTES)
    with pytest.raises(BadInput, match=f"more than the {MAX_BYTES} bytes"):
        read_calibration(path)


def test_another_camera_of_interhand_becomes_the_clip(tmp_path: Path, capsys) -> None:
    mano = write_mirrored_mano(tmp_path / "mano")
    hands = {side: load_template(f"mano:{mano}", side) for side in ("right", "left")}
    angles, truth = {"400015": 0.3, "400016": -0.5}, {}
    for cam, angle in angles.items():
        truth = write_interhand(tmp_path / cam / "InterHand2.6M", hands, cam=cam, angle=angle)
        words = ["data", "import", "interhand26m", str(tmp_path / cam / "InterHand2.6M")]
        sequence = f"Capture21/0390_dh_touchROM/cam{cam}"
        words += [sequence, "--mano", str(mano), "--size", "96", "-o", str(tmp_path / f"c{cam}")]
        assert main(words) == 0
    capsys.readouterr()
    places = [str(tmp_path / f"c{cam}") for cam in angles]
    assert main(["data", "import", "second-view", *places, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    # The left hand is missing from one of the twelve frames.
    assert facts["frames"] == facts["second_frames"] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    assert facts["distance_px"] < 0.01
    clip = open_capture(tmp_path / "c400015").free_view
    assert clip is not None
    other = open_capture(tmp_path / "c400016")
    assert (clip.frame(4) == other.frame(5)).all()
    # The camera is the one that the data set has, to the six digits of its rotation.
    rotation, position = interhand_camera(angles["400016"])
    assert np.abs(clip.cameras.viewmats[:, :3, :3] - rotation).max() < 1e-5
    centre = -np.einsum(
        "fji,fj->fi", clip.cameras.viewmats[:, :3, :3], clip.cameras.viewmats[:, :3, 3]
    )
    assert np.abs(1e3 * centre - position).max() < 1e-6
    # The first camera's hands lie where the second one's pictures show the true hands.
    K, scale = clip.cameras.Ks[4], clip.cameras.Ks[4, 0, 0] / 1270.0
    for side, hand in clip.hands.items():
        model = load_template(clip.info.hand_model.source, side)
        points = pose_parameters(model, hand).vertices.numpy()[4]
        local = points @ clip.cameras.viewmats[4, :3, :3].T + clip.cameras.viewmats[4, :3, 3]
        found = (local @ K.T)[:, :2] / local[:, 2:]
        expected = (interhand_project(truth[side][5], -0.5) - (170.0, 250.0)) * scale + K[:2, 2]
        assert np.abs(found - expected).max() < 0.1
    assert main(["data", "import", "second-view", *places]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["data", "import", "second-view", *places, "--overwrite"]) == 0
    assert "from where the second camera saw them" in capsys.readouterr().out
