"""Landmarks of another convention. Oracle: a drawn video, and landmarks changed on purpose."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from encoded_video import write_pictures
from synthetic_clip import (
    HEIGHT,
    WIDTH,
    SyntheticClip,
    landmark_import,
    make_clip,
    write_landmarks,
    write_video,
)

from hwp_bench.base.errors import BadInput
from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main
from hwp_bench.importers.shared.landmarks import HandTracks, write_hand_tracks
from hwp_bench.importers.video import VideoImport, decode, import_video
from hwp_bench.importers.video import api as pipeline
from hwp_bench.importers.video.api import drop_blank_frames
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames, read_times
from hwp_bench.importers.video.source import (
    VideoSource,
    landmark_doubts,
    read_source,
    refuse_other_units,
)

FRAMES = 24
#: A fit without outlines, textures and pictures.
FIT = landmark_import(40, outline_steps=1)
#: Our joints in the order of MANO's model and its tips, and of InterHand2.6M's annotations.
MANO = [0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20]
INTERHAND = [4, 3, 2, 1, 8, 7, 6, 5, 12, 11, 10, 9, 16, 15, 14, 13, 20, 19, 18, 17, 0]
#: What a person gets wrong: what becomes of `image` and `world`, and what is to be said of it.
WRONG: dict[str, tuple[Any, Any, str]] = {
    "exchanged": (lambda i: i[..., ::-1], lambda w: w, "x and y of `image` are exchanged"),
    "both exchanged": (
        lambda i: i[..., ::-1],
        lambda w: w[..., [1, 0, 2]],
        "x and y of `image` are exchanged",
    ),
    "from below": (lambda i: i * (1, -1) + (0, HEIGHT), lambda w: w, "y of `image` points up"),
    "MANO": (
        lambda i: i[:, MANO],
        lambda w: w[:, MANO],
        "the joints of `image` and `world` are in MANO's order, not in MediaPipe's",
    ),
    "InterHand": (
        lambda i: i,
        lambda w: w[:, INTERHAND],
        "the joints of `world` are in InterHand2.6M's order, not in MediaPipe's",
    ),
    "world up": (lambda i: i, lambda w: w * (1, -1, -1), "y of `world` points up"),
    "world mirrored": (lambda i: i, lambda w: w * (-1, 1, 1), "`world` is mirrored"),
    "mirrored": (
        lambda i: i * (-1, 1) + (WIDTH, 0),
        lambda w: w * (-1, 1, 1),
        "`image` is mirrored",
    ),
    "half": (lambda i: 0.5 * i, lambda w: w, "`image` is of a video of half this size"),
    "late": (
        lambda i: np.concatenate([i[:1]] * 3 + [i[:-3]]),
        lambda w: np.concatenate([w[:1]] * 3 + [w[:-3]]),
        "the landmarks come about 3 frames too late",
    ),
}


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return make_clip(FRAMES)


@pytest.fixture(scope="module")
def source(clip: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> VideoSource:
    folder = tmp_path_factory.mktemp("wrong")
    video = write_video(folder / "hand.avi", [clip.picture(frame) for frame in range(FRAMES)])
    return read_source(video, write_landmarks(folder / "hand.npz", clip.landmarks), VideoImport())


def changed(source: VideoSource, name: str) -> VideoSource:
    image, world, _ = WRONG[name]
    hand = source.landmarks
    wrong = replace(hand, image=image(hand.image), world=world(hand.world))
    return replace(source, hands={"right": wrong})


def test_nothing_is_said_of_right_ones(source: VideoSource) -> None:
    assert landmark_doubts(source) == ()
    refuse_other_units(source)


@pytest.mark.parametrize("name", WRONG)
def test_the_likely_convention_is_named(source: VideoSource, name: str) -> None:
    assert landmark_doubts(changed(source, name)) == (WRONG[name][2],)


def test_landmarks_of_different_frames_are_told(source: VideoSource) -> None:
    random = np.random.default_rng(0)
    turns = np.linalg.qr(random.normal(size=(FRAMES, 3, 3)))[0]
    hand = replace(source.landmarks, world=source.landmarks.world @ turns)
    said = landmark_doubts(replace(source, hands={"right": hand}))
    assert said == ("`image` and `world` do not show the same hand in the same frames",)


def test_only_frames_that_are_looked_at_are_converted(
    source: VideoSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest, converted = decode.to_srgb, []

    def count(*given: Any, **more: Any) -> np.ndarray:
        converted.append(1)
        return honest(*given, **more)

    monkeypatch.setattr(decode, "to_srgb", count)
    assert landmark_doubts(source) == ()
    assert 0 < len(converted) <= 12 < FRAMES


@pytest.mark.parametrize("less", [1, 4])
def test_a_stride_hides_no_missing_frame(clip: SyntheticClip, tmp_path: Path, less: int) -> None:
    count = FRAMES // 2 * 2  # even: one row less selects as many
    video = write_video(tmp_path / "a.avi", [clip.picture(frame) for frame in range(count)])
    few = write_landmarks(tmp_path / "a.npz", clip.landmarks.select(np.arange(count - less)))
    with pytest.raises(BadInput, match=f"has {count - less} frames, the video has {count}"):
        read_source(video, few, VideoImport(frames=FrameRange(stride=2)))


def test_a_hand_in_black_frames_alone_is_left_out(source: VideoSource) -> None:
    frames = source.images.frames.copy()
    frames[:3] = 0
    hand = source.hands["right"]
    shown = np.arange(len(hand.detected)) < 3
    hands = {"right": hand, "left": replace(hand, detected=shown)}
    images = replace(source.images, frames=frames)
    assert list(drop_blank_frames(replace(source, images=images, hands=hands)).hands) == ["right"]
    alone = replace(source, images=images, hands={"left": hands["left"]})
    with pytest.raises(BadInput, match="in frames of one colour only"):
        drop_blank_frames(alone)


def test_a_part_of_a_video_that_is_cut_off_is_imported(clip: SyntheticClip, tmp_path: Path) -> None:
    """Its frames are fewer than its packets and its header say. Oracle: decoding them."""
    images = [clip.picture(frame) for frame in range(FRAMES)]
    whole = write_pictures(
        tmp_path / "whole.mp4", images, container_options={"movflags": "faststart"}
    )
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: int(0.7 * whole.stat().st_size)])
    info, stamps = probe(cut), read_times(cut)
    count = sum(1 for _ in read_frames(info, FrameRange()))
    assert stamps is not None
    assert 10 < count == len(stamps) < info.stated_frames
    options = VideoImport(frames=FrameRange(2, 9))
    tracked = write_landmarks(tmp_path / "a.npz", clip.landmarks.select(np.arange(count)))
    source = read_source(cut, tracked, options)
    assert source.indices.tolist() == list(range(2, 9))
    assert source.images.frames.any(axis=(1, 2, 3)).all()
    other = write_landmarks(tmp_path / "b.npz", clip.landmarks.select(np.arange(count - 1)))
    with pytest.raises(BadInput, match=f"has {count - 1} frames, the video has {count}"):
        read_source(cut, other, options)


@pytest.mark.parametrize("moved", [0.0, 0.5])
def test_normalised_landmarks_are_no_metres(source: VideoSource, moved: float) -> None:
    hand = source.landmarks
    flat = np.concatenate([hand.image / (WIDTH, HEIGHT) - moved, hand.world[..., 2:]], axis=-1)
    wrong = replace(source, hands={"right": replace(hand, world=flat)})
    with pytest.raises(BadInput, match="world: holds `image` divided by the image's size"):
        refuse_other_units(wrong)


def test_tracks_of_another_size_are_refused(source: VideoSource, tmp_path: Path) -> None:
    hand = source.landmarks
    image = np.concatenate([hand.image, hand.image[..., :1]], axis=-1)[None].astype(np.float32)
    ones = np.ones((1, FRAMES), np.float32)
    world = hand.world[None].astype(np.float32)
    tracks = HandTracks(image, world, ones, ones, ones.astype(np.int32), (640, 480))
    path = write_hand_tracks(tmp_path / "hands.npz", tracks)
    with pytest.raises(BadInput, match="was tracked at 640x480, the video is 320x240"):
        refuse_other_units(replace(source, landmarks_path=path))


def test_nothing_fitted_is_an_error_with_its_reason(
    source: VideoSource,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wrong = write_landmarks(tmp_path / "x.npz", changed(source, "MANO").landmarks)
    monkeypatch.setattr(pipeline, "VideoImport", lambda **more: VideoImport(fit=FIT, **more))
    monkeypatch.setattr("hwp_bench.importers.video.VideoImport", pipeline.VideoImport)
    out = tmp_path / "capture"
    words = ["--landmarks", str(wrong), "--side", "right", "-o", str(out)]
    assert main(["data", "import", "video", str(source.video.path), *words]) == 1
    said = capsys.readouterr().err
    assert "no right hand can follow these landmarks" in said
    assert f"it seems that {WRONG['MANO'][2]}" in said
    assert "Landmarks are 21 joints in MediaPipe's order" in said
    assert not out.exists()


def test_a_low_overlap_is_warned_of_in_the_record_and_by_the_check(
    source: VideoSource, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = write_landmarks(tmp_path / "x.npz", changed(source, "half").landmarks)
    options = VideoImport(size=32, fit=FIT, side="right")
    clip = import_video(source.video.path, wrong, tmp_path / "capture", options)
    assert clip.warnings[0] == WRONG["half"][2]
    said = capsys.readouterr().err
    assert "x.npz: it seems that `image` is of a video of half this size" in said
    record = json.loads((tmp_path / "capture" / "extra" / "import.json").read_text())
    assert record["warnings"] == list(clip.warnings)
    report = check_capture(tmp_path / "capture")
    found = [one.problem for one in report.findings if one.field == "source.fit.warnings"]
    assert found == list(clip.warnings)
