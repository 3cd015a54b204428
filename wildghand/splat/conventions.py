"""The numbers that every backend must share, so that they draw the same image.

They are those of gsplat's CUDA kernels (pixel centres at +0.5, OpenCV camera axes).
"""

from __future__ import annotations

#: A splat does not change a pixel where its alpha is below this.
MIN_ALPHA = 1.0 / 255.0
#: Alpha is clamped here, so that the transmittance behind a splat is never zero.
MAX_ALPHA = 0.999
#: The splat that would bring the transmittance of a pixel down to this, and all behind it,
#: are left out.
MIN_TRANSMITTANCE = 1e-4
#: Half of the margin, as a share of the image size, by which the tangent of the view angle may
#: leave the image before the Jacobian of the perspective is frozen (the EWA approximation
#: has no meaning far outside the image).
FRUSTUM_MARGIN = 0.15
#: A colour beyond this counts as not finite: sums over a pixel must fit into a float32, and
#: so must the gradients of a loss that is quadratic in the colours.
MAX_COLOR = 1e15

#: Values of `render_mode`, as in gsplat.
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
#: Values of `rasterize_mode`, as in gsplat.
RASTERIZE_MODES = ("classic", "antialiased")
#: A splat is culled where its visible part reaches farther than this many pixels from its
#: centre, or is so thin that the inverse of its variance (px^-2) exceeds MAX_PRECISION.
MAX_REACH = 1e30
MAX_PRECISION = 1e30
