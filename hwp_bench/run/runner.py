"""Run a method on one capture in a process of its own, away from the test frames."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, BadMethod, MethodFailed, one_line, shown
from hwp_bench.base.files import inside, read_json, temporary_name, write_json
from hwp_bench.base.folders import open_up, remove_tree, scratch_folder
from hwp_bench.base.records import unfold
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.results.schema import ISOLATED
from hwp_bench.run import START
from hwp_bench.run.sandbox.confinement import (
    CACHE,
    HOME,
    Confinement,
    has_accelerators,
    plain_environment,
    sandbox_environment,
)
from hwp_bench.run.sandbox.supervise import (
    MAX_PROCESSES,
    Limits,
    ProcessOutcome,
    Program,
    run_confined,
)
from hwp_bench.run.worker import (
    FAILURE,
    FREE_VIEW,
    LOG,
    PREDICTIONS,
    PROGRESS,
    REHEARSAL,
    RUN,
    RunFacts,
    read_facts,
)

#: Free bytes below which a disc counts as full: an image of a megapixel may need this much.
LOW_SPACE = 4 << 20
# Bytes that are written to find out whether a quota still allows any.
_PROBE = 64 << 10
#: Seconds a method may take on one capture unless told otherwise.
DEFAULT_TIME_LIMIT = 3600.0
#: Lines of a method's output that are repeated when it cannot be made.
LAST = 8
_REMEDIES = {
    "time": "Raise --time-limit, or give the method a --budget.",
    "memory": "Raise --memory-limit, or make the method smaller.",
    "processes": "Make the method start fewer.",
    "machine": "End other programs, run fewer jobs at once, or make the method smaller; "
    "--memory-limit stops it earlier.",
}


@dataclass(frozen=True)
class RunRecord:
    """The outcome of a run."""

    #: Folder of the predicted frames.
    predictions: Path
    #: The content of `run.json`; empty for submitted predictions.
    facts: RunFacts
    #: Wall time of the whole process, start-up included, seconds.
    wall_seconds: float
    #: How the process was isolated: `namespaces`, or `processes` with the reason;
    #: None for submitted predictions.
    isolation: str | None = None
    #: Folder of the predicted frames of the free-view clip; None where a submission or command
    #: has none.
    free_view: Path | None = None
    #: That the disc of the output had no room meanwhile, as a sentence; None where it always had.
    shortage: str | None = None


def run_method(
    manifest: MethodManifest,
    capture_id: str,
    request: Path,
    output: Path,
    *,
    time_limit: float = DEFAULT_TIME_LIMIT,
    confinement: Confinement | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    check: bool = False,
) -> RunRecord:
    """Run a method on a request; a Python method that is checked leaves `findings.json`."""
    if manifest.kind == "predictions":
        below = f"{manifest.entry.predictions}/{capture_id}"
        folder, clip = inside(manifest.root, below), inside(manifest.root, f"{below}/{FREE_VIEW}")
        if not folder.is_dir():
            raise BadMethod(
                f"has no predictions for {capture_id}",
                where=folder,
                remedy=f"Put the frames into {below}/.",
            )
        return RunRecord(folder, RunFacts(), 0.0, free_view=clip if clip.is_dir() else None)
    confinement = confinement or Confinement()
    remove_tree(output)
    output.mkdir(parents=True)
    limits = Limits(time_limit, confinement.memory_bytes)
    started = time.perf_counter()
    # In a sandbox the working folder is another one, and a relative path would lead nowhere.
    folders = request.absolute(), output.absolute()
    space = SpaceWatch(folders[1])
    options = ("--check",) if check and manifest.kind == "python" else ()
    outcome, isolation = _run(
        manifest, *folders, confinement, limits, on_progress, options, space=space
    )
    wall = time.perf_counter() - started
    # First the links, pipes, sockets and devices. A link that leads nowhere inside a sandbox leads
    # to real files outside it: the toolkit would read a test frame for a prediction. A method may
    # also have put one in the place of the folders below.
    open_up(output)
    for name in (CACHE, HOME):
        remove_tree(output / name)
    shortage = space.finish(outcome.log_problem)
    problem = remedy = field = None
    facts = RunFacts()
    if outcome.stopped is not None:
        problem = _broken(outcome.stopped, f"on {capture_id}", limits)
        remedy = _REMEDIES[outcome.stopped]
    elif outcome.status != 0:
        problem = f"failed on {capture_id}: {_reason(output, outcome.status)}"
        if outcome.starved:
            problem += "; the kernel ended processes for want of memory meanwhile"
            remedy = _REMEDIES["machine"]
    elif manifest.kind == "python" and not (output / RUN).is_file():
        problem = f"ended before it had rendered every frame of {capture_id}"
    else:
        try:
            facts = read_facts(output / RUN)
        except BadInput as error:
            problem = f"wrote a {RUN} that cannot be read ({error.problem})"
            field = error.field
    if problem is not None:
        reason = f"; {shortage}" if shortage else ""
        text = f"{manifest.name} {problem}{reason}"
        raise MethodFailed(text, where=output / LOG, field=field, remedy=remedy)
    clip = output / FREE_VIEW
    free_view = clip if manifest.kind == "python" or clip.is_dir() else None
    return RunRecord(output / PREDICTIONS, facts, wall, isolation, free_view, shortage)


def rehearse_method(
    manifest: MethodManifest,
    settings: RunSettings,
    *,
    time_limit: float = DEFAULT_TIME_LIMIT,
    confinement: Confinement | None = None,
) -> None:
    """Make a Python method with its settings and stop there, as `run_method` would begin.

    What fails here would fail on every capture: an import, a setting's value, a device. Of a
    command it is looked whether its program is there.
    """
    if manifest.kind == "command":
        _look_for_program(manifest)
    if manifest.kind != "python":
        return
    confinement = confinement or Confinement()
    limits = Limits(time_limit, confinement.memory_bytes)
    with scratch_folder("hwp-rehearsal-") as scratch:
        request, output = scratch / "request", scratch / "output"
        output.mkdir()
        asked = {"settings": unfold(settings.settings), "seed": settings.seed}
        write_json(request / REHEARSAL, asked)
        outcome, _ = _run(manifest, request, output, confinement, limits, None, ("--rehearse",))
        open_up(output)  # before anything in it is read: it may hold links and pipes
        if outcome.status != 0:
            lines = last_lines(output / LOG)
            # One line is the reason itself.
            for line in lines if len(lines) > 1 else ():
                notice(f"{manifest.name}: {line}")
            broken = outcome.stopped and _broken(outcome.stopped, "while it was made", limits)
            raise MethodFailed(
                f"{manifest.name} cannot be made: {broken or _reason(output, outcome.status)}",
                remedy="It fails before it sees a capture, so that nothing was rendered or run.",
            )


def _run(
    manifest: MethodManifest,
    request: Path,
    output: Path,
    confinement: Confinement,
    limits: Limits,
    on_progress: Callable[[int, int], None] | None,
    options: Sequence[str] = (),
    *,
    space: SpaceWatch | None = None,
) -> tuple[ProcessOutcome, str]:
    """Run in the best sandbox that is asked for and possible; says which it was."""
    command = [*_command(manifest, request, output), *options]

    def poll() -> None:
        if space is not None:
            space.look()
        if on_progress is not None:
            _show_progress(output / PROGRESS, on_progress)

    isolation = "processes"
    if confinement.mode != "none":
        environment, places = sandbox_environment(manifest.root, request, output, confinement)
        log, memory_files = output / LOG, has_accelerators()
        walled = Program(command, output, environment, places, log, memory_files)
        outcome = run_confined(walled, limits, poll)
        if outcome.refused is None:
            return outcome, ISOLATED
        if confinement.mode == "required":
            raise MethodFailed(
                f"namespaces are required, but the system refuses them ({outcome.refused})",
                where=manifest.name,
                field="isolation",
                remedy="docs/threat-model.md says what they need.",
            )
        isolation = f"processes ({outcome.refused})"
    environment = plain_environment(manifest.root, output)
    plain = Program(command, output, environment, None, output / LOG)
    outcome = run_confined(plain, limits, poll)
    if outcome.refused is not None:
        raise MethodFailed(f"could not be started ({outcome.refused})", where=manifest.name)
    return outcome, isolation


def sandbox_problem() -> str | None:
    """Return why a method would run here without a sandbox, or None."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder)
        environment, places = sandbox_environment(output, output, output, Confinement())
        program = Program(
            [sys.executable, "-c", ""],
            output,
            environment,
            places,
            output / LOG,
            has_accelerators(),
        )
        return run_confined(program, Limits(60.0, Confinement().memory_bytes)).refused


def _command(manifest: MethodManifest, request: Path, output: Path) -> list[str]:
    places = {
        "request": str(request.resolve()),
        "output": str(output.resolve()),
        "method": str(manifest.root.resolve()),
        "python": sys.executable,
    }
    if manifest.kind == "python":
        worker = ["{python}", *START, "hwp_bench.run.worker", "{request}", "{output}"]
        words = [*worker, "--method", "{method}", "--entry", str(manifest.entry.python)]
    else:
        words = list(manifest.entry.command or ())
    pattern = "|".join(places)
    return [re.sub(rf"{{({pattern})}}", lambda found: places[found[1]], word) for word in words]


def _show_progress(path: Path, on_progress: Callable[[int, int], None]) -> None:
    # A link may lead to a file that only the toolkit can read.
    if path.is_symlink():
        return
    with contextlib.suppress(BadInput, KeyError, TypeError, ValueError):
        value = read_json(path, max_bytes=10_000)
        on_progress(int(value["done"]), int(value["total"]))


def _broken(limit: str, when: str, limits: Limits) -> str:
    return {
        "time": f"ran out of time {when} after {limits.seconds:g} s",
        "memory": f"took more than {limits.memory / 1e9:.3g} GB of memory {when}",
        "processes": f"ran more than {MAX_PROCESSES} processes at once {when}",
        "machine": f"was stopped {when} because the machine's memory ran out",
    }[limit]


def _reason(output: Path, status: int | None) -> str:
    with contextlib.suppress(BadInput, KeyError, TypeError):
        return shown(str(read_json(output / FAILURE, max_bytes=100_000)["problem"])[:2000])
    last = last_lines(output / LOG)[-1:]
    if status is not None and status > 0 and last:
        return f"exit status {status}; it printed last: {last[0]}"
    if status is not None and status < 0:
        with contextlib.suppress(ValueError):
            return f"killed by {signal.Signals(-status).name}"
    return f"exit status {status}"


def last_lines(log: Path) -> list[str]:
    """Return the last lines that a method printed, such as the end of its traceback."""
    try:
        with open(log, "rb") as stream:
            stream.seek(max(0, log.stat().st_size - 8192))
            text = stream.read(8192).decode(errors="replace")
    except OSError:
        return []
    return [one_line(line.rstrip(), 500) for line in text.splitlines() if line.strip()][-LAST:]


def _look_for_program(manifest: MethodManifest) -> None:
    """Refuse a command whose program is not there, or may not be run."""
    word = (manifest.entry.command or [""])[0]
    program = word.replace("{method}", str(manifest.root.resolve()))
    if "{" in program or (os.sep in program and not os.path.isabs(program)):
        return
    if shutil.which(program) is None:
        problem = f"there is no program {word!r}"
        if os.path.isfile(program):
            problem = f"the program {word!r} is not executable"
        raise BadMethod(
            problem,
            where=manifest.root,
            field="entry.command",
            remedy="Install it, or correct the command; chmod +x makes a script executable.",
        )


# --- whether the disc of the output had room for images meanwhile


class SpaceWatch:
    """Looks at the free space of a folder's disc again and again, and keeps the least.

    Many programs do not notice a full disc: OpenCV's `imwrite` leaves an empty file and returns,
    and the program ends well. Such a loss is the disc's fault and not the method's. A disc that is
    full for less time than lies between two looks goes unnoticed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._least: int | None = None

    def look(self) -> None:
        """Look once."""
        with contextlib.suppress(OSError):
            free = shutil.disk_usage(self._folder).free
            self._least = free if self._least is None else min(self._least, free)

    def finish(self, log_problem: str | None = None) -> str | None:
        """Look a last time, and say what the run lacked."""
        self.look()
        problem = log_problem or self._refusal()
        if problem is not None:
            return f"the disc of its output could not be written while it ran ({problem})"
        if self._least is not None and self._least < LOW_SPACE:
            return f"the disc of its output was full while it ran ({self._least:,} bytes left)"
        return None

    def _refusal(self) -> str | None:
        """Why nothing can be written now although bytes are free: quotas, inodes."""
        probe = temporary_name(self._folder / "probe")
        try:
            probe.write_bytes(bytes(_PROBE))
        except OSError as error:
            return error.strerror or type(error).__name__
        finally:
            with contextlib.suppress(OSError):
                probe.unlink(missing_ok=True)
        return None
