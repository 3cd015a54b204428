"""The sensor: noise, rows that are read in turn, sharpened edges, and the JPEG that is stored.

It is not a perturbation: a frame and its clean version both pass it, with the same noise. H.264
needs the whole clip; `hwp_bench.sim.produce.video_encoding` is its pass over the stored frames.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import LUMA
from hwp_bench.sim.effects.base import Effect
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.schema import Scene

#: Standard deviation of the blur that sharpening subtracts, px.
SHARPENING_RADIUS = 1.0


class _Sensor(Effect):
    name = "sensor"

    def passes(self, scene: Scene) -> tuple[str, ...]:
        sensor = scene.sensor
        asked = {
            "rolling": sensor.rolling_shutter,
            "auto": sensor.auto is not None,
            "sensor": sensor.noise,
            "sharpening": sensor.sharpening,
            "jpeg": sensor.jpeg_quality,
            "h264": sensor.h264,
        }
        return tuple(name for name, setting in asked.items() if setting)

    def readout(self, scene: Scene) -> float:
        return scene.sensor.rolling_shutter

    def record(
        self, scene: Scene, frame: int, colors: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, ...]:
        if not scene.sensor.noise:
            return colors
        rng = generator(scene.seed, "sensor", frame)
        noise = scene.sensor.noise * rng.normal(size=colors[0].shape)
        # Counted photons scatter with the square root of their number.
        return tuple(color + noise * np.sqrt(np.clip(color, 0.02, 1.0)) for color in colors)

    def store(self, scene: Scene, image: np.ndarray) -> np.ndarray:
        if scene.sensor.sharpening:
            image = sharpened(image, scene.sensor.sharpening)
        if not scene.sensor.jpeg_quality:
            return image
        import cv2

        quality = [cv2.IMWRITE_JPEG_QUALITY, scene.sensor.jpeg_quality]
        _, packed = cv2.imencode(".jpg", image[..., ::-1], quality)
        stored = cv2.imdecode(packed, cv2.IMREAD_COLOR)
        assert stored is not None
        return np.ascontiguousarray(stored[..., ::-1], dtype=np.uint8)


def sharpened(image: np.ndarray, strength: float) -> np.ndarray:
    """Unsharp mask on the luma, as a phone applies it after the tone curve.

    Args:
        image: (H, W, 3) uint8 sRGB.
        strength: share of the fine structure that is added.

    Returns:
        (H, W, 3) uint8; colours keep their differences from the luma.
    """
    import cv2

    luma = image.astype(np.float32) @ np.array(LUMA, dtype=np.float32)
    fine = luma - cv2.GaussianBlur(luma, (0, 0), SHARPENING_RADIUS)
    raised = image + (strength * fine)[..., None]
    return np.clip(np.round(raised), 0, 255).astype(np.uint8)


EFFECT = _Sensor()
