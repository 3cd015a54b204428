"""From a scene to a capture folder, and from a suite to captures in the cache.

Frames are rendered in parallel, the same on any machine. They wait in one file each until their
capture is whole; a render that was interrupted continues where it stopped.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import HwpError, UsageError, place, reason_of, whole_number
from hwp_bench.base.files import atomic_write, cache_root, canonical_json, sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.base.records import whole_seed
from hwp_bench.capture import (
    Cameras,
    Capture,
    CaptureInfo,
    CaptureWriter,
    HandModelId,
    open_capture,
)
from hwp_bench.capture.folder import refuse_taken
from hwp_bench.capture.schema import FREE_VIEW, SIMULATED, check_id
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.sources import absolute_source
from hwp_bench.run.engine import Engine, Job, LocalEngine, Needs
from hwp_bench.run.engine.job import OnProgress, ignore_progress
from hwp_bench.run.engine.processes import THREADS, LocalJob, Stopped, WorkerLost, run_in_process
from hwp_bench.sim.effects import FramePlan, hands_at, plan_frame, shown_in
from hwp_bench.sim.hand.rigs import rig_path
from hwp_bench.sim.produce.estimates import confused_mask, estimate_hands, estimate_mask
from hwp_bench.sim.produce.free_view import FRAMES as FREE_FRAMES
from hwp_bench.sim.produce.free_view import (
    add_free_view,
    free_file,
    has_free_view,
    read_waiting,
    render_waiting_free,
    write_free_view,
)
from hwp_bench.sim.produce.truth import distances, write_truth
from hwp_bench.sim.render.frame import eight_bit_coverage, render_frame, write_layers
from hwp_bench.sim.scene.scene import (
    Scene,
    intrinsics,
    parameters_of,
    scene_hands,
    viewmat,
    with_clean_share,
)
from hwp_bench.sim.scene_files import load_scene, scene_names
from hwp_bench.sim.sensor import check_encoder, through_h264
from hwp_bench.sim.subject.hand import model_digests, of_side, skin_atlas

#: Version of the pixels that the renderer makes; part of every render key.
RENDERER = 10
#: Edge of an image where no other is given.
DEFAULT_SIZE = 256
#: Terms under which simulated captures may be used.
LICENCE = "CC0-1.0"
#: Smallest and largest number of frames; smallest and largest edge of one, px; most processes.
FRAMES, SIZES, MAX_WORKERS = (10, 100_000), (32, 1024), 1024
# Frames below which a second process costs more than it saves: to start, to read the skin and to
# build the hands takes it as long as 50 frames of 256 px, or 100 of 112 px.
_FRAMES_PER_WORKER = 50
_REMEDY = "Finished frames are kept; the same command continues from there."


def check_extent(frame_count: int, size: int, workers: int | None = None) -> None:
    """Refuse what cannot be rendered or planned, before anything takes memory for it."""
    for name, value, low, high in (
        ("frame_count", frame_count, *FRAMES),
        ("size", size, *SIZES),
        ("workers", 1 if workers is None else workers, 1, MAX_WORKERS),
    ):
        value = whole_number(value, name)
        if not low <= value <= high:
            raise UsageError(f"{value} is not in {low}..{high}", field=name)


def render_key(scene: Scene, frame_count: int, size: int) -> str:
    """Digest of everything that decides the pixels of a capture."""
    files = model_digests(scene.subject)
    return sha256_json([RENDERER, scene.digest, frame_count, size, *files])


@dataclass(frozen=True)
class RenderRequest:
    """A capture to render, in any process on any machine."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread; its own if None.
    frame_count: int | None = None
    #: Edge of the square image in pixels; `DEFAULT_SIZE` if None.
    size: int | None = None
    #: Seed; the scene's own if None.
    seed: int | None = None
    #: Processes of one render; as many as help if None.
    workers: int | None = None
    #: Whether linear layers are stored too.
    exr: bool = False
    #: Whether a capture that exists already is used as it is.
    keep: bool = False
    #: Whether one that is there is replaced.
    overwrite: bool = False
    #: Whether the free-view clip is rendered too.
    free_view: bool = True

    @property
    def frames(self) -> int:
        """Frames of the capture."""
        return self.scene.frame_count if self.frame_count is None else self.frame_count

    @property
    def edge(self) -> int:
        """Edge of its images, px."""
        return DEFAULT_SIZE if self.size is None else self.size

    def checked(self) -> RenderRequest:
        """The request with its seed in the scene; refuses what cannot be rendered."""
        scene = self.scene
        check_id(scene.id, "scene")
        if self.seed is not None:
            scene = replace(scene, seed=whole_seed(self.seed, "seed"))
        check_extent(self.frames, self.edge, self.workers)
        if scene.sensor.h264:
            check_encoder(scene.id)
        return replace(self, scene=scene, seed=None)

    def job(self, output: Path, needs: Needs) -> Job:
        """The render as a job of an engine."""
        return Job(
            text=self.scene.id,
            # In turn, a render shows its own progress.
            here=lambda on_progress: self.render(output),
            work=self,
            output=output,
            finished=lambda: self.keep and self.is_whole(output),
            needs=needs,
        )

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Render; see `hwp_bench.run.engine.job.Work`."""
        self.render(output, on_progress)

    def render(self, output: Path, on_progress: OnProgress = ignore_progress) -> None:
        """Render into a folder, or use the capture that exists there if `keep` says so.

        The free-view clip of a capture that exists is rendered where it is missing.
        """
        if not self.keep:
            _render(self.checked(), output, on_progress)
            return
        with exclusive(output, wait=True):
            if not _is_capture(output):
                _render(replace(self.checked(), overwrite=True), output, on_progress)
            elif not self.is_whole(output):
                capture = open_capture(output)
                clip = output / FREE_VIEW
                add_free_view(self.checked().scene, clip, capture.info, capture.hands)

    def is_whole(self, output: Path) -> bool:
        """Whether a folder holds a capture with all that is asked for."""
        return _is_capture(output) and (not self.free_view or has_free_view(output))


def _is_capture(folder: Path) -> bool:
    """Whether a folder holds a capture that can be opened."""
    try:
        open_capture(folder)
    except HwpError:
        return False
    return True


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
        workers: processes; as many as help if None.
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
    request = RenderRequest(
        scene,
        frame_count,
        size,
        seed,
        workers,
        exr=exr,
        overwrite=overwrite,
        free_view=free_view,
    )
    request.render(place(out, "out"))
    return open_capture(place(out, "out"))


def _render(request: RenderRequest, out: Path, on_progress: OnProgress) -> None:
    """Render a request that was checked."""
    refuse_taken(out, overwrite=request.overwrite)
    key = render_key(request.scene, request.frames, request.edge)[:16]
    waiting = out.absolute().parent / f".{out.name}.{key}{'-exr' if request.exr else ''}"
    with exclusive(waiting, wait=True):
        try:
            waiting.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise HwpError(f"cannot be made ({reason_of(error)})", where=waiting) from error
        try:
            # Another process may have made it while this one waited.
            refuse_taken(out, overwrite=request.overwrite)
            start = time.perf_counter()
            _render_missing(request, waiting, on_progress)
            _assemble(request, waiting, out, time.perf_counter() - start)
            shutil.rmtree(waiting, ignore_errors=True)
        finally:
            # Frames of a render that failed stay for the next start; nothing else does.
            with contextlib.suppress(OSError):
                waiting.rmdir()
            with contextlib.suppress(OSError):
                waiting.with_name(f"{waiting.name}.lock").unlink()


def _render_missing(request: RenderRequest, waiting: Path, on_progress: OnProgress) -> None:
    scene = request.scene
    frames = range(request.frames)
    missing = [frame for frame in frames if read_waiting(frame_file(waiting, frame)) is None]
    free = range(FREE_FRAMES if request.free_view else 0)
    unseen = [frame for frame in free if read_waiting(free_file(waiting, frame)) is None]
    left = len(missing) + len(unseen)
    if not left:
        return
    # Built once here, so that no two processes paint the same skin.
    scene_hands(scene)
    for side in scene.sides:
        skin_atlas(of_side(scene.subject, side), side)
    asked = request.workers or min(os.cpu_count() or 1, left // _FRAMES_PER_WORKER)
    workers = max(1, min(asked, left))
    # The clip's frames are dealt out from the other end, so that every process has as many.
    works = [
        RenderFrames(request, missing[first::workers], unseen[workers - 1 - first :: workers])
        for first in range(workers)
    ]
    every = request.frames + len(free)
    with progress(f"Rendering {scene.id}", left) as update:

        def count(done: int, total: int) -> None:
            update(done)
            on_progress(every - left + done, every)

        if workers == 1:
            works[0]({}, waiting, count)
        else:
            _render_in_processes(works, waiting, count)


@dataclass(frozen=True)
class RenderFrames:
    """Renders some frames of a request into a folder: the work of one process."""

    #: What they are frames of.
    request: RenderRequest
    #: Numbers of the frames.
    frames: Sequence[int]
    #: Numbers of frames of the free-view clip.
    free: Sequence[int] = ()

    def __len__(self) -> int:
        return len(self.frames) + len(self.free)

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Render; see `hwp_bench.run.engine.job.Work`."""
        for done, frame in enumerate(self.frames, start=1):
            render_waiting(self.request, frame, output)
            on_progress(done, len(self))
        if self.free:
            scene, edge = self.request.scene, self.request.edge
            rendered = render_waiting_free(scene, self.free, edge, output)
            for done, _ in enumerate(rendered, start=len(self.frames) + 1):
                on_progress(done, len(self))


def frame_file(folder: Path, frame: int) -> Path:
    """Path of a rendered frame; its linear layers have the same name as `.exr`."""
    return folder / f"{frame:06d}.npz"


def render_waiting(request: RenderRequest, frame: int, folder: Path) -> None:
    """Render one frame into the folder where it waits for its capture."""
    count, size = request.frames, request.edge
    result = render_frame(request.scene, frame, count, size)
    cost = {
        "seconds": dict(result.cost.seconds),
        "rays": dict(result.cost.rays),
        "subframes": result.plan.subframes,
    }
    buffer = io.BytesIO()
    np.savez(
        buffer,
        rgb=result.rgb,
        clean=result.clean,
        coverage=result.coverage.astype(np.float32),
        clean_coverage=result.clean_coverage.astype(np.float32),
        cost=np.frombuffer(json.dumps(cost).encode(), dtype=np.uint8),
    )
    path = frame_file(folder, frame)
    if request.exr:
        write_layers(path.with_suffix(".exr"), request.scene, result, count, size)
    # Last: the frame counts as rendered only when all of it is there.
    atomic_write(path, buffer.getvalue())


def _render_in_processes(
    works: Sequence[RenderFrames], folder: Path, on_progress: OnProgress
) -> None:
    """Render frames in as many processes as there are works; if one fails, all are ended."""
    stop = threading.Event()
    done = [0] * len(works)

    def run(index: int) -> None:
        def count(steps: int, total: int) -> None:
            done[index] = steps
            on_progress(sum(done), sum(map(len, works)))

        # One thread each: the processes share the processors.
        job = LocalJob(works[index], {}, folder.absolute(), dict.fromkeys(THREADS, "1"))
        try:
            run_in_process(job, count, stop.is_set)
            count(len(works[index]), 0)
        except BaseException:
            stop.set()
            raise

    with ThreadPoolExecutor(len(works)) as pool:
        futures = [pool.submit(run, index) for index in range(len(works))]
        try:
            while wait(futures, timeout=1.0).not_done:
                pass  # a wait without end would not let Ctrl-C through on every system
        finally:
            stop.set()
    for error in (future.exception() for future in futures):
        if isinstance(error, WorkerLost):
            problem = f"a rendering process was killed ({error})"
            raise HwpError(problem, where=works[0].request.scene.id, remedy=_REMEDY) from error
        if isinstance(error, HwpError):
            remedy = error.remedy or _REMEDY
            again = type(error)(error.problem, where=error.where, field=error.field, remedy=remedy)
            raise again from error
        if error is not None and not isinstance(error, Stopped):
            raise error


def _assemble(request: RenderRequest, waiting: Path, out: Path, seconds: float) -> None:
    """Make the capture of the frames that wait."""
    scene, count, size = request.scene, request.frames, request.edge
    plans = [plan_frame(scene, frame, count, size) for frame in range(count)]
    truth = true_hands(scene, plans)
    cameras = Cameras(
        Ks=np.repeat(intrinsics(scene, size)[None], count, axis=0),
        viewmats=np.stack([viewmat(scene, item.seconds) for item in plans]),
    )
    info = _info(scene, plans, size)
    costs = []
    estimates = estimate_hands(scene, truth, plans)
    overwrite = request.overwrite
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
            layers = frame_file(waiting, item.frame).with_suffix(".exr")
            if layers.exists():
                writer.extra(f"exr/{layers.name}", layers.read_bytes())
            costs.append(json.loads(arrays["cost"].tobytes()))
        writer.true_hands(truth)
        write_truth(writer.folder, scene.subject, scene.sides)
        writer.extra("scene.json", canonical_json(scene.to_json()))
        if off := distances(scene):
            rows = {side: asdict(distance) for side, distance in off.items()}
            writer.extra("subject.json", canonical_json(rows))
        writer.extra("cost.json", json.dumps({"wall_seconds": round(seconds, 3), "frames": costs}))
        if request.free_view:
            write_free_view(scene, writer.folder / FREE_VIEW, info, estimates, waiting)


def _video(scene: Scene, waiting: Path, info: CaptureInfo, name: str) -> Iterator[np.ndarray]:
    """The frames, or their clean versions, out of the video that the device stores.

    It is encoded here, in one process, over the whole clip: frames that were rendered by any
    number of processes in any order give the same stream.
    """
    images = (_waiting_frame(waiting, frame)[name] for frame in range(info.frame_count))
    return through_h264(images, scene.sensor.h264, info.fps, scene.id)


def _waiting_frame(waiting: Path, frame: int) -> dict[str, np.ndarray]:
    arrays = read_waiting(frame_file(waiting, frame))
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
    count = len(plans)
    moments = [hands_at(shown_in(scene, item.frame, count), item.seconds) for item in plans]
    return parameters_of(scene, moments)


def _info(scene: Scene, plans: list[FramePlan], size: int) -> CaptureInfo:
    model, files = scene_hands(scene)[scene.sides[0]].model, model_digests(scene.subject)
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
        hand_model=HandModelId(model.name, model.digest, absolute_source(known)),
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
            **({} if scene.clean_share is None else {"clean_share": scene.clean_share}),
            **({"model_files": files} if files else {}),
        },
        licence=LICENCE,
    )


@dataclass(frozen=True)
class SuiteItem:
    """One capture of a suite."""

    #: The scene.
    scene: Scene
    #: Frames over which it is spread.
    frame_count: int
    #: Edge of the image in pixels.
    size: int
    #: Masks of simulated captures are exact.
    exact_masks: ClassVar[bool] = True

    @property
    def id(self) -> str:
        """Id of the scene and of its capture."""
        return self.scene.id

    @property
    def shows(self) -> str:
        """Title of the scene."""
        return self.scene.title

    @property
    def hands(self) -> str:
        """`right`, `left` or `both`."""
        return self.scene.hands

    @property
    def perturbations(self) -> tuple[str, ...]:
        """Names of the perturbations that it declares, sorted."""
        return tuple(sorted({call.kind for call in self.scene.effects}))

    def is_source_of(self, info: CaptureInfo) -> bool:
        """Return whether a capture was rendered from the scene, with these frames and this size."""
        given = (info.id, info.frame_count, info.width, info.height)
        wanted = (self.id, self.frame_count, self.size, self.size)
        return given == wanted and info.source.get("scene_digest") == self.scene.digest


# One single-hand and one interacting capture for each perturbation: interaction 0 and 5,
# complex poses 1 and 6, illumination 2 and 7, motion blur 3 and 4.
_MINI = tuple(f"capture{number}" for number in range(8))


@dataclass(frozen=True)
class _Rule:
    """How a suite is made of scenes."""

    #: Edge of the image, px.
    size: int
    #: Frames of each capture, over the same motions; None: by the paper's number and `every`.
    frames: int | None = None
    #: The captures; None: all scenes of the group.
    captures: tuple[str, ...] | None = None
    #: Without `frames`: how many of the paper's frames stand for one of the suite's.
    every: int = 1
    #: The group of scenes; empty: the eleven captures.
    group: str = ""
    #: Share of the training part that is clean; None: as the scenes have it.
    clean_share: float | None = None


_SUITES: Mapping[str, _Rule] = MappingProxyType(
    {
        "smoke": _Rule(112, 30, ("capture0", "capture4")),
        "mini": _Rule(176, 60, _MINI),
        "full-lite": _Rule(256, every=12),
        "full": _Rule(256),
        "wild-dev": _Rule(176, 60, group="wild-dev"),
        "wild-test": _Rule(176, 60, group="wild-test"),
        "persistent": _Rule(176, 60, group="persistent"),
        **{
            f"persistent-clean{percent}": _Rule(
                176, 60, group="persistent", clean_share=percent / 100
            )
            for percent in (0, 20, 35, 60)
        },
    }
)


def suite_names() -> tuple[str, ...]:
    """Names of the suites: the paper's captures, smallest first, wild ones, persistent ones."""
    return tuple(_SUITES)


def suite(name: str) -> tuple[SuiteItem, ...]:
    """Return the captures of a suite.

    Args:
        name: `smoke` (seconds), `mini` (minutes), `full` (hours), `full-lite` (a twelfth
            of its frames), or of scenes that are as wide as the world: `wild-dev` (for tuning)
            or `wild-test` (for reports only); or of perturbations that last: `persistent`, with
            10 % of the training frames clean, and `persistent-clean0`, `-clean20`, `-clean35` and
            `-clean60`, the same captures with another share.

    Raises:
        UsageError: there is no such suite.
    """
    if name not in _SUITES:
        raise UsageError(f"there is no suite {name!r}", remedy=f"Known: {', '.join(_SUITES)}.")
    rule = _SUITES[name]
    scenes = [load_scene(capture) for capture in rule.captures or scene_names(rule.group)]
    if rule.clean_share is not None:
        scenes = [with_clean_share(scene, rule.clean_share) for scene in scenes]
    return tuple(
        SuiteItem(scene, rule.frames or -(-scene.frame_count // rule.every), rule.size)
        for scene in scenes
    )


def ensure_suite(
    name: str | Sequence[SuiteItem],
    cache: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    *,
    engine: Engine | None = None,
    needs: Needs | None = None,
    free_view: bool = True,
) -> list[Path]:
    """Render the captures of a suite that are not in the cache yet.

    Args:
        name: a suite, or captures such as some of one.
        cache: folder of captures; the toolkit's cache if None.
        workers: processes for each render.
        engine: where captures are rendered; one after another in this process if None.
        needs: what one render takes of a machine.
        free_view: also render free-view clips, which captures in the cache may lack.

    Returns:
        The capture folders, in the suite's order.

    Raises:
        UsageError: there is no such suite.
        HwpError: a render failed; captures that were finished stay.
    """
    engine, needs = engine or LocalEngine(), needs or Needs()
    items = suite(name) if isinstance(name, str) else name
    each = workers_each(workers, engine, needs)
    jobs = [
        RenderRequest(
            item.scene, item.frame_count, item.size, workers=each, keep=True, free_view=free_view
        ).job(_folder(item, cache), needs)
        for item in items
    ]
    if not all(job.finished() for job in jobs):
        engine.run(jobs, lambda index: None)
    return [job.output for job in jobs]


def is_rendered(name: str, cache: str | os.PathLike[str] | None = None) -> bool:
    """Whether every capture of a suite is in the cache, with its free-view clip."""
    return all(
        RenderRequest(item.scene, item.frame_count, item.size, keep=True).is_whole(
            _folder(item, cache)
        )
        for item in suite(name)
    )


def _folder(item: SuiteItem, cache: str | os.PathLike[str] | None) -> Path:
    """Where a capture lies in the cache."""
    root = Path(cache) if cache is not None else cache_root() / "sim" / "captures"
    key = render_key(item.scene, item.frame_count, item.size)
    return root / f"{item.scene.id}-{item.frame_count}x{item.size}-{key[:12]}"


def workers_each(workers: int | None, engine: Engine, needs: Needs) -> int | None:
    """The processes of one render: as asked for, else as many as the engine allows.

    In turn each render takes as many as help; where several run at once, the processors
    of a job.
    """
    return workers if workers is not None or engine.in_turn else max(1, int(needs.cpus))
