"""The compiled loop of `psnr_ssim`: from window means to SSIM, each number read once."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.compiled import compiled


@compiled(nogil=True)
def similarity(
    means: tuple[np.ndarray, np.ndarray],
    squares: tuple[np.ndarray, np.ndarray],
    product: np.ndarray,
    constants: tuple[float, float, float],
) -> None:
    """SSIM of every window and channel, in place of `product`.

    Variances are clamped at 0 and the covariance to what they allow.

    Args:
        means: (N,) float64 window means of x and of y.
        squares: (N,) float64 window means of x * x and of y * y.
        product: (N,) float64 window means of x * y; is overwritten.
        constants: C1, C2, and the factor on variances and covariance.

    Source: Wang et al., 2004, equation 13.
    """
    mean_x, mean_y = means
    square_x, square_y = squares
    c1, c2, correction = constants
    twice = 2.0 * correction
    for i in range(len(product)):
        x, y = mean_x[i], mean_y[i]
        xx, yy, xy = x * x, y * y, x * y
        variance_x, variance_y = max(square_x[i] - xx, 0.0), max(square_y[i] - yy, 0.0)
        bound = np.sqrt(variance_x * variance_y)
        covariance = max(min(product[i] - xy, bound), -bound)
        numerator = (xy * 2.0 + c1) * (covariance * twice + c2)
        spread = (variance_x + variance_y) * correction + c2
        product[i] = numerator / ((xx + yy + c1) * spread)
