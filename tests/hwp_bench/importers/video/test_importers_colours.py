"""Colours of videos. Oracle: the formulas of ITU-R BT.601, 709, 2020, 2100 and 2390 in float64.

Samples are encoded without loss, in patches of one colour, so that their values are known. Two
levels are told apart: ordinary video of 8 bits goes through FFmpeg's fast converter, which is up
to 2.9 of 255 levels off; all else is within rounding (half a level) and 0.05 levels of tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from encoded_video import (
    HLG,
    TO_BT709,
    WEIGHTS,
    from_srgb,
    ordinary_hlg,
    pictures,
    samples_of,
    write_pictures,
    write_samples,
)

from hwp_bench.base.errors import BadInput
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames

ROUNDED, FAST = 0.55, 2.95
PQ = {**HLG, "color_trc": 16}
PATCH, ROWS, COLUMNS = 8, 6, 8


def srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def hlg_to_scene(x: np.ndarray) -> np.ndarray:
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(x <= 0.5, x * x / 3, (np.exp((x - c) / a) + b) / 12)


M1, M2, C1, C2, C3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875


def pq_to_light(x: np.ndarray) -> np.ndarray:
    p = x ** (1 / M2)
    return 10000 * (np.maximum(p - C1, 0) / (C2 - C3 * p)) ** (1 / M1)


def light_to_pq(light: np.ndarray) -> np.ndarray:
    y = (np.asarray(light) / 10000) ** M1
    return ((C1 + C2 * y) / (1 + C3 * y)) ** M2


def eetf(light: np.ndarray) -> np.ndarray:
    """BT.2390 from 1000 to 203 cd/m2, of light in cd/m2."""
    white, target = light_to_pq(1000.0), light_to_pq(203.0)
    e1, most = np.minimum(light_to_pq(light) / white, 1.0), target / white
    ks = 1.5 * most - 0.5
    t = (e1 - ks) / (1 - ks)
    p = (2 * t**3 - 3 * t**2 + 1) * ks + (t**3 - 2 * t**2 + t) * (1 - ks)
    p += (-2 * t**3 + 3 * t**2) * most
    return pq_to_light(np.where(e1 < ks, e1, p) * white)


def displayed(light: np.ndarray) -> np.ndarray:
    """From cd/m2 in BT.2020, (..., 3), to sRGB in [0, 1]."""
    largest = light.max(axis=-1, keepdims=True)
    scaled = light * np.where(largest > 0, eetf(largest) / np.maximum(largest, 1e-9), 1.0)
    return srgb(scaled / 203.0 @ TO_BT709.T)


def hlg_displayed(signal: np.ndarray) -> np.ndarray:
    scene = hlg_to_scene(np.clip(signal, 0, 1))
    bright = scene @ [0.2627, 0.6780, 0.0593]
    return displayed(1000.0 * bright[..., None] ** 0.2 * scene)


def pq_displayed(signal: np.ndarray) -> np.ndarray:
    return displayed(pq_to_light(np.clip(signal, 0, 1)))


def signal_of(planes: Sequence[np.ndarray], matrix: int, *, full: bool, bits: int) -> np.ndarray:
    """Samples (N,) of Y', Cb and Cr to the signal of red, green and blue (N, 3)."""
    y, cb, cr = (plane.astype(np.float64) for plane in planes)
    step = 2 ** (bits - 8)
    if full:
        y, cb, cr = (v / (2**bits - 1) for v in (y, cb - 128 * step, cr - 128 * step))
    else:
        y, cb, cr = (y / step - 16) / 219, (cb / step - 128) / 224, (cr / step - 128) / 224
    red, blue = WEIGHTS[matrix]
    r, b = y + 2 * (1 - red) * cr, y + 2 * (1 - blue) * cb
    return np.stack([r, (y - red * r - blue * b) / (1 - red - blue), b], axis=-1)


#: The finest that encoders have which always lose something.
OPTIONS = {
    "libvpx": {"crf": "4", "qmin": "0", "qmax": "4", "b": "40M"},
    "libvpx-vp9": {"lossless": "1"},
    "libsvtav1": {"preset": "8", "crf": "1", "svtav1-params": "lp=1"},
    "prores_ks": {"profile": "4", "qscale": "1"},
}


def colours() -> np.ndarray:
    """Signals (48, 3): skin, greys from black to white, primaries, and some of all kinds."""
    rng = np.random.default_rng(3)
    skin = np.array([0.62, 0.47, 0.4]) * np.linspace(0.35, 1.4, 12)[:, None]
    grey = np.linspace(0.0, 1.0, 12)[:, None] * np.ones(3)
    strong = np.array([[0.8, 0.1, 0.1], [0.1, 0.7, 0.1], [0.1, 0.1, 0.8], [0.75, 0.7, 0.1]])
    return np.concatenate([skin, grey, strong, rng.uniform(0.1, 0.9, (20, 3))])


def write_patches(
    path: Path, planes: Sequence[np.ndarray], pix_fmt: str, codec: str, marks: dict[str, int]
) -> Path:
    """One frame of patches, 4:2:0, 4:2:2 or 4:4:4."""
    whole = [np.kron(p.reshape(ROWS, COLUMNS), np.ones((PATCH, PATCH), p.dtype)) for p in planes]
    if "420" in pix_fmt:
        whole[1:] = [plane[::2, ::2] for plane in whole[1:]]
    if "422" in pix_fmt:
        whole[1:] = [plane[:, ::2] for plane in whole[1:]]
    return write_samples(path, [whole], pix_fmt, codec, marks=marks, options=OPTIONS.get(codec))


def read_patches(path: Path) -> np.ndarray:
    """The middle of each patch, (48, 3), levels."""
    [(_, image)] = read_frames(probe(path), FrameRange())
    middles = image[PATCH // 2 :: PATCH, PATCH // 2 :: PATCH]
    return middles.reshape(-1, 3).astype(np.float64)


@pytest.mark.parametrize(("matrix", "full"), [(1, False), (6, True), (9, False), (9, True)])
@pytest.mark.parametrize(
    ("pix_fmt", "bits", "codec", "ending", "tolerance"),
    [
        ("yuv420p", 8, "libx264", "mp4", FAST),
        ("yuv444p", 8, "libx264", "mkv", ROUNDED),
        ("yuv420p10le", 10, "libx265", "mov", ROUNDED),
        ("yuv420p10le", 10, "ffv1", "mkv", ROUNDED),
    ],
)
def test_ordinary_video(
    tmp_path: Path, pix_fmt: str, bits: int, codec: str, ending: str, tolerance: float,
    matrix: int, full: bool,
) -> None:  # fmt: skip
    """Matrix and range as stated."""
    marks = {"colorspace": matrix, "color_primaries": 1, "color_trc": 1,
             "color_range": 2 if full else 1}  # fmt: skip
    planes = samples_of(np.clip(colours(), 0, 1), matrix, full=full, bits=bits)
    path = write_patches(tmp_path / f"a.{ending}", planes, pix_fmt, codec, marks)
    truth = np.clip(signal_of(planes, matrix, full=full, bits=bits), 0, 1) * 255
    assert np.abs(read_patches(path) - truth).max() <= tolerance


@pytest.mark.parametrize(("marks", "displays"), [(HLG, hlg_displayed), (PQ, pq_displayed)])
@pytest.mark.parametrize(
    ("codec", "ending", "full"), [("libx265", "mov", False), ("ffv1", "mkv", True)]
)
def test_hdr(tmp_path: Path, marks, displays, codec: str, ending: str, full: bool) -> None:
    planes = samples_of(np.clip(colours(), 0, 1), 9, full=full, bits=10)
    marks = {**marks, "color_range": 2 if full else 1}
    path = write_patches(tmp_path / f"a.{ending}", planes, "yuv420p10le", codec, marks)
    truth = displays(signal_of(planes, 9, full=full, bits=10)) * 255
    assert np.abs(read_patches(path) - truth).max() <= ROUNDED
    assert ("HLG" if marks["color_trc"] == 18 else "PQ") in probe(path).colours


@pytest.mark.parametrize(
    ("codec", "ending", "pix_fmt", "matrix", "lost"),
    [
        ("libvpx", "webm", "yuv420p", 6, 3.0),
        ("libvpx-vp9", "webm", "yuv420p", 1, 0.0),
        ("libsvtav1", "mp4", "yuv420p10le", 9, 2.0),
        ("prores_ks", "mov", "yuv422p10le", 9, 2.0),
    ],
)
def test_codecs_keep_their_colours(
    tmp_path: Path, codec: str, ending: str, pix_fmt: str, matrix: int, lost: float
) -> None:
    """Ordinary video in 8 bits, HLG in 10; `lost`: levels that the encoder may take."""
    bits = 10 if "10" in pix_fmt else 8
    marks = HLG if bits == 10 else {"colorspace": matrix, "color_range": 1}
    planes = samples_of(np.clip(colours(), 0, 1), matrix, full=False, bits=bits)
    path = write_patches(tmp_path / f"a.{ending}", planes, pix_fmt, codec, marks)
    signal = signal_of(planes, matrix, full=False, bits=bits)
    truth = (hlg_displayed(signal) if bits == 10 else np.clip(signal, 0, 1)) * 255
    exact = ROUNDED if bits == 10 else FAST
    assert np.abs(read_patches(path) - truth).max() <= exact + lost


@pytest.mark.parametrize(
    ("pix_fmt", "bits", "tolerance"), [("yuv420p", 8, FAST), ("yuv420p10le", 10, ROUNDED)]
)
def test_odd_sizes_keep_their_colours(
    tmp_path: Path, pix_fmt: str, bits: int, tolerance: float
) -> None:
    """Also in the last row and column, whose colour is half of a sample."""
    marks = HLG if bits == 10 else {"colorspace": 6, "color_range": 1}
    matrix, height, width = marks["colorspace"], 47, 63
    one = samples_of(np.array([[0.62, 0.47, 0.4]]), matrix, full=False, bits=bits)
    planes = [np.full((height, width), one[0][0])]
    planes += [np.full((24, 32), sample[0]) for sample in one[1:]]
    path = write_samples(tmp_path / "a.mkv", [planes], pix_fmt, "ffv1", marks=marks)
    [(_, image)] = read_frames(probe(path), FrameRange())
    signal = signal_of(one, matrix, full=False, bits=bits)
    truth = (hlg_displayed(signal) if bits == 10 else np.clip(signal, 0, 1))[0] * 255
    assert image.shape == (height, width, 3)
    assert np.abs(image - truth).max() <= tolerance


def test_levels_of_hdr_are_those_of_the_recommendation() -> None:
    """BT.2408, table 1: reference white, 203 cd/m2, is 75 % HLG and 58 % PQ; the grey card, 26."""
    from hwp_bench.importers.video.colours import hlg_scene_light, pq_light, roll_off

    assert 1000 * hlg_scene_light(np.array([0.75, 0.38])) ** 1.2 == pytest.approx(
        [203, 26], rel=0.02
    )
    assert pq_light(np.array([0.58, 0.38])) == pytest.approx([203, 26], rel=0.04)
    # The curve ends at white, rises, and leaves what is darker than 87.8 cd/m2 alone.
    light = np.linspace(0, 1000 / 203, 2000)
    bent = roll_off(light)
    assert bent[-1] == pytest.approx(1.0, abs=1e-6)
    assert (np.diff(bent) > 0).all()
    np.testing.assert_allclose(bent[light < 87.8 / 203], light[light < 87.8 / 203], atol=1e-9)


def test_an_ordinary_picture_in_hlg_comes_back(tmp_path: Path) -> None:
    """As a phone does it: sRGB shown at 203 cd/m2, in HLG and BT.2020, 10 bits.

    Tolerance: half a step of 10 bits is worth up to 0.6 levels here in each of three samples.
    """
    given = np.clip(colours()[:12], 0, 1) * 0.7
    given = np.concatenate([given] * 4)
    planes = ordinary_hlg(given)
    path = write_patches(tmp_path / "a.mov", planes, "yuv420p10le", "libx265", HLG)
    assert np.abs(read_patches(path) - given * 255).max() <= 2.0


@pytest.mark.parametrize(("primaries", "green"), [(9, (0, 255, 0)), (12, (0, 255, 0))])
def test_wide_primaries_without_hdr(tmp_path: Path, primaries: int, green) -> None:
    """Greys stay, what lies outside becomes the nearest of each channel.

    Of BT.2020 every colour is compared; the matrix of Display P3 is that of Apple's profile.
    """
    p3 = np.array([[1.2249, -0.2247, 0], [-0.0420, 1.0419, 0], [-0.0197, -0.0786, 1.0979]])
    marks = {"colorspace": 9, "color_primaries": primaries, "color_trc": 14, "color_range": 1}
    planes = samples_of(np.clip(colours(), 0, 1), 9, full=False, bits=10)
    path = write_patches(tmp_path / "a.mov", planes, "yuv420p10le", "libx265", marks)
    light = from_srgb(np.clip(signal_of(planes, 9, full=False, bits=10), 0, 1))
    truth = srgb(light @ (TO_BT709 if primaries == 9 else p3).T) * 255
    # Matrices of four digits are up to 0.1 levels off.
    assert np.abs(read_patches(path) - truth).max() <= ROUNDED + 0.1


@pytest.mark.parametrize(("size", "matrix"), [((64, 48), 6), ((1280, 16), 1), ((16, 592), 1)])
def test_what_states_nothing(tmp_path: Path, size: tuple[int, int], matrix: int) -> None:
    """BT.601 for small frames, BT.709 for large ones, as players have it; limited range."""
    width, height = size
    one = samples_of(np.array([[0.7, 0.4, 0.3]]), matrix, full=False, bits=8)
    planes = [np.full((height, width), one[0][0], np.uint8)]
    planes += [np.full((height // 2, width // 2), sample[0], np.uint8) for sample in one[1:]]
    path = write_samples(tmp_path / "a.mkv", [planes], "yuv420p", "ffv1")
    [(_, image)] = read_frames(probe(path), FrameRange())
    truth = signal_of(one, matrix, full=False, bits=8)[0] * 255
    assert np.abs(image[height // 2, width // 2] - truth).max() <= FAST


@pytest.mark.parametrize("codec", ["libx264", "mpeg4", "mjpeg", "libvpx-vp9"])
def test_pixels_of_ordinary_video_are_those_of_opencv(tmp_path: Path, codec: str) -> None:
    """Captures of earlier videos keep their digests: every pixel is the same."""
    pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = write_pictures(tmp_path / "a.mkv", pictures(6), codec, pix_fmt=pix_fmt)
    capture = cv2.VideoCapture(str(path))
    frames = list(read_frames(probe(path), FrameRange()))
    assert len(frames) == 6
    for _, image in frames:
        np.testing.assert_array_equal(image, capture.read()[1][:, :, ::-1])


@pytest.mark.parametrize(
    ("marks", "named"),
    [
        ({**HLG, "colorspace": 14}, "ICtCp"),
        ({**HLG, "colorspace": 10}, "constant luminance"),
        ({"colorspace": 8, "color_primaries": 1, "color_trc": 1}, "YCgCo"),
        ({"colorspace": 1, "color_primaries": 1, "color_trc": 8}, "linear light"),
        ({"colorspace": 1, "color_primaries": 8, "color_trc": 1}, "primaries 8"),
        ({"colorspace": 9, "color_primaries": 9, "color_trc": 2}, "states no transfer function"),
    ],
)
def test_what_cannot_be_converted_is_named(tmp_path: Path, marks, named: str) -> None:
    planes = samples_of(np.clip(colours(), 0, 1), 9, full=False, bits=10)
    path = write_patches(tmp_path / "a.mov", planes, "yuv420p10le", "libx265", marks)
    with pytest.raises(BadInput, match=named) as caught:
        probe(path)
    assert caught.value.where == str(path)
    assert "ffmpeg -i VIDEO" in (caught.value.remedy or "")


def test_dolby_vision_without_a_base_is_named(tmp_path: Path) -> None:
    """Profile 5 is HEVC with the tag dvh1 that states no colours."""
    planes = samples_of(np.clip(colours(), 0, 1), 9, full=True, bits=10)
    path = write_patches(tmp_path / "a.mov", planes, "yuv420p10le", "libx265", {"color_range": 2})
    content = path.read_bytes()
    assert b"hev1" in content
    path.write_bytes(content.replace(b"hev1", b"dvh1"))
    with pytest.raises(BadInput, match="Dolby Vision"):
        probe(path)


def test_red_green_and_blue_of_more_than_eight_bits(tmp_path: Path) -> None:
    one = np.array([640, 480, 400], np.uint16)
    # Stored as green, blue, red.
    planes = [np.full((48, 64), one[channel]) for channel in (1, 2, 0)]
    path = write_samples(tmp_path / "a.mkv", [planes], "gbrp10le", "ffv1")
    [(_, image)] = read_frames(probe(path), FrameRange())
    assert np.abs(image[24, 32] - one / 1023 * 255).max() <= 1.0
