"""Videos of two hands. Oracle: simulated hands with known parameters that hide each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from small_captures import CaptureMaker
from synthetic_clip import FOCAL, FPS, HEIGHT, WIDTH, landmark_import, make_clip, write_landmarks
from two_hand_clip import TwoHandClip, make_two_hands, write_two_hands

from hwp_bench.base.errors import BadCapture, BadInput
from hwp_bench.capture import identify_hand_model, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main
from hwp_bench.hands.raster import overlap
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.shared.landmarks import read_landmarks
from hwp_bench.importers.video import (
    FrameRange,
    ImportedClip,
    SolveSettings,
    VideoImport,
    import_video,
)
from hwp_bench.importers.video.glimpse import PaintedHand, paint_hand
from hwp_bench.importers.video.solve import Footage, fit_landmarks, share_camera
from hwp_bench.importers.video.source import read_source
from hwp_bench.results import read_results

FRAMES, SWAPS, GAP = 16, (4, 9, 13), range(7, 9)
QUICK = SolveSettings(
    start_steps=60,
    landmark_steps=90,
    contour_steps=20,
    contour_rounds=1,
    texture=False,
    picture_rounds=2,
)


@pytest.fixture(scope="module")
def clip() -> TwoHandClip:
    return make_two_hands(FRAMES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, clip: TwoHandClip) -> Path:
    folder = tmp_path_factory.mktemp("two")
    write_two_hands(folder, clip, SWAPS, GAP)
    return folder


@pytest.fixture(scope="module")
def imported(folder: Path) -> ImportedClip:
    options = VideoImport(size=128, fit=QUICK, focal=FOCAL)
    return import_video(folder / "hands.avi", folder / "hands.npz", folder / "capture", options)


def test_swaps_are_repaired_before_the_fit(folder: Path, clip: TwoHandClip) -> None:
    for side, hand in clip.hands.items():
        landmarks = read_landmarks(folder / "hands.npz", min_score=0.5, side=side)
        apart = np.linalg.norm(landmarks.image - hand.landmarks.image, axis=-1).mean(axis=1)
        # Noise of 1 px in both directions; the hands are 35 px apart and more.
        assert apart[landmarks.detected].max() < 2.5
        missed = GAP if side == "left" else ()
        np.testing.assert_array_equal(np.flatnonzero(~landmarks.detected), list(missed))


@pytest.mark.slow
def test_both_hands_lie_on_the_true_ones(imported: ImportedClip, clip: TwoHandClip) -> None:
    assert imported.facts()["swaps_repaired"] == len(SWAPS)
    assert imported.shown == "both"
    for side, true in clip.hands.items():
        hand = imported.hands[side]
        posed = pose_parameters(true.template, hand.parameters)
        joints = posed.landmarks.numpy()
        middle = np.array([WIDTH / 2, HEIGHT / 2])
        pixels = joints[..., :2] / joints[..., 2:] * FOCAL + middle
        error = np.linalg.norm(pixels - true.landmarks.image, axis=-1).mean(axis=1)
        centred = joints - joints[:, :1] - (true.joints - true.joints[:, :1])
        millimetres = 1e3 * np.linalg.norm(centred, axis=-1).mean()
        depth = 1e3 * np.abs(joints[:, 0, 2] - true.joints[:, 0, 2]).mean()
        print(f"{side}: {error.mean():.2f} px, {millimetres:.1f} mm, wrist depth {depth:.0f} mm")
        # The tracker errs by 1.25 px and 4.8 mm on average.
        assert error.mean() < 2.0
        assert error.max() < 5.0
        assert millimetres < 6.0
        # Scale comes from the landmarks in space, within 5 %: 21 mm at 0.42 m.
        assert depth < 25.0
        valid = np.ones(FRAMES, dtype=bool)
        if side == "left":
            valid[list(GAP)] = False
        np.testing.assert_array_equal(hand.parameters.valid, valid)


@pytest.mark.slow
def test_one_capture_with_one_camera_holds_both(imported: ImportedClip, folder: Path) -> None:
    assert check_capture(folder / "capture").ok
    capture = open_capture(folder / "capture")
    assert capture.info.hands == "both"
    assert sorted(capture.hands) == ["left", "right"]
    assert capture.cameras.Ks.shape == (FRAMES, 3, 3)
    facts = capture.info.source["fit"]
    assert facts["swaps_repaired"] == len(SWAPS)
    assert facts["hands"]["left"]["frames_detected"] == FRAMES - len(GAP)


@pytest.mark.slow
def test_masks_are_of_both_hands(imported: ImportedClip, folder: Path, clip: TwoHandClip) -> None:
    capture = open_capture(folder / "capture")
    crop = capture.info.source["crop"]
    scale = 128 / crop["side"]
    for frame in range(0, FRAMES, 3):
        true = np.maximum(clip.right.silhouette(frame), clip.left.silhouette(frame))
        x, y = np.array(crop["corners"][frame]) * scale
        matrix = np.array([[scale, 0, 0.5 * scale - 0.5 - x], [0, scale, 0.5 * scale - 0.5 - y]])
        warped = cv2.warpAffine(true, matrix, (128, 128)) > 127
        assert overlap(capture.mask(frame) > 127, warped) > 0.88


def test_each_hand_is_shown_in_frames_that_it_is_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def paint(clip: Any, images: np.ndarray, detected: np.ndarray) -> PaintedHand:
        asked.append(int(detected.sum()))
        return paint_hand(clip, images, detected)

    monkeypatch.setattr("hwp_bench.importers.video.api.paint_hand", paint)
    video, landmarks = write_two_hands(tmp_path, make_two_hands(FRAMES), (), range(4, 12))
    options = VideoImport(size=64, fit=landmark_import(30, outline_steps=3), focal=FOCAL)
    import_video(video, landmarks, tmp_path / "out", options, glimpse=lambda hands: None)
    assert set(asked) == {FRAMES, FRAMES - 8}


def test_two_hands_get_one_focal_length(clip: TwoHandClip) -> None:
    """Oracle: the mean of both; with no step after it, no joint moves in the image."""
    footage, few = Footage(WIDTH, HEIGHT, FPS, None), SolveSettings(start_steps=3, landmark_steps=3)
    fits = [
        fit_landmarks(hand.landmarks, hand.template, footage, few) for hand in clip.hands.values()
    ]
    with torch.no_grad():
        fits[0].model.variables.log_focal.add_(0.1)
        before = [fit.model.pose().landmarks[:, 0] for fit in fits]
        wrists = [fit.model.pixels(wrist) for fit, wrist in zip(fits, before, strict=True)]
    logs = [float(fit.model.variables.log_focal.detach()) for fit in fits]
    share_camera(fits, steps=0)
    for fit, wrist in zip(fits, wrists, strict=True):
        assert float(fit.model.variables.log_focal.detach()) == pytest.approx(np.mean(logs), 1e-5)
        with torch.no_grad():
            moved = fit.model.pixels(fit.model.pose().landmarks[:, 0]) - wrist
        # The tracker's offset of the wrist is not on the ray of its joint.
        assert moved.abs().max() < 0.1


@pytest.mark.slow
def test_whichever_hand_is_seen_most_a_method_takes_the_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From video to scored table, one hand or two, of which the left or the right is seen most."""
    # The tracks say the sides; fits to both sides of each only warn.
    monkeypatch.setattr("hwp_bench.importers.video.solve._SIDE_STEPS", 4)
    frames, options = 10, VideoImport(size=32, fit=landmark_import(12, 2), focal=FOCAL)
    made = []
    for most, other in (("left", "right"), ("right", "left")):
        folder = tmp_path / most
        folder.mkdir()
        clip = make_two_hands(frames, nearest=0.08)
        write_two_hands(folder, clip, (), range(4, 8), lost=other)
        for side in ("auto", most) if most == "left" else ("auto",):
            out = folder / side
            chosen = replace(options, side=side, id=f"{most}-{side}")
            imported = import_video(folder / "hands.avi", folder / "hands.npz", out, chosen)
            assert next(iter(imported.hands)) == most
            assert open_capture(out).info.hands == ("both" if side == "auto" else most)
            report = check_capture(out)
            assert report.ok, report.findings
            assert not [one for one in report.findings if one.field == "hand_model.digest"]
            made.append(str(out))
    words = ["evaluate", "baselines/plain", "--capture", *made, "--steps", "2"]
    assert main([*words, "-o", str(tmp_path / "results"), "--isolation", "none"]) == 0
    results = read_results(tmp_path / "results")
    assert [capture.failure for capture in results.captures] == [None] * 3
    assert all(capture.frames for capture in results.captures)
    assert main(["table", str(tmp_path / "results")]) == 0


@pytest.mark.parametrize(
    ("hands", "other"), [("both", "left"), ("right", "left"), ("left", "right")]
)
def test_a_digest_of_the_other_hand_is_named(
    make_capture: CaptureMaker, capsys: pytest.CaptureFixture[str], hands: str, other: str
) -> None:
    capture = make_capture(hands=hands, frames=10)
    file = capture.root / "capture.json"
    digests = [identify_hand_model("anny", one).digest for one in (hands, other)]
    file.write_text(file.read_text().replace(*digests))
    assert main(["data", "check", str(capture.root)]) == 1
    said = capsys.readouterr().out
    assert f"{capture.root}: NOT SOUND\n" in said
    assert f"hand_model.digest: is the digest of the {other} hand of anny-1" in said
    first = "right" if hands == "both" else hands
    with pytest.raises(
        BadCapture, match=f"capture's first hand is the {first} one.* write"
    ) as caught:
        open_capture(capture.root).template(first)
    assert digests[0] in str(caught.value)


def test_one_of_two_hands_can_be_chosen(folder: Path) -> None:
    few = VideoImport(frames=FrameRange(0, 6))
    both = read_source(folder / "hands.avi", folder / "hands.npz", few)
    assert list(both.hands) == ["right", "left"]
    chosen = replace(few, side="left")
    left = read_source(folder / "hands.avi", folder / "hands.npz", chosen)
    assert list(left.hands) == ["left"]
    assert left.windows.side < both.windows.side


def test_both_hands_of_landmarks_of_one_hand_are_refused(folder: Path, tmp_path: Path) -> None:
    one = write_landmarks(tmp_path / "one.npz", make_clip(FRAMES).landmarks)
    with pytest.raises(BadInput, match="has landmarks of one hand"):
        read_source(folder / "hands.avi", one, VideoImport(side="both"))
