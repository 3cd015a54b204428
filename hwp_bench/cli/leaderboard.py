"""`hwp-bench leaderboard` and `hwp-bench dev leaderboard`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError, has_odd_characters, shown
from hwp_bench.base.files import check_places
from hwp_bench.base.packages import data_folder
from hwp_bench.base.tables import print_table, to_object
from hwp_bench.cli.options import SEVERAL, add_json, add_out, captures_of, print_json

if TYPE_CHECKING:
    from hwp_bench.leaderboard.entries import Entry, Submission

_ADD = """examples:
  hwp-bench dev leaderboard add runs/mine-mini
  hwp-bench dev leaderboard add runs/* --entries board/entries
  hwp-bench dev leaderboard add runs/field/mini       # every method and seed in the folder

For the maintainers of a board: writes into its folder. Others make a submission.
"""
_BUILD = """examples:
  hwp-bench leaderboard build -o site
  hwp-bench leaderboard build -o site --entries submission/leaderboard/entries --with runs/mine-mini
"""
_SHOW = """examples:
  hwp-bench leaderboard show
  hwp-bench leaderboard show --suite mini --json
  hwp-bench leaderboard show --entries submission/leaderboard/entries

One table for each suite and version of the protocol, best row first: rank with 95 % interval,
scores, level and badge, and a sentence that says who wins and how surely. Each method has one row,
of its newest entries that were checked furthest; rows that lack captures have no rank.
"""
_SUBMIT = """examples:
  hwp-bench leaderboard submit runs/mine-mini -o submission --author "A. Person"
  hwp-bench leaderboard submit runs/mine-* -o submission --link code=https://example.org/mine
  hwp-bench leaderboard submit runs/mine-mini -o submission --avatars avatars/mine-mini
  hwp-bench leaderboard submit runs/new -o submission --revises mine-mini-seed0-0123abcd \\
      --reason "a frame was rendered with the wrong camera"

Writes FOLDER/leaderboard/entries/NAME.json and FOLDER/PULL_REQUEST.md. Copy the first into a clone
of the repository, open a pull request, and paste the second into it. Nothing else is written.
"""
_CHECK = """examples:
  hwp-bench leaderboard check
  hwp-bench leaderboard check --entries submission/leaderboard/entries
  hwp-bench leaderboard check --against ../base/leaderboard/entries   # nothing was changed
  hwp-bench leaderboard check --json

Checks schema, digests, protocol version, completeness, revisions, and that the rows of a table are
of the same data. Exit status 0: all is sound; 1: a file is damaged, changed or incomplete;
2: an entry cannot stand with the others.
"""
_REGISTER = """examples:
  hwp-bench dev leaderboard register plain-mini-16s-seed0-0123abcd

For the maintainers of a board. The names and titles of methods that ship with the toolkit belong to
it: an entry that carries one is left out, and `check` refuses it, until its digest is listed in
names.json, next to the folder of entries. `add` lists what it adds.
"""
_CONFIRM = """examples:
  hwp-bench dev leaderboard confirm runs/mine-mini --checked-by maintainers
  hwp-bench dev leaderboard confirm runs/field/mini --checked-by maintainers
  hwp-bench dev leaderboard confirm runs/second-run --checked-by maintainers --tolerance 0.05
  hwp-bench dev leaderboard confirm runs/second --checked-by me --entry mine-mini-seed0-0123abcd

Checks are never removed. Where checks of an entry contradict each other, the one that differs
counts until a new check overrules it by name (--overrules, --reason).

Verifies the results as `hwp-bench verify` does and writes a check next to the entry. Results of the
entry itself make its level `rescored`; another run of the same method, settings, seed and budget
makes it `re-run` where the macro mean of PSNR is the same within the tolerance. Exit status 0: it
reproduces; 1: it differs (the check says so too); 2: no entry fits.
"""

_CONTEST = """examples:
  hwp-bench dev leaderboard contest mine-mini-seed0-0123abcd runs/again --checked-by "B. Person" \\
      --reason "the same call gives 4 dB less"
  hwp-bench dev leaderboard contest mine-mini-seed0-0123abcd 89abcdef --withdraw rerun \\
      --checked-by maintainers --reason "it ran without its weights"

RERUN is another run of the entry's method with the same settings, seed, budget and data. It is
written whole into a file next to the entry, with both digests, and the row shows the lower score
until one of the two is withdrawn: a withdrawn entry leaves the board, a withdrawn rerun counts no
more. Both stay in the folder and on the method's page.
"""

#: Longest text that an entry holds, characters.
_LINE = 1000


def _add_results(parser: argparse.ArgumentParser) -> None:
    text = "results folder or results.json"
    parser.add_argument("results", nargs="+", metavar="RESULTS", help=text)


def _add_check(parser: argparse.ArgumentParser) -> None:
    text = "entries before: none may be changed or removed"
    parser.add_argument("--against", metavar="DIR", help=text)
    add_json(parser, "print the entries as JSON")


def _add_show(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--suite", metavar="NAME", help="only the tables of this suite")
    add_json(parser, "print the tables as JSON")


def _add_contest(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("entry", metavar="ENTRY", help="name of the entry")
    text = "results of the other run; with --withdraw the first 8 digits of its digest"
    add("rerun", metavar="RERUN", help=text)
    add("--checked-by", required=True, metavar="NAME", help="who contests or withdraws")
    add("--reason", required=True, metavar="TEXT", help="why")
    text = "settle the contest: take one of the two out"
    add("--withdraw", choices=("entry", "rerun"), default="", help=text)


def _add_register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="+", metavar="ENTRY", help="name of an entry")


def _add_build(parser: argparse.ArgumentParser) -> None:
    add_out(parser, "folder of the site")
    text = "results folders of entries, for the images of their reports"
    parser.add_argument("--with", dest="folders", **SEVERAL, metavar="RESULTS", help=text)
    text = (
        "also copy pages of avatars (captures/ID/avatar.html in these folders) and link to "
        "them; they run the scripts of whoever made them"
    )
    parser.add_argument("--avatar-pages", action="store_true", help=text)


def _add_submit(parser: argparse.ArgumentParser) -> None:
    _add_results(parser)
    add = parser.add_argument
    add_out(parser, "new folder of the submission")
    add("--author", default="", metavar="NAME", help="who answers for the rows")
    text = "https address of code, paper, predictions or avatars; may be repeated"
    add("--link", action="append", default=[], metavar="KIND=URL", help=text)
    text = "fitted avatars, one file or folder for each capture id; only digests are noted"
    add("--avatars", metavar="DIR", help=text)
    add("--revises", metavar="ENTRY", help="name of the entry that is corrected")
    add("--reason", default="", metavar="TEXT", help="why it is corrected")
    add_json(parser, "print the entries as JSON")


def _add_confirm(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("results", nargs="+", metavar="RESULTS", help="results folder with predictions")
    add("--checked-by", required=True, metavar="NAME", help="who checks")
    add("--entry", metavar="NAME", help="the entry, if several match")
    text = "largest difference of the macro mean of PSNR of a second run (default 0.1)"
    add("--tolerance", type=float, default=0.1, metavar="DB", help=text)
    add("--capture", **SEVERAL, metavar="PATH", help="captures (default: the result's suite)")
    text = "digest (8 digits at least) of a check of the entry that no longer counts"
    add("--overrules", action="append", default=[], metavar="CHECK", help=text)
    add("--reason", default="", metavar="TEXT", help="why it does not count")
    add_json(parser, "print the check as JSON")


def _add(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.entries import make_entry
    from hwp_bench.leaderboard.rules import check_complete, check_source
    from hwp_bench.leaderboard.submit import add_entries
    from hwp_bench.results import read_results, results_among

    found = []
    for file in results_among(args.results):
        found.append(read_results(file))
        check_source(file)
        check_complete(make_entry(found[-1]))
    for entry in add_entries(folder, found):
        notice(f"entry: {entry}")
    return 0


def _submit(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.rules import check_source, sound_entries
    from hwp_bench.leaderboard.submit import TEXT, submit
    from hwp_bench.report.sources import read_sources, source_folders
    from hwp_bench.results import results_among

    submission = _submission(args)
    sources = read_sources(args.results)
    inputs = {"RESULTS": source_folders(sources), "--avatars": args.avatars}
    check_places({"--out": args.out}, inputs)
    for file in results_among(args.results):
        check_source(file)
    out, avatars = Path(args.out), Path(args.avatars) if args.avatars else None
    done = submit(out, sources, sound_entries(folder), submission, avatars)
    for entry, there in done:
        count = len(entry.results.captures)
        if there < count:
            notice(f"{entry.name}: predictions of {count - there} of {count} captures not at hand")
    notice(f"submission: {out}; text of the pull request: {out / TEXT}")
    _print_entries([entry for entry, _ in done], args.json)
    return 0


def _submission(args: argparse.Namespace) -> Submission:
    from hwp_bench.leaderboard.entries import Submission

    given = [
        ("--author", args.author),
        ("--reason", args.reason),
        ("--revises", args.revises or ""),
    ]
    for option, text in [*given, *(("--link", text) for text in args.link)]:
        _check_line(option, text)
    links = {}
    for text in args.link:
        kind, equals, address = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r} is not KIND=URL", field="--link")
        links[kind] = address
    return Submission(args.author, args.revises, args.reason, links)


def _check_line(option: str, text: str, *, empty: bool = True) -> None:
    """Refuse what an entry cannot hold: it would be written, and then not be read."""
    if not empty and not text:
        raise UsageError("is empty", field=option)
    if len(text) > _LINE or "\n" in text or has_odd_characters(text):
        raise UsageError(
            f"{shown(text[:60])!r} is not one line of at most {_LINE:,} characters without "
            "control characters",
            field=option,
        )


def _check(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.entries import read_entries
    from hwp_bench.leaderboard.rules import (
        check_bound,
        check_complete,
        check_dates,
        check_entries,
        check_names,
        check_unchanged,
        read_names,
    )

    _refuse_none(folder)
    entries = check_entries(read_entries(folder))
    for entry in entries:
        check_complete(entry)
        check_bound(entry)
        check_dates(entry)
    check_names(entries, read_names(folder))
    new = check_unchanged(folder, Path(args.against)) if args.against else None
    _print_entries(entries, args.json)
    if not args.json:
        print(f"{len(entries)} entries, all sound" + ("" if new is None else f", {new} new files"))
    return 0


def _show(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.board import board_tables

    entries = _sound_entries(folder)
    chosen = [entry for entry in entries if args.suite in (None, entry.results.suite)]
    if args.suite and not chosen:
        raise UsageError(f"no entry is of the suite {args.suite!r}", field="--suite")
    tables = board_tables(chosen)
    if args.json:
        print_json([to_object(table) for table in tables])
    for table in () if args.json else tables:
        print_table(table)
    return 0


def _confirm(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.entries import read_entries, refuse_installed, write_check
    from hwp_bench.leaderboard.rules import left_out
    from hwp_bench.leaderboard.submit import confirm, entry_of
    from hwp_bench.results import read_results, results_among

    _check_line("--checked-by", args.checked_by)
    _check_line("--reason", args.reason)
    refuse_installed(folder)
    _refuse_none(folder)
    if not 0 <= args.tolerance <= 100:
        raise UsageError(f"{args.tolerance} is not between 0 and 100 dB", field="--tolerance")
    files = results_among(args.results)
    if len(files) > 1 and (args.entry or args.overrules):
        raise UsageError("is of one result", field="--entry" if args.entry else "--overrules")
    entries = read_entries(folder, left_out)
    # Before a suite is rendered for them.
    chosen = [entry_of(entries, read_results(file), args.entry) for file in files]
    checks = []
    for entry, file in zip(chosen, files, strict=True):
        check = confirm(
            entry,
            file,
            captures_of(args.capture, file),
            by=args.checked_by,
            tolerance=args.tolerance,
            overrules=args.overrules,
            reason=args.reason,
        )
        notice(f"check: {write_check(folder, check)}")
        checks.append(check)
        if not args.json:
            print(f"{check.entry}: {check.kind}, {check.verdict} ({check.frames} frames)")
        if check.rerun and not args.json:
            psnr = check.scores["psnr"]
            print(f"  second run {check.rerun[:8]}: PSNR {psnr:.2f} dB (macro mean)")
            print(f"  captures with the same predictions: {check.same_predictions}")
    if args.json:
        found = [asdict(check) for check in checks]
        print_json(found if found[1:] else found[0])
    return 0 if all(check.verdict == "reproduces" for check in checks) else 1


def _contest(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.entries import refuse_installed, write_check
    from hwp_bench.leaderboard.rules import check_source, sound_entries
    from hwp_bench.leaderboard.submit import contest
    from hwp_bench.results import result_files

    _check_line("--checked-by", args.checked_by, empty=False)
    _check_line("--reason", args.reason, empty=False)
    refuse_installed(folder)
    _refuse_none(folder)
    fitting = [entry for entry in sound_entries(folder) if entry.name == args.entry]
    if not fitting:
        raise UsageError("is not a sound entry", where=folder, field=args.entry)
    rerun: Path | str = args.rerun
    if not args.withdraw:
        files = result_files(args.rerun)
        if len(files) != 1:
            problem = f"has {len(files)} results, and one run contests one entry"
            raise UsageError(problem, where=args.rerun, field="RERUN")
        (rerun,) = files
        check_source(rerun)
    made = contest(
        fitting[0], rerun, by=args.checked_by, reason=args.reason, withdraws=args.withdraw
    )
    notice(f"{made.kind}: {write_check(folder, made)}")
    if made.results:
        own, other = (run.scores["psnr"] for run in (fitting[0].results, made.results))
        print(f"{args.entry}: PSNR {own:.2f} dB, contested by {made.rerun[:8]}: {other:.2f} dB")
    return 0


def _register(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.entries import read_entries, refuse_installed
    from hwp_bench.leaderboard.rules import NAME, left_out, register

    refuse_installed(folder)
    entries = {entry.name: entry for entry in read_entries(folder, left_out)}
    for name in args.names:
        if name not in entries:
            raise UsageError("is not an entry", where=folder, field=name)
    added = register(folder, [entries[name] for name in args.names])
    notice(f"{len(added)} entries added to {folder.parent / NAME}")
    return 0


def _build(args: argparse.Namespace, folder: Path) -> int:
    from hwp_bench.leaderboard.site import build_site
    from hwp_bench.report.sources import read_sources, source_folders

    _refuse_none(folder)
    sources = read_sources(args.folders)
    check_places({"--out": args.out}, {"--with": source_folders(sources), "--entries": folder})
    entries = _sound_entries(folder)
    page = build_site(Path(args.out), entries, sources, avatar_pages=args.avatar_pages)
    notice(f"site: {page}")
    return 0


def _refuse_none(folder: Path) -> None:
    """Refuse a folder without entries: a wrong path must not look like a sound board."""
    from hwp_bench.leaderboard.entries import entry_files

    if not entry_files(folder):
        problem = "holds no entry" if folder.is_dir() else "is not a folder"
        raise UsageError(
            problem, where=folder, field="--entries", remedy="Name the folder of the entries."
        )


def _sound_entries(folder: Path) -> list[Entry]:
    """Read the sound entries of a folder; one without any is refused, as its board is empty."""
    from hwp_bench.leaderboard.rules import sound_entries

    _refuse_none(folder)
    entries = sound_entries(folder)
    if not entries:
        raise UsageError(
            "holds no sound entry",
            where=folder,
            field="--entries",
            remedy="Name the folder of the entries; `hwp-bench leaderboard check` says what is "
            "wrong with a file.",
        )
    return entries


def _print_entries(entries: Sequence[Entry], as_json: bool) -> None:
    if not as_json:
        return
    facts = [
        {
            "entry": entry.name,
            "digest": entry.digest,
            "suite": entry.results.suite,
            "protocol": entry.protocol,
            "level": entry.level,
            "badge": entry.badge,
            "revises": entry.submission.revises,
            "by": entry.submission.by,
            "links": entry.submission.links,
            "captures": [
                {
                    "id": capture.id,
                    "data": capture.digest,
                    "predictions": capture.predictions_digest,
                    "avatar": entry.submission.avatars.get(capture.id),
                }
                for capture in entry.results.captures
            ],
        }
        for entry in entries
    ]
    print_json(facts)


def _command(
    examples: str,
    add_arguments: Callable[[argparse.ArgumentParser], None],
    act: Callable[[argparse.Namespace, Path], int],
) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int]]:
    """Return the arguments and the work of a command on a folder of entries, `--entries`."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.epilog = examples
        add_arguments(parser)
        text = "folder of the entries (default leaderboard/entries)"
        parser.add_argument("--entries", type=Path, metavar="DIR", help=text)

    def run(args: argparse.Namespace) -> int:
        return act(args, args.entries or data_folder("leaderboard") / "entries")

    return add, run


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "show": _command(_SHOW, _add_show, _show),
    "submit": _command(_SUBMIT, _add_submit, _submit),
    "check": _command(_CHECK, _add_check, _check),
    "confirm": _command(_CONFIRM, _add_confirm, _confirm),
    "build": _command(_BUILD, _add_build, _build),
    "add": _command(_ADD, _add_results, _add),
    "contest": _command(_CONTEST, _add_contest, _contest),
    "register": _command(_REGISTER, _add_register, _register),
}
