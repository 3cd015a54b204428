"""Colour: sRGB and linear light, brightness, lamps, and light as a function of the normal."""

from __future__ import annotations

import numpy as np

#: Weights of linear red, green and blue in luminance (ITU-R BT.709, the primaries of sRGB).
LUMINANCE = (0.2126, 0.7152, 0.0722)
#: Weights of sRGB-encoded red, green and blue in luma (ITU-R BT.601).
LUMA = (0.299, 0.587, 0.114)


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB in [0, 1] (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, dtype=np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear light as sRGB in [0, 1]; values outside are clipped (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    high = 1.055 * np.power(np.maximum(linear, 0.0031308), 1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, high)


def eight_bit_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear light as sRGB in 8 bits; values outside 0-1 are clipped."""
    return np.round(linear_to_srgb(linear) * 255.0).astype(np.uint8)


def log_light(srgb: np.ndarray, floor: float) -> np.ndarray:
    """Return the logarithm of linear light, in which a gain is a sum.

    Args:
        srgb: sRGB in [0, 1], any shape.
    """
    return np.log(srgb_to_linear(srgb) + floor)


def lamp_color(kelvin: float) -> np.ndarray:
    """Linear sRGB colour of a black body, scaled to luminance 1 and relative to 5500 K.

    Source: a power law through the Planckian locus in linear sRGB, within 10 % of it from 4,600 to
    12,000 K. Warmer lamps come out less warm: one of 3,000 K as one of about 3,800 K.
    """
    ratio = kelvin / 5500.0
    color = np.array([ratio**-0.55, 1.0, ratio**0.75])
    return color / float(color @ LUMINANCE)


#: Polynomials of degree 0 to 2.
COUNT = 9


def harmonics(normals: np.ndarray) -> np.ndarray:
    """The nine polynomials of degree 0 to 2 that span the spherical harmonics."""
    x, y, z = np.moveaxis(normals, -1, 0)
    known = (normals**2).sum(axis=-1) > 0.5
    second = np.where(known, 3.0 * z * z - 1.0, 0.0)
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, second], axis=-1)
