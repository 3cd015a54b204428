"""The verdict of a fit. Oracle: a hand whose palm, or back, is all that its cameras see."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_captures import free_hand
from synthetic_clip import FOCAL, HEIGHT, WIDTH, make_clip
from tiny_fits import UNJUDGED

import wildghand
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, open_capture
from wildghand.from_video.verdict import judge_avatar, parts_of, read_verdict
from wildghand.poses.believe import ClipPoses

FRAMES, EDGE = 30, 80
#: A camera on the other side of the hand, which is 0.42 m away.
BEHIND = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0.84], [0, 0, 0, 1]])
#: What an import would have taken down.
FIT = {"reprojection_px": {"mean": 3.25}, "frames_valid": FRAMES, "frames_detected": FRAMES}


def film(place: Path, behind: Sequence[bool], side: str = "right", fit: Any = FIT) -> Capture:
    """A capture whose frames show the palm, or from `behind` the back; every pixel is hand."""
    frames = len(behind)
    clip, scale = make_clip(frames, side=side, bend=0.2), EDGE / HEIGHT
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1 / scale]]) * scale
    K[0, 2] = K[1, 2] = EDGE / 2
    info = CaptureInfo(
        id="filmed", hands=side, action="turning", device="none", fps=30.0, width=EDGE,
        height=EDGE, frame_count=frames, hand_model=free_hand(side), perturbations={},
        source={"kind": "test", "fit": fit}, licence="CC0",
    )  # fmt: skip
    viewmats = np.stack([BEHIND if turned else np.eye(4) for turned in behind])
    cameras = Cameras(np.tile(K, (frames, 1, 1)), viewmats)
    with CaptureWriter(place, info, {side: clip.hand}, cameras) as writer:
        for frame in range(frames):
            writer.frame(frame, np.full((EDGE, EDGE, 3), 90 + frame, np.uint8))
            writer.mask(frame, np.full((EDGE, EDGE), 255, np.uint8))
    return open_capture(place)


@pytest.mark.parametrize(
    ("side", "behind", "missing"),
    [
        ("right", [False] * FRAMES, "the back was never seen: turn the hand over for three"),
        ("left", [True] * FRAMES, "the palm was never seen: show the palm to the camera for three"),
        ("right", [f % 2 == 0 for f in range(FRAMES)], None),
    ],
)  # fmt: skip
def test_what_was_not_seen_is_to_be_filmed(
    tmp_path: Path, side: str, behind: list[bool], missing: str | None
) -> None:
    capture = film(tmp_path / "capture", behind, side)
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=2, all_frames=True)
    verdict = judge_avatar(avatar, capture)
    parts = verdict.parts_seen[side]
    shown = {"palm": not all(behind), "back": any(behind)}
    for name, there in shown.items():
        assert (parts[name] > 0.8) if there else (parts[name] < 0.1), parts
    if missing is None:
        assert verdict.surface_seen[side] > 0.8
        assert verdict.film_next == []
        assert verdict.lines()[1] == "film next: nothing is missing: all sides were seen"
    else:
        assert 0.3 < verdict.surface_seen[side] < 0.7
        assert verdict.film_next[0].startswith(missing)
    assert verdict.pose_error_px == {side: 3.25}
    assert verdict.psnr_of == "fitted"


def test_frames_that_were_kept_out_are_scored(tmp_path: Path) -> None:
    """Oracle: the mean square error by hand; every pixel but those at the border is scored."""
    lost = {**FIT, "frames_valid": 25}
    capture = film(tmp_path / "capture", [False] * FRAMES, fit=lost)
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=2)
    verdict = judge_avatar(avatar, capture)
    assert (verdict.psnr_of, verdict.psnr_frames) == ("kept out", 3)
    found = []
    for frame in (27, 28, 29):
        drawn = avatar.render(capture.hand_poses(frame), capture.camera(frame))[..., :3]
        error = np.rint(255 * drawn.clip(0, 1)) - capture.frame(frame)
        found.append(-10 * np.log10(np.square(error[2:-2, 2:-2] / 255).mean()))
    assert verdict.psnr == pytest.approx(np.mean(found), abs=0.3)
    assert "5 of 30 frames could not be followed: move the hand more slowly" in verdict.film_next
    said = verdict.lines()[0]
    assert f"{verdict.surface_seen['right']:.0%} of the surface seen" in said
    assert "poses 3.2 px from the tracked landmarks" in said
    assert f"{verdict.psnr:.1f} dB on 3 kept out frames" in said
    (tmp_path / "verdict.json").write_text(json.dumps(asdict(verdict)))
    assert read_verdict(tmp_path / "verdict.json") == verdict


def test_a_fit_of_all_frames_is_tested_with_the_last_twentieth(tmp_path: Path) -> None:
    capture = film(tmp_path / "capture", [False] * 60)
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=2, all_frames=True)
    # One stands for validation, which has too few frames to choose by.
    assert avatar.record.frames == list(range(56))
    verdict = judge_avatar(avatar, capture)
    assert (verdict.psnr_of, verdict.psnr_frames) == ("kept out", 3)


def test_the_surface_is_counted_in_the_corrected_poses(tmp_path: Path) -> None:
    """Oracle: hands that are turned by 180 degrees about their fingers show the back."""
    capture = film(tmp_path / "capture", [False] * FRAMES)
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=2)
    pose = capture.hands["right"].pose.copy()
    over = Rotation.from_rotvec(pose[:, 0]) * Rotation.from_rotvec([np.pi, 0.0, 0.0])
    pose[:, 0] = over.as_rotvec()
    turned = {"right": dataclasses.replace(capture.hands["right"], pose=pose)}
    avatar.model.clip_poses = ClipPoses.of(capture.hands, turned)
    seen = judge_avatar(avatar, capture).parts_seen["right"]
    assert seen["palm"] < 0.1, seen
    assert seen["back"] > 0.8, seen


@pytest.mark.parametrize("side", ["right", "left"])
def test_parts_lie_where_they_are_named(tmp_path: Path, side: str) -> None:
    """Oracle: at rest the palm looks along -y, fingers along -x (a left hand's along x)."""
    capture = film(tmp_path / "capture", [False] * FRAMES, side)
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=1, all_frames=True)
    rig = avatar.model.rigs[side]
    parts = parts_of(rig, side)
    assert not (parts["palm"] & parts["back"]).any()
    assert not (parts["thumb side"] & parts["little finger side"]).any()
    assert np.any(list(parts.values()), axis=0).mean() > 0.9
    places = rig.template.vertices.numpy()[rig.template.faces.numpy()].mean(axis=1)
    middle = {
        name: places[rig.anchors.face_index[part]].mean(axis=0) for name, part in parts.items()
    }
    assert middle["palm"][1] < middle["back"][1] - 0.005
    thumb = rig.template.joints.numpy()[13:16].mean(axis=0)
    little = rig.template.joints.numpy()[7:10].mean(axis=0)
    way = thumb - little
    assert (middle["thumb side"] - middle["little finger side"]) @ way > 0
