"""One row of 16 float32 for each Gaussian of each image: all that tiles need, one cache line.

A projected Gaussian is kept as its exponent is evaluated. With e the distance across pixel rows
and u the distance along the row from the splat's centre line, both scaled,

    log2(alpha) = log2(opacity) - e^2 - u^2
    e = across * dy,   u = along * (dx + shear * dy)

which is the Cholesky form of the inverse covariance. Both squares stay small wherever the splat
is visible, so a needle hundreds of pixels long loses no digits in float32; the usual
a dx^2 + 2 b dx dy + c dy^2 loses all of them. Centre and shear are pairs of float32 (value
and rounding error) because the distance to a pixel is a difference of nearly equal numbers.
"""

from __future__ import annotations

#: Floats in a row.
ROW = 16
MEAN_X, MEAN_Y, MEAN_X_LOW, MEAN_Y_LOW, SHEAR, SHEAR_LOW, ALONG, ACROSS = range(8)
#: log2 of the opacity.
LOG2_OPACITY = 8
#: Half the size in pixels of the box around the visible part.
REACH_X, REACH_Y = 9, 10
#: dy of the visible part's rightmost point; its leftmost has the opposite.
TANGENT_Y = 11
#: First row of tiles that it touches, and how many.
FIRST_ROW, ROWS = 12, 13
