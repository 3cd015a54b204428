"""The whole import. Oracle: a video drawn from the hand model with known parameters."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from encoded_video import write_pictures
from synthetic_clip import (
    FOCAL,
    SyntheticClip,
    landmark_import,
    make_clip,
    write_landmarks,
    write_video,
)

from hwp_bench.base.drawing import GAP, LABEL_HEIGHT, outlined
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.images import read_rgb, write_image
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main
from hwp_bench.hands import load_template, project
from hwp_bench.hands.raster import overlap
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.video.api import IMPORTER_VERSION, drop_blank_frames, import_video
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames
from hwp_bench.importers.video.solve import SolveSettings
from hwp_bench.importers.video.source import VideoImport, read_source

FRAMES = 16
QUICK = SolveSettings(
    start_steps=60, landmark_steps=120, contour_steps=30, contour_rounds=1, picture_rounds=1
)
#: The same without texture and pictures, where the fit is not what is asked about.
QUICKER = replace(QUICK, texture=False, picture_rounds=0)
HASTY = replace(QUICKER, landmark_steps=40, contour_steps=5)
REAL = Path(__file__).resolve().parents[5] / "shared" / "data" / "real_hand"


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return make_clip(FRAMES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, clip: SyntheticClip) -> Path:
    """Video, landmarks (frame 5 not seen) and masks."""
    folder = tmp_path_factory.mktemp("video")
    write_video(folder / "hand.avi", [clip.picture(frame) for frame in range(FRAMES)])
    score = np.ones(FRAMES)
    score[5] = 0.0
    write_landmarks(folder / "hand.npz", clip.landmarks, score=score)
    (folder / "masks").mkdir()
    for frame in range(FRAMES):
        write_image(folder / "masks" / f"{frame:06d}.png", clip.silhouette(frame))
    return folder


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    options = VideoImport(size=128, fit=QUICK, focal=FOCAL, licence="CC0")
    import_video(folder / "hand.avi", folder / "hand.npz", folder / "capture", options)
    return open_capture(folder / "capture")


def true_mask(clip: SyntheticClip, capture: Capture, frame: int) -> np.ndarray:
    """The true silhouette in the capture's crop, by an affine warp of the whole frame."""
    crop = capture.info.source["crop"]
    scale = capture.info.width / crop["side"]
    x, y = np.array(crop["corners"][frame]) * scale
    # OpenCV has pixel centres at whole numbers: the half pixel is scaled too.
    matrix = np.array([[scale, 0, 0.5 * scale - 0.5 - x], [0, scale, 0.5 * scale - 0.5 - y]])
    warped = cv2.warpAffine(clip.silhouette(frame), matrix, capture.size[::-1])
    return warped > 127


def test_the_capture_is_sound(capture: Capture, clip: SyntheticClip) -> None:
    assert check_capture(capture.root).ok
    info = capture.info
    assert (info.hands, info.fps, info.frame_count, info.width) == ("right", 30.0, FRAMES, 128)
    assert info.perturbations == {}
    assert info.made_by == f"video {IMPORTER_VERSION}"
    assert check_capture(capture.root).facts["made_by"] == info.made_by
    assert (info.hand_model.name, info.hand_model.digest) == (
        clip.template.name,
        clip.template.digest,
    )
    assert info.source["focal"] == {"px": pytest.approx(FOCAL, rel=1e-5), "from": "user"}
    assert info.source["fit"]["frames_detected"] == FRAMES - 1
    np.testing.assert_array_equal(capture.hands["right"].valid, np.arange(FRAMES) != 5)
    extra = json.loads((capture.root / "extra" / "import.json").read_text())
    assert len(extra.pop("call")) == 64
    assert extra == info.source["fit"]
    shown = read_rgb(capture.root / "extra" / "overlay.png")[GAP + LABEL_HEIGHT :][:128, GAP:]
    np.testing.assert_array_equal(shown[:, :128], outlined(capture.frame(0), capture.mask(0)))
    drawn = (shown[:, 128:256] != capture.frame(0)).any(axis=2)
    assert drawn[capture.mask(0) > 127].mean() > 0.5


def test_times_of_frames_are_kept(folder: Path, clip: SyntheticClip, tmp_path: Path) -> None:
    """A phone's steps reach the capture and the fit; even ones but for rounding are a rate."""
    images = [clip.picture(frame) for frame in range(FRAMES)]
    times = np.cumsum([0, *([33, 33, 67, 35, 33] * 3)])
    write_pictures(tmp_path / "hand.mkv", images, "mjpeg", pix_fmt="yuvj420p", times=times.tolist())
    options = VideoImport(size=128, fit=HASTY, focal=FOCAL, frames=FrameRange(1, 15, 2))
    imported = import_video(tmp_path / "hand.mkv", folder / "hand.npz", tmp_path / "c", options)
    info = open_capture(tmp_path / "c").info
    kept = (times[1:15:2] - times[1]) / 1000
    np.testing.assert_allclose(info.frame_times(), kept, atol=1e-9)
    assert info.fps == pytest.approx(6 / kept[-1])
    assert check_capture(tmp_path / "c").ok
    fitted = imported.first.fitted.landmarks
    np.testing.assert_allclose(fitted.steps, 30 * np.diff(kept))
    even = [round(1000 * frame / 30) for frame in range(FRAMES)]
    write_pictures(tmp_path / "even.mkv", images, "mjpeg", pix_fmt="yuvj420p", times=even)
    source = read_source(tmp_path / "even.mkv", folder / "hand.npz", options)
    assert (source.footage.times, source.footage.fps) == (None, 15.0)
    # Browsers' recordings may state a rate of 1000.
    slow = [100 * frame for frame in range(FRAMES)]
    write_pictures(tmp_path / "slow.mkv", images, "mjpeg", pix_fmt="yuvj420p", times=slow)
    source = read_source(tmp_path / "slow.mkv", folder / "hand.npz", options)
    assert source.footage.times is None
    assert source.footage.fps == pytest.approx(5.0)


def test_the_stored_hand_lies_on_the_true_hand(capture: Capture, clip: SyntheticClip) -> None:
    # Through the capture's own cameras, against the truth moved to the crop: 2 px of 128.
    hand = capture.hands["right"]
    posed = pose_parameters(load_template(), hand)
    cameras = capture.cameras
    pixels, depth = project(
        posed.landmarks, torch.from_numpy(cameras.viewmats), torch.from_numpy(cameras.Ks)
    )
    crop = capture.info.source["crop"]
    truth = (clip.landmarks.image - np.array(crop["corners"])[:, None]) * 128 / crop["side"]
    error = np.linalg.norm(pixels.numpy() - truth, axis=-1)
    assert error.mean() < 2.0
    assert error[5].mean() < 4.0  # the frame that was not seen is bridged
    assert depth.min() > 0.2


def test_masks_cover_the_true_hand(capture: Capture, clip: SyntheticClip) -> None:
    for frame in range(FRAMES):
        found = capture.mask(frame) > 127
        assert overlap(found, true_mask(clip, capture, frame)) > 0.9


def test_frames_are_the_video(capture: Capture, clip: SyntheticClip) -> None:
    crop = capture.info.source["crop"]
    (x, y), side = crop["corners"][3], crop["side"]
    padded = np.pad(clip.picture(3), ((side, side), (side, side), (0, 0)))
    square = padded[y + side : y + 2 * side, x + side : x + 2 * side]
    expected = cv2.resize(square, (128, 128), interpolation=cv2.INTER_AREA)
    # JPEG on noise of 4 levels, averaged.
    assert np.abs(capture.frame(3).astype(float) - expected).mean() < 4


def test_a_video_that_ends_early_is_recorded(
    tmp_path: Path, clip: SyntheticClip, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of a file and the landmarks of its frames: imported, with a warning in the record."""
    images = [clip.picture(frame) for frame in range(FRAMES)]
    whole = write_pictures(tmp_path / "whole.mkv", images, "ffv1", pix_fmt="bgr0")
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    count = len(list(read_frames(probe(cut), FrameRange())))
    assert FRAMES // 2 - 2 <= count <= FRAMES // 2
    arrays = {name: getattr(clip.landmarks, name)[:count] for name in ("image", "world", "score")}
    write_landmarks(tmp_path / "hand.npz", clip.landmarks, **arrays)
    options = VideoImport(size=64, fit=landmark_import(20, 10), focal=FOCAL)
    result = import_video(cut, tmp_path / "hand.npz", tmp_path / "capture", options)
    said = f"ends early, after {count} of {FRAMES} frames: the file is cut off"
    assert f"warning: {cut} {said}" in capsys.readouterr().err
    assert result.facts()["warnings"][0] == f"the video {said}"
    source = open_capture(tmp_path / "capture").info.source
    assert source["fit"]["warnings"][0] == f"the video {said}"
    assert source["video"]["decoded_frames"] == count
    assert source["video"]["stated_frames"] == FRAMES
    assert source["video"]["ends_early"] is True
    assert (source["video"]["codec"], source["video"]["warning"]) == ("ffv1", said)


def test_the_command_prints_the_numbers_and_saves_the_sheet(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SolveSettings, "__init__", lambda self: _set(self, QUICKER))
    sheet = folder / "sheet.png"
    words = ["data", "import", "video", str(folder / "hand.avi"), "-o", str(folder / "by_command")]
    words += ["--landmarks", str(folder / "hand.npz"), "--size", "96", "--range", "6:16"]
    words += ["--stride", "2", "--sheet", str(sheet), "--perturbations", "motion_blur"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "mean reprojection error of the 21 joints of the right hand:" in out
    assert "px at 320x240" in out
    assert "overlap of mesh and mask: 0.9" in out
    assert read_rgb(sheet).shape[0] > 96
    info = open_capture(folder / "by_command").info
    assert (info.id, info.frame_count, info.fps) == ("by_command", 5, 15.0)
    assert info.source["frames"] == [6, 8, 10, 12, 14]
    assert info.perturbations == {"motion_blur": None}
    # Again: it is complete, as after a kill in the last moment. Another call needs --overwrite.
    sheet.unlink()
    assert main(words) == 0
    assert "is complete: the same call has made it" in capsys.readouterr().err
    assert read_rgb(sheet).shape[0] > 96
    # A sheet of another name is of the kind that the name says.
    for name, status in (("late.jpg", 0), ("late.gif", 2)):
        words[words.index("--sheet") + 1] = str(folder / name)
        assert main(words) == status
    assert (folder / "late.jpg").read_bytes()[:3] == b"\xff\xd8\xff"
    assert not (folder / "late.gif").exists()
    words[words.index("--sheet") + 1] = str(sheet)
    assert main([*words, "--min-score", "0.4"]) == 2
    assert "exists already" in capsys.readouterr().err
    monkeypatch.setattr(SolveSettings, "__init__", lambda self: _set(self, HASTY))
    assert main([*words, "--overwrite", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 5


def _set(settings: SolveSettings, values: SolveSettings) -> None:
    settings.__dict__.update(values.__dict__)


def test_own_masks_are_taken(folder: Path, clip: SyntheticClip) -> None:
    options = VideoImport(
        size=96, fit=QUICKER, focal=FOCAL, masks=folder / "masks", frames=FrameRange(0, 9)
    )
    result = import_video(folder / "hand.avi", folder / "hand.npz", folder / "own", options)
    capture = open_capture(folder / "own")
    assert capture.info.source["masks"] == "user"
    for frame in (0, 7):
        assert overlap(capture.mask(frame) > 127, true_mask(clip, capture, frame)) > 0.97
    assert result.masks.overlap[result.source.landmarks.detected].min() > 0.9


BAD_INPUTS = {
    "landmarks of another video": ("hand.npz", {"count": FRAMES - 2}, BadInput, "frames"),
    "no such masks": ("hand.npz", {"masks": "nowhere"}, BadInput, "--masks"),
    "missing masks": ("hand.npz", {"masks": "few"}, BadInput, "13 of 16 frames have no mask: 3"),
    "no such perturbation": ("hand.npz", {"perturbations": ("fog",)}, BadInput, "fog"),
    "bad id": ("hand.npz", {"id": "a/b"}, BadInput, "a/b"),
    "too few frames": ("hand.npz", {"frames": FrameRange(0, 2)}, UsageError, "--range"),
    "hand never seen": ("hand.npz", {"frames": FrameRange(5, 6)}, UsageError, "--range"),
    "beyond the end": ("hand.npz", {"frames": FrameRange(50, 60)}, UsageError, "--range"),
}


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_is_one_clear_error_and_leaves_nothing(
    folder: Path, clip: SyntheticClip, tmp_path: Path, case: str
) -> None:
    name, changes, kind, message = BAD_INPUTS[case]
    changes = dict(changes)
    landmarks = folder / name
    if "count" in changes:
        few = clip.landmarks.select(np.arange(changes.pop("count")))
        landmarks = write_landmarks(tmp_path / "few.npz", few)
    if "masks" in changes:
        changes["masks"] = tmp_path / str(changes["masks"])
    if case == "missing masks":
        for frame in range(3):
            write_image(tmp_path / "few" / f"mask_{frame}.png", clip.silhouette(frame))
    before = set(tmp_path.iterdir())
    with pytest.raises(kind, match=message):
        import_video(
            folder / "hand.avi", landmarks, tmp_path / "out", replace(VideoImport(), **changes)
        )
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--licence", "\x1b[2J"], "--licence: holds a control character"),
        (["--licence", ""], "--licence: must have 1 to 10,000 characters"),
        (["--action", "a\x07"], "--action: holds a control character"),
        (["--device", "\u202eb"], "--device: holds a control character"),
        (["--device", "x" * 10_001], "--device: must have 1 to 10,000 characters"),
        (["--hand-model", "mano:\x1b"], "--hand-model: holds a control character"),
        (["--id", "a\x1bb"], "id: 'a\\x1bb' is not a capture id"),
        (["--perturbations", "\x1b"], "there is no perturbation"),
        (["--sheet", "sheet.xyz"], "--sheet: must end in one of .png"),
        (["--sheet", "."], "--out: lies in the output --sheet"),
        (["--sheet", "out/sheet.png"], "--sheet: lies in the output --out"),
        (["--sheet", "hand.npz/sheet.png"], "--sheet: lies in the input --landmarks"),
    ],
)
def test_arguments_are_checked_before_any_work(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("hwp_bench.importers.video.api.read_source", None)
    given = ["data", "import", "video", "hand.avi", "-o", "out", "--landmarks", "hand.npz"]
    assert main([*given, *words]) in (1, 2)
    said = capsys.readouterr().err
    assert message in said
    assert "\x1b" not in said
    assert not (folder / "out").exists()


def test_black_frames_show_no_hand(
    folder: Path, clip: SyntheticClip, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = [clip.picture(frame) * (frame not in (3, 9)) for frame in range(FRAMES)]
    video = write_video(tmp_path / "hand.avi", pictures)
    source = drop_blank_frames(read_source(video, folder / "hand.npz", VideoImport()))
    assert "no hand is taken from frames of one colour: 3, 9." in capsys.readouterr().err
    np.testing.assert_array_equal(np.flatnonzero(~source.detected), [3, 5, 9])


def test_two_masks_of_a_frame_are_named(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "masks").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "obj2_000012.png").write_bytes((tmp_path / "000012.png").read_bytes())
    said = r"--masks: has two masks of frame 12: 000012\.png and obj2_000012\.png"
    with pytest.raises(BadInput, match=said):
        read_source(folder / "hand.avi", folder / "hand.npz", VideoImport(masks=tmp_path))


def test_a_mask_of_another_size_is_named(folder: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for frame in range(FRAMES):
        write_image(masks / f"{frame}.png", np.zeros((24, 32), dtype=np.uint8))
    with pytest.raises(HwpError, match="32x24 pixels where 320x240"):
        import_video(
            folder / "hand.avi",
            folder / "hand.npz",
            tmp_path / "out",
            VideoImport(masks=masks, fit=QUICK),
        )


@pytest.mark.parametrize(
    ("field", "value"),
    [("side", "neither"), ("focal", 0.0), ("focal", float("nan")), ("size", 8), ("min_score", 2.0)],
)
def test_options_that_make_no_sense_are_refused(field: str, value: object) -> None:
    with pytest.raises(UsageError):
        replace(VideoImport(), **{field: value})


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the study material is not here")
def test_a_part_of_the_real_video(tmp_path: Path) -> None:
    # Frames 590 to 621 open and make a fist, fast; the bound is 8 px at 1280x720.
    options = VideoImport(
        frames=FrameRange(590, 621),
        fit=SolveSettings(start_steps=80, landmark_steps=200, contour_steps=60, picture_rounds=2),
    )
    result = import_video(
        REAL / "human_hand_video.mp4", REAL / "landmarks.npz", tmp_path / "real", options
    )
    assert result.first.error.mean < 5.0
    assert result.first.parameters.valid.all()
    assert result.masks.overlap.mean() > 0.9
    assert result.masks.overlap.mean() > result.overlap_landmarks_only + 0.02
    assert check_capture(tmp_path / "real").ok
