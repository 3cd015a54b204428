"""The wild suites for people: what each capture is, what sets share, and contact sheets.

Run from the repository: `python -m benchmarks.wild wild-dev` prints a table of the captures and one
of the parts that sets share (docs/wild.md); `--picture FILE` also draws some frames of every
capture of the suite, a row each, and renders captures that are not in the cache.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import wildghand
from benchmarks.scene_overlap import KINDS, counts, parts, shared
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import Column, Table, to_markdown
from hwp_bench.sim.hand.rigs import SHIPPED
from hwp_bench.sim.produce.capture import ensure_suite
from hwp_bench.sim.produce.preview import captioned
from hwp_bench.sim.scene.scene import Scene, level
from hwp_bench.sim.scene_files import load_scene, scene_groups, scene_names

#: Frames of a capture in its row, and their edge in pixels.
COLUMNS, SIZE = 8, 104
#: Where the prior's scenes are.
PRIOR = Path(wildghand.__file__).parent / "priors" / "scenes"
_QUALITY = 82
_SHORT = {
    "hand_object_interaction": "interaction",
    "complex_poses": "poses",
    "illumination": "illumination",
    "motion_blur": "blur",
}


def sets() -> dict[str, list[Scene]]:
    """Every set of scenes by its name: the paper's captures, the groups, those of the prior."""
    found = {"captures": [load_scene(name) for name in scene_names()]}
    found |= {group: [load_scene(name) for name in scene_names(group)] for group in scene_groups()}
    found["prior"] = [load_scene(str(path)) for path in sorted(PRIOR.glob("*.toml"))]
    return found


def capture_table(scenes: Sequence[Scene]) -> Table:
    """What each capture of a suite is."""
    columns = ("capture", "hands", "perturbations", "person", "light", "behind", "camera, hands")
    rows = tuple(
        (
            scene.id,
            scene.hands,
            ", ".join(_SHORT[call.kind] for call in scene.effects),
            _person(scene),
            _light(scene),
            ", ".join([scene.background, *_behind(scene)]),
            _camera(scene),
        )
        for scene in scenes
    )
    return Table("What each capture is", tuple(map(Column, columns)), rows, ranked=False)


def disjoint_table(found: Mapping[str, Sequence[Scene]]) -> Table:
    """How many different parts each set of scenes has, and what pairs of sets share."""
    rows: list[tuple[Any, ...]] = [
        (name, *(counts(scenes)[kind] for kind in KINDS)) for name, scenes in found.items()
    ]
    for first, second in itertools.combinations(found, 2):
        lines = shared(found[first], found[second])
        common = [sum(line.startswith(f"{kind} ") for line in lines) for kind in KINDS]
        rows.append((f"{first} and {second} share", *common))
    return Table("Parts", tuple(map(Column, ("set", *KINDS))), tuple(rows), ranked=False)


def sheet(suite: str) -> np.ndarray:
    """Some frames of every capture, perturbed and clean in turn, a row each: (H, W, 3) uint8."""
    import cv2

    from hwp_bench.capture import open_capture

    rows = []
    for folder in ensure_suite(suite):
        capture = open_capture(folder)
        scene = load_scene(capture.info.id)
        frames = [capture.frame(frame) for frame in shown_frames(scene, capture.info.frame_count)]
        small = [cv2.resize(frame, (SIZE, SIZE), interpolation=cv2.INTER_AREA) for frame in frames]
        small[0] = captioned(small[0], capture.info.id.rpartition("-")[2])
        rows.append(np.concatenate(small, axis=1))
    return np.concatenate(rows, axis=0)


def shown_frames(scene: Scene, frame_count: int) -> list[int]:
    """Half of the frames from the episodes, strongest first, the others without perturbation."""
    moments = np.arange(frame_count) / frame_count
    strength = np.array([max(level(call, m) for call in scene.effects) for m in moments])
    middles = [0.5 * (part.start + part.end) for call in scene.effects for part in call.episodes]
    busy = sorted({round(middle * frame_count) for middle in middles})
    clean = np.flatnonzero(strength == 0.0)
    half = COLUMNS // 2
    chosen = [busy[i] for i in np.linspace(0, len(busy) - 1, half).astype(int)]
    chosen += list(clean[np.linspace(0, len(clean) - 1, COLUMNS - half).astype(int)])
    return sorted(int(frame) for frame in chosen)


def _person(scene: Scene) -> str:
    subject, looks = scene.subject, scene.subject.looks
    words = [f"tone {subject.tone:g}", f"{subject.age:g} years"]
    if subject.model.startswith(SHIPPED):
        words.append(f"rig {subject.model.removeprefix(SHIPPED)}")
    if subject.anatomy is not None:
        words.append(f"joints {subject.anatomy.joint_shift:g} mm")
    marks = {name: getattr(looks, name) for name in ("freckles", "wrinkles", "hair")}
    words += [name for name, value in marks.items() if value > 0.0]
    words += [f"{glove.kind} glove" for glove in looks.gloves]
    words += ["tattoos"] * bool(looks.tattoos) + ["polish"] * bool(looks.polish)
    words += ["rings"] * bool(looks.rings) + [item.kind for item in looks.wrist]
    shown = sorted(text for kind, text in parts(scene) if kind == "object")
    words += ["bare forearm"] * (looks.arm == "bare") + shown
    return ", ".join(words)


def _light(scene: Scene) -> str:
    light = scene.light
    lamps = sum(lamp.width < 0.4 for lamp in light.lamps)
    windows = len(light.lamps) - lamps
    words = ["key light"] * (light.key > 0.0) + ["walls"] * (light.room is not None)
    words += [f"{lamps} lamp" + "s" * (lamps > 1)] * bool(lamps)
    words += [f"{windows} window" + "s" * (windows > 1)] * bool(windows)
    behind = any(lamp.place[2] > 0.0 for lamp in light.lamps)
    return ", ".join(words + ["from behind"] * behind)


def _behind(scene: Scene) -> list[str]:
    there = {"clutter": scene.behind.clutter, "face": scene.behind.face, "arm": scene.behind.arm}
    return [name for name, what in there.items() if what is not None]


def _camera(scene: Scene) -> str:
    sensor = scene.sensor
    words = ["auto"] * (sensor.auto is not None) + ["sharp"] * (sensor.sharpening > 0.0)
    words += ["JPEG"] * (sensor.jpeg_quality > 0) + ["rolling"] * (sensor.rolling_shutter > 0.0)
    return ", ".join(words + ["tracker"] * (scene.estimator is not None))


def main() -> None:
    """Print the tables of a suite and draw its sheet if asked."""
    import cv2

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("suite", choices=scene_groups())
    parser.add_argument("--picture", type=Path, help="write a contact sheet")
    args = parser.parse_args()
    found = sets()
    print(to_markdown(capture_table(found[args.suite])))
    print(to_markdown(disjoint_table(found)), end="")
    if args.picture is not None:
        image = np.ascontiguousarray(sheet(args.suite)[..., ::-1])
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        print(atomic_write(args.picture, data.tobytes()))


if __name__ == "__main__":
    main()
