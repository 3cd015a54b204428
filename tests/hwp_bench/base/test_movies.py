"""Videos that browsers play. Oracles: OpenCV's and PyAV's decoders, Chromium's player."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import open_page

from hwp_bench.base.errors import HwpError, MissingDependency, ShapeMismatch
from hwp_bench.base.images import check_encoder, write_movie

FPS = 24
#: Flat colours of a hand, a wall and a sleeve, sRGB.
COLOURS = ((205, 150, 120), (40, 60, 140), (20, 20, 20))


def clip(frames: int = 10, height: int = 96, width: int = 128) -> list[np.ndarray]:
    """A bar in one colour that moves over another; its place tells the frames apart."""
    made = []
    for frame in range(frames):
        image = np.full((height, width, 3), COLOURS[1], np.uint8)
        image[height // 2 :] = COLOURS[2]
        image[: height // 2, 8 * frame : 8 * frame + 24] = COLOURS[0]
        made.append(image)
    return made


def decoded(path: Path) -> list[np.ndarray]:
    capture, found = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        found.append(read[1][:, :, ::-1])
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(FPS)
    return found


@pytest.mark.parametrize("size", [(96, 128), (95, 127)])
def test_it_is_h264_and_shows_the_frames_in_order(size: tuple[int, int], tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    frames = clip(10, *size)
    path = write_movie(tmp_path / "a" / "clip.mp4", iter(frames), FPS)
    assert [one.name for one in path.parent.iterdir()] == ["clip.mp4"]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert container.format.name.split(",")[1] == "mp4"
    # Its index goes before its frames, so that it plays while it loads.
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")
    shown = decoded(path)
    assert len(shown) == len(frames)
    for image, truth in zip(shown, frames, strict=True):
        height, width = truth.shape[:2]
        assert image.shape[:2] == (height + height % 2, width + width % 2)
        # Colours are kept at half the resolution: edges of the bar blur by a pixel or two.
        error = np.abs(image[:height, :width].astype(int) - truth)
        assert np.median(error) <= 4
        assert error.mean() <= 6


def test_what_cannot_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mixed = [*clip(2), np.zeros((8, 8, 3), np.uint8)]
    for frames in ([], mixed, [np.zeros((8, 8, 3))]):
        with pytest.raises(ShapeMismatch):
            write_movie(tmp_path / "clip.mp4", frames, FPS)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(HwpError, match="cannot be written"):
        write_movie(tmp_path / "file" / "clip.mp4", clip(1), FPS)
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingDependency, match="pip install av"):
        check_encoder()


PAGE = """<!doctype html><meta charset=utf-8><title>clip</title>
<link rel=icon href="data:,"><video src="clip.mp4" muted></video>"""
#: Plays the clip to its middle and returns the video's state and the colour of three pixels.
PLAY = """
const done = arguments[0], video = document.querySelector("video");
video.addEventListener("error", () => done({error: video.error.message}));
video.addEventListener("seeked", () => {
  const canvas = document.createElement("canvas");
  canvas.width = video.videoWidth; canvas.height = video.videoHeight;
  const pen = canvas.getContext("2d");
  pen.drawImage(video, 0, 0);
  const at = (x, y) => [...pen.getImageData(x, y, 1, 1).data].slice(0, 3);
  done({size: [video.videoWidth, video.videoHeight], seconds: video.duration,
        colours: [at(8 * 5 + 12, 20), at(8 * 5 - 12, 20), at(40, 80)]});
});
video.currentTime = 5.5 / 24;
"""


@pytest.mark.slow
def test_chromium_plays_it(tmp_path: Path) -> None:
    """A page from a file may not read its pixels, so the clip is within the page."""
    import base64

    path = write_movie(tmp_path / "clip.mp4", clip(), FPS)
    inside = "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()
    page = tmp_path / "page.html"
    page.write_text(PAGE.replace("clip.mp4", inside))
    with open_page(page, tmp_path / "profile") as driver:
        can = "return document.createElement('video').canPlayType(arguments[0])"
        if not driver.execute_script(can, 'video/mp4; codecs="avc1.64000a"'):
            pytest.skip("this build of Chromium has no H.264")
        shown = driver.execute_async_script(PLAY)
    assert "error" not in shown, shown
    assert shown["size"] == [128, 96]
    assert shown["seconds"] == pytest.approx(10 / FPS, abs=0.01)
    # The browser reads the marks of the colour space; 4:2:0 and the quantizer cost some levels.
    np.testing.assert_allclose(shown["colours"], COLOURS, atol=6)
