"""Images in and out. Oracle: OpenCV's and Pillow's own readers and writers, exact."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import open_page
from PIL import Image
from scipy import ndimage

from hwp_bench.base import images
from hwp_bench.base.errors import BadImage, HwpError, MissingDependency, ShapeMismatch
from hwp_bench.base.images import (
    as_float,
    as_uint8,
    check_encoder,
    pixel_digest,
    read_gray,
    read_rgb,
    sample,
    write_image,
    write_movie,
)


@pytest.fixture
def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)


def test_opencv_reads_what_is_written_and_the_other_way(tmp_path: Path, picture) -> None:
    path = write_image(tmp_path / "ours.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(path))[:, :, ::-1], picture)
    cv2.imwrite(str(tmp_path / "theirs.png"), picture[:, :, ::-1])
    np.testing.assert_array_equal(read_rgb(tmp_path / "theirs.png", (30, 40)), picture)
    write_image(tmp_path / "mask.png", picture[:, :, 0])
    np.testing.assert_array_equal(read_gray(tmp_path / "mask.png"), picture[:, :, 0])
    assert sorted(item.name for item in tmp_path.iterdir()) == [
        "mask.png",
        "ours.png",
        "theirs.png",
    ]


def test_gray_becomes_rgb_and_alpha_is_dropped(tmp_path: Path, picture) -> None:
    write_image(tmp_path / "gray.png", picture[:, :, 0])
    gray = read_rgb(tmp_path / "gray.png")
    assert all((gray[:, :, c] == picture[:, :, 0]).all() for c in range(3))
    alpha = np.zeros((30, 40, 1), np.uint8)
    write_image(tmp_path / "rgba.png", np.concatenate([picture, alpha], axis=2))
    # Transparent pixels keep their colour: alpha is dropped, not composited.
    np.testing.assert_array_equal(read_rgb(tmp_path / "rgba.png"), picture)


@pytest.mark.parametrize("kind", ["missing", "empty", "text", "truncated", "size", "16-bit"])
def test_bad_images_are_named(tmp_path: Path, picture, kind: str) -> None:
    path = tmp_path / "image.png"
    whole = write_image(tmp_path / "whole.png", picture).read_bytes()
    problem = {
        "missing": "does not exist",
        "empty": "is empty",
        "text": "is not a PNG or JPEG or BMP image",
        "truncated": "is damaged or truncated",
        "size": "40x30 pixels where 32x32 is expected",
        "16-bit": "uint16 samples",
    }[kind]
    if kind == "16-bit":
        cv2.imwrite(str(path), picture.astype(np.uint16) * 256)
    elif kind != "missing":
        content = {"empty": b"", "text": b"no image", "truncated": whole[: len(whole) // 2]}
        path.write_bytes(content.get(kind, whole))
    with pytest.raises(BadImage, match=problem) as caught:
        read_rgb(path, (32, 32) if kind == "size" else (30, 40))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def _chunk(kind: bytes, content: bytes) -> bytes:
    crc = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)


def test_a_header_that_claims_gigabytes_is_refused_before_decoding(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b""))
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts))
    with pytest.raises(BadImage, match=r"above the limit|malicious"):
        read_rgb(path)


def test_what_cannot_be_written_is_one_error(tmp_path: Path, picture) -> None:
    with pytest.raises(ShapeMismatch):
        write_image(tmp_path / "float.png", picture / 255.0)
    with pytest.raises(HwpError, match="not an image format"):
        write_image(tmp_path / "file.nothing", picture)
    assert list(tmp_path.iterdir()) == []


def test_digest_sees_pixels_and_shape_not_compression(picture) -> None:
    assert pixel_digest(picture) == pixel_digest(picture.copy())
    changed = picture.copy()
    changed[3, 4, 1] ^= 1
    assert pixel_digest(picture) != pixel_digest(changed)
    assert pixel_digest(picture) != pixel_digest(picture.reshape(40, 30, 3))


def _pillow(path: Path, picture: np.ndarray, form: str, **options: object) -> Path:
    Image.fromarray(picture).save(path, format=form, **options)
    return path


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("form", ["JPEG", "PNG"])
def test_a_mark_to_turn_the_picture_is_refused(
    tmp_path: Path, picture, form: str, orientation: int
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = _pillow(tmp_path / "turned.png", picture, form, exif=exif)
    with pytest.raises(BadImage, match=f"EXIF orientation {orientation}"):
        read_rgb(path)
    exif[0x0112] = 1
    assert read_rgb(_pillow(path, picture, form, exif=exif)).shape == (30, 40, 3)


def test_an_animated_png_is_refused(tmp_path: Path, picture) -> None:
    frames = [Image.fromarray(255 - picture)]
    path = _pillow(tmp_path / "moving.png", picture, "PNG", save_all=True, append_images=frames)
    with pytest.raises(BadImage, match="animated"):
        read_rgb(path)


@pytest.mark.parametrize("kind", ["zTXt", "iTXt", "tEXt"])
@pytest.mark.parametrize("after", [False, True])
def test_texts_that_unpack_to_gigabytes_are_refused_unread(
    tmp_path: Path, picture, kind: str, after: bool
) -> None:
    """900 texts of 8 MB each in a file of 7 MB had kept a decoder busy for a minute."""
    path = _pillow(tmp_path / "texts.png", picture, "PNG")
    data = path.read_bytes()
    packed = zlib.compress(bytes(8_000_000), 9)
    method = {"zTXt": b"\0", "iTXt": b"\1\0\0\0", "tEXt": b""}[kind]
    size = 40 if kind != "tEXt" else 1100
    texts = b"".join(
        _chunk(kind.encode(), b"key%d\0" % i + method + (packed if method else b"text"))
        for i in range(size)
    )
    cut = len(data) - 12 if after else 33
    path.write_bytes(data[:cut] + texts + data[cut:])
    with pytest.raises(BadImage, match="texts and profiles next to its pixels"):
        read_rgb(path)
    few = _chunk(b"tEXt", b"Author\0A person") * 20
    path.write_bytes(data[:cut] + few + data[cut:])
    assert np.array_equal(read_rgb(path), picture)


@pytest.mark.parametrize("form", ["GIF", "TIFF", "WEBP", "TGA", "PPM", "ICO"])
def test_other_formats_are_refused_whatever_the_name(tmp_path: Path, picture, form: str) -> None:
    path = _pillow(tmp_path / "000018.png", picture, form)
    with pytest.raises(BadImage, match="is not a PNG or JPEG or BMP image"):
        read_rgb(path)


@pytest.mark.parametrize("form", ["zip", "tar"])
def test_an_archive_in_place_of_an_image_is_refused(tmp_path: Path, form: str) -> None:
    import shutil

    (tmp_path / "content").mkdir()
    archive = Path(shutil.make_archive(str(tmp_path / "archive"), form, tmp_path / "content"))
    with pytest.raises(BadImage, match="is not a PNG or JPEG or BMP image"):
        read_rgb(archive.rename(tmp_path / "000018.png"))


def test_palettes_one_bit_and_gray_with_alpha_are_read_as_pillow_does(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    gray = Image.fromarray(rng.integers(0, 2, (16, 24), dtype=np.uint8) * 255)
    for mode in ("P", "1", "LA"):
        path = tmp_path / f"{mode}.png"
        gray.convert(mode).save(path)
        np.testing.assert_array_equal(read_rgb(path), np.asarray(gray.convert("RGB")))


def test_a_folder_or_a_pipe_is_no_image(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe.png")
    for name, named in (("pipe.png", "a pipe"), (".", "a folder")):
        with pytest.raises(BadImage, match=f"is {named} where a file is expected"):
            read_rgb(tmp_path / name)


def test_as_uint8_clips_and_rounds_half_to_even():
    # Halves in float64: k + 0.5 levels over 255 times 255 may not be exact, so take those that are.
    levels = np.arange(255) + 0.5
    halves = levels / 255.0
    exact = halves * 255.0 == levels
    expected = np.where(np.arange(255) % 2 == 0, np.arange(255), np.arange(255) + 1)
    assert exact.sum() > 100
    np.testing.assert_array_equal(as_uint8(halves)[exact], expected[exact])
    np.testing.assert_array_equal(as_uint8(np.array([-3.0, 0.0, 1.0, 7.0])), [0, 0, 255, 255])


def test_float_and_uint8_images_are_taken_alike() -> None:
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    np.testing.assert_array_equal(as_float(levels), np.arange(256).reshape(16, 16) / 255)
    for dtype in (np.float32, np.float64):
        np.testing.assert_array_equal(as_uint8(as_float(levels).astype(dtype)), levels)
    assert as_uint8(levels) is levels
    given = np.array([-0.5, 0.25, 1.5], np.float32)
    assert as_float(given) is given
    np.testing.assert_array_equal(as_uint8(given), [0, 64, 255])
    for convert in (as_uint8, as_float):
        with pytest.raises(BadImage, match="uint8 or float, not int64"):
            convert(np.zeros(3, np.int64))
        for bad in (np.nan, np.inf, -np.inf):
            with pytest.raises(BadImage, match="NaN or infinite"):
                convert(np.array([0.5, bad]))


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (37, 1), (1, 4096), (4096, 1), (2, 2)])
def test_images_one_pixel_wide_and_of_4096_come_back(tmp_path: Path, size) -> None:
    image = np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8)
    path = write_image(tmp_path / "colour.png", image)
    np.testing.assert_array_equal(read_rgb(path, size), image)
    np.testing.assert_array_equal(cv2.imread(str(path))[:, :, ::-1], image)
    # Neither channels nor rows lie next to one another.
    strided = np.asfortranarray(image)[::-1]
    write_image(tmp_path / "strided.png", strided)
    np.testing.assert_array_equal(read_rgb(tmp_path / "strided.png"), image[::-1])
    write_image(tmp_path / "mask.png", image[:, :, 0])
    np.testing.assert_array_equal(read_gray(tmp_path / "mask.png"), image[:, :, 0])


def test_any_number_of_places_is_read() -> None:
    """Oracle: SciPy's interpolation, to a 32nd of a pixel, which is the step of OpenCV's tables."""
    rng = np.random.default_rng(0)
    image = rng.random((20, 30, 3), dtype=np.float32)
    for count in (0, 1, 1024, 40_000):
        places = rng.uniform((1.0, 1.0), (29.0, 19.0), (count, 2))
        expected = [
            ndimage.map_coordinates(image[..., channel], (places - 0.5).T[::-1], order=1)
            for channel in range(3)
        ]
        found = sample(image, places)
        assert found.shape == (count, 3)
        np.testing.assert_allclose(found, np.stack(expected, axis=-1), atol=1 / 32)
    assert not sample(image, np.array([[-5.0, 3.0], [10.0, 40.0]])).any()


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


def test_frames_are_shown_when_they_were_recorded(tmp_path: Path) -> None:
    """Oracle: the stamps of the packets."""
    import av

    times = [0.0, 0.033, 0.068, 0.135, 0.4]
    path = write_movie(tmp_path / "clip.mp4", clip(5), FPS, times)
    with av.open(str(path)) as container:
        found = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    np.testing.assert_allclose(found, times, atol=1e-4)


def test_every_processor_writes_the_same_movie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: x264 without SIMD."""
    noise = np.random.default_rng(0).integers(40, 220, (16, 16, 3), dtype=np.uint8)
    frames = clip(12, 48, 48)
    for step, frame in enumerate(frames):
        frame[8:24, 4 + step : 20 + step] = noise
    one = write_movie(tmp_path / "one.mp4", frames, FPS)
    monkeypatch.setattr(images, "REPEATABLE", f"{images.REPEATABLE}:asm=0")
    np.testing.assert_array_equal(
        decoded(one), decoded(write_movie(tmp_path / "two.mp4", frames, FPS))
    )


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
