"""Forecast of a render: passes counted from the plan, cost predicted from a few probes."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.sim.effects import ORDER, FramePlan, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.produce.capture import check_extent
from hwp_bench.sim.produce.free_view import FRAMES, free_views, render_free
from hwp_bench.sim.render.frame import carry_out, steady_gain
from hwp_bench.sim.scene.scene import Scene, clean_share
from hwp_bench.sim.sensor import through_h264

# Joins the names of effects that act in the same frame.
_PLUS = " + "
# Frames that are encoded to measure what one takes.
_ENCODED = 10


@dataclass(frozen=True)
class Forecast:
    """The passes of a capture and what they are expected to cost on this machine."""

    #: Name of the scene.
    scene: str
    #: Number of frames.
    frame_count: int
    #: Edge of the image in pixels.
    size: int
    #: Frames that need each pass.
    passes: Mapping[str, int]
    #: Sub-frames over all frames, one for each frame without motion blur.
    subframes: int
    #: Frames of each group: frames with the same set of effects acting.
    groups: Mapping[str, int]
    #: Processor seconds by group, or None without probing.
    seconds: Mapping[str, float] | None
    #: Rays by group, or None without probing.
    rays: Mapping[str, int] | None
    #: Share of the training part in which no effect acts, 0 to 1, by the scene's episodes.
    clean_share: float
    #: Training frames in which no effect acts.
    clean_frames: int
    #: Frames of the free-view clip.
    free_frames: int = FRAMES
    #: Processor seconds of that clip, or None without probing.
    free_seconds: float | None = None
    #: Rays of that clip, or None without probing.
    free_rays: int | None = None

    def shares(self) -> dict[str, float] | None:
        """Seconds by cause: `clean`, then the extra of each effect; they add up to the total.

        Where effects meet in a frame the extra cost is split by what each costs on its own.
        """
        if self.seconds is None:
            return None
        base = self.seconds.get("clean", 0.0) / max(self.groups.get("clean", 0), 1)
        shares = {"clean": base * self.frame_count}
        alone = {
            name: max(self.seconds[name] / count - base, 1e-6)
            for name, count in self.groups.items()
            if name != "clean" and _PLUS not in name
        }
        for name, count in self.groups.items():
            kinds = [] if name == "clean" else name.split(_PLUS)
            weights = [alone.get(kind, 1e-6) for kind in kinds]
            extra = self.seconds[name] - base * count
            for kind, weight in zip(kinds, weights, strict=True):
                shares[kind] = shares.get(kind, 0.0) + extra * weight / sum(weights)
        return shares


def forecast(
    scene: Scene, frame_count: int | None = None, size: int | None = None, *, probe: bool = True
) -> Forecast:
    """Plan all frames and predict their cost.

    Frames are grouped by the effects that act in them. Of each group the frame with the median
    number of sub-frames is rendered once and its cost multiplied.
    """
    count = scene.frame_count if frame_count is None else frame_count
    edge = 256 if size is None else size
    check_extent(count, edge)
    plans = [plan_frame(scene, frame, count, edge) for frame in range(count)]
    train = contiguous_split(scene.id, count).train
    groups: dict[str, list[FramePlan]] = {}
    for item in plans:
        groups.setdefault(group_name(item), []).append(item)
    seconds, rays = _probed(scene, groups, edge) if probe else (None, None)
    free_seconds, free_rays = _probed_free(scene, edge) if probe else (None, None)
    return Forecast(
        scene=scene.id,
        frame_count=count,
        size=edge,
        passes=dict(Counter(name for item in plans for name in item.passes)),
        subframes=sum(item.subframes for item in plans),
        groups={name: len(items) for name, items in groups.items()},
        seconds=seconds,
        rays=rays,
        clean_share=round(clean_share(scene), 4),
        clean_frames=sum(not plans[frame].strength for frame in train.tolist()),
        free_seconds=free_seconds,
        free_rays=free_rays,
    )


def group_name(item: FramePlan) -> str:
    """Name of the group of a frame: the effects that act in it, or `clean`."""
    return _PLUS.join(item.strength) or "clean"


def _probed(
    scene: Scene, groups: Mapping[str, list[FramePlan]], size: int
) -> tuple[dict[str, float], dict[str, int]]:
    seconds, rays = {}, {}
    warm = next(iter(groups.values()))[0]
    carry_out(scene, warm, size)  # loads the hand and paints the skin, once for a capture
    for name, items in groups.items():
        typical = sorted(items, key=lambda item: item.subframes)[len(items) // 2]
        probe = carry_out(scene, typical, size)
        cost = probe.cost
        scale = sum(item.subframes for item in items) / typical.subframes
        # A frame and its clean version are encoded, whatever their sub-frames.
        video = 2.0 * len(items) * encoding_seconds(scene, probe.rgb)
        seconds[name] = round(scale * sum(cost.seconds.values()) + video, 3)
        rays[name] = round(scale * sum(cost.rays.values()))
    return seconds, rays


def _probed_free(scene: Scene, size: int) -> tuple[float, int]:
    """Processor seconds and rays of the free-view clip, from one of its frames."""
    once, each = RenderCost(), RenderCost()
    gain = steady_gain(scene, once)
    (view, *_) = free_views(scene)
    render_free(scene, view, size, gain, each)
    seconds = sum(once.seconds.values()) + FRAMES * sum(each.seconds.values())
    return round(seconds, 3), sum(once.rays.values()) + FRAMES * sum(each.rays.values())


def encoding_seconds(scene: Scene, image: np.ndarray) -> float:
    """Processor seconds that the scene's video takes a frame, measured; 0 without one."""
    if not scene.sensor.h264:
        return 0.0
    moving = [np.roll(image, step, axis=1) for step in range(_ENCODED)]
    start = time.process_time()
    for _ in through_h264(moving, scene.sensor.h264, scene.fps, scene.id):
        pass
    return (time.process_time() - start) / _ENCODED


def share_table(forecasts: list[Forecast]) -> Table:
    """Processor seconds of each effect in each scene."""
    names = ("clean", *ORDER)
    rows: list[tuple[Cell, ...]] = []
    for item in forecasts:
        shares = item.shares() or {}
        total = sum(shares.values())
        costs = [shares.get(name) for name in names]
        rows.append((item.scene, item.frame_count, *costs, total, total / item.frame_count))
    columns = [Column(name, digits=0) for name in ("scene", "frames", *names, "all")]
    return Table(
        "Processor seconds by what calls for them", (*columns, Column("s a frame")), tuple(rows)
    )


def plan_table(forecasts: list[Forecast]) -> Table:
    """Passes and predicted cost of each scene and group of frames."""
    rows: list[tuple[Cell, ...]] = []
    for item in forecasts:
        seconds, rays = item.seconds, item.rays
        for name, count in item.groups.items():
            if seconds is None or rays is None:
                rows.append((item.scene, name, count, None, None, None))
            else:
                spent = seconds[name]
                rows.append((item.scene, name, count, spent / count, spent, rays[name] / 1e6))
        clean = f"clean in training ({item.clean_share:.0%} of it)"
        rows.append((item.scene, clean, item.clean_frames, None, None, None))
        passes = ", ".join(f"{name} {count}" for name, count in item.passes.items())
        spent_free, cast = item.free_seconds, item.free_rays
        each = None if spent_free is None else spent_free / item.free_frames
        millions = None if cast is None else cast / 1e6
        rows.append((item.scene, "free view", item.free_frames, each, spent_free, millions))
        total = None if seconds is None else sum(seconds.values()) + (spent_free or 0.0)
        content = f"all ({passes}; {item.subframes} sub-frames)"
        count = item.frame_count + item.free_frames
        rows.append((item.scene, content, count, None, total, None))
    columns = (
        Column("scene"),
        Column("frames with"),
        Column("frames"),
        Column("s a frame"),
        Column("s in all", digits=0),
        Column("rays (millions)", digits=1),
    )
    return Table("Frames by the effects that act in them", columns, tuple(rows))
