"""The colours of a video's frames: from the samples of any phone to sRGB in 8 bits.

What a file states (matrix, range, primaries, transfer; ITU-T H.273) decides how its samples are
read. Where it states nothing: BT.709 from 1280 columns or more than 576 rows on, BT.601 below, as
players assume, and limited range.

Ordinary video, in the primaries of BT.709 or of BT.601 (which differ little and are taken for
those of BT.709, as browsers do), is converted by FFmpeg's swscale. Its values are shown as sRGB.

HLG and PQ (ITU-R BT.2100) become light as a display of 1000 cd/m2 shows it, relative to 203 cd/m2,
the reference white of HDR (ITU-R BT.2408). So that what is brighter does not burn out, the curve of
ITU-R BT.2390 (EETF, from 1000 to 203 cd/m2) bends above 88 cd/m2, which is level 176 of 255:
reference white becomes level 228, the peak 255. It is applied to the largest of red, green and
blue, which keeps the hue. Then the primaries become those of BT.709, colours outside of them are
clipped, and the rest is encoded as sRGB. Metadata of single scenes are not used.

Ordinary video in wide primaries (BT.2020, Display P3) takes the same way without the curve, and so
does the full range of more than 8 bits, which swscale misses by a level.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.colors import eight_bit_srgb, srgb_to_linear
from hwp_bench.base.errors import BadInput
from hwp_bench.base.kernels import compiled, helper

#: Reference white of HDR (ITU-R BT.2408), and the peak that curves end at, cd/m2.
REFERENCE_WHITE, PEAK = 203.0, 1000.0
#: Entries of the tables that stand for curves, of which the nearest is taken: it is less than 0.05
#: of 255 levels off.
TABLE = 65537

_UNSPECIFIED, _RESERVED = 2, 3
_PQ, _HLG = 16, 18
#: Transfer functions whose values are shown as sRGB (H.273: BT.709, gamma 2.2 and 2.8, BT.601,
#: 240M, xvYCC, BT.1361, sRGB, BT.2020).
_ORDINARY = (1, 4, 5, 6, 7, 11, 12, 13, 14, 15)
_TRANSFERS = {
    8: "linear light",
    9: "a logarithmic transfer function (100:1)",
    10: "a logarithmic transfer function (316:1)",
    17: "the transfer function of cinemas (SMPTE 428)",
}
#: Matrices by their number in H.273: the weights of red and blue, and swscale's number.
_MATRICES = {
    1: (0.2126, 0.0722, 1),
    4: (0.30, 0.11, 4),
    5: (0.299, 0.114, 5),
    6: (0.299, 0.114, 5),
    7: (0.212, 0.087, 7),
    9: (0.2627, 0.0593, 9),
}
_OTHER_MATRICES = {
    8: "YCgCo",
    10: "BT.2020 with constant luminance",
    11: "SMPTE 2085",
    12: "a matrix that follows from the primaries",
    13: "constant luminance with a matrix that follows from the primaries",
    14: "ICtCp",
    15: "IPT-C2",
    16: "YCgCo-R, even",
    17: "YCgCo-R, odd",
}
#: Primaries that are taken for those of BT.709: BT.709, both of BT.601, 240M, EBU 3213.
_NARROW = (1, 5, 6, 7, 22)
_BT709 = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))
#: Wide primaries, all with the white point D65, as chromaticities of red, green and blue.
_WIDE = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
_D65 = (0.3127, 0.3290)
_NAMES = {1: "BT.709", 4: "FCC", 5: "BT.601", 6: "BT.601", 7: "SMPTE 240M", 9: "BT.2020"}
_PRIMARIES = {9: "BT.2020", 12: "Display P3"}
#: Brands of MP4 files whose video is Dolby Vision.
_DOLBY_TAGS = ("dvh1", "dvhe", "dva1", "dvav", "dav1")
_CONVERT = (
    "libplacebo=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv:format=yuv420p"
)


@dataclass(frozen=True)
class Colours:
    """How the samples of a frame are read."""

    #: Number in H.273, a key of `_MATRICES`; 0 for samples of red, green and blue.
    matrix: int
    #: 1 for BT.709 or what is taken for it, 9 for BT.2020, 12 for Display P3.
    primaries: int
    #: 1 for ordinary video, 16 for PQ, 18 for HLG.
    transfer: int
    #: Whether samples use the full range.
    full: bool
    #: Of a sample.
    bits: int

    @property
    def plain(self) -> bool:
        """Whether swscale alone gives sRGB."""
        return self.transfer == 1 and self.primaries == 1

    def __str__(self) -> str:
        curve = {_PQ: "HDR (PQ)", _HLG: "HDR (HLG)"}.get(self.transfer, "SDR")
        matrix = _NAMES.get(self.matrix, "RGB")
        wide = _PRIMARIES.get(self.primaries)
        primaries = "" if wide is None else f", primaries of {wide}"
        range_ = "full" if self.full else "limited"
        return f"{curve}, {matrix}{primaries}, {range_} range, {self.bits} bits"


def colours_of(frame: Any, tag: str, path: Path) -> Colours:
    """Find out how the samples of a frame of PyAV's are to be read, by the codec's tag too."""
    bits = frame.format.components[0].bits
    matrix, primaries, transfer = frame.colorspace, frame.color_primaries, frame.color_trc
    full = frame.color_range == 2 or frame.format.name.startswith("yuvj")
    if transfer in (0, _RESERVED):
        transfer = _UNSPECIFIED
    if primaries in (0, _RESERVED):
        primaries = _UNSPECIFIED
    wide = primaries == 9 or (primaries == _UNSPECIFIED and matrix == 9)
    marks = {side.type.name for side in frame.side_data}
    dolby = tag in _DOLBY_TAGS or not marks.isdisjoint(("DOVI_RPU_BUFFER", "DOVI_METADATA"))
    if transfer == _UNSPECIFIED and dolby:
        raise _refused(path, "Dolby Vision without a picture for other decoders (profile 5)")
    if transfer == _UNSPECIFIED and wide:
        raise BadInput(
            "has the primaries of BT.2020 and states no transfer function, as log recordings do",
            where=path,
            remedy="Convert log with the look-up table of its camera. If it is HLG (or "
            f"smpte2084 for PQ): ffmpeg -i VIDEO -vf setparams=color_trc=arib-std-b67,{_CONVERT} "
            "-crf 12 video.mp4",
        )
    hdr = transfer in (_PQ, _HLG)
    if not hdr and transfer not in (*_ORDINARY, _UNSPECIFIED):
        raise _refused(path, _TRANSFERS.get(transfer, f"transfer function {transfer} of H.273"))
    if primaries == _UNSPECIFIED:
        primaries = 9 if hdr or wide else 1
    if primaries in _NARROW:
        primaries = 1
    elif primaries not in _WIDE:
        raise _refused(path, f"primaries {primaries} of H.273")
    matrix = _matrix(frame, matrix, 9 if primaries == 9 else None, path)
    if matrix == 0:
        full = True
        if hdr or primaries != 1:
            raise _refused(path, "red, green and blue samples in HDR or wide primaries")
    return Colours(matrix, primaries, transfer if hdr else 1, full, bits)


def _matrix(frame: Any, stated: int, expected: int | None, path: Path) -> int:
    """The matrix of a frame; where nothing is stated, that which players assume."""
    if frame.format.is_rgb or frame.format.name == "pal8":
        return 0
    if stated in _MATRICES:
        return stated
    # Some recorders write 0, the mark of red, green and blue, for any other value.
    if stated not in (0, _UNSPECIFIED, _RESERVED):
        raise _refused(path, _OTHER_MATRICES.get(stated, f"matrix {stated} of H.273"))
    if expected is not None:
        return expected
    return 1 if frame.width >= 1280 or frame.height > 576 else 6


def _refused(path: Path, what: str) -> BadInput:
    return BadInput(
        f"has colours that are not converted here: {what}",
        where=path,
        remedy=f"Convert it: ffmpeg -i VIDEO -vf {_CONVERT} -crf 12 video.mp4",
    )


def to_srgb(frame: Any, colours: Colours, size: tuple[int, int]) -> np.ndarray:
    """Convert a frame of PyAV's to (height, width, 3) uint8 sRGB; `size` is width and height."""
    if colours.matrix:
        frame.colorspace = _MATRICES[colours.matrix][2]
        frame.color_range = 2 if colours.full else 1
    width, height = size
    same_size = (frame.width, frame.height) == size
    # Red, green and blue need no matrix.
    if colours.plain and not (colours.matrix and colours.full and colours.bits > 8):
        # Exact rounding moves ordinary video by one level, and would change every capture.
        flags = _bicubic(exact=colours.bits > 8 or not same_size)
        made = frame.reformat(width, height, "rgb24", None, None, flags, None, 2, threads=1)
        return np.asarray(made.to_ndarray())
    flags = _bicubic(exact=True)
    made = frame.reformat(width, height, "yuv444p16le", interpolation=flags, threads=1)
    planes = [
        np.frombuffer(plane, dtype="<u2").reshape(-1, plane.line_size // 2)[:height, :width]
        for plane in made.planes[:3]
    ]
    # Black, the span of brightness and that of colour differences, in samples of 16 bits.
    full = float((2**colours.bits - 1) << (16 - colours.bits))
    levels = (0.0, full, full) if colours.full else (4096.0, 219.0 * 256.0, 224.0 * 256.0)
    out = np.empty((height, width, 3), dtype=np.uint8)
    red, blue, _ = _MATRICES[colours.matrix]
    tables = _tables(colours.transfer, colours.primaries)
    convert(*planes, *levels, np.array([red, 1.0 - red - blue, blue]), *tables, out)
    return out


def _bicubic(*, exact: bool) -> int:
    from av.video.reformatter import Interpolation as Flags

    if not exact:
        return int(Flags.BICUBIC)
    return int(Flags.BICUBIC | Flags.ACCURATE_RND | Flags.FULL_CHR_H_INT | Flags.FULL_CHR_H_INP)


@functools.lru_cache(maxsize=8)
def _tables(transfer: int, primaries: int) -> tuple[np.ndarray, ...]:
    """The curves and matrix of a conversion, as the kernel takes them.

    Returns:
        Linear light for a signal in [0, 1]; weights of luminance; what HLG's display scales light
        by, one entry where there is none; factors for a largest component in [0, `top`]; `top`;
        the matrix of the primaries; sRGB of 8 bits for the square root of light in [0, 1].
    """
    signal = np.linspace(0.0, 1.0, TABLE)
    top, factors, display = 1.0, np.ones(TABLE), np.ones(1)
    if transfer == _HLG:
        # Scene light; with the display's exponent it becomes light of 0 to 1 of the peak.
        light, display = hlg_scene_light(signal) * (PEAK / REFERENCE_WHITE), signal**0.4
    elif transfer == _PQ:
        light = pq_light(signal) / REFERENCE_WHITE
    else:
        light = srgb_to_linear(signal)
    if transfer in (_HLG, _PQ):
        top = PEAK / REFERENCE_WHITE
        largest = np.linspace(0.0, top, TABLE)
        factors[1:] = roll_off(largest[1:]) / largest[1:]
    luminance = _to_xyz(_WIDE.get(primaries, _BT709))[1]
    matrix = np.linalg.inv(_to_xyz(_BT709)) @ _to_xyz(_WIDE.get(primaries, _BT709))
    codes = eight_bit_srgb(signal**2)
    small = (one.astype(np.float32) for one in (display, factors))
    return light.astype(np.float32), luminance, *small, np.float64(top), matrix, codes


def hlg_scene_light(signal: np.ndarray) -> np.ndarray:
    """Scene light in [0, 1] for an HLG signal in [0, 1] (ITU-R BT.2100, inverse OETF)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    signal = np.asarray(signal, dtype=np.float64)
    return np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)


_M1, _M2 = 2610.0 / 16384.0, 2523.0 / 4096.0 * 128.0
_C1, _C2, _C3 = 3424.0 / 4096.0, 2413.0 / 4096.0 * 32.0, 2392.0 / 4096.0 * 32.0


def pq_light(signal: np.ndarray) -> np.ndarray:
    """Light in cd/m2 for a PQ signal in [0, 1] (ITU-R BT.2100, EOTF)."""
    power = np.asarray(signal, dtype=np.float64) ** (1.0 / _M2)
    return 10000.0 * (np.maximum(power - _C1, 0.0) / (_C2 - _C3 * power)) ** (1.0 / _M1)


def pq_signal(light: np.ndarray) -> np.ndarray:
    """PQ signal in [0, 1] for light in cd/m2 (ITU-R BT.2100, inverse EOTF)."""
    power = (np.asarray(light, dtype=np.float64) / 10000.0) ** _M1
    return ((_C1 + _C2 * power) / (1.0 + _C3 * power)) ** _M2


def roll_off(light: np.ndarray) -> np.ndarray:
    """Bend light so that the peak becomes reference white (ITU-R BT.2390, EETF).

    Light is relative to reference white, 0 or more; the result in [0, 1], the same up to 0.43.
    """
    peak = pq_signal(np.array(PEAK))
    given = np.minimum(pq_signal(np.asarray(light) * REFERENCE_WHITE) / peak, 1.0)
    most = pq_signal(np.array(REFERENCE_WHITE)) / peak
    knee = 1.5 * most - 0.5
    t = np.maximum(given - knee, 0.0) / (1.0 - knee)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee
        + (t**3 - 2 * t**2 + t) * (1.0 - knee)
        + (-2 * t**3 + 3 * t**2) * most
    )
    return np.where(given < knee, light, pq_light(spline * peak) / REFERENCE_WHITE)


def _to_xyz(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    """The matrix from linear red, green and blue to XYZ (SMPTE RP 177)."""
    columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in primaries]).T
    x, y = _D65
    scale = np.linalg.solve(columns, [x / y, 1.0, (1.0 - x - y) / y])
    return np.asarray(columns * scale)


@helper
def _nearest(table: np.ndarray, place: float) -> float:
    """Look up the entry of a table nearest to a place in [0, 1]; places outside get its ends."""
    last = len(table) - 1
    if not place > 0.0:
        return table[0]
    return table[last] if place >= 1.0 else table[int(place * last + 0.5)]


@compiled(nogil=True)
def convert(
    luma: np.ndarray,
    blue: np.ndarray,
    red: np.ndarray,
    black: float,
    luma_span: float,
    chroma_span: float,
    weights: np.ndarray,
    light: np.ndarray,
    luminance: np.ndarray,
    display: np.ndarray,
    factors: np.ndarray,
    top: float,
    matrix: np.ndarray,
    codes: np.ndarray,
    out: np.ndarray,
) -> None:
    """Convert the samples of a frame, (H, W) uint16 Y', Cb and Cr, by what `_tables` returns.

    `weights` (3,) are those of red, green and blue in Y'; `out` (H, W, 3) uint8 is written.
    """
    red_step = 2.0 * (1.0 - weights[0]) / chroma_span
    blue_step = 2.0 * (1.0 - weights[2]) / chroma_span
    luma_step, per_top = 1.0 / luma_span, 1.0 / top
    red_share, blue_share = weights[0] / weights[1], weights[2] / weights[1]
    luma_share = 1.0 / weights[1]
    for row in range(luma.shape[0]):
        for column in range(luma.shape[1]):
            y = (luma[row, column] - black) * luma_step
            b = y + (blue[row, column] - 32768.0) * blue_step
            r = y + (red[row, column] - 32768.0) * red_step
            g = luma_share * y - red_share * r - blue_share * b
            r = _nearest(light, r)
            g = _nearest(light, g)
            b = _nearest(light, b)
            scale = 1.0
            if len(display) > 1:
                bright = luminance[0] * r + luminance[1] * g + luminance[2] * b
                # Light is in units of reference white, the display's in those of the peak.
                scale = _nearest(display, np.sqrt(bright * per_top))
            largest = scale * max(r, max(g, b)) * per_top
            scale *= per_top / largest if largest > 1.0 else _nearest(factors, largest)
            r *= scale
            g *= scale
            b *= scale
            for channel in range(3):
                linear = matrix[channel, 0] * r + matrix[channel, 1] * g + matrix[channel, 2] * b
                root = np.sqrt(linear) if linear > 0.0 else 0.0
                out[row, column, channel] = _nearest(codes, root)
