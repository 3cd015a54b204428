"""What is wrong with a video, told before the import. Oracle: a sound drawn video, spoilt."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_clip import HEIGHT, WIDTH, SyntheticClip, make_clip, write_landmarks, write_video

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.skeleton import LANDMARK_EDGES
from hwp_bench.importers.shared.frames import cut, follow_hands, resample
from hwp_bench.importers.video import VideoImport, import_video
from hwp_bench.importers.video.decode import ClipImages
from hwp_bench.importers.video.source import VideoSource, read_source
from hwp_bench.importers.video.usable import find_faults, measure, say_faults

FRAMES = 10
#: A picture and its landmarks (21, 2) px, spoilt in a frame.
Spoil = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return make_clip(FRAMES)


def moved(picture: np.ndarray, points: np.ndarray, matrix: list[list[float]]):
    """Both by an affine map; pixel centres of OpenCV lie half a pixel off."""
    linear, shift = np.array(matrix)[:, :2], np.array(matrix)[:, 2]
    given = np.concatenate([linear, (shift + linear @ [0.5, 0.5] - 0.5)[:, None]], axis=1)
    size, wall = (WIDTH, HEIGHT), cv2.BORDER_REPLICATE
    return cv2.warpAffine(picture, given, size, borderMode=wall), points @ linear.T + shift


def smaller(frame: int, picture: np.ndarray, points: np.ndarray):
    return moved(picture, points, [[0.4, 0.0, 90.0], [0.0, 0.4, 70.0]])


def lifted(frame: int, picture: np.ndarray, points: np.ndarray):
    """Two joints of each finger lie above the frame."""
    shift = 20.0 - np.sort(points[:, 1])[12]
    return moved(picture, points, [[1.0, 0.0, 0.0], [0.0, 1.0, shift - 20.0]])


def jumping(frame: int, picture: np.ndarray, points: np.ndarray):
    """By 80 px, from side to side; the palm is 45 px wide."""
    return moved(picture, points, [[1.0, 0.0, 40.0 - 80.0 * (frame % 2)], [0.0, 1.0, 0.0]])


def brightened(frame: int, picture: np.ndarray, points: np.ndarray):
    return (picture.astype(int) * 2 + 60).clip(0, 255).astype(np.uint8), points


def darkened(frame: int, picture: np.ndarray, points: np.ndarray):
    return picture // 16, points


def drawn_over(frame: int, picture: np.ndarray, points: np.ndarray):
    """As MediaPipe's examples draw what they found."""
    picture, places = picture.copy(), points.astype(int).tolist()
    for first, last in LANDMARK_EDGES:
        cv2.line(picture, places[first], places[last], (0, 255, 0), 2)
    for place in places:
        cv2.circle(picture, place, 3, (255, 0, 0), -1)
    return picture, points


def greyed(frame: int, picture: np.ndarray, points: np.ndarray):
    return np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2), points


def untouched(frame: int, picture: np.ndarray, points: np.ndarray):
    return picture, points


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory, clip: SyntheticClip) -> VideoSource:
    folder = tmp_path_factory.mktemp("sound")
    video = write_video(folder / "hand.avi", [clip.picture(frame) for frame in range(FRAMES)])
    return read_source(video, write_landmarks(folder / "hand.npz", clip.landmarks), VideoImport())


def spoilt(sound: VideoSource, clip: SyntheticClip, spoil: Spoil, frames: int) -> VideoSource:
    """A video whose first frames are spoilt, as the import reads it."""
    pairs = [(clip.picture(frame), clip.landmarks.image[frame]) for frame in range(FRAMES)]
    pairs[:frames] = [spoil(frame, *pair) for frame, pair in enumerate(pairs[:frames])]
    hand = replace(sound.landmarks, image=np.stack([points for _, points in pairs]))
    windows = follow_hands([hand], 30.0, 256)
    images = np.stack(
        [
            resample(cut(picture, corner, windows.side), 256)
            for (picture, _), corner in zip(pairs, windows.corners, strict=True)
        ]
    )
    shown = ClipImages(images, images)
    return replace(sound, hands={"right": hand}, windows=windows, images=shown)


def faults(source: VideoSource, options: VideoImport | None = None):
    found = []
    for side, hand in source.hands.items():
        found += find_faults(source, side, measure(source, hand), options or VideoImport())
    return found


def test_of_a_sound_video_nothing_is_said(
    tmp_path: Path, sound: VideoSource, capsys: pytest.CaptureFixture[str]
) -> None:
    assert faults(sound) == []
    capsys.readouterr()
    say_faults(sound, tmp_path / "capture", VideoImport(strict=True))
    assert capsys.readouterr().err == ""
    assert not list(tmp_path.iterdir())


def test_a_file_of_the_user_next_to_the_capture_stays(
    tmp_path: Path, sound: VideoSource, clip: SyntheticClip
) -> None:
    own = tmp_path / "capture_tracked.jpg"
    own.write_text("mine")
    dark = spoilt(sound, clip, darkened, FRAMES)
    # The sheet of a sound video is none, and the same video has the same sheet again.
    for source in (sound, dark, dark):
        say_faults(source, tmp_path / "capture", VideoImport())
        assert own.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2


def test_the_folder_that_one_is_in_has_a_name(
    tmp_path: Path, sound: VideoSource, clip: SyntheticClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "mine")
    say_faults(spoilt(sound, clip, darkened, FRAMES), ".", VideoImport())
    assert len(list(tmp_path.glob("mine_tracked_*.jpg"))) == 1


SPOILT = [
    (smaller, r"the right hand is 4\d px large in a typical frame, 60 are needed"),
    (lifted, r"the right hand is cut off in {} of 10 frames"),
    (jumping, r"the right hand moves more than its width to the next frame in \d+ of 10 frames"),
    (brightened, r"the right hand is overexposed in {} of 10 frames"),
    (darkened, r"the right hand is underexposed in {} of 10 frames"),
    (drawn_over, r"the right hand has lines drawn over it in {} of 10 frames"),
]


@pytest.mark.parametrize(("spoil", "said"), SPOILT)
def test_what_is_wrong_is_said_with_numbers(
    sound: VideoSource, clip: SyntheticClip, spoil: Spoil, said: str
) -> None:
    """In all frames nothing can come of it."""
    [fault] = faults(spoilt(sound, clip, spoil, FRAMES))
    assert fault.fatal
    assert re.fullmatch(said.format(10), fault.said), fault.said


@pytest.mark.parametrize(("spoil", "said"), SPOILT[1:])
def test_what_is_wrong_in_some_frames_is_a_warning(
    sound: VideoSource, clip: SyntheticClip, spoil: Spoil, said: str
) -> None:
    [fault] = faults(spoilt(sound, clip, spoil, 3))
    assert not fault.fatal
    assert re.fullmatch(said.format(3), fault.said), fault.said


def test_what_may_be_right_is_a_warning(sound: VideoSource, clip: SyntheticClip) -> None:
    [fault] = faults(spoilt(sound, clip, greyed, FRAMES))
    assert "has no colour of skin" in fault.said
    assert not fault.fatal
    seldom = replace(sound.landmarks, detected=np.arange(FRAMES) % 4 == 0)
    [fault] = faults(replace(sound, hands={"right": seldom}))
    assert fault.said == "the right hand is seen in 3 of 10 frames"
    assert not fault.fatal


def test_a_mirrored_video_contradicts_the_side_that_is_stated(sound: VideoSource) -> None:
    left = replace(sound, hands={"left": sound.landmarks}, scores={"left": sound.scores["right"]})
    [fault] = faults(left, VideoImport(side="left"))
    assert "is said to be a left one" in fault.said
    assert "as in a mirrored video" in fault.said
    assert fault.fatal
    # Where nobody stated it, the hand is what the pictures show, or it is a warning.
    assert [fault.fatal for fault in faults(left)] == [False]


def test_one_message_with_a_sheet_comes_before_the_import(
    tmp_path: Path, clip: SyntheticClip, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    """Refused where it is asked for, warned of else; both before any fit."""

    class Begun(Exception):
        pass

    def begin(*given: object) -> None:
        raise Begun

    monkeypatch.setattr("hwp_bench.importers.video.api.fit_video", begin)
    pairs = [
        lifted(frame, clip.picture(frame), clip.landmarks.image[frame]) for frame in range(FRAMES)
    ]
    video = write_video(tmp_path / "hand.avi", [picture // 16 for picture, _ in pairs])
    landmarks = replace(clip.landmarks, image=np.stack([points for _, points in pairs]))
    tracked = write_landmarks(tmp_path / "hand.npz", landmarks)
    with pytest.raises(BadInput) as caught:
        import_video(video, tracked, tmp_path / "capture", VideoImport(strict=True))
    message = str(caught.value)
    assert "cut off in 10 of 10 frames; the right hand is underexposed in 10" in message
    assert "Keep all of the hand in the picture, film with more light" in message
    [sheet] = tmp_path.glob("capture_tracked_*.jpg")
    assert str(sheet) in message
    assert cv2.imread(str(sheet)).shape[1] > 4 * 256
    assert not (tmp_path / "capture").exists()
    capsys.readouterr()
    with pytest.raises(Begun):
        import_video(video, tracked, tmp_path / "capture")
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert "cut off in 10 of 10 frames" in said[0]


@pytest.mark.parametrize(("bad", "fatal"), [(1, []), (2, [False]), (5, [False]), (6, [True])])
@pytest.mark.parametrize(
    ("field", "most", "beyond"),
    [("outside", 2, 3), ("moved", 1.0, 1.01), ("bright", 0.3, 0.31), ("dark", 0.7, 0.71)],
)
def test_faults_begin_where_the_page_says(
    sound: VideoSource, field: str, most: float, beyond: float, bad: int, fatal: list[bool]
) -> None:
    """docs/video.md: more than a tenth of the frames is a warning, more than half too much."""
    values = np.full(FRAMES, float(most))
    values[:bad] = beyond
    given = replace(measure(sound, sound.landmarks), **{field: values})  # type: ignore[arg-type]
    found = find_faults(sound, "right", given, VideoImport())
    assert [fault.fatal for fault in found] == fatal


@pytest.mark.parametrize(("size", "fatal"), [(60.0, []), (59.5, [True])])
def test_a_hand_of_sixty_pixels_is_large_enough(
    sound: VideoSource, size: float, fatal: list[bool]
) -> None:
    given = replace(measure(sound, sound.landmarks), size=np.full(FRAMES, size))
    found = find_faults(sound, "right", given, VideoImport())
    assert [fault.fatal for fault in found] == fatal
