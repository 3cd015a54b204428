"""A fit from a capture folder to an avatar, which can be stopped and goes on."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import disc_errors, sha256_file, sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import Split, contiguous_split
from hwp_bench.methods.contract import REQUEST, Avatar, Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import CALL, load_avatar, made_by_call, save_avatar
from wildghand.fitting.affordable import affordable
from wildghand.fitting.fit import Fit
from wildghand.fitting.optimize import Watch, Watchers, optimize
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.ready import ready_fit
from wildghand.fitting.saved_state import load_state, save_state
from wildghand.gaussians.fit_loop import Loss
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.splat.threads import denormals_flushed

#: Seconds between two saved states.
SAVE_EVERY = 20.0
#: Name of the saved state in the work folder.
STATE = "state.pt"


class _Clock:
    """The `Report` of a fit that nobody scores.

    Args:
        before: seconds that earlier runs of the fit took.
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
        """Seconds of fitting, those of earlier runs included."""
        return time.perf_counter() - self._start


def unfinished(out: Path) -> Path:
    """Return the folder of the state of a fit to an avatar folder, until it is finished."""
    return out.with_name(out.name + ".fit")


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

    With `out` the state is saved next to it every 20 seconds. The same call goes on with it after
    a stop, and takes the avatar as it is where it was finished; with a budget in steps the result
    is that of a fit that was never stopped.

    Args:
        source: the capture folder.
        out: the avatar folder; None: nothing is written (`save_avatar` can do it later).
        settings: what `wildghand.model.settings.read_settings` takes.
        budget: when to stop; without steps the settings' number holds.
        seed: of everything random.
        all_frames: fit the validation and test frames too: for an avatar, not for a score.
        overwrite: replace an avatar that is there.
        world: the processes that fit together; only rank 0 writes.
        watch: looks at the fit after each step, while its clock stands still.

    Raises:
        BadMethod: a setting is unknown or out of range.
        UsageError: `out` exists and is not of the same call, the processes cannot share a batch
            evenly, or there are several and no `out`.
        BadInput: no training frame can be used, or the saved state is of another fit.
        DidNotConverge: the fit diverged at once.
        HwpError: another fit is writing to `out`, or `out` cannot be written to (steps up to the
            last saved state are not lost), or another process has ended.
    """
    chosen = read_settings(settings or {})
    world.shard(chosen.schedule.batch)
    run = RunSettings(dict(settings or {}), seed, budget or Budget())
    if out is None:
        if world.size > 1:
            raise UsageError("is missing; several processes share a fit in its folder", field="out")
        capture = open_capture(source)
        split = every_frame(capture) if all_frames else _split(capture)
        with tempfile.TemporaryDirectory() as folder:
            write_request(Path(folder) / "request", capture, split, run)
            avatar = _fit_in(Path(folder), capture, run, chosen, world, watch, save=False)
            _ = avatar.weight_masks  # Made while the frames are there.
            return avatar
    out = Path(out)
    if out.exists() and not overwrite and not (out / CALL).is_file():
        raise _exists(out)
    capture = open_capture(source)
    split = every_frame(capture) if all_frames else _split(capture)
    work = unfinished(out)
    limits = [run.budget.seconds, run.budget.steps]
    call = sha256_json([capture.digest, split.digest, dict(run.settings), seed, limits])
    if out.exists() and not overwrite:
        if not made_by_call(out, call):
            raise _exists(out)
        # A process may be killed after its avatar was whole.
        if world.is_main:
            notice(f"{out} is complete: the same call has made it; --overwrite fits again")
        return load_avatar(out)
    with disc_errors(work), exclusive(work) if world.is_main else contextlib.nullcontext():
        if world.is_main:
            write_request(work / "request", capture, split, run)
        world.wait_for_main()
        avatar = _fit_in(work, capture, run, chosen, world, watch)
        if world.is_main:
            save_avatar(avatar, out, overwrite=overwrite, call=call)
            shutil.rmtree(work, ignore_errors=True)
        world.wait_for_main()
    return avatar


def _exists(out: Path) -> UsageError:
    return UsageError("exists", where=out, remedy="Choose another name, or give --overwrite.")


def _fit_in(
    work: Path,
    capture: Capture,
    run: RunSettings,
    chosen: WildGHandSettings,
    world: World,
    watch: Watch | None,
    *,
    save: bool = True,
) -> WildGHandAvatar:
    """Fit, from the state that is saved in the work folder if there is one."""
    training = affordable(open_request(work / "request"), chosen, run.budget)
    digest = sha256_json(
        [sha256_file(work / "request" / REQUEST), capture.info.to_json().get("digests")]
    )
    entered = time.perf_counter()
    device = ready_fit(chosen.device)
    if world.is_main:
        ready = time.perf_counter() - entered
        notice(f"Kernels made ready in {ready:.1f} s, which the seconds of the fit leave out.")
    fit = Fit(training, chosen, run.seed, device, world)
    watchers, start, before = Watchers(chosen.schedule.plateau_steps), 0, 0.0
    state = work / STATE
    if state.is_file():
        start, before = load_state(state, fit, watchers, digest)
        if world.is_main:
            notice(f"Going on after {start} steps.")
    fit.require_same(start)
    steps = chosen.schedule.steps if run.budget.steps is None else run.budget.steps
    with _shown(capture, steps, world) as show:
        clock = _Clock(before, show)
        saved = time.perf_counter()

        def after_step(step: int, watched: Watchers) -> None:
            nonlocal saved
            if save and world.is_main and time.perf_counter() - saved >= SAVE_EVERY:
                save_state(state, fit, watched, step=step, seconds=clock.elapsed, digest=digest)
                saved = time.perf_counter()

        def look(fit: Fit, step: int, loss: Loss) -> None:
            if watch is not None:
                with clock.standing_still():
                    watch(fit, step, loss)

        return optimize(
            fit,
            run.budget,
            clock,
            start=start,
            watchers=watchers,
            after_step=after_step,
            watch=look,
        )


@contextlib.contextmanager
def _shown(capture: Capture, steps: int, world: World) -> Iterator[Callable[[int], None]]:
    """The progress bar, which only rank 0 shows."""
    if not world.is_main:
        yield lambda done: None
        return
    with progress(f"Fitting {capture.info.id}", steps) as show:
        yield show


def _split(capture: Capture) -> Split:
    try:
        return contiguous_split(capture.info.id, capture.info.frame_count)
    except HwpError as error:
        raise UsageError(
            f"is too short for a split ({error})",
            where=capture.root,
            remedy="Fit all of it with --all-frames.",
        ) from error


def every_frame(capture: Capture) -> Split:
    """Every frame but the last two, which stand for the parts that a split must have.

    Raises:
        BadInput: there are fewer than three.
    """
    count = capture.info.frame_count
    if count < 3:
        raise BadInput(
            f"has {count} of the 3 frames that a fit to all of them needs at least",
            where=capture.root,
            field="frame_count",
        )
    return Split(capture.info.id, count, (0, count - 2), (count - 2, count - 1), (count - 1, count))
