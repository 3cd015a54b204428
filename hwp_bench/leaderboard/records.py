"""Records that stand with the results of an entry: its submission and its checks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import Count, Digest, Line, number
from hwp_bench.results.schema import MAX_CAPTURES, ScoreTable, check_scores

#: Version of the entry files. `submission` was added within it and may be missing.
ENTRY_SCHEMA = "hwp-leaderboard-entry/1"
#: Version of the check files.
CHECK_SCHEMA = "hwp-leaderboard-check/1"
#: How far a row was checked, the least first.
LEVELS = ("self-reported", "rescored", "re-run")
#: What the levels mean, in words for people.
LEVEL_TEXTS = {
    "self-reported": "the submitter's own numbers; form and digests are sound",
    "rescored": "every score was computed again from the stored predictions",
    "re-run": "the method was run again, and its score came out the same",
}
#: What a reproducibility badge can say, and what it means.
BADGES = {
    "not tried": "nobody has checked this row yet",
    "scores hold": "the predictions have these scores; the method was not run again",
    "reproduces": "a second run of the method had the same score within the tolerance",
    "differs": "a check found other numbers than the row has",
    "disputed": "its checks contradict each other; the one that differs counts",
}
#: What a link of a submission can lead to.
LINKS = ("code", "paper", "predictions", "avatars")

#: A moment, ISO 8601 in UTC.
Moment = Annotated[
    str,
    Meta(
        pattern=r"\A\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}\+00:00\Z",
        description="a moment such as 2026-01-01T00:00:00+00:00",
    ),
]


@dataclass(frozen=True)
class Submission:
    """A submitter and what was added to the results: corrections, links, digests of avatars."""

    #: Who stands for the row.
    by: Line = ""
    #: Name of the entry that this one corrects; None for a first entry.
    revises: Line | None = None
    #: Why it was corrected; empty for a first entry.
    reason: Line = ""
    #: Addresses by what they lead to (`LINKS`); each begins with `https://`.
    links: dict[Line, Line] = field(default_factory=dict)
    #: SHA-256 of the fitted avatar of each capture, by capture id.
    avatars: Annotated[dict[Line, Digest], Meta(max_length=MAX_CAPTURES)] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        if (self.revises is None) != (not self.reason):
            raise UsageError("a revision needs a reason, and a reason a revision", field="reason")
        for name, address in self.links.items():
            if name not in LINKS:
                known = f"Known: {', '.join(LINKS)}."
                raise UsageError(f"{name!r} is not a kind of link", field="links", remedy=known)
            if not address.startswith("https://") or any(c in address for c in " \"'<>\\"):
                raise UsageError("is not an https:// address", field=f"links.{name}")


@dataclass(frozen=True)
class Check:
    """One check of an entry, made by `hwp-bench leaderboard confirm`."""

    #: Name of the entry.
    entry: Line
    #: Digest in the entry's file: a check is of one content only.
    entry_digest: Digest
    #: `rescored`: its predictions were scored again. `re-run`: the method was run again.
    kind: Literal["rescored", "re-run"]
    #: Whether the numbers of the entry were found again.
    verdict: Literal["reproduces", "differs"]
    #: When, ISO 8601, UTC.
    date: Moment
    #: Who checked.
    by: Line
    #: Version of the toolkit that checked.
    toolkit: Line
    #: Digest of its modules.
    code: Line
    #: Processor, cores and system that it ran on.
    machine: Line
    #: Frames whose scores were computed again from predictions.
    frames: Count
    #: Of them, frames whose PSNR and SSIM scikit-image computed too.
    cross_checked: Count
    #: Parts of the checked result that were not as it says.
    differences: Count
    #: Digest of the second run's results; None for `rescored`.
    rerun: Digest | None = None
    #: Macro means that the second run had, by metric.
    scores: ScoreTable = field(default_factory=dict)
    #: Captures of the second run whose predictions are those of the entry, pixel by pixel.
    same_predictions: Count = 0
    #: Largest difference of the macro mean of PSNR that still reproduces, dB.
    tolerance: float = number(0.0, 0.0, 100.0)
    #: Digests of checks of the same entry that this one takes out of force.
    overrules: Annotated[list[Digest], Meta(max_length=100)] = field(default_factory=list)
    #: Why it does; empty where it overrules none.
    reason: Line = ""

    def __post_init__(self) -> None:
        check_scores(self.scores)
        if self.cross_checked > self.frames:
            raise UsageError("is more than the frames", field="cross_checked")
        if self.kind == "rescored" and (self.rerun is not None or self.scores):
            raise UsageError("belongs to a second run, and this is none", field="rerun")
        if self.kind == "re-run" and (self.rerun is None or "psnr" not in self.scores):
            raise UsageError("must have the digest and PSNR of the second run", field="rerun")
        if bool(self.overrules) != bool(self.reason):
            raise UsageError("who overrules a check gives a reason", field="reason")

    @property
    def content(self) -> dict[str, Any]:
        """Its fields as its file holds them; those that are of no use in it are left out."""
        fields = asdict(self)
        return fields if self.overrules else _without(fields, "overrules", "reason")

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of its content, by which another check overrules it."""
        return sha256_json(self.content)


def _without(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if name not in names}


def in_force(checks: Iterable[Check]) -> list[Check]:
    """Return the checks of an entry that no other one overrules, in the order given.

    A check that is itself overruled overrules none. Dates decide nothing: they can be forged.
    """
    waiting = list(checks)
    everything = list(waiting)
    kept: dict[str, bool] = {}
    while waiting:
        ready = []
        for check in waiting:
            above = [other.digest for other in everything if check.digest in other.overrules]
            if all(digest in kept for digest in above):
                ready.append((check, not any(kept[digest] for digest in above)))
        # A digest cannot hold itself, so that there is always one that nothing undecided overrules.
        for check, stays in ready:
            kept[check.digest] = stays
            waiting.remove(check)
        if not ready:
            break
    return [check for check in everything if kept.get(check.digest, False)]


def level(checks: Iterable[Check]) -> str:
    """Return how far a row was checked: the highest of `LEVELS` that no check in force denies."""
    found = in_force(checks)
    denied = {check.kind for check in found if check.verdict == "differs"}
    held = {check.kind for check in found} - denied
    return max(["self-reported", *held], key=LEVELS.index)


def badge(checks: Iterable[Check]) -> str:
    """Return the reproducibility badge of a row, one of `BADGES`."""
    found = in_force(checks)
    denied = {check.kind for check in found if check.verdict == "differs"}
    if any(check.kind in denied and check.verdict == "reproduces" for check in found):
        return "disputed"
    if denied:
        return "differs"
    return {"self-reported": "not tried", "rescored": "scores hold", "re-run": "reproduces"}[
        level(found)
    ]
