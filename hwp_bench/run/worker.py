"""The process that a Python method runs in, and what it leaves in its output folder.

It is given a request folder and an output folder, and does not know where the capture is. With
`--check` it draws on where a picture cannot be taken, and lists what is wrong. It is started by
`hwp_bench.run.start`. A command may write the same files.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TypeAlias

import numpy as np
from msgspec import Meta

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadMethod, HwpError, MethodFailed, one_line, shown
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.base.records import Count, Line, Seconds, parse_record
from hwp_bench.capture.schema import frame_name
from hwp_bench.hands.skeleton import Camera, HandPose
from hwp_bench.methods.contract import Avatar, Budget, MethodFactory, TrainingCapture
from hwp_bench.methods.request import open_request

#: Folder of the predicted test frames inside the output folder.
PREDICTIONS = "predictions"
#: Folder of the predicted frames of the free-view clip inside the output folder.
FREE_VIEW = "free"
#: Folder of the validation frames of each checkpoint inside the output folder.
CHECKPOINTS = "checkpoints"
#: Folder of files that a method writes about itself, for pictures and tables; optional.
DIAGNOSTICS = "diagnostics"
#: Time, steps and memory of the run.
RUN = "run.json"
#: How far the fit is.
PROGRESS = "progress.json"
#: Why the run failed.
FAILURE = "failure.json"
#: The method's printed output.
LOG = "log.txt"
#: Findings of a run with `--check`.
FINDINGS = "findings.json"
#: Settings and seed of a method that is only made, in the place of a request.
REHEARSAL = "rehearsal.json"
#: Largest `run.json` that is read, bytes; most frames and checkpoints in it.
MAX_BYTES = 1024 * 1024
MAX_FRAMES, MAX_CHECKPOINTS = 64, 1000
#: Most places of one finding that are named.
MAX_PLACES = 5
# Colours may leave [0, 1] by this much, as sums of weights do, before a check doubts them.
_MARGIN = 0.02
#: Most validation frames that are rendered for a checkpoint.
CHECKPOINT_FRAMES = 8
#: Seconds between two writes of the progress file.
PROGRESS_INTERVAL = 0.5


def main(arguments: list[str] | None = None) -> int:
    """Run a method on a request, or only make it (`--rehearse`); returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("request", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--method", type=Path, required=True)
    parser.add_argument("--entry", required=True)
    parser.add_argument("--rehearse", action="store_true")
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args(arguments)
    args.output.mkdir(parents=True, exist_ok=True)
    status, watch = 1, Watch() if args.check else None
    if watch is not None:
        sys.addaudithook(watch.hear)
    try:
        factory = load_entry(args.method, args.entry)
        if args.rehearse:
            asked = read_json(args.request / REHEARSAL)
            factory(asked["settings"], asked["seed"])
        else:
            draw = render_checked if watch is None else watch.draw
            run(open_request(args.request), factory, args.output, draw)
        return 0
    except (HwpError, SystemExit) as error:
        if isinstance(error, SystemExit) and isinstance(error.code, int | None):
            raise
        problem = str(error)
        print(f"error: {problem}", file=sys.stderr)
    except BaseException as error:
        traceback.print_exc()
        problem = f"{type(error).__name__}: {error}"
        status = 130 if isinstance(error, KeyboardInterrupt) else 1
    finally:
        if watch is not None:
            write_json(args.output / FINDINGS, {"found": watch.found})
    # For the runner; a full disc takes the reason from nobody else.
    with contextlib.suppress(HwpError, ValueError):
        # A message may hold what no file of Unicode can.
        write_json(args.output / FAILURE, {"problem": shown(problem[:2000])})
    return status


def load_entry(method: Path, entry: str) -> MethodFactory:
    """Import `module:callable`; modules in the method directory come first."""
    module_name, _, name = entry.partition(":")
    sys.path.insert(0, str(method.resolve()))
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise BadMethod(
            f"cannot import {module_name} ({error})", where=method, field="entry.python"
        ) from error
    factory = getattr(module, name, None)
    if not callable(factory):
        raise BadMethod(f"{module_name} has no {name}", where=method, field="entry.python")
    return factory


#: Renders a picture of hands with a camera; the last argument is its name in messages.
Draw: TypeAlias = Callable[[Avatar, Mapping[str, HandPose], Camera, str], np.ndarray]


def run(training: TrainingCapture, factory: MethodFactory, output: Path, draw: Draw) -> None:
    """Fit, render the targets, and write predictions, checkpoints and `run.json`.

    A frame that cannot be rendered costs only itself, as long as there are others.
    """
    validation = training.validation
    frames = validation[evenly(len(validation), CHECKPOINT_FRAMES)].tolist()

    def render(avatar: Avatar, frame: int) -> np.ndarray:
        return draw(avatar, training.hand_poses(frame), training.camera(frame), f"frame {frame}")

    def record(index: int, avatar: Avatar) -> None:
        _write_frames(frames, partial(render, avatar), checkpoint_folder(output, index))

    entered = time.perf_counter()
    method = factory(training.run.settings, training.run.seed)
    ready_seconds = time.perf_counter() - entered
    notice(f"Ready after {ready_seconds:.1f} s, which do not count as seconds of the fit.")
    report = ReportClock(training.run.budget, record, output / PROGRESS)
    avatar = method.fit(training, training.run.budget, report)
    _wait_for_gpu()
    fit_seconds, cpu = report.elapsed, report.cpu_seconds
    final_step = int(getattr(avatar, "steps", report.last))
    explain = getattr(avatar, "write_diagnostics", None)
    if callable(explain):
        explain(output / DIAGNOSTICS)
    report.take(final_step, avatar, fit_seconds)
    targets = training.targets.tolist()
    render_seconds = _write_frames(targets, partial(render, avatar), output / PREDICTIONS)
    render_free_views(avatar, training, output / FREE_VIEW, draw)
    facts = RunFacts(
        fit_seconds=fit_seconds,
        cpu_seconds=cpu,
        ready_seconds=ready_seconds,
        render_seconds=render_seconds,
        curve_seconds=report.paused,
        # A fit that went back to an earlier state has spent its time on the later steps too.
        steps=report.last,
        peak_memory=peak_memory(),
        device=str(getattr(avatar, "device", _used_device()))[:100],
        checkpoint_frames=frames,
        checkpoints=report.checkpoints,
    )
    write_json(output / RUN, asdict(facts))


def _write_frames(
    frames: Sequence[int],
    render: Callable[[int], np.ndarray],
    folder: Path,
    *,
    needed: bool = True,
) -> float:
    """Write each frame that can be rendered; what is wrong with others goes to the log.

    Args:
        needed: raise the last frame's exception where none can be rendered.

    Returns:
        Seconds of rendering.
    """
    seconds, failed = 0.0, 0
    for frame in frames:
        started = time.perf_counter()
        try:
            pixels = render(frame)
        except Exception:
            failed += 1
            if needed and failed == len(frames):
                raise
            traceback.print_exc()
            continue
        finally:
            seconds += time.perf_counter() - started
        write_image(folder / frame_name(frame), pixels)
    return seconds


def _wait_for_gpu() -> None:
    """Wait for what a GPU was told: that belongs to the fit, not to what is drawn next."""
    if (cuda := _used_cuda()) is not None:
        cuda.synchronize()


def _used_device() -> str:
    """Return where a method computed that does not say so: on a GPU if torch has used one."""
    return "cpu" if _used_cuda() is None else "cuda"


def _used_cuda() -> ModuleType | None:
    """Return `torch.cuda` if the method has used a GPU through it; imports nothing."""
    cuda = sys.modules.get("torch.cuda")
    return cuda if cuda is not None and cuda.is_initialized() else None


def render_free_views(avatar: Avatar, training: TrainingCapture, folder: Path, draw: Draw) -> None:
    """Render the free-view clip, if there is one; a frame that fails costs only itself."""
    views = training.free_views
    if views is None:
        return

    def render(frame: int) -> np.ndarray:
        camera = views.cameras.camera(frame, training.width, training.height)
        return draw(avatar, views.hand_poses(frame), camera, f"free-view frame {frame}")

    _write_frames(range(len(views)), render, folder, needed=False)


def render_checked(
    avatar: Avatar, hands: Mapping[str, HandPose], camera: Camera, name: str
) -> np.ndarray:
    """Render hands and bring the image to 8 bits: clipped, rounded half to even.

    A fourth channel is dropped: the data set owns the mask.
    """
    image = np.asarray(avatar.render(hands, camera))
    fault = _fault(image, camera)
    if fault is not None:
        raise MethodFailed(fault[1], field=name)
    return as_uint8(np.asarray(image[:, :, :3], dtype=np.float64))


def _fault(image: np.ndarray, camera: Camera) -> tuple[str, str] | None:
    """Why a picture cannot be taken: what is wrong in a word, and in a sentence."""
    size = (camera.height, camera.width)
    if image.shape not in ((*size, 3), (*size, 4)):
        return "shape", f"render returned shape {image.shape}, not {(*size, 3)} or {(*size, 4)}"
    if image.dtype.kind not in "fiub":
        return "type", f"render returned {image.dtype}, not real numbers"
    if not np.isfinite(image).all():
        return "nan", "render returned NaN or infinity"
    return None


# --- a run that is checked: it continues where a picture cannot be taken


class Watch:
    """Collects what is wrong with pictures, and looks for calls to the network."""

    def __init__(self) -> None:
        self.found: dict[str, list[str]] = {}

    def note(self, check: str, problem: str, place: str) -> None:
        """Add a place to what is found: a sentence by its word, then the first places."""
        found = self.found.setdefault(check, [one_line(problem, 500)])
        if len(found) <= MAX_PLACES:
            found.append(one_line(place, 200))

    def hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Note an audit event of Python that asks for another machine."""
        if event not in ("socket.connect", "socket.sendto", "socket.getaddrinfo"):
            return
        address = arguments[0] if event == "socket.getaddrinfo" else arguments[1]
        host = address[0] if isinstance(address, tuple) else address
        local = not host or (event != "socket.getaddrinfo" and not isinstance(address, tuple))
        if local or str(host).startswith(("127.", "::1", "localhost")):
            return
        self.note("network", "the method asks for another machine", str(host))

    def draw(
        self, avatar: Avatar, hands: Mapping[str, HandPose], camera: Camera, name: str
    ) -> np.ndarray:
        """Render as `render_checked` does; a picture that cannot be taken is noted and black."""
        try:
            image = np.asarray(avatar.render(hands, camera))
        except Exception as error:
            traceback.print_exc()
            self.note("run", f"render raised {type(error).__name__}: {error}", name)
            return np.zeros((camera.height, camera.width, 3), np.uint8)
        fault = _fault(image, camera)
        if fault is not None:
            self.note(*fault, name)
            return np.zeros((camera.height, camera.width, 3), np.uint8)
        colours = np.asarray(image[:, :, :3], dtype=np.float64)
        low, high = colours.min(), colours.max()
        if low < -_MARGIN or high > 1 + _MARGIN:
            text = f"render returned colours from {low:.3g} to {high:.3g}, not in [0, 1]"
            self.note("range", text, name)
        return as_uint8(colours)


@dataclass(frozen=True)
class _Findings:
    """The content of the file of findings."""

    found: dict[Line, Annotated[list[Line], Meta(min_length=1, max_length=MAX_PLACES + 1)]]


def read_findings(path: Path) -> dict[str, list[str]]:
    """Read what a checked run found: a sentence and the first places, by a word for what is wrong.

    There is nothing where the run was killed before, or was not checked.
    """
    if not path.is_file():
        return {}
    value = read_json(path, max_bytes=MAX_BYTES)
    return parse_record(_Findings, value, where=path).found


# --- the clock and its checkpoints


class ReportClock:
    """The `Report` that a method is given."""

    def __init__(
        self, budget: Budget, record: Callable[[int, Avatar], None], progress_file: Path
    ) -> None:
        self._due = checkpoint_times(budget)
        self._due_steps = [budget.steps * tenth / 10 for tenth in range(1, 10) if budget.steps]
        self._record = record
        self._progress_file = progress_file
        self._last_progress = 0.0
        #: Seconds that the clock has stood still for checkpoints.
        self.paused = 0.0
        self._start = time.perf_counter()
        self._paused_cpu = 0.0
        self._start_cpu = cpu_seconds()
        self.checkpoints: list[Checkpoint] = []
        #: The largest step that was reported, whether a checkpoint was due or not.
        self.last = 0

    @property
    def elapsed(self) -> float:
        """Seconds on the method's clock."""
        return time.perf_counter() - self._start - self.paused

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of this process and of children that have ended, on the method's clock."""
        return cpu_seconds() - self._start_cpu - self._paused_cpu

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Take a checkpoint if one is due; the first offer is always one."""
        step = int(step)  # NumPy's cannot be written as JSON
        self.last = max(self.last, step)
        in_time = self._due and self.elapsed >= self._due[0]
        in_steps = self._due_steps and step >= self._due_steps[0]
        if in_time or in_steps or not self.checkpoints:
            self.take(step, avatar)

    def take(self, step: int, avatar: Avatar, seconds: float | None = None) -> None:
        """Take a checkpoint now; the clock stands still meanwhile."""
        step = int(step)
        self.last = max(self.last, step)
        if seconds is None:
            _wait_for_gpu()
            seconds = self.elapsed
        entered, entered_cpu = time.perf_counter(), cpu_seconds()
        self._due = [moment for moment in self._due if moment > seconds]
        self._due_steps = [due for due in self._due_steps if due > step]
        self._record(len(self.checkpoints), avatar)
        self.checkpoints.append(Checkpoint(step, seconds, peak_memory()))
        self.paused += time.perf_counter() - entered
        self._paused_cpu += cpu_seconds() - entered_cpu

    def progress(self, done: int, total: int) -> None:
        """Tell the runner how far the fit is."""
        now = time.perf_counter()
        if now - self._last_progress >= PROGRESS_INTERVAL or done >= total:
            self._last_progress = now
            # A fit need not end because its bar stands still.
            with contextlib.suppress(HwpError):
                write_json(self._progress_file, {"done": int(done), "total": int(total)})
            self.paused += time.perf_counter() - now


def checkpoint_times(budget: Budget) -> list[float]:
    """Return the seconds at which checkpoints are due: dense at the start, then regular.

    1, 2, 4, 8, ... s, and every tenth of a budget in seconds. (`ReportClock` adds the first offer
    of a method, and every tenth of a budget in steps.)
    """
    horizon = budget.seconds or 24 * 3600.0
    due = {float(2**power) for power in range(18) if 2**power <= horizon}
    if budget.seconds:
        due |= {budget.seconds * tenth / 10 for tenth in range(1, 10)}
    return sorted(due)


def cpu_seconds() -> float:
    """Return the CPU seconds of this process, all threads, and of its children that have ended."""
    spent = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in spent)


def peak_memory() -> int:
    """Return the peak resident memory of this process, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts in KiB, macOS in bytes.
    return peak if sys.platform == "darwin" else peak * 1024


# --- the facts that `run.json` holds


@dataclass(frozen=True)
class Checkpoint:
    """One recorded moment of a fit; see `results.CurvePoint`."""

    step: Count
    seconds: Seconds
    peak_memory: Count


@dataclass(frozen=True)
class RunFacts:
    """Time, steps and memory of a run; None where the method reports none."""

    #: Seconds on the method's clock.
    fit_seconds: Seconds | None = None
    #: CPU seconds of the process and its children on that clock, all threads added up.
    cpu_seconds: Seconds | None = None
    #: Seconds before that clock started, in which the method was made: what it compiles or loads.
    ready_seconds: Seconds | None = None
    #: Seconds to render the test frames.
    render_seconds: Seconds | None = None
    #: Seconds spent on checkpoints, outside the method's clock.
    curve_seconds: Seconds | None = None
    #: Optimizer steps.
    steps: Count | None = None
    #: Peak memory of the process, bytes.
    peak_memory: Count | None = None
    device: Line | None = None
    #: Validation frames that were rendered for every checkpoint.
    checkpoint_frames: Annotated[list[Count], Meta(max_length=MAX_FRAMES)] = field(
        default_factory=list
    )
    #: The checkpoints, in time order; the last is the finished fit.
    checkpoints: Annotated[list[Checkpoint], Meta(max_length=MAX_CHECKPOINTS)] = field(
        default_factory=list
    )


def checkpoint_folder(output: Path, index: int) -> Path:
    """Return the folder of the validation frames of a checkpoint."""
    return output / CHECKPOINTS / f"{index:03d}"


def read_facts(path: Path) -> RunFacts:
    """Read `run.json`; a run need not write one."""
    if not path.is_file():
        return RunFacts()
    return parse_record(RunFacts, read_json(path, max_bytes=MAX_BYTES), where=str(path))
