"""Records that stand with the results of an entry: its submission and its checks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import Count, Digest, Line, number
from hwp_bench.results.bounds import MAX_CAPTURES, ScoreTable, check_scores

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
    "differs": "the latest check found other numbers than the row has",
}
#: What a link of a submission can lead to.
LINKS = ("code", "paper", "predictions", "avatars")

#: A moment, ISO 8601 in UTC: checks are in the order of their dates.
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

    def __post_init__(self) -> None:
        check_scores(self.scores)
        if self.cross_checked > self.frames:
            raise UsageError("is more than the frames", field="cross_checked")
        if self.kind == "rescored" and (self.rerun is not None or self.scores):
            raise UsageError("belongs to a second run, and this is none", field="rerun")
        if self.kind == "re-run" and (self.rerun is None or "psnr" not in self.scores):
            raise UsageError("must have the digest and PSNR of the second run", field="rerun")


def latest(checks: Iterable[Check]) -> dict[str, Check]:
    """Return the last check of each kind; a later check overrules an earlier one."""
    return {check.kind: check for check in sorted(checks, key=lambda item: item.date)}


def level(checks: Iterable[Check]) -> str:
    """Return how far a row was checked: the highest of `LEVELS` whose last check found it again."""
    found = [check.kind for check in latest(checks).values() if check.verdict == "reproduces"]
    return max(["self-reported", *found], key=LEVELS.index)


def badge(checks: Iterable[Check]) -> str:
    """Return the reproducibility badge of a row, one of `BADGES`."""
    last = latest(checks)
    if any(check.verdict == "differs" for check in last.values()):
        return "differs"
    return {"self-reported": "not tried", "rescored": "scores hold", "re-run": "reproduces"}[
        level(last.values())
    ]
