"""What looks and moving backgrounds cost, and what colours like skin do to estimated masks.

Run from the repository: `python -m benchmarks.looks` prints, for every item, the passes that it
adds to each frame in `hwp-bench dev plan`, the processor seconds a frame with and without it, and
the processor seconds that its paint takes once for a subject;
`python -m benchmarks.looks --masks 24` prints, over that many frames before every backdrop, the
intersection over union of estimated and exact mask, and which share of the hand's area is taken
too much and too little.

Seconds: the cheapest of `--repeats` renders of the same frame, one process, in turns with the
frame without the item; the first render, which paints, is left out. The paint's seconds hold for
an empty cache: the run has a cache folder of its own.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace

import numpy as np

from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.produce.estimates import confused_mask, estimate_mask
from hwp_bench.sim.props.behind import Behind, Clutter, Face, OtherArm, plane_names
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.subject.arms import arm_atlas
from hwp_bench.sim.subject.hand import of_side, skin_atlas
from hwp_bench.sim.subject.subject import Looks
from hwp_bench.sim.subject.wear import Glove, Polish, Ring, Tattoo, WristWear

#: Scene that is varied; frames over which it is spread, and the frame that is timed (clean).
SCENE, SPREAD, FRAME = "capture1", 240, 235


def items(scene: Scene) -> dict[str, Scene]:
    """The scene with one item each, by the item's name."""
    looks = {
        "freckles": Looks(freckles=1.0),
        "wrinkles": Looks(wrinkles=1.0),
        "hair": Looks(hair=1.0),
        "tattoo": Looks(tattoos=(Tattoo("mandala"),)),
        "nail polish": Looks(polish=(Polish(((0.6, 0.0, 0.1),)),)),
        "work gloves": Looks(gloves=(Glove("work"),)),
        "two rings": Looks(rings=(Ring("ring"), Ring("index", stone=0.006))),
        "watch": Looks(wrist=(WristWear("watch", side="both"),)),
        "beads": Looks(wrist=(WristWear("beads", side="both"),)),
        "bare forearm": Looks(arm="bare"),
    }
    behind = {
        "clutter (8)": Behind(clutter=Clutter()),
        "face": Behind(face=Face()),
        "other arm": Behind(arm=OtherArm()),
    }
    varied = {
        name: replace(scene, subject=replace(scene.subject, looks=look))
        for name, look in looks.items()
    }
    varied |= {name: replace(scene, background=name) for name in plane_names()}
    return varied | {name: replace(scene, behind=what) for name, what in behind.items()}


def measure_cost(repeats: int, size: int) -> None:
    """Print passes, seconds a frame and seconds of painting for every item."""
    plain = replace(load_scene(SCENE), effects=())
    usual = plan_frame(plain, FRAME, SPREAD, size).passes
    render_frame(plain, FRAME, SPREAD, size)  # loads and compiles what every item needs
    print("| item | added passes | s a frame without | with | more | painted once, s |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    for name, scene in items(plain).items():
        painting = _painting(scene)
        best: dict[str, list[float]] = {}
        for _ in range(repeats + 1):
            for key, shown in (("with", scene), ("without", plain)):
                start = time.process_time()
                render_frame(shown, FRAME, SPREAD, size)
                best.setdefault(key, []).append(time.process_time() - start)
        seconds = {key: min(values[1:]) for key, values in best.items()}
        passes = [row for row in plan_frame(scene, FRAME, SPREAD, size).passes if row not in usual]
        more = seconds["with"] - seconds["without"]
        row = f"{seconds['without']:.3f} | {seconds['with']:.3f} | {more:+.3f} | {painting:.1f}"
        print(f"| {name} | {', '.join(passes)} | {row} |", flush=True)


def _painting(scene: Scene) -> float:
    start = time.process_time()
    subject = of_side(scene.subject, "right")
    skin_atlas(subject, "right")
    if subject.looks.arm == "bare":
        arm_atlas(subject)
    return time.process_time() - start


def measure_masks(frames: int, size: int) -> None:
    """Print how far estimated masks are from exact ones before every backdrop."""
    plain = replace(load_scene(SCENE), effects=())
    bare = replace(plain, subject=replace(plain.subject, looks=Looks(arm="bare")))
    shown = {"studio": replace(plain, background="studio"), "bare forearm": bare}
    shown |= {name: replace(plain, background=name) for name in plane_names()}
    shown |= {
        name: scene
        for name, scene in items(plain).items()
        if name in ("clutter (8)", "face", "other arm")
    }
    print("| before | IoU | 10th percentile | too much, % of the hand | too little, % |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, scene in shown.items():
        rows = []
        for step in range(frames):
            recipe = plan_frame(scene, int((step + 0.5) * SPREAD / frames), SPREAD, size)
            result = render_frame(scene, recipe.frame, SPREAD, size)
            exact = result.coverage
            mask = estimate_mask(scene, recipe, exact, exact)
            taken = confused_mask(scene, recipe, mask, exact, result.rgb) > 127
            hand = exact > 0.5
            area = hand.sum()
            both, either = (taken & hand).sum(), (taken | hand).sum()
            rows.append((both / either, (taken & ~hand).sum() / area, (hand & ~taken).sum() / area))
        iou, much, little = np.array(rows).T
        low = np.quantile(iou, 0.1)
        much, little = 100.0 * much.mean(), 100.0 * little.mean()
        print(f"| {name} | {iou.mean():.3f} | {low:.3f} | {much:.1f} | {little:.1f} |", flush=True)


def main() -> None:
    """Measure what the arguments say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--masks", type=int, metavar="N", help="frames to compare masks over")
    parser.add_argument("--size", type=int, default=256, help="edge of the frames in pixels")
    parser.add_argument("--repeats", type=int, default=3, help="renders of each frame")
    args = parser.parse_args()
    if args.masks:
        measure_masks(args.masks, args.size)
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HWP_CACHE"] = folder
        measure_cost(args.repeats, args.size)


if __name__ == "__main__":
    main()
