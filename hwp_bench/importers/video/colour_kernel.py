"""The compiled loop of `video_colours`: from Y'CbCr samples of 16 bits to sRGB."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.kernels import compiled, helper


@helper
def _nearest(table: np.ndarray, place: float) -> float:
    """A table's value at the nearest entry to a place in [0, 1]; outside, that of its ends."""
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
    """Convert the samples of a frame.

    Args:
        luma, blue, red: (H, W) uint16, Y', Cb and Cr.
        black: sample of black.
        luma_span, chroma_span: samples from black to white, and from one end of a colour
            difference to the other.
        weights: (3,) of red, green and blue in Y'.
        light: linear light for signals that are evenly spaced in [0, 1].
        luminance: (3,) weights of linear light in luminance.
        display: scales light, for square roots of luminance that are evenly spaced in [0, top];
            one entry where nothing does.
        factors: scales light, for largest components that are evenly spaced in [0, top].
        top: light above it becomes white.
        matrix: (3, 3) to the primaries of sRGB.
        codes: sRGB of 8 bits for square roots of light that are evenly spaced in [0, 1].
        out: (H, W, 3) uint8, written.
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
