"""Pictures of one hand under different light and in different cameras, for the gallery."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.sim.produce.video_encoding import through_h264
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.lighting import Lamp, Room
from hwp_bench.sim.scene.reader import load_scene
from hwp_bench.sim.scene.recorder import AutoControl
from hwp_bench.sim.scene.schema import Light, Scene, Sensor

#: Scene that is shown, the moment of it, and the edge of an image in pixels.
SHOWN, MOMENT, SIZE = "capture1", 0.87, 176
#: Pictures in a row.
COLUMNS = 5
# Upper left corner of what is shown of a camera's image, and the frames of its video.
_CORNER = (50, 44)
_RECORDED = 12
_AUTO = Sensor(noise=0.0, auto=AutoControl(wander=0.0))
_WALLS = Room(left=(0.9, 0.12, 0.08), right=(0.08, 0.55, 0.75))


def lights_shown(light: Light) -> dict[str, tuple[Light, Sensor]]:
    """Light and sensor of each picture, by its caption.

    Args:
        light: of the scene as it is.
    """
    fixed = Sensor(noise=0.0)
    window = Lamp(place=(-0.9, -0.2, 0.0), strength=1.5, width=0.9, height=1.2, kelvin=6500.0)
    bulb = Lamp(place=(-0.45, -0.1, -0.12), strength=1.0, width=0.04, kelvin=2900.0)
    blue = Lamp(place=(0.8, -0.3, -0.4), strength=0.5, width=0.15, color=(0.35, 0.5, 1.0))
    behind = Lamp(place=(0.45, -0.35, 0.45), strength=4.0, width=0.5, kelvin=6000.0, through=1.0)
    dim = replace(light, key=0.0, sky=0.3)
    back = replace(dim, sky=0.22, lamps=(behind,), backdrop=6.0)
    return {
        "as it is": (light, fixed),
        "window": (replace(dim, lamps=(window,)), fixed),
        "bulb, near": (replace(dim, sky=0.15, lamps=(bulb,)), fixed),
        "window right, low": (
            replace(dim, lamps=(replace(window, place=(0.8, 0.35, -0.3), kelvin=4500.0),)),
            fixed,
        ),
        "two lamps": (replace(dim, sky=0.15, lamps=(bulb, blue)), fixed),
        "coloured walls": (replace(dim, sky=1.3, room=_WALLS), fixed),
        "walls and window": (replace(dim, sky=0.6, room=_WALLS, lamps=(window,)), fixed),
        "backlight, fixed": (back, fixed),
        "backlight, auto": (back, _AUTO),
        "bulb, auto": (replace(dim, sky=0.05, lamps=(bulb,)), _AUTO),
    }


def light_sheet() -> np.ndarray:
    """One hand under the lights of `lights_shown`, each named: (H, W, 3) uint8."""
    scene = load_scene(SHOWN)
    cells = [
        captioned(_shown(replace(scene, light=light, sensor=sensor)), name)
        for name, (light, sensor) in lights_shown(scene.light).items()
    ]
    rows = [
        np.concatenate(cells[start : start + COLUMNS], axis=1)
        for start in range(0, len(cells), COLUMNS)
    ]
    return np.concatenate(rows, axis=0)


def sensors_shown() -> dict[str, Sensor]:
    """The sensor of each picture, by its caption."""
    return {
        "light": Sensor(noise=0.0),
        "noise": Sensor(noise=0.02),
        "sharpened": Sensor(noise=0.01, sharpening=1.2),
        "JPEG 40": Sensor(noise=0.01, jpeg_quality=40),
        "H.264 0.3": Sensor(noise=0.01, h264=0.3),
        "H.264 0.15": Sensor(noise=0.01, h264=0.15),
        "H.264 0.08": Sensor(noise=0.01, h264=0.08),
        "all": Sensor(noise=0.015, sharpening=1.2, jpeg_quality=80, h264=0.2),
    }


def camera_sheet() -> np.ndarray:
    """The middle of one frame in the cameras of `sensors_shown`, twice its size: (H, W, 3) uint8.

    Raises:
        HwpError: nothing here can encode H.264.
    """
    cells = []
    for name, sensor in sensors_shown().items():
        scene = replace(load_scene(SHOWN), sensor=sensor)
        image = _shown(scene) if not sensor.h264 else _recorded(scene)
        rows, columns = (slice(start, start + SIZE // 2) for start in _CORNER)
        cells.append(captioned(image[rows, columns].repeat(2, axis=0).repeat(2, axis=1), name))
    half = len(cells) // 2
    return np.concatenate(
        [np.concatenate(part, axis=1) for part in (cells[:half], cells[half:])], axis=0
    )


def _shown(scene: Scene, before: int = 0) -> np.ndarray:
    """The frame that is shown, or one before it."""
    frame = int(MOMENT * scene.frame_count) - before
    return render_frame(scene, frame, scene.frame_count, SIZE).clean


def _recorded(scene: Scene) -> np.ndarray:
    """The frame that is shown, as the last of a short video."""
    frames = (_shown(scene, before) for before in reversed(range(_RECORDED)))
    return list(through_h264(frames, scene.sensor.h264, scene.fps, scene.id))[-1]


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """A copy of an image (H, W, 3) uint8 with a text in its upper left corner."""
    import cv2

    drawn = image.copy()
    scale = len(image) / 420.0
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        place = (4, int(36 * scale))
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, width, cv2.LINE_AA)
    return drawn
