"""How an image is cut up: tiles, blocks of pixels that fill one vector, and constants.

A splat is a small blob. A vector of pixels shaped as a block (4 x 4 rather than 16 x 1) misses
it less often, so fewer lanes are wasted. Each tile has 16 blocks, so that one 16-lane vector
says which blocks of a tile a splat can reach.
"""

from __future__ import annotations

import math

import llvmlite.binding
import numpy as np
from numba import types
from numba.core import config

from wildghand.splat import conventions as rules
from wildghand.splat.kernels.lanes import make_constant, make_fill, make_load
from wildghand.splat.kernels.simd import Vector


def _lanes() -> int:
    """float32 lanes of the widest registers of the processor that numba compiles for."""
    features = getattr(config, "CPU_FEATURES", None)  # of NUMBA_CPU_FEATURES
    if features is None:
        try:
            features = llvmlite.binding.get_host_cpu_features().flatten()
        except RuntimeError:  # not every platform can tell
            features = ""
    return 16 if "+avx512f" in features and "+avx512vl" in features else 8


#: Pixels in a block: one vector.
LANES = _lanes()
#: Blocks in a tile.
BLOCKS = 16
#: Shape of a block in pixels.
BLOCK_WIDTH, BLOCK_HEIGHT = (4, 4) if LANES == 16 else (4, 2)
#: Blocks side by side in a tile.
BLOCK_COLUMNS = 4
#: Shape of a tile in pixels.
TILE_WIDTH = BLOCK_COLUMNS * BLOCK_WIDTH
TILE_HEIGHT = BLOCKS // BLOCK_COLUMNS * BLOCK_HEIGHT

#: A vector with one lane for each pixel of a block.
PIXELS = Vector(types.float32, LANES)
#: A vector with one lane for each block of a tile.
PER_BLOCK_EXACT = Vector(types.float64, BLOCKS)

fill_pixels = make_fill(PIXELS)
load_pixels = make_load(PIXELS)
#: Column and row of each pixel in its block.
pixel_column = make_constant(PIXELS, [lane % BLOCK_WIDTH for lane in range(LANES)])
pixel_row = make_constant(PIXELS, [lane // BLOCK_WIDTH for lane in range(LANES)])
#: Column and row in its tile of each block's first pixel.
block_column = make_constant(
    PER_BLOCK_EXACT, [block % BLOCK_COLUMNS * BLOCK_WIDTH for block in range(BLOCKS)]
)
block_row = make_constant(
    PER_BLOCK_EXACT, [block // BLOCK_COLUMNS * BLOCK_HEIGHT for block in range(BLOCKS)]
)

#: log2 of the alpha at which a splat ends, and of the largest alpha.
LOG2_MIN_ALPHA = np.float32(math.log2(rules.MIN_ALPHA))
LOG2_MAX_ALPHA = np.float32(math.log2(rules.MAX_ALPHA))
MIN_TRANSMITTANCE = np.float32(rules.MIN_TRANSMITTANCE)
