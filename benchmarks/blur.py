"""What a frame with motion blur costs in clean frames, and how close its sub-frames come.

Run from the repository: `python -m benchmarks.blur` prints ratios of processor time next to their
budgets. `python -m benchmarks.blur --subframes` prints how far frames of a few sub-frames are from
one of many, over the hand.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.simulation import SPREAD, Kind, frames_of
from hwp_bench.base.rays import EmbreeMesh, EmbreexMesh, library
from hwp_bench.metrics.pixels import decibels
from hwp_bench.sim.effects import hands_at, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.render.frame import carry_out, render_frame
from hwp_bench.sim.render.stage import RenderStage
from hwp_bench.sim.scene.scene import intrinsics, pixel_rays, viewmat
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.subject.hand import MOVING

#: Scenes whose frames with motion blur are compared with their clean frames, by what they show.
BLURRED = {"one hand": "capture3", "two hands": "capture10"}
#: Clean frames that a frame with motion blur may cost, its own clean version included.
BLUR_BUDGET = 4.0
#: Share of embreex's time that a mesh and one ray a pixel may take.
RAY_BUDGET = 0.7
#: Sub-frames of the frame that others are compared with, and of the others.
MANY, FEW = 96, (24, 16, 12, 8)


def measure(size: int = 256, count: int = 3) -> dict[str, float]:
    """Ratios of processor time; lower is better.

    The first two are what a frame with motion blur costs in clean frames of the same scene, the
    third is the cost of a mesh and its rays next to the package embreex alone. What is compared
    takes turns in this process, so that other work on the machine slows both sides.

    Args:
        size: edge of the image, px.
        count: frames of each kind and scene, spread over the scene.

    Returns:
        Name of a ratio -> ratio; `BLUR_BUDGET` and `RAY_BUDGET` are what they may be.
    """
    ratios = {}
    for title, name in BLURRED.items():
        clean, blurred = _seconds(name, size, count)
        ratios[f"blurred frame / clean frame, {title}"] = blurred / clean
    return ratios | {"mesh and rays / embreex alone": _rays_ratio(size)}


def _seconds(name: str, size: int, count: int) -> tuple[float, float]:
    """Processor seconds of a clean and of a blurred frame of a scene."""
    scene = load_scene(name)
    kinds = [Kind("", name, acting, None) for acting in ((), ("motion_blur",))]
    turns = zip(*(frames_of(kind, scene, size, count) for kind in kinds), strict=True)
    seconds = [0.0, 0.0]
    render_frame(scene, 0, SPREAD, size)
    for turn in turns:
        for kind, frame in enumerate(turn):
            start = time.process_time()
            render_frame(scene, frame, SPREAD, size)
            seconds[kind] += (time.process_time() - start) / count
    return seconds[0], seconds[1]


def _rays_ratio(size: int) -> float:
    """Processor time of a hand's mesh and one ray a pixel, over that of embreex; best of five."""
    loaded = library()
    if loaded is None:
        return 1.0
    scene = load_scene("capture3")
    surface = RenderStage(scene, RenderCost()).surface(hands_at(scene, 0.0), MOVING)
    view = viewmat(scene, 0.0)
    origin, directions = pixel_rays(intrinsics(scene, size), view, (0, size, 0, size), 1)
    best = [np.inf, np.inf]
    meshes: tuple[Any, Any] = (partial(EmbreeMesh, loaded), EmbreexMesh)
    for _ in range(5):
        for way, mesh in enumerate(meshes):
            start = time.process_time()
            mesh(surface.vertices, surface.faces).first_hits(
                origin[None], directions.reshape(-1, 3)
            )
            best[way] = min(best[way], time.process_time() - start)
    return best[0] / best[1]


def subframe_table(size: int, count: int) -> str:
    """A Markdown table: PSNR over the hand to a frame of `MANY` sub-frames, dB."""
    lines = [
        "| scene | frame | its sub-frames | " + " | ".join(str(n) for n in FEW) + " |",
        "| --- | ---: | ---: |" + " ---: |" * len(FEW),
    ]
    for title, name in BLURRED.items():
        scene = load_scene(name)
        for frame in frames_of(Kind(title, name, ("motion_blur",), None), scene, size, count):
            recipe = plan_frame(scene, frame, SPREAD, size)
            dense = carry_out(scene, replace(recipe, subframes=MANY), size)
            hand = dense.coverage > 0.0
            cells = []
            for number in FEW:
                image = carry_out(scene, replace(recipe, subframes=number), size).rgb
                error = (image[hand].astype(float) - dense.rgb[hand]) / 255.0
                cells.append(f"{decibels(float(np.square(error).mean())):.1f}")
            lines.append(f"| {name} | {frame} | {recipe.subframes} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the ratios, or the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256, help="edge in pixels (default 256)")
    parser.add_argument("--frames", type=int, default=3, help="frames of a kind and scene")
    parser.add_argument("--subframes", action="store_true", help="accuracy instead of cost")
    args = parser.parse_args()
    if args.subframes:
        print(subframe_table(args.size, args.frames))
        return
    for name, ratio in measure(args.size, args.frames).items():
        budget = BLUR_BUDGET if name.startswith("blurred") else RAY_BUDGET
        print(f"{name}: {ratio:.2f} (budget {budget:.1f})")


if __name__ == "__main__":
    main()
