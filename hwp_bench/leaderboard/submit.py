"""Makes entries of results, and the folder of a pull request with the text that goes with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import atomic_folder, files_digest, sha256_of
from hwp_bench.evaluation.scoring import predictions_digest, read_predictions
from hwp_bench.leaderboard.entries import Entry, make_entry, refuse_installed, write_entry
from hwp_bench.leaderboard.names import register
from hwp_bench.leaderboard.records import Submission
from hwp_bench.leaderboard.rules import check_complete, check_current, check_entries
from hwp_bench.leaderboard.soundness import check_bound, sound_entries
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import Results
from hwp_bench.sim.produce.suites import suite

#: Where entries lie in the repository, and in a submission.
PLACE = "leaderboard/entries"
#: Name of the text of the pull request.
TEXT = "PULL_REQUEST.md"


@dataclass(frozen=True)
class Submitted:
    """A submission that was written."""

    #: Its folder.
    folder: Path
    #: Its entries.
    entries: tuple[Entry, ...]
    #: Captures whose predictions lay next to the results, of how many, by entry.
    predictions: Mapping[str, tuple[int, int]]


def add_entry(folder: Path, results: Results) -> Path:
    """Write an entry of results without a submission; returns its file.

    An entry under the name of a method that ships is registered: see `names`.

    Raises:
        BadResult, UsageError: the results are not fit for the leaderboard, or do not go together
            with the sound entries that are there.
    """
    entry = make_entry(results)
    check_current(entry)
    check_entries([*sound_entries(folder), entry])
    check_bound(entry)
    file = write_entry(folder, entry)
    register(folder, [entry])
    return file


def submit(
    folder: Path,
    sources: Sequence[ResultsSource],
    existing: Sequence[Entry],
    submission: Submission,
    avatars: Path | None = None,
) -> Submitted:
    """Write a folder with everything that a pull request needs.

    Args:
        folder: a new or empty folder outside of installed packages.
        sources: results of whole suites.
        existing: entries of the leaderboard, which they must go together with.
        submission: who stands for them, links, and for one result: what it revises.
        avatars: folder with one file or folder for each capture, named by its id; they are not
            copied, their digests are noted.

    Raises:
        UsageError: the folder is not empty or belongs to an installed package, a result is of
            other protocols or data, or there are several results of one revision.
        BadResult: a result is incomplete, or the predictions next to it are not those that it
            was scored from.
    """
    refuse_installed(folder)
    if submission.revises is not None and len(sources) != 1:
        raise UsageError("a revision is of one result", field="--revises")
    made: list[Entry] = []
    checked = {}
    for source in sources:
        added = submission
        if avatars is not None:
            digests = avatar_digests(avatars, [c.id for c in source.results.captures])
            added = Submission(
                submission.by, submission.revises, submission.reason, submission.links, digests
            )
        entry = make_entry(source.results, added)
        check_current(entry)
        # The rules of single entries come first: only a known suite can be complete.
        check_entries([*existing, *made, entry])
        check_complete(entry)
        check_bound(entry)
        if entry.name in {other.name for other in [*existing, *made]}:
            raise UsageError("is on the leaderboard already", where=entry.name)
        checked[entry.name] = (_check_predictions(source), len(source.results.captures))
        made.append(entry)
    with atomic_folder(folder) as temporary:
        for entry in made:
            write_entry(temporary / PLACE, entry)
        done = Submitted(folder, tuple(made), checked)
        (temporary / TEXT).write_text(pull_request_text(done), encoding="utf-8")
    return done


def _check_predictions(source: ResultsSource) -> int:
    """Return the number of captures whose predictions are there and are those of the result."""
    sizes = {item.scene.id: item.size for item in suite(source.results.suite)}
    found = 0
    for capture in source.results.captures:
        place = source.place(capture.id, "predictions")
        if place is None or not place.is_dir():
            continue
        size = sizes[capture.id]
        frames = [frame.frame for frame in capture.frames]
        if predictions_digest(read_predictions(place, frames, (size, size))) != (
            capture.predictions_digest
        ):
            raise BadResult(
                "are not the predictions that the result was scored from",
                where=place,
                remedy="Evaluate again; `hwp-bench verify` shows what differs.",
            )
        found += 1
    return found


def avatar_digests(folder: Path, captures: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of the avatar of each capture: of a file, or of a folder's files.

    Args:
        folder: holds `ID`, or one `ID.something`, for each capture.
        captures: their ids.

    Raises:
        BadResult: the avatar of a capture is missing, or two fit.
    """
    found = {}
    for name in captures:
        places = [place for place in sorted(folder.glob("*")) if _is_avatar_of(place, name)]
        if len(places) != 1:
            many = ", ".join(place.name for place in places)
            raise BadResult(
                f"holds {many}, which are two" if places else "holds no avatar of the capture",
                where=folder,
                field=name,
                remedy="Give one file or folder for each capture, named by its id.",
            )
        (place,) = places
        files = [p for p in place.rglob("*") if p.is_file() and not p.is_symlink()]
        found[name] = files_digest(place, files) if place.is_dir() else sha256_of(place)
    return found


def _is_avatar_of(place: Path, name: str) -> bool:
    return not place.is_symlink() and (place.name == name or place.stem == name)


def pull_request_text(done: Submitted) -> str:
    """Return the text of the pull request, Markdown: the rows, their digests, how to check."""
    lines = ["# New leaderboard rows", ""]
    for entry in done.entries:
        results, added = entry.results, entry.submission
        scores = results.scores
        there, count = done.predictions[entry.name]
        lines += [
            f"## {_plain(results.method.title)} on {results.suite}",
            "",
            f"- entry: `{PLACE}/{entry.name}.json`, digest `{entry.digest}`",
            f"- protocol {entry.protocol}, seed {results.seed}, {count} captures, complete",
            f"- PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}, oriented distance "
            f"{scores['oriented_distance']:.4f} (macro means)",
            f"- level: {entry.level}; predictions at hand of {there} of {count} captures",
        ]
        if added.by:
            lines.append(f"- submitted by {_plain(added.by)}")
        if added.revises:
            lines.append(f"- revises `{_plain(added.revises)}`: {_plain(added.reason)}")
        lines += [f"- {name}: <{address}>" for name, address in sorted(added.links.items())]
        lines += ["", "| capture | predictions | avatar |", "| --- | --- | --- |"]
        lines += [
            f"| {_plain(c.id)} | `{c.predictions_digest}` | {_digest_cell(added, c.id)} |"
            for c in results.captures
        ]
        lines.append("")
    lines += [
        "## How to check",
        "",
        "```sh",
        f"hwp-bench leaderboard check --entries {PLACE} --against BASE/{PLACE}",
        f"hwp-bench leaderboard confirm RESULTS --entries {PLACE} --by NAME",
        "```",
    ]
    return "\n".join(lines) + "\n"


def _digest_cell(submission: Submission, capture: str) -> str:
    digest = submission.avatars.get(capture)
    return f"`{digest}`" if digest else "–"


def _plain(text: str) -> str:
    """Return a text without the characters that mean something in Markdown or HTML."""
    return "".join(char for char in text if char not in "`|<>[]*_\\") or "–"
