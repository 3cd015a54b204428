"""What a job is, and what an engine does with jobs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

#: Takes (done, total) steps of a job.
Report = Callable[[int, int], None]
#: Called when a job begins, with (index, count, text); returns what takes its steps, if anything.
OnStart = Callable[[int, int, str], Report | None]
#: Called with the index of a job whose result is in its folder.
OnDone = Callable[[int], None]
#: Times that a job is begun anew after its worker was lost.
RETRIES = 3


@dataclass(frozen=True)
class Needs:
    """What one job takes of a machine."""

    #: Processors; also the threads that a job is given when several run at once.
    cpus: float = 1.0
    #: GPUs; a fraction lets several jobs share one.
    gpus: float = 0.0


@dataclass(frozen=True)
class Folder:
    """A folder that a job reads."""

    #: Where it lies on the machine that asks for the job.
    path: Path
    #: Names directly inside it that the job does not need.
    skip: tuple[str, ...] = ()


class Work(Protocol):
    """The work of a job that leaves this process: importable, and small when pickled."""

    def __call__(self, inputs: Mapping[str, Path], output: Path, report: Report) -> None:
        """Do the work.

        Args:
            inputs: the folders that the job named, where they lie on this machine.
            output: folder that takes the result; it may hold an earlier start's.
            report: takes (done, total) steps now and then.

        Raises:
            HwpError: the work cannot be done; a second try would not help.
        """
        ...


@dataclass(frozen=True)
class Job:
    """One piece of work with a folder as its result."""

    #: What a person is shown.
    text: str
    #: Does the work in this process.
    here: Callable[[Report], None]
    #: Does the same anywhere else.
    work: Work
    #: Folder of the result.
    output: Path
    #: Whether the result of this very job is there already.
    finished: Callable[[], bool]
    #: Folders that `work` reads, by name.
    inputs: Mapping[str, Folder] = field(default_factory=dict)
    #: What it takes of a machine.
    needs: Needs = field(default_factory=Needs)


class Engine(Protocol):
    """Runs jobs. A context manager; jobs run only inside its block."""

    #: Whether jobs run one after another in this process, and tell `on_start` of it.
    in_turn: bool

    def __enter__(self) -> Engine: ...

    def __exit__(self, *_: object) -> None: ...

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; each result is in its folder before `on_done` hears of it.

        Args:
            jobs: the jobs, in the order in which they are to begin.
            on_done: called in this thread, in the order in which the jobs end.
            on_start: called where `in_turn`; the other engines show the jobs themselves.

        Raises:
            HwpError: a job failed. In turn, nothing is begun after it; otherwise the other jobs
                are finished first.
        """
        ...
