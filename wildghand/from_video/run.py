"""Runs the stages of a job: what is done already is kept, what has changed is made again."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

from hwp_bench.base.console import StagesView, notice
from wildghand.from_video.job import Job
from wildghand.from_video.pace import Pace
from wildghand.from_video.record import JobRecord, StageRecord, read_record, write_record
from wildghand.from_video.stage import Stage


def run_stages(job: Job, stages: Sequence[Stage]) -> tuple[JobRecord, list[str]]:
    """Run the stages that are not done; every process of the job's world calls this.

    Args:
        job: the job; its work folder exists.
        stages: in order.

    Returns:
        The record, and the names of the stages that were done before; of the first process.

    Raises:
        HwpError: whatever a stage raises; the same call goes on with that stage.
    """
    if not job.world.is_main:
        for stage in stages:
            if job.world.broadcast(0.0):
                if stage.together:
                    stage.run(job)
                job.world.wait_for_main()
        return JobRecord(), []
    known = read_record(job.record).stages
    # An older version may have had other stages.
    names = [stage.name for stage in stages]
    record = JobRecord(stages={name: known[name] for name in names if name in known})
    pace = Pace([stage.expected(job) for stage in stages])
    kept: list[str] = []
    with StagesView() as view:
        for number, stage in enumerate(stages):
            facts = stage.facts(job)
            needed = not _is_done(job, stage, record, facts)
            job.world.broadcast(float(needed))
            if not needed:
                kept.append(stage.name)
                continue
            own, later = pace.left(number)
            view.stage(number + 1, len(stages), stage.title, own=own, later=later)
            if kept and number == len(kept):
                notice(f"Done before and kept: {', '.join(kept)}.")
            _tell(stage, record, facts)
            if record.changed(stage.name, facts) != []:
                stage.discard(job)
            record = record.having(stage.name, StageRecord(facts))
            write_record(job.record, record)
            began, began_cpu = _now()
            stage.run(job)
            job.world.wait_for_main()
            ended, ended_cpu = _now()
            pace.ran(number, ended - began)
            ran = StageRecord(facts, True, ended - began, ended_cpu - began_cpu)
            record = record.having(stage.name, ran)
            write_record(job.record, record)
    if len(kept) == len(stages):
        notice(f"{job.folder}: all is done already, and nothing has changed.")
    return record, kept


def _is_done(job: Job, stage: Stage, record: JobRecord, facts: dict[str, str]) -> bool:
    last = record.stages.get(stage.name)
    return last is not None and last.done and last.facts == facts and stage.result(job).exists()


def _tell(stage: Stage, record: JobRecord, facts: dict[str, str]) -> None:
    """Say why a stage is run that was run before."""
    changed, last = record.changed(stage.name, facts), record.stages.get(stage.name)
    if changed:
        notice(f"{stage.title} again; changed since the last run: {', '.join(changed)}.")
    elif last is not None:
        why = "its result is missing" if last.done else "the last run was stopped there"
        notice(f"{stage.title} once more: {why}.")


def _now() -> tuple[float, float]:
    """The clock, and the processor time of this process and of those that it has started, s."""
    used = os.times()
    return time.perf_counter(), used.user + used.system + used.children_user + used.children_system
