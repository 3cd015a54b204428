"""Jobs one after another in this process."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.run.engine.job import Job, OnDone, OnStart


class LocalEngine:
    """Runs jobs in their order, in this process, with all of the machine to each."""

    in_turn = True

    def __enter__(self) -> LocalEngine:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        for index, job in enumerate(jobs):
            report = on_start(index, len(jobs), job.text) if on_start else None
            job.here(report or ignore)
            on_done(index)


def ignore(done: int, total: int) -> None:
    """Take the steps of a job that nobody watches."""
