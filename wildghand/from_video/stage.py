"""A stage of a job: what it makes, what that depends on, how it is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from wildghand.from_video.job import Job


@dataclass(frozen=True)
class Stage:
    """One stage.

    It is run when its facts differ from those of its last run, when that did not end, or when
    what it makes is missing.
    """

    #: Short name, in the record and in messages.
    name: str
    #: What it does, as progress shows it.
    title: str
    #: What its result depends on: digests and settings as texts, by a name that a person
    #: understands. The stages before it have ended when this is called.
    facts: Callable[[Job], dict[str, str]]
    #: The file or folder that says that its result is there.
    result: Callable[[Job], Path]
    #: Makes the result. Where the last run with the same facts was stopped, it may go on there.
    run: Callable[[Job], None]
    #: Seconds that it is expected to take on two cores, for the remaining time. The stages before
    #: it may not have been run.
    expected: Callable[[Job], float]
    #: Removes what a stopped run left, because its facts are others.
    discard: Callable[[Job], None] = lambda job: None
    #: Whether all processes run it, or the first one only.
    together: bool = False
