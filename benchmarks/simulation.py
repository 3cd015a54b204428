"""What simulated frames cost in seconds and memory, and how deep skin sinks into skin.

Run from the repository: `python -m benchmarks.simulation` prints seconds a frame by kind of frame
and the largest memory of `hwp-bench sim render` for a short and a long capture;
`python -m benchmarks.simulation --penetration 24` prints, for every gesture and for that many
frames spread over every scene, the deepest place of a hand inside itself or the other.

Seconds: `--workers` processes render frames of one kind at once, each warm after one frame, as
`sim render` does. Wall seconds a frame is what one frame adds to the length of the render;
processor seconds a frame is the same on one core. A perturbed frame includes its clean version.
Memory: resident sets of the command and all its processes, added up and sampled 20 times a
second; pages that they share count once for each.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import psutil

from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import load_scene, scene_names

#: Frames over which a scene is spread where frames of a kind are looked for.
SPREAD = 240


@dataclass(frozen=True)
class Kind:
    """A kind of frame."""

    #: What it is, for people.
    title: str
    #: Scene whose frames are rendered.
    scene: str
    #: The effects that act in them, no other.
    acting: tuple[str, ...]
    #: Wall seconds a frame that it may take at 256 px on two cores, or None.
    goal: float | None


KINDS = (
    Kind("one hand, clean", "capture0", (), 0.25),
    Kind("one hand, object and shadow", "capture0", ("hand_object_interaction",), None),
    Kind("one hand, motion blur", "capture3", ("motion_blur",), None),
    Kind("two hands, clean", "capture10", (), None),
    Kind("two hands, object and shadow", "capture10", ("hand_object_interaction",), 0.6),
    Kind("two hands, motion blur", "capture10", ("motion_blur",), None),
)


def frames_of(kind: Kind, scene: Scene, size: int, count: int) -> list[int]:
    """Frames of a kind, spread over the scene."""
    fitting = [
        frame
        for frame in range(SPREAD)
        if tuple(plan_frame(scene, frame, SPREAD, size).strength) == kind.acting
    ]
    if not fitting:
        raise SystemExit(f"{scene.id} has no frame of the kind: {kind.title}")
    return [fitting[i] for i in np.linspace(0, len(fitting) - 1, count).astype(int)]


def render_some(name: str, frames: list[int], size: int) -> tuple[float, float, float]:
    """Render frames in this process: wall and processor seconds, and sub-frames, each a frame."""
    import torch

    torch.set_num_threads(1)
    scene = load_scene(name)
    render_frame(scene, frames[0], SPREAD, size)
    wall, processor, subframes = time.perf_counter(), time.process_time(), 0
    for frame in frames:
        subframes += render_frame(scene, frame, SPREAD, size).plan.subframes
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    return wall / len(frames), processor / len(frames), subframes / len(frames)


def speed_table(size: int, count: int, workers: int) -> str:
    """A Markdown table of seconds a frame."""
    lines = [
        f"| frames at {size} px | sub-frames | processor s | wall s, {workers} processes | goal |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    # Each process uses one core, as a render's do.
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for kind in KINDS:
            frames = frames_of(kind, load_scene(kind.scene), size, count * workers)
            jobs = [
                pool.submit(render_some, kind.scene, frames[first::workers], size)
                for first in range(workers)
            ]
            walls, processors, subframes = zip(*(job.result() for job in jobs), strict=True)
            wall = 1.0 / sum(1.0 / value for value in walls)
            goal = "" if kind.goal is None else f"{kind.goal:.2f}"
            lines.append(
                f"| {kind.title} ({kind.scene}) | {np.mean(subframes):.0f} "
                f"| {np.mean(processors):.2f} | {wall:.2f} | {goal} |"
            )
    return "\n".join(lines)


def peak_memory(scene: str, frames: int, size: int, workers: int) -> float:
    """Largest memory of `hwp-bench sim render` and its processes, GB."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hwp_bench.cli.main", "sim", "render", scene]
        command += ["-o", str(Path(folder) / scene), "--frame-count", str(frames)]
        command += ["--size", str(size), "--workers", str(workers)]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            peak, root = 0, psutil.Process(process.pid)
            while process.poll() is None:
                peak = max(peak, _resident(root))
                time.sleep(0.05)
        if process.returncode:
            raise SystemExit(f"the render ended with status {process.returncode}")
    return peak / 1e9


def _resident(root: psutil.Process) -> int:
    total = 0
    try:
        processes = [root, *root.children(recursive=True)]
    except psutil.Error:
        return 0
    for process in processes:
        try:
            total += process.memory_info().rss
        except psutil.Error:
            continue  # it ended meanwhile
    return total


def memory_table(size: int, workers: int) -> str:
    """A Markdown table of the largest memory of a short and a long render."""
    lines = [
        f"| render at {size} px, {workers} processes | frames | largest memory, GB | goal |",
        "| --- | ---: | ---: | ---: |",
    ]
    for frames in (12, 48):
        peak = peak_memory("capture10", frames, size, workers)
        lines.append(f"| capture10 | {frames} | {peak:.2f} | 3.00 |")
    return "\n".join(lines)


def penetration_table(frames: int) -> str:
    """A Markdown table of the deepest places, over gestures and over frames of the scenes, mm."""
    from benchmarks.penetration import hand_penetration, scene_penetration
    from hwp_bench.hands.poses import gestures
    from hwp_bench.sim.scene.scene import HandKey, moment_of_key, scene_hands
    from hwp_bench.sim.subject.hand import MOVING

    hand = scene_hands(load_scene("capture1"), MOVING)["right"]
    lines = ["| gesture | deepest, mm |", "| --- | ---: |"]
    for name in gestures():
        depth = 1e3 * hand_penetration(hand, moment_of_key(HandKey(name)), "right").max()
        lines.append(f"| {name} | {depth:.1f} |")
    lines += ["", f"| {frames} frames of | hand | median, mm | 90 % | 99 % | deepest |"]
    lines += ["| --- | --- | ---: | ---: | ---: | ---: |"]
    moments = (np.arange(frames) + 0.5) / frames
    pooled: dict[str, list[np.ndarray]] = {"in itself": [], "in the other": []}
    for name in scene_names():
        for part, depths in scene_penetration(load_scene(name), moments).items():
            lines.append(_depth_row(name, part, depths))
            pooled["in the other" if part == "both" else "in itself"].append(depths)
    for part, rows in pooled.items():
        lines.append(_depth_row("all", part, np.concatenate(rows)))
    return "\n".join(lines)


def _depth_row(name: str, part: str, depths: np.ndarray) -> str:
    cells = [f"{1e3 * value:.1f}" for value in np.quantile(depths, [0.5, 0.9, 0.99, 1.0])]
    return f"| {name} | {part} | {' | '.join(cells)} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256, help="edge in pixels (default 256)")
    parser.add_argument("--frames", type=int, default=4, help="frames of a kind and process")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--penetration", type=int, metavar="FRAMES", help="depths instead")
    args = parser.parse_args()
    if args.penetration is not None:
        print(penetration_table(args.penetration))
        return
    print(speed_table(args.size, args.frames, args.workers))
    print()
    print(memory_table(args.size, args.workers))


if __name__ == "__main__":
    main()
