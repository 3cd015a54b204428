"""The compiled loop of `video_colours`: from Y'CbCr samples of 16 bits to sRGB."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.compiled import compiled, helper


@helper
def _looked_up(table: np.ndarray, place: float) -> float:
    """A table's value at a place in [0, 1]; outside, that of its ends."""
    last = len(table) - 1
    if not place > 0.0:
        return table[0]
    if place >= 1.0:
        return table[last]
    at = place * last
    index = int(at)
    return table[index] + (at - index) * (table[index + 1] - table[index])


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
    factors: np.ndarray,
    top: float,
    matrix: np.ndarray,
    codes: np.ndarray,
    out: np.ndarray,
) -> None:
    """Convert the samples of a frame.

    Args:
        luma, blue, red: (H, W) uint16, Y', Cb and Cr.
        black: sample of black.
        luma_span, chroma_span: samples from black to white, and from one end of a colour
            difference to the other.
        weights: (3,) of red, green and blue in Y'.
        light: linear light for signals that are evenly spaced in [0, 1].
        luminance: (4,) weights of linear light in luminance, and the exponent of it that scales
            light.
        factors: scales light, for largest components that are evenly spaced in [0, top].
        top: light above it becomes white.
        matrix: (3, 3) to the primaries of sRGB.
        codes: sRGB in [0, 255] for square roots of light that are evenly spaced in [0, 1].
        out: (H, W, 3) uint8, written.
    """
    for row in range(luma.shape[0]):
        for column in range(luma.shape[1]):
            y = (luma[row, column] - black) / luma_span
            b = y + 2.0 * (1.0 - weights[2]) * (blue[row, column] - 32768.0) / chroma_span
            r = y + 2.0 * (1.0 - weights[0]) * (red[row, column] - 32768.0) / chroma_span
            g = (y - weights[0] * r - weights[2] * b) / weights[1]
            r = _looked_up(light, r)
            g = _looked_up(light, g)
            b = _looked_up(light, b)
            scale = 1.0
            if luminance[3] != 0.0:
                bright = luminance[0] * r + luminance[1] * g + luminance[2] * b
                # Light is in units of reference white, the exponent's in those of the peak.
                scale = (bright / top) ** luminance[3]
            largest = scale * max(r, max(g, b))
            if largest > top:
                scale *= 1.0 / largest
            else:
                scale *= _looked_up(factors, largest / top)
            for channel in range(3):
                linear = scale * (
                    matrix[channel, 0] * r + matrix[channel, 1] * g + matrix[channel, 2] * b
                )
                root = np.sqrt(linear) if linear > 0.0 else 0.0
                out[row, column, channel] = int(_looked_up(codes, root) + 0.5)
