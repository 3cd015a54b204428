"""The documentation's pictures of scenes, severities, light, looks and cameras.

python -m tools.sim_gallery -o docs/pictures/sim
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import track
from hwp_bench.base.errors import HwpError
from hwp_bench.base.files import atomic_write, check_places
from hwp_bench.sim.effects import EFFECTS, hands_at
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.light.lights import Lamp, Light, Room
from hwp_bench.sim.produce.free_view import FRAMES, free_views, render_free
from hwp_bench.sim.produce.preview import captioned, strip
from hwp_bench.sim.props.behind import Behind, Clutter, Face, OtherArm
from hwp_bench.sim.render.frame import SimulatedFrame, render_frame, steady_gain
from hwp_bench.sim.scene.scene import (
    EffectCall,
    HandKey,
    Scene,
    Track,
    hand_parameters,
    intrinsics,
    scene_hands,
    viewmat,
    with_effects,
    with_severity,
)
from hwp_bench.sim.scene_files import load_scene, scene_names
from hwp_bench.sim.sensor import AutoControl, Sensor, check_encoder, through_h264
from hwp_bench.sim.subject.subject import Looks
from hwp_bench.sim.subject.wear import Glove, Polish, Ring, Tattoo, WristWear
from hwp_bench.taxonomy import MAX_SEVERITY

#: Scene that is shown, the moment of it, and the edge of an image in pixels.
_LIT, _LIT_MOMENT, _LIT_SIZE = "capture1", 0.87, 176
#: Pictures in a row.
_LIT_COLUMNS = 5
# Upper left corner of what is shown of a camera's image, and the frames of its video.
_CORNER = (50, 44)
_RECORDED = 12
_AUTO = Sensor(noise=0.0, auto=AutoControl(wander=0.0))
_WALLS = Room(left=(0.9, 0.12, 0.08), right=(0.08, 0.55, 0.75))


def lights_shown(light: Light) -> dict[str, tuple[Light, Sensor]]:
    """Light and sensor of each picture, by its caption."""
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
    scene = load_scene(_LIT)
    cells = [
        captioned(_lit_frame(replace(scene, light=light, sensor=sensor)), name)
        for name, (light, sensor) in lights_shown(scene.light).items()
    ]
    rows = [
        np.concatenate(cells[start : start + _LIT_COLUMNS], axis=1)
        for start in range(0, len(cells), _LIT_COLUMNS)
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
    """The middle of one frame in the cameras of `sensors_shown`, twice its size: (H, W, 3)."""
    cells = []
    for name, sensor in sensors_shown().items():
        scene = replace(load_scene(_LIT), sensor=sensor)
        image = _lit_frame(scene) if not sensor.h264 else _recorded(scene)
        rows, columns = (slice(start, start + _LIT_SIZE // 2) for start in _CORNER)
        cells.append(captioned(image[rows, columns].repeat(2, axis=0).repeat(2, axis=1), name))
    half = len(cells) // 2
    return np.concatenate(
        [np.concatenate(part, axis=1) for part in (cells[:half], cells[half:])], axis=0
    )


def _lit_frame(scene: Scene, before: int = 0) -> np.ndarray:
    """The frame that is shown, or one before it."""
    frame = int(_LIT_MOMENT * scene.frame_count) - before
    return render_frame(scene, frame, scene.frame_count, _LIT_SIZE).clean


def _recorded(scene: Scene) -> np.ndarray:
    """The frame that is shown, as the last of a short video."""
    frames = (_lit_frame(scene, before) for before in reversed(range(_RECORDED)))
    return list(through_h264(frames, scene.sensor.h264, scene.fps, scene.id))[-1]


#: Scene whose light and subject are shown, and the edge of an image in pixels.
_LOOK, _LOOK_SIZE = "capture1", 160
#: Pictures in a row.
_LOOK_COLUMNS = 7
# Field of view, degrees: hand and wrist are in the picture.
_VIEW = 30.0
_NAILS = ((0.10, 0.25, 0.70), (0.90, 0.75, 0.10), (0.10, 0.60, 0.40), (0.85, 0.25, 0.50))


def looks_shown() -> dict[str, tuple[float, float, Looks]]:
    """Tone, age and looks of each picture, by its caption."""
    red = Polish(((0.62, 0.02, 0.06),))
    return {
        "tone -0.4": (-0.4, 25.0, Looks(arm="bare")),
        "freckles": (0.0, 30.0, Looks(freckles=1.0, blood=0.5)),
        "wrinkles": (0.25, 85.0, Looks(wrinkles=1.0, freckles=0.35)),
        "hair": (0.2, 40.0, Looks(hair=1.0, arm="bare")),
        "olive": (0.45, 30.0, Looks(yellow=1.0, arm="bare")),
        "tone 1.0": (1.0, 35.0, Looks()),
        "tone 1.4": (1.4, 30.0, Looks(arm="bare")),
        "mandala, bands": (
            0.25,
            30.0,
            Looks(tattoos=(Tattoo("mandala", size=1.2), Tattoo("bands", "fingers", seed=3))),
        ),
        "vine, letters": (
            0.5,
            30.0,
            Looks(tattoos=(Tattoo("vine", seed=3, size=1.3), Tattoo("letters", "fingers", 4))),
        ),
        "polish, rings": (
            0.1,
            30.0,
            Looks(polish=(red,), rings=(Ring("ring", stone=0.006), Ring("index", "silver"))),
        ),
        "five colours": (
            0.75,
            25.0,
            Looks(polish=(Polish((*_NAILS, (0.9, 0.9, 0.9))),), rings=(Ring("thumb", "black"),)),
        ),
        "watch": (0.6, 40.0, Looks(arm="bare", wrist=(WristWear("watch", side="both"),))),
        "fingerless": (0.3, 30.0, Looks(gloves=(Glove("fingerless", (0.13, 0.15, 0.18)),))),
        "work glove": (0.3, 30.0, Looks(arm="bare", gloves=(Glove("work", (0.75, 0.58, 0.22)),))),
    }


def backdrops_shown() -> dict[str, tuple[str, Behind]]:
    """Backdrop and what is before it in each picture, by its caption."""
    clutter, face, arm = Clutter(count=14), Face(), OtherArm(reach=1.1)
    return {
        "wood": ("wood", Behind()),
        "cardboard": ("cardboard", Behind()),
        "sand": ("sand", Behind()),
        "beige wall": ("beige_wall", Behind()),
        "clutter": ("office", Behind(clutter=clutter)),
        "face": ("living", Behind(face=face)),
        "other arm": ("kitchen", Behind(arm=arm)),
    }


def look_sheet() -> np.ndarray:
    """One hand with the looks and before the backdrops shown, each named: (H, W, 3) uint8."""
    scene = load_scene(_LOOK)
    key = HandKey("open", (0.0, -0.005, 0.0), turn=6.0, tilt=8.0)
    scene = replace(
        scene,
        hands="right",
        track=Track(4.0, right=(key,), variation=0.0),
        camera=replace(scene.camera, field_of_view=_VIEW),
        sensor=Sensor(noise=0.0),
        effects=(),
    )
    cells = []
    for name, (tone, age, looks) in looks_shown().items():
        subject = replace(scene.subject, tone=tone, age=age, looks=looks)
        cells.append(captioned(_look_frame(replace(scene, subject=subject)), name))
    small = replace(scene.subject, looks=Looks(arm="bare"))
    for name, (background, behind) in backdrops_shown().items():
        there = replace(scene, subject=small, background=background, behind=behind)
        cells.append(captioned(_look_frame(there), name))
    rows = [
        np.concatenate(cells[start : start + _LOOK_COLUMNS], axis=1)
        for start in range(0, len(cells), _LOOK_COLUMNS)
    ]
    return np.concatenate(rows, axis=0)


def _look_frame(scene: Scene) -> np.ndarray:
    return render_frame(scene, 40, 100, _LOOK_SIZE).clean


#: Edge of an image in pixels.
GALLERY_SIZE = 176
#: Images in the strip of a capture.
STRIP_FRAMES = 8
#: Scene in which each perturbation is shown.
SHOWN_IN = (
    ("hand_object_interaction", "capture0"),
    ("complex_poses", "capture1"),
    ("illumination", "capture2"),
    ("motion_blur", "capture3"),
)
#: Scenes whose free-view clips are shown.
FREE_SHOWN = ("capture2", "capture4")
_QUALITY = 88


def write_gallery(folder: Path) -> list[Path]:
    """Write `captureN.jpg`, `severity-KIND.jpg`, `free-view.jpg`, and the sheets by name.

    The sheets are `lights.jpg`, `looks.jpg` and `cameras.jpg`.

    The last one is left out where nothing can encode H.264.
    """
    paths = []
    for name in track(scene_names(), "Strips of the captures"):
        scene = load_scene(name)
        paths.append(_write(folder / f"{name}.jpg", strip(_capture_strip(scene), STRIP_FRAMES)))
    for kind, name in track(SHOWN_IN, "Strips of the severities"):
        image = strip(_severity_strip(load_scene(name), kind), MAX_SEVERITY + 1)
        paths.append(_write(folder / f"severity-{kind}.jpg", image))
    rows = [free_view_strip(load_scene(name)) for name in FREE_SHOWN]
    paths.append(_write(folder / "free-view.jpg", np.concatenate(rows)))
    paths.append(_write(folder / "lights.jpg", light_sheet()))
    paths.append(_write(folder / "looks.jpg", look_sheet()))
    with contextlib.suppress(HwpError):
        check_encoder("the gallery")
        paths.append(_write(folder / "cameras.jpg", camera_sheet()))
    return paths


def free_view_strip(scene: Scene) -> np.ndarray:
    """Two rows of frames of the free-view clip, with their numbers."""
    cost = RenderCost()
    gain = steady_gain(scene, cost)
    picks = evenly(FRAMES, 2 * STRIP_FRAMES).tolist()
    views = free_views(scene)
    cells = []
    for frame in picks:
        _, image, _ = render_free(scene, views[frame], GALLERY_SIZE, gain, cost)
        cells.append(captioned(image, str(frame)))
    rows = cells[:STRIP_FRAMES], cells[STRIP_FRAMES:]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _capture_strip(scene: Scene) -> list[SimulatedFrame]:
    """The middle of the first episodes of each effect in turn, between clean frames."""
    busy = [
        0.5 * (part.start + part.end)
        for step in range(3)
        for call in scene.effects
        for part in call.episodes[step : step + 1]
    ][: STRIP_FRAMES - 3]
    moments = sorted([0.0, *busy, 0.87, 0.96])
    moments += [0.8, 0.83, 0.99, 0.9]
    frames = [int(moment * scene.frame_count) for moment in sorted(moments[:STRIP_FRAMES])]
    return [render_frame(scene, frame, scene.frame_count, GALLERY_SIZE) for frame in frames]


def _severity_strip(scene: Scene, kind: str) -> list[SimulatedFrame]:
    """One frame at severity 0 to 5, with nothing else acting."""
    call = scene.effect(kind)
    assert call is not None
    part = call.episodes[0]
    frame = int(0.5 * (part.start + part.end) * scene.frame_count)
    results: list[SimulatedFrame] = []
    for severity in range(1, MAX_SEVERITY + 1):
        alone = with_severity(with_effects(scene, [kind]), severity)
        result = render_frame(alone, frame, scene.frame_count, GALLERY_SIZE)
        if not results:
            results.append(_clean_twin(result))
        results.append(_with_estimate(alone, call, result) if kind == "complex_poses" else result)
    return results


def _clean_twin(result: SimulatedFrame) -> SimulatedFrame:
    none = dict.fromkeys(result.plan.severity, 0)
    return replace(result, rgb=result.clean, plan=replace(result.plan, severity=none))


def _with_estimate(scene: Scene, call: EffectCall, result: SimulatedFrame) -> SimulatedFrame:
    """The frame with the joints where an estimator of this severity sees them."""
    import cv2
    import torch

    from hwp_bench.hands import pose_hand, project

    seconds = result.plan.seconds
    angle, length = EFFECTS[call.kind].estimate_error(result.plan.strength[call.kind])
    rng = generator(scene.seed, "gallery")
    image = result.rgb.copy()
    for side, moment in hands_at(scene, seconds).items():
        hand = scene_hands(scene)[side]
        pose, transl = hand_parameters(moment, side, hand.joints)
        pose = pose + angle * rng.normal(size=pose.shape)
        transl = transl + length * rng.normal(size=3)
        arrays = (pose[None], hand.betas, transl[None])
        posed = pose_hand(hand.tensors, *(torch.as_tensor(array) for array in arrays))
        view = torch.as_tensor(viewmat(scene, seconds))[None]
        K = torch.as_tensor(intrinsics(scene, len(image)))[None]
        pixels = project(posed.landmarks, view, K)[0][0].numpy()
        for first in range(1, 21, 4):
            chain = np.vstack([pixels[:1], pixels[first : first + 4]])
            cv2.polylines(
                image, [np.round(chain).astype(np.int32)], False, (255, 140, 0), 1, cv2.LINE_AA
            )
    return replace(result, rgb=image)


def _write(path: Path, image: np.ndarray) -> Path:
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), settings)
    return atomic_write(path, data.tobytes())


def main() -> None:
    """Write the documentation's strips and sheets, and print their paths."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--out", default="docs/pictures/sim", help="folder")
    args = parser.parse_args()
    check_places({"--out": args.out}, {})
    for path in write_gallery(Path(args.out)):
        print(path)


if __name__ == "__main__":
    main()
