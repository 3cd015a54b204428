"""The sensor: noise, and linear light turned into 8-bit sRGB. Every frame passes it."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.colors import linear_to_srgb
from hwp_bench.sim.scene import Scene
from hwp_bench.sim.seeds import generator


def sensor_noise(scene: Scene, frame: int, size: int) -> np.ndarray:
    """The noise of one frame, the same for its clean version: (S, S, 3), before scaling."""
    rng = generator(scene.seed, "sensor", frame)
    return scene.noise * rng.normal(size=(size, size, 3))


def develop(color: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
    """Turn linear light into 8-bit sRGB.

    Args:
        color: (S, S, 3) linear.
        noise: what `sensor_noise` returns, or None. It grows with the square root of the light,
            as the noise of counted photons does.
    """
    if noise is not None:
        color = color + noise * np.sqrt(np.clip(color, 0.02, 1.0))
    return np.round(linear_to_srgb(color) * 255.0).astype(np.uint8)
