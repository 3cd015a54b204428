"""A job, what an engine does with jobs, and the engine that most runs need: one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, Self

from hwp_bench.base.errors import HwpError

#: Is told (done, total) steps of a job.
OnProgress = Callable[[int, int], None]
#: Called when a job begins, with (index, count, text); returns what is told its steps, if anything.
OnStart = Callable[[int, int, str], OnProgress | None]
#: Called with the index of a job whose result is in its folder.
OnDone = Callable[[int], None]


@dataclass(frozen=True)
class Needs:
    """The share of a machine that one job takes."""

    #: Processors; also the threads that a job is given when several run at once.
    cpus: float = 1.0
    #: GPUs; a fraction lets several jobs share one.
    gpus: float = 0.0


@dataclass(frozen=True)
class Folder:
    """A folder that a job reads."""

    #: Where it lies on the machine that orders the job.
    path: Path
    #: Names directly inside it that the job does not need.
    skip: tuple[str, ...] = ()


class Work(Protocol):
    """The work of a job that leaves this process: importable, and small when pickled."""

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Do the work."""
        ...


@dataclass(frozen=True)
class Job:
    """One piece of work with a folder as its result."""

    #: The text that a person is shown.
    text: str
    #: Does the work in this process.
    here: Callable[[OnProgress], object]
    #: Does the same anywhere else.
    work: Work
    #: Folder of the result.
    output: Path
    #: Whether the result of exactly this job is there already.
    finished: Callable[[], bool]
    #: Folders that `work` reads, by name.
    inputs: Mapping[str, Folder] = field(default_factory=dict)
    #: The share of a machine that it takes.
    needs: Needs = field(default_factory=Needs)


class Engine:
    """Runs jobs. A context manager; jobs run only inside its block."""

    #: Whether jobs run one after another in this process, and tell `on_start` of it.
    in_turn = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; each result is in its folder before `on_done` is called."""
        raise NotImplementedError


class LocalEngine(Engine):
    """Runs jobs one after another in this process; each has the whole machine."""

    in_turn = True

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        for index, job in enumerate(jobs):
            on_progress = on_start(index, len(jobs), job.text) if on_start else None
            job.here(on_progress or ignore_progress)
            on_done(index)


def ignore_progress(done: int, total: int) -> None:
    """Ignore the progress of a job that is not shown."""


def raise_first(errors: Sequence[HwpError], count: int) -> None:
    """Raise the first error, if any, saying how many of `count` jobs failed."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        first = errors[0]
        problem = f"{first.problem} (the first of {len(errors)} failures in {count} jobs)"
        error = type(first)(problem, where=first.where, field=first.field, remedy=first.remedy)
        raise error from first
