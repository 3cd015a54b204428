"""Draws what a scene has behind the hands: over the backdrop, below everything that is cast."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.behind import Face
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.subject.skin import skin_color

# Share of the time in which eyes are closed.
_BLINK = 0.06


def draw_behind(
    scene: Scene, directions: np.ndarray, seconds: float, image: np.ndarray
) -> np.ndarray:
    """Draw clutter, face and arm, the nearest last.

    Each module is imported only where a scene shows what it draws.

    Args:
        scene: whose `behind` is drawn.
        directions: (H, W, 3) of the pixels, world, z away from the camera.
        seconds: time of the capture.
        image: (H, W, 3) linear reflectance of the backdrop.

    Returns:
        (H, W, 3) float64 linear reflectance.
    """
    behind = scene.behind
    drawn = image.astype(np.float64)
    half = float(np.tan(np.radians(scene.camera.field_of_view) / 2.0))
    slope = directions[..., :2] / np.maximum(directions[..., 2:], 1e-3) / half
    places = (slope[..., 0], slope[..., 1])
    if behind.clutter is not None:
        from hwp_bench.sim.props.drifting import draw_clutter

        draw_clutter(
            drawn,
            places,
            seconds,
            count=behind.clutter.count,
            speed=behind.clutter.speed,
            seed=behind.clutter.seed,
        )
    if behind.face is not None:
        _draw_face(drawn, places, seconds, behind.face, scene.subject.tone)
    if behind.arm is not None:
        from hwp_bench.sim.props.other_arm import draw_arm

        arm = behind.arm
        tone = scene.subject.tone if arm.tone is None else arm.tone
        draw_arm(
            drawn,
            places,
            seconds,
            srgb_to_linear(skin_color(tone)),
            left=arm.side == "left",
            reach=arm.reach,
            sway=arm.sway,
            pace=arm.pace,
            seed=arm.seed,
        )
    return drawn


def _draw_face(
    image: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    seconds: float,
    face: Face,
    tone: float,
) -> None:
    import cv2

    from hwp_bench.sim.props.face import COLUMNS, FRAME, ROWS, face_picture

    rng = generator(face.seed, "face moves")
    rates, phases = rng.uniform(0.5, 1.9, 3), rng.uniform(0.0, 2.0 * np.pi, 4)
    waves = np.sin(rates * seconds + phases[:3])
    closed = (0.31 * seconds + phases[3]) % 1.0 < _BLINK
    red, green, blue = skin_color(tone if face.tone is None else face.tone).tolist()
    picture = face_picture((red, green, blue), face.seed, bool(closed))
    sway = face.sway * face.size
    x = (places[0] - face.place[0] - sway * waves[0]) / face.size
    y = (places[1] - face.place[1] - 0.5 * sway * waves[1]) / face.size
    tilt = 0.7 * face.sway * waves[2]
    u = np.cos(tilt) * x + np.sin(tilt) * y
    v = np.cos(tilt) * y - np.sin(tilt) * x
    columns = (u - FRAME[0]) / (FRAME[1] - FRAME[0]) * (COLUMNS - 1)
    rows = (v - FRAME[2]) / (FRAME[3] - FRAME[2]) * (ROWS - 1)
    # Below the frame the shoulders go on.
    rows = np.where(rows > ROWS - 1, np.minimum(rows, ROWS - 1.0), rows)
    seen = cv2.remap(
        picture,
        columns.astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
    )
    image *= 1.0 - seen[..., 3:]
    image += seen[..., :3]
