"""From a scene to a capture folder: frames in parallel, resumable, the same on any machine."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import HwpError, UsageError, place, reason_of, whole_number
from hwp_bench.base.files import canonical_json, sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.capture import (
    Cameras,
    Capture,
    CaptureInfo,
    CaptureWriter,
    HandModelId,
    open_capture,
)
from hwp_bench.capture.schema import FREE_VIEW, SIMULATED
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.effects.plan import FramePlan, hands_at, plan
from hwp_bench.sim.produce.estimates import estimate_hands, estimate_mask
from hwp_bench.sim.produce.extent import check_extent
from hwp_bench.sim.produce.frames import (
    RenderFrames,
    eight_bit_coverage,
    exr_file,
    frame_file,
    read_frame,
    render_frames,
    render_in_processes,
)
from hwp_bench.sim.produce.free_view import write_free_view
from hwp_bench.sim.produce.lookalikes import confused_mask
from hwp_bench.sim.produce.subject_mesh import write_truth
from hwp_bench.sim.produce.subject_table import subject_json
from hwp_bench.sim.produce.video_encoding import check_encoder, through_h264
from hwp_bench.sim.scene.motion import hand_parameters
from hwp_bench.sim.scene.optics import focus_point, intrinsics, viewmat
from hwp_bench.sim.scene.reader import load_scene
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.subject.atlas import skin_atlas
from hwp_bench.sim.subject.hand import scene_hands
from hwp_bench.sim.subject.painting import of_side
from hwp_bench.sim.subject.rigs import rig_path

#: Version of the pixels that the renderer makes; part of every render key.
RENDERER = 10
#: Edge of an image where no other is given.
DEFAULT_SIZE = 256
#: Terms under which simulated captures may be used.
LICENCE = "CC0-1.0"
# Frames below which a second process costs more than it saves.
_FRAMES_PER_WORKER = 10


def render_key(scene: Scene, frame_count: int, size: int) -> str:
    """Digest of everything that decides the pixels of a capture."""
    return sha256_json([RENDERER, scene.digest, frame_count, size])


def render_capture(
    scene: Scene | str | Path,
    out: str | os.PathLike[str],
    *,
    frame_count: int | None = None,
    size: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overwrite: bool = False,
    exr: bool = False,
    free_view: bool = True,
) -> Capture:
    """Render a capture.

    A render that was interrupted continues where it stopped: finished frames wait next to `out`
    until the capture is whole.

    Args:
        scene: a scene, its name, or its file.
        out: the capture folder to make.
        frame_count: frames over which the scene is spread; the scene's own if None.
        size: edge of the square image in pixels.
        seed: replaces the scene's seed.
        workers: processes; as many as are worth it if None.
        overwrite: replace an existing folder.
        exr: also store linear light, depth, normals, object ids and motion of every frame as
            OpenEXR, under `extra/`.
        free_view: also render the free-view clip, under `free/`.

    Raises:
        UsageError: `out` exists, or a number is out of range.
        BadInput: the scene file is at fault.
        HwpError: rendering failed, or `out` cannot be written.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(os.fspath(place(scene, "scene")))
    if seed is not None:
        if whole_number(seed, "seed") < 0:
            raise UsageError(f"is {seed}", field="seed", remedy="Use 0 or more.")
        scene = replace(scene, seed=seed)
    count = scene.frame_count if frame_count is None else frame_count
    edge = DEFAULT_SIZE if size is None else size
    check_extent(count, edge, workers)
    if scene.sensor.h264:
        check_encoder(scene.id)
    out = place(out, "out")
    if out.exists() and not overwrite and (out.is_file() or any(out.iterdir())):
        raise UsageError(
            "exists already", where=out, remedy="Choose another place, or --overwrite."
        )
    kind = "-exr" if exr else ""
    waiting = out.absolute().parent / f".{out.name}.{render_key(scene, count, edge)[:16]}{kind}"
    with exclusive(waiting, wait=True):
        try:
            waiting.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise HwpError(f"cannot be made ({reason_of(error)})", where=waiting) from error
        try:
            start = time.perf_counter()
            _render_missing(scene, count, edge, waiting, workers, exr)
            seconds = time.perf_counter() - start
            _assemble(scene, count, edge, waiting, out, overwrite, seconds, free_view)
            shutil.rmtree(waiting, ignore_errors=True)
        finally:
            # Frames of a render that failed stay for the next start; nothing else does.
            with contextlib.suppress(OSError):
                waiting.rmdir()
            with contextlib.suppress(OSError):
                waiting.with_name(f"{waiting.name}.lock").unlink()
    return open_capture(out)


def _render_missing(
    scene: Scene, count: int, size: int, waiting: Path, workers: int | None, exr: bool
) -> None:
    missing = [frame for frame in range(count) if read_frame(waiting, frame) is None]
    if not missing:
        return
    # Built once here, so that no two processes paint the same skin.
    scene_hands(scene)
    for side in scene.sides:
        skin_atlas(of_side(scene.subject, side))
    if workers is None:
        workers = max(1, min(os.cpu_count() or 1, len(missing) // _FRAMES_PER_WORKER))
    with progress(f"Rendering {scene.id}", len(missing)) as update:
        if workers == 1:
            for done, frame in enumerate(missing, start=1):
                render_frames(scene, [frame], count, size, waiting, exr)
                update(done)
            return
        works = [
            RenderFrames(scene, missing[first::workers], count, size, exr)
            for first in range(workers)
        ]
        render_in_processes(works, waiting, update)
        update(len(missing))


def _assemble(
    scene: Scene,
    count: int,
    size: int,
    waiting: Path,
    out: Path,
    overwrite: bool,
    seconds: float,
    free_view: bool,
) -> None:
    plans = [plan(scene, frame, count, size) for frame in range(count)]
    truth = true_hands(scene, plans)
    cameras = Cameras(
        Ks=np.repeat(intrinsics(scene, size)[None], count, axis=0),
        viewmats=np.stack([viewmat(scene, item.seconds) for item in plans]),
    )
    info = _info(scene, plans, size)
    costs = []
    estimates = estimate_hands(scene, truth, plans)
    with CaptureWriter(out, info, estimates, cameras, overwrite=overwrite) as writer:
        videos = [_video(scene, waiting, info, name) for name in ("rgb", "clean")]
        for item in plans:
            arrays = _waiting_frame(waiting, item.frame)
            rgb, clean = arrays["rgb"], arrays["clean"]
            if scene.sensor.h264:
                rgb, clean = (next(video) for video in videos)
            coverage = arrays["coverage"].astype(np.float64)
            writer.frame(item.frame, rgb)
            writer.clean(item.frame, clean)
            writer.true_mask(item.frame, eight_bit_coverage(coverage))
            clean_coverage = arrays["clean_coverage"].astype(np.float64)
            writer.clean_mask(item.frame, eight_bit_coverage(clean_coverage))
            mask = estimate_mask(scene, item, coverage, clean_coverage)
            writer.mask(item.frame, confused_mask(scene, item, mask, coverage, rgb))
            layers = exr_file(waiting, item.frame)
            if layers.exists():
                writer.extra(f"exr/{layers.name}", layers.read_bytes())
            costs.append(json.loads(arrays["cost"].tobytes()))
        writer.true_hands(truth)
        write_truth(writer.folder, scene.subject, scene.sides)
        writer.extra("scene.json", canonical_json(scene.to_json()))
        if subject := subject_json(scene):
            writer.extra("subject.json", canonical_json(subject))
        writer.extra("cost.json", json.dumps({"wall_seconds": round(seconds, 3), "frames": costs}))
        if free_view:
            write_free_view(scene, writer.folder / FREE_VIEW, info, estimates)


def _video(scene: Scene, waiting: Path, info: CaptureInfo, name: str) -> Iterator[np.ndarray]:
    """The frames, or their clean versions, out of the video that the device stores.

    It is encoded here, in one process, over the whole clip: frames that were rendered by any
    number of processes in any order give the same stream.
    """
    images = (_waiting_frame(waiting, frame)[name] for frame in range(info.frame_count))
    return through_h264(images, scene.sensor.h264, info.fps, scene.id)


def _waiting_frame(waiting: Path, frame: int) -> dict[str, np.ndarray]:
    arrays = read_frame(waiting, frame)
    if arrays is None:
        frame_file(waiting, frame).unlink(missing_ok=True)
        raise HwpError(
            f"frame {frame} was damaged while it waited",
            where=waiting,
            remedy="Run the same command again; only this frame is rendered again.",
        )
    return arrays


def true_hands(scene: Scene, plans: list[FramePlan]) -> dict[str, HandParameters]:
    """The true hand parameters of every frame, by side."""
    subjects = scene_hands(scene)
    focus = focus_point()
    truth = {}
    staged = [hands_at(scene, item.seconds) for item in plans]
    for side in scene.sides:
        rows = [
            hand_parameters(hands[side], side, subjects[side].model_joints, focus)
            for hands in staged
        ]
        truth[side] = HandParameters(
            pose=np.stack([pose for pose, _ in rows]),
            betas=subjects[side].betas,
            transl=np.stack([transl for _, transl in rows]),
            valid=np.ones(len(plans), dtype=bool),
        )
    return truth


def _info(scene: Scene, plans: list[FramePlan], size: int) -> CaptureInfo:
    model = scene_hands(scene)[scene.sides[0]].model
    known = "anny" if rig_path(scene.subject.model) is not None else scene.subject.model
    return CaptureInfo(
        id=scene.id,
        hands=scene.hands,
        action=scene.action,
        device=scene.device,
        fps=scene.fps * len(plans) / scene.frame_count,
        width=size,
        height=size,
        frame_count=len(plans),
        hand_model=HandModelId(name=model.name, digest=model.digest, source=known),
        perturbations={
            call.kind: tuple(item.severity[call.kind] for item in plans) for call in scene.effects
        },
        source={
            "kind": SIMULATED,
            "scene": scene.id,
            "title": scene.title,
            "scene_digest": scene.digest,
            "seed": scene.seed,
            "renderer": RENDERER,
        },
        licence=LICENCE,
    )
