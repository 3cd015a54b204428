"""The record of a job: stages that are done, and their inputs, so that a stopped job goes on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.records import Seconds, parse_record

#: Largest record that is read, bytes.
_MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class StageRecord:
    """One stage as it was run last."""

    #: What its result depends on: digests and settings as texts, by name.
    facts: dict[str, str]
    #: Whether it ended; False for one that was begun.
    done: bool = False
    #: Seconds that it took.
    seconds: Seconds = 0.0
    #: Seconds of processor time that it took, on all cores together.
    cpu_seconds: Seconds = 0.0


@dataclass(frozen=True)
class JobRecord:
    """The stages of a job that were run."""

    schema: Literal["wildghand-stages/1"] = "wildghand-stages/1"
    #: By name.
    stages: dict[str, StageRecord] = field(default_factory=dict)

    def changed(self, name: str, facts: dict[str, str]) -> list[str] | None:
        """Say how the facts of a stage differ from those of its last run.

        Returns:
            Names of what changed; empty: nothing did; None: it was never run.
        """
        last = self.stages.get(name)
        if last is None:
            return None
        names = {**facts, **last.facts}
        return [one for one in names if facts.get(one) != last.facts.get(one)]

    def having(self, name: str, stage: StageRecord) -> JobRecord:
        """Return the record with one stage replaced."""
        return replace(self, stages={**self.stages, name: stage})


def read_record(path: Path) -> JobRecord:
    """Read the record; an empty one where there is no file.

    Raises:
        BadInput: the file is damaged or of another version.
    """
    if not path.exists():
        return JobRecord()
    try:
        value = read_json(path, max_bytes=_MAX_BYTES)
        return parse_record(JobRecord, value, where=str(path), error=BadInput)
    except BadInput as error:
        raise BadInput(
            error.problem,
            where=error.where,
            field=error.field,
            remedy="Delete it, or give --overwrite, to make the avatar from the start.",
        ) from error


def write_record(path: Path, record: JobRecord) -> None:
    """Write the record, whole or not at all."""
    write_json(path, asdict(record))
