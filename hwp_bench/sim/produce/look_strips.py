"""Pictures of looks and of what can be behind a hand, for the documentation's gallery."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.sim.produce.light_strips import captioned
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.behind import Behind, Clutter, Face, OtherArm
from hwp_bench.sim.scene.looks import Glove, Looks, Polish, Ring, Tattoo, WristWear
from hwp_bench.sim.scene.reader import load_scene
from hwp_bench.sim.scene.schema import HandKey, Scene, Sensor, Track

#: Scene whose light and subject are shown, and the edge of an image in pixels.
SHOWN, SIZE = "capture1", 160
#: Pictures in a row.
COLUMNS = 7
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
    scene = load_scene(SHOWN)
    key = HandKey("open", (0.0, -0.005, 0.0), turn=6.0, tilt=8.0)
    scene = replace(
        scene,
        hands="right",
        track=Track(4.0, {"right": (key,)}, 0.0),
        camera=replace(scene.camera, field_of_view=_VIEW),
        sensor=Sensor(noise=0.0),
        effects=(),
    )
    cells = []
    for name, (tone, age, looks) in looks_shown().items():
        subject = replace(scene.subject, tone=tone, age=age, looks=looks)
        cells.append(captioned(_shown(replace(scene, subject=subject)), name))
    small = replace(scene.subject, looks=Looks(arm="bare"))
    for name, (background, behind) in backdrops_shown().items():
        there = replace(scene, subject=small, background=background, behind=behind)
        cells.append(captioned(_shown(there), name))
    rows = [
        np.concatenate(cells[start : start + COLUMNS], axis=1)
        for start in range(0, len(cells), COLUMNS)
    ]
    return np.concatenate(rows, axis=0)


def _shown(scene: Scene) -> np.ndarray:
    return render_frame(scene, 40, 100, SIZE).clean
