"""A fit from a capture folder to an avatar, which can be stopped and continues.

The state of an unfinished fit lies on disk, so that a stopped one continues as if it had not been.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import atomic_write, disc_errors, sha256_file, sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import Split, contiguous_split
from hwp_bench.methods.contract import REQUEST, Avatar, Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import (
    CALL,
    load_avatar,
    made_by_call,
    refuse_no_avatar,
    save_avatar,
)
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.method import affordable, digest_of_named_files, read_usable, ready_fit
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.gaussians.fit_loop import Loss
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.plain.loop import IterativeFit, Watchers, run_fit
from wildghand.splat.threads import denormals_flushed

#: Seconds between two saved states.
SAVE_EVERY = 20.0
#: Name of the saved state in the work folder.
STATE = "state.pt"
#: Version of the file.
SCHEMA = "wildghand-fit/1"
#: Largest file that is read, bytes.
MAX_BYTES = 8 << 30

#: Looks at a fit: (fit, steps so far, loss of the last one). It changes nothing of the fit.
Watch = Callable[[Fit, int, Loss], None]
Result = TypeVar("Result")


class _Clock:
    """The `Report` of a fit that nobody scores.

    Args:
        before: seconds that preparing the fit took, or all until its state was saved.
        show: takes the number of steps that are done.
    """

    def __init__(self, before: float, show: Any) -> None:
        self._start = time.perf_counter() - before
        self._show = show

    @contextlib.contextmanager
    def standing_still(self) -> Iterator[None]:
        """Leave what happens within this out of the seconds of the fit."""
        entered = time.perf_counter()
        try:
            yield
        finally:
            self._start += time.perf_counter() - entered

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Take a checkpoint: none is ever due."""

    def progress(self, done: int, total: int) -> None:
        """Show how far the fit is."""
        self._show(done)

    @property
    def elapsed(self) -> float:
        """Seconds of the fit, those of its preparation and of earlier runs included."""
        return time.perf_counter() - self._start


def unfinished(out: Path, ending: str = ".fit") -> Path:
    """Return the folder of the state of a fit to an output folder, until it is finished."""
    named = Path(os.path.abspath(out))  # `.` has no name.
    return named.with_name(named.name + ending)


@denormals_flushed()
def fit_capture(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    all_frames: bool = False,
    overwrite: bool = False,
    world: World = SINGLE_PROCESS,
    watch: Watch | None = None,
) -> WildGHandAvatar:
    """Fit an avatar to a capture, and write it if a folder is named.

    With `out` the state is saved next to it every 20 seconds. The same call continues with it after
    a stop, and takes the avatar as it is where it was finished; with a budget in steps the result
    is that of a fit that was never stopped.

    Args:
        out: the avatar folder; None: nothing is written (`save_avatar` can do it later).
    """
    chosen = read_usable(settings or {})
    world.shard(chosen.schedule.batch)
    run = RunSettings(dict(settings or {}), seed, budget or Budget())
    if out is None and world.size > 1:
        raise UsageError("is missing; several processes share a fit in its folder", field="out")
    if out is not None:
        refuse_no_avatar(out)
    exists = UsageError("exists", where=out, remedy="Choose another name, or give --overwrite.")
    kept = out is not None and Path(out).exists() and not overwrite
    if out is not None and kept and not (Path(out) / CALL).is_file():
        raise exists
    capture = open_capture(source)
    split = every_frame(capture, tested=True) if all_frames else _split(capture)
    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            avatar = _fit_in(Path(folder), capture, split, run, world, watch, save=False)
            _ = avatar.weight_masks  # Made while the frames are there.
            return avatar
    out, work = Path(out), unfinished(Path(out))
    limits = [run.budget.seconds, run.budget.steps]
    named = digest_of_named_files(chosen)
    call = sha256_json([capture.digest, split.digest, dict(run.settings), named, seed, limits])
    if kept:
        if not made_by_call(out, call):
            raise exists
        # A process may be killed after its avatar was whole.
        if world.is_main:
            notice(f"{out} is complete: the same call has made it; --overwrite fits again")
            shutil.rmtree(work, ignore_errors=True)
        return load_avatar(out)
    with disc_errors(work), exclusive(work) if world.is_main else contextlib.nullcontext():
        avatar = _fit_in(work, capture, split, run, world, watch)
        if world.is_main:
            save_avatar(avatar, out, overwrite=overwrite, call=call)
            shutil.rmtree(work, ignore_errors=True)
        world.wait_for_main()
    return avatar


def _fit_in(
    work: Path,
    capture: Capture,
    split: Split,
    run: RunSettings,
    world: World,
    watch: Watch | None,
    *,
    save: bool = True,
) -> WildGHandAvatar:
    """Fit, from the state that is saved in the work folder if there is one."""
    if world.is_main:
        write_request(work / "request", capture, split, run)
    world.wait_for_main()
    chosen = read_settings(run.settings)
    training = open_request(work / "request")
    digest = digest_of_request(work / "request", capture, chosen)
    entered = time.perf_counter()
    device = ready_fit(chosen.device)
    if world.is_main:
        ready = time.perf_counter() - entered
        notice(f"Kernels ready after {ready:.1f} s, which do not count as seconds of the fit.")
    entered = time.perf_counter()
    fit = make_fit(affordable(training, chosen, run.budget), chosen, run.seed, device, world)
    prepared = time.perf_counter() - entered

    def look(step: int, loss: Loss) -> None:
        if watch is not None:
            watch(fit, step, loss)

    return run_resumed(
        fit,
        run.budget,
        work / STATE,
        digest,
        f"Fitting {capture.info.id}",
        prepared=prepared,
        save=save,
        is_main=world.is_main,
        # Within a block each process holds its own part of the gradient that they share.
        every=fit.shared_steps if world.size > 1 else 1,
        begin=fit.require_same,
        look=look,
    )


def digest_of_request(request: Path, capture: Capture, settings: WildGHandSettings) -> str:
    """Digest of what a saved state belongs to: request, the capture's files and named ones."""
    files = capture.info.to_json().get("digests")
    return sha256_json([sha256_file(request / REQUEST), files, digest_of_named_files(settings)])


def run_resumed(
    fit: IterativeFit[Result],
    budget: Budget,
    state: Path,
    digest: str,
    title: str,
    *,
    prepared: float = 0.0,
    save: bool = True,
    is_main: bool = True,
    every: int = 1,
    begin: Callable[[int], None] = lambda start: None,
    look: Callable[[int, Loss], None] = lambda step, loss: None,
) -> Result:
    """Run a fit from its saved state, if there is one, and save it every 20 seconds.

    It is saved after multiples of `every` steps only.

    Args:
        prepared: seconds of the budget that making the fit took.
    """
    watchers, start, before = Watchers(), 0, prepared
    if state.is_file():
        # Its seconds have those of the first preparation in them.
        start, before = load_state(state, fit, watchers, digest)
        if is_main:
            notice(f"Continuing after {start} steps.")
    begin(start)
    with contextlib.ExitStack() as stack:
        show: Callable[[int], None] = lambda done: None  # noqa: E731
        if is_main:
            show = stack.enter_context(progress(title, fit.count_steps(budget)))
        clock = _Clock(before, show)
        saved = time.perf_counter()

        def after_step(step: int, watched: Watchers, loss: Loss) -> None:
            nonlocal saved
            due = step % every == 0 and time.perf_counter() - saved >= SAVE_EVERY
            if save and is_main and due:
                save_state(state, fit, watched, step=step, seconds=clock.elapsed, digest=digest)
                saved = time.perf_counter()
            with clock.standing_still():
                look(step, loss)

        return run_fit(fit, budget, clock, start=start, watchers=watchers, after_step=after_step)


def save_state(
    path: str | os.PathLike[str],
    fit: IterativeFit[Any],
    watchers: Watchers,
    *,
    step: int,
    seconds: float,
    digest: str,
) -> None:
    """Write everything that changes during a fit."""
    state = {
        "schema": SCHEMA,
        "digest": digest,
        "step": step,
        "seconds": seconds,
        "fit": fit.state_dict(),
        "watchers": watchers.state_dict(),
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    atomic_write(path, buffer.getvalue())


def load_state(
    path: str | os.PathLike[str],
    fit: IterativeFit[Any],
    watchers: Watchers,
    digest: str,
) -> tuple[int, float]:
    """Bring a fit back to a saved state; nothing in the file is executed."""
    file = Path(path)
    if not file.is_file() or file.stat().st_size > MAX_BYTES:
        raise BadInput(f"is missing or larger than {MAX_BYTES} bytes", where=file)
    try:
        state = torch.load(file, map_location=fit.device, weights_only=True)
        if not isinstance(state, Mapping) or state.get("schema") != SCHEMA:
            raise BadInput(f"is not a state of schema {SCHEMA}", where=file)
        _check_digest(state, digest, file)
        fit.load_state_dict(state["fit"])
        watchers.load_state_dict(state["watchers"])
        return int(state["step"]), float(state["seconds"])
    except BadInput:
        raise
    except (
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
    ) as error:
        problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise BadInput(
            f"is damaged ({problem})", where=file, remedy="Remove it to fit from the start."
        ) from error


def _check_digest(state: Mapping[str, Any], digest: str, file: Path) -> None:
    if state.get("digest") != digest:
        raise BadInput(
            "belongs to another capture, other settings or files that they name, or another seed",
            where=file,
            remedy="Give the same arguments to continue with it, or remove it to start again.",
        )


def _split(capture: Capture) -> Split:
    try:
        return contiguous_split(capture.info.id, capture.info.frame_count)
    except HwpError as error:
        raise UsageError(
            f"is too short for a split ({error})",
            where=capture.root,
            remedy="Fit all of it with --all-frames.",
        ) from error


# Frames at the end of a clip that a fit of all frames is tested with: a twentieth, at most 12.
_TESTED_SHARE, _MOST_TESTED = 20, 12


def every_frame(capture: Capture, *, tested: bool = False) -> Split:
    """Every frame but the last two, which stand for the parts that a split must have.

    Args:
        tested: leave out more, to test the fit with them.
    """
    count = capture.info.frame_count
    if count < 3:
        raise BadInput(
            f"has {count} of the 3 frames that a fit to all of them needs at least",
            where=capture.root,
            field="frame_count",
        )
    most = _MOST_TESTED if tested else 1
    first = count - max(1, min(most, count // _TESTED_SHARE))
    return Split(capture.info.id, count, (0, first - 1), (first - 1, first), (first, count))
