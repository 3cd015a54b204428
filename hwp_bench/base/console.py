"""Everything that a person sees while a program works: standard streams, notices, progress.

Whatever the encoding or the end of a stream, it does not stop the work. Progress and notices go
to standard error, so that standard output stays the result: on a terminal as bars, elsewhere (logs,
CI) as a few lines of text. One piece of work is shown by `progress` or `track`, a list of jobs by
`JobsView`, stages of unequal length by `StagesView`.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar, Token
from typing import TYPE_CHECKING, Self, TextIO, TypeVar

from hwp_bench.base.errors import shown

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


#: What characters that we print become where the encoding of a stream lacks them.
_FORMS = {
    "─": "-",
    "━": "-",
    "–": "-",
    "—": "-",
    "−": "-",
    "↑": "^",
    "↓": "v",
    "×": "x",
    "±": "+-",
    "≤": "<=",
    "≥": ">=",
    "°": " deg",
    "µ": "u",
    "✓": "yes",
    "✕": "x",
    "…": "...",
    "‘": "'",
    "’": "'",
    "“": '"',
    "”": '"',
    "\u00a0": " ",
}
#: The standard streams by the number of their handle.
_STREAMS = ("stdin", "stdout", "stderr")


def encoding_of(stream: TextIO | None) -> str:
    """Return the name of a stream's encoding; UTF-8 for one that has none."""
    return getattr(stream, "encoding", None) or "utf-8"


def expressed(text: str, encoding: str) -> str:
    """Return a text as an encoding can hold it.

    Similar characters of ASCII stand for dashes, rules, arrows and signs that it lacks, backslash
    escapes as Python's for every other character.
    """
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        if len(text) > 1:
            return "".join(expressed(char, encoding) for char in text)
        return _FORMS.get(text) or text.encode("ascii", "backslashreplace").decode("ascii")
    return text


def print_document(text: str) -> None:
    """Print what is a file by itself, such as a table in LaTeX.

    Off a terminal it is UTF-8 whatever the locale is, as the files are that we write.
    """
    buffer = getattr(sys.stdout, "buffer", None)
    if buffer is None or sys.stdout.isatty():
        print(expressed(text, encoding_of(sys.stdout)), end="")
        return
    sys.stdout.flush()
    buffer.write(text.encode("utf-8", "backslashreplace"))


def in_utf8_mode(program: str) -> None:
    """Start this process again in Python's UTF-8 mode, where the locale is of another encoding.

    Python cannot change the encoding of file names while it runs. In another one than UTF-8 a name
    with an accent cannot be text (ASCII), or is another name for libraries in C++ (Latin-1). The
    standard streams keep the encoding that they have. Nothing is done in UTF-8, where the user
    chose `-X utf8`, or where the process is not one of this program (a script, a test).
    """
    if sys.getfilesystemencoding().lower().replace("-", "") == "utf8" or os.name != "posix":
        return
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    if main is None or os.path.basename(main) not in (program, "main.py"):
        return
    if "utf8" in sys._xoptions or not sys.executable:
        return
    streams = f"{encoding_of(sys.stdout)}:backslashreplace"
    os.environ.setdefault("PYTHONIOENCODING", streams)
    os.environ["PYTHONUTF8"] = "1"
    os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Let a block print whatever it wants.

    What the encoding of standard output lacks becomes a backslash escape. A stream that the caller
    has closed (`>&-`) takes what is printed and drops it, and its handle is in use, so that no file
    that is opened later gets what others print.
    """
    closed = [name for name in _STREAMS if getattr(sys, name) is None]
    errors = getattr(sys.stdout, "errors", None)
    with contextlib.ExitStack() as opened:
        if closed:
            _fill_handles()
        for name in closed:
            mode = "r" if name == "stdin" else "w"
            stream = opened.enter_context(open(os.devnull, mode, encoding="utf-8"))
            setattr(sys, name, stream)
            opened.callback(setattr, sys, name, None)
        changed = sys.stdout
        if isinstance(changed, io.TextIOWrapper):
            changed.reconfigure(errors="backslashreplace")
        try:
            yield
        finally:
            if isinstance(changed, io.TextIOWrapper) and errors and not changed.closed:
                with contextlib.suppress(OSError):
                    changed.reconfigure(errors=errors)


def _fill_handles() -> None:
    """Open what is closed of the handles 0, 1 and 2, for this process and its children."""
    for handle in range(len(_STREAMS)):
        try:
            os.fstat(handle)
        except OSError:
            # The system gives the lowest free handle, which is this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


def settle(stream: TextIO | None) -> OSError | None:
    """Write out what a stream holds; return why it cannot be written, and then it is silent.

    So Python does not complain when it ends.
    """
    if stream is None or stream.closed:
        return None
    try:
        stream.flush()
    except OSError as error:
        _silence(stream)
        return error
    if _reader_gone(stream):
        _silence(stream)
        return BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
    return None


def _silence(stream: TextIO) -> None:
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, stream.fileno())
        os.close(nothing)


def _reader_gone(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads: what failed before is in no buffer."""
    if not hasattr(select, "poll"):
        return False
    with contextlib.suppress(OSError, ValueError):
        watched = select.poll()
        watched.register(stream, 0)
        return any(event & select.POLLERR for _, event in watched.poll(0))
    return False


def tell(text: str) -> None:
    """Print a line on standard error; where it cannot be printed, the work continues without."""
    stream = sys.stderr
    if stream is None or stream.closed:
        return
    try:
        print(expressed(text, encoding_of(stream)), file=stream, flush=True)
    except OSError:
        settle(stream)


def on_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal; not one that is closed."""
    return stream is not None and not stream.closed and stream.isatty()


Item = TypeVar("Item")
#: What `progress` does: takes a description and a total, yields a function that takes how many
#: steps are done.
Shows = Callable[[str, int], contextlib.AbstractContextManager[Callable[[int], None]]]

#: A display on the terminal around the pieces of work of this context, which shows them itself:
#: two displays would overwrite each other.
OUTER: ContextVar[Shows | None] = ContextVar("outer", default=None)

#: Jobs that took less than this share of the longest one were found finished; an estimate of the
#: remaining time leaves them out.
FOUND = 0.1


def notice(text: str) -> None:
    """Print a line for a person on standard error; what could steer a terminal becomes `?`.

    Where nobody reads it any more it is dropped, and the work continues.
    """
    tell(shown(text))


def clock(seconds: float) -> str:
    """Return seconds as `m:ss` or `h:mm:ss`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def remaining(durations: Sequence[float], left: int) -> float | None:
    """Estimate the seconds that are left."""
    ran = [spent for spent in durations if spent >= FOUND * max(durations)]
    return left * sum(ran) / len(ran) if ran else None


@contextlib.contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how far a piece of work is, with elapsed and remaining time.

    On a terminal a bar; elsewhere one line when the work ends, which says how much of it was done.
    What is yielded takes the number of steps that are done by now.
    """
    start = time.perf_counter()
    outer = OUTER.get()
    if outer is not None:
        with outer(description, total) as update:
            yield update
        return
    if not on_terminal(sys.stderr):
        reached = [0]
        yield reached.append
        # Work may end early: by its budget, or because nothing gets better any more.
        share = f"{total}" if reached[-1] == total else f"{reached[-1]} of {total}"
        notice(f"{description}: {share} in {time.perf_counter() - start:.1f} s")
        return
    with new_bars() as bars:
        task = bars.add_task(description, total=total, left="")
        yield lambda done: update_bar(bars, task, start, done, total)


def track(items: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items and show progress over them."""
    count = total if total is not None else len(items)  # type: ignore[arg-type]
    with progress(description, count) as update:
        for done, item in enumerate(items, start=1):
            yield item
            update(done)


class _Display:
    """Bars on a terminal while a block runs, nothing elsewhere; a context manager."""

    def __init__(self, *, shown: bool = True) -> None:
        self._bars = new_bars() if shown and on_terminal(sys.stderr) else None
        self._all: TaskID | None = None
        self._began = time.perf_counter()

    def __enter__(self) -> Self:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()


class JobsView(_Display):
    """Shows jobs: a bar for all of them and one for each that runs.

    Elsewhere than on a terminal a line of text says that a job begins, and one that it has ended.
    Jobs that run one after another are told to `turn`. An engine that runs
    several at once calls `begin`, then `start`, `steps`, `end` and `drop` with the index of a job,
    from any thread.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        super().__init__(shown=not quiet)
        self._quiet = quiet
        #: When each job that runs has begun, and its bar.
        self._running: dict[int, tuple[float, TaskID | None]] = {}
        self._durations: list[float] = []
        self._count = self._ended = 0

    def turn(self, index: int, count: int, text: str) -> Callable[[int, int], None]:
        """Begin job `index` of `count`, after the one before it has ended."""
        if index == 0 or count != self._count:
            self.begin(count)
        for other in list(self._running):
            self._durations.append(self.drop(other) or 0.0)
        self._ended = index
        left = remaining(self._durations, count - index)
        about = "" if left is None else f", about {clock(left)} left"
        if self._bars is None:
            elapsed = clock(time.perf_counter() - self._began)
            self.say(f"[{index + 1}/{count}] {text} ({elapsed} elapsed{about})")
        self._add(index, text)
        return lambda done, total: self.steps(index, done, total)

    def begin(self, count: int) -> None:
        """Say how many jobs there are."""
        self._count, self._ended = count, 0
        self._began = time.perf_counter()
        self._running.clear()
        self._durations.clear()
        if self._bars is not None:
            for task in self._bars.task_ids:
                self._bars.remove_task(task)
            self._all = self._bars.add_task("jobs", total=count, left="")

    def start(self, index: int, text: str, place: str) -> None:
        """Say that a job begins at a place, or begins again at another."""
        again = self.drop(index) is not None
        text = f"{text}, on {place}"
        if self._bars is None or again:
            word = "again, its worker was lost: " if again else ""
            self.say(f"[{index + 1}/{self._count}] {word}{text}")
        self._add(index, text)

    def steps(self, index: int, done: int, total: int) -> None:
        """Say how far a job is."""
        began, task = self._running.get(index, (0.0, None))
        if self._bars is not None and task is not None:
            update_bar(self._bars, task, began, done, total)
            self._update_all()

    def end(self, index: int, text: str, problem: str | None = None) -> None:
        """Say that a job has ended, and why it failed if it did."""
        spent = self.drop(index)
        self._ended += 1
        if spent is not None:
            self._durations.append(spent)
        took = "" if spent is None else f" in {clock(spent)}"
        if problem is not None:
            self.say(f"[{self._ended} of {self._count} ended] {text} failed: {problem}")
        elif self._bars is None:
            elapsed = clock(time.perf_counter() - self._began)
            self.say(f"[{self._ended} of {self._count} ended, {elapsed} elapsed] {text}{took}")
        self._update_all()

    def say(self, text: str) -> None:
        """Tell a person something about the jobs."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        elif not self._quiet:
            notice(text)

    def drop(self, index: int) -> float | None:
        """Take a job out of the view; returns the seconds that it ran, None if it did not."""
        if index not in self._running:
            return None
        began, task = self._running.pop(index)
        if task is not None and self._bars is not None:
            self._bars.remove_task(task)
        return time.perf_counter() - began

    def _add(self, index: int, text: str) -> None:
        began, task = time.perf_counter(), None
        if self._bars is not None:
            task = self._bars.add_task(f"  [{index + 1}] {text}", total=None, left="")
        self._running[index] = began, task
        self._update_all()

    def _update_all(self) -> None:
        if self._bars is None or self._all is None:
            return
        left = remaining(self._durations, self._count - self._ended)
        if left is not None and self._running:
            now = time.perf_counter()
            spent = sum(now - began for began, _ in list(self._running.values()))
            left = max(left - spent, 0.0) / len(self._running)
        self._bars.update(self._all, completed=self._ended, left=left_text(left))


def new_bars() -> Progress:
    """Return an empty display of bars on standard error; each has a field `left`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("elapsed{task.fields[left]}", markup=False),
        console=Console(stderr=True),
        # What is printed meanwhile stands above the bars only where both are on the screen.
        redirect_stdout=on_terminal(sys.stdout),
    )


def update_bar(bars: Progress, task: TaskID, began: float, done: int, total: int) -> None:
    """Show how far a bar is, and what is left at the pace since `began` (`time.perf_counter`)."""
    left = (time.perf_counter() - began) * (total - done) / done if done else None
    bars.update(task, completed=done, total=total, left=left_text(left))


def left_text(seconds: float | None) -> str:
    """Return the words for the seconds that are left, to follow those that have passed."""
    return "" if seconds is None else f", about {clock(seconds)} left"


class StagesView(_Display):
    """Shows stages of unequal length, one after the other, and how much is left of all.

    On a terminal one bar for all of them, and below it those that `progress` and `track` show
    within a stage; elsewhere a line at the beginning of each.
    """

    def __init__(self) -> None:
        super().__init__()
        self._stage_began = self._began
        self._left: tuple[float, float] = (0.0, 0.0)
        self._outer: Token[Shows | None] | None = None

    def __enter__(self) -> Self:
        if self._bars is not None:
            self._outer = OUTER.set(self.part)
        return super().__enter__()

    def __exit__(self, *_: object) -> None:
        if self._outer is not None:
            OUTER.reset(self._outer)
        super().__exit__()

    def stage(self, number: int, count: int, text: str, *, own: float, later: float) -> None:
        """Begin a stage."""
        self._stage_began = time.perf_counter()
        self._left = (own, later)
        elapsed = clock(self._stage_began - self._began)
        line = f"[{number}/{count}] {text}"
        if self._bars is None:
            notice(f"{line} ({elapsed} elapsed{left_text(own + later)})")
            return
        if self._all is None:
            self._all = self._bars.add_task(line, total=count, left="")
        self._bars.update(self._all, description=line, total=count, completed=number - 1)
        self._tell()

    @contextlib.contextmanager
    def part(self, description: str, total: int) -> Iterator[Callable[[int], None]]:
        """Show a piece of the stage as a bar of its own; see `progress`."""
        assert self._bars is not None
        bars, start = self._bars, time.perf_counter()
        task = bars.add_task(f"  {description}", total=total, left="")

        def update(done: int) -> None:
            update_bar(bars, task, start, done, total)
            self._tell()

        try:
            yield update
        finally:
            bars.remove_task(task)

    def _tell(self) -> None:
        """Say how much is left: of this stage what it has not used yet, and the later ones."""
        if self._bars is not None and self._all is not None:
            own, later = self._left
            left = max(own - (time.perf_counter() - self._stage_began), 0.0) + later
            self._bars.update(self._all, left=left_text(left))
