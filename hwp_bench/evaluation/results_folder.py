"""The folder that an evaluation writes to: what is kept of it, and what may not be lost in it.

New results of a capture are made in `captures/.unfinished` and take their place when they are
whole. Results of another evaluation are refused, or stay until every new one is there
(`overwrite`). Files of a person's own stay in every case.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hwp_bench.base.console import notice
from hwp_bench.base.errors import HwpError, UsageError, bounded
from hwp_bench.base.files import canonical_json, disc_errors, temporary_name
from hwp_bench.base.folders import remove_tree
from hwp_bench.base.records import flattened
from hwp_bench.base.tables import FORMATS, write_tables
from hwp_bench.evaluation.capture_evaluation import (
    RESULT,
    CaptureEvaluation,
    read_result,
    stored_result,
)
from hwp_bench.report.tables import all_tables, free_view_tables
from hwp_bench.results import CaptureResult, Results, read_results, write_results

#: Folder of results that are not whole yet, inside `captures`; no capture has such an id.
UNFINISHED = ".unfinished"
#: The result file of an evaluation.
RESULTS = "results.json"

# What an evaluation writes into the folder of a capture; everything else is a person's own.
_OURS = re.compile(
    rf"{re.escape(RESULT)}|warnings\.json|log\.txt|(predictions|free)/\d{{6,}}\.png"
    r"|pictures/(worst|median|best|comparison|free_view)\.png"
    r"|diagnostics/[^/]*temporal\.json|diagnostics/weights/[^/]*\.png|run(/.*)?"
)
# How a folder of a capture is called while another takes its place.
_RETIRED = re.compile(r"\.(.+)\.[0-9a-f]{12}")
# Longest value that a difference repeats.
_SHOWN = 40


@dataclass(frozen=True)
class ResultsFolder:
    """The folder of one evaluation, and what is in it already."""

    root: Path
    #: The evaluations, one a capture.
    evaluations: tuple[CaptureEvaluation, ...]
    #: Stored results of the same key by place in `evaluations`; they are not run again.
    kept: Mapping[int, CaptureResult]
    #: Results of another evaluation are there, which stay until all new ones are whole.
    replaces: bool

    @property
    def captures(self) -> Path:
        """The folder of the captures' folders."""
        return self.root / "captures"

    def final(self, place: int) -> Path:
        """Return the folder of a capture's result."""
        return self.captures / self.evaluations[place].capture.info.id

    def unfinished(self, place: int) -> Path:
        """Return the folder in which the result is made."""
        return self.captures / UNFINISHED / self.evaluations[place].capture.info.id

    def finish(self, place: int) -> CaptureResult:
        """Read a result that is whole, and give it its place unless others stand there."""
        result = read_result(self.unfinished(place))
        if not self.replaces:
            with disc_errors(self.root):
                _take_place(self.unfinished(place), self.final(place))
        return result

    def as_it_was(self, results: Results) -> Results:
        """The record that is there, if a new one would only say otherwise when and where it ran."""
        with contextlib.suppress(HwpError):
            stored = read_results(self.root / RESULTS)
            run = {name: getattr(stored, name) for name in ("started", "environment", "toolkit")}
            if replace(results, **run) == stored:
                return stored
        return results


def finish_together(finished: Sequence[tuple[ResultsFolder, Results]], *, tables: bool) -> None:
    """Write the records of whole evaluations of one command; old results go only now."""
    with _interrupts_later():
        for folder, results in finished:
            if folder.replaces:
                with disc_errors(folder.root):
                    write_results(folder.captures / UNFINISHED / RESULTS, results)
        for folder, results in finished:
            with disc_errors(folder.root):
                if folder.replaces:
                    _replace(folder.root, tables=tables)
                else:
                    _write(folder.root, results, tables=tables)
                remove_tree(folder.captures / UNFINISHED)


def open_results_folder(
    root: Path, head: Results, evaluations: Sequence[CaptureEvaluation], *, overwrite: bool = False
) -> ResultsFolder:
    """Look at what a folder holds, and say what of it is kept; to be called under its lock."""
    with disc_errors(root):
        _clean(root)
    problems = refuse_other(root, head, evaluations, overwrite=overwrite)
    folder = ResultsFolder(root, tuple(evaluations), {}, bool(problems))
    if problems:
        notice(f"replaces, once all is done: {root} ({'; '.join(problems)})")
    else:
        found = [
            (place, stored_result(evaluation, folder.final(place)))
            for place, evaluation in enumerate(evaluations)
        ]
        kept = {place: result for place, result in found if result is not None}
        folder = replace(folder, kept=kept)
    for place in range(len(evaluations)):
        # Of another key, or of a process that was killed; one of this key is taken as it is.
        if stored_result(evaluations[place], folder.unfinished(place)) is None:
            remove_tree(folder.unfinished(place))
    return folder


def announce_kept(folders: Sequence[ResultsFolder]) -> None:
    """Say which results are kept, because their key is that of this evaluation."""
    names = [
        folder.evaluations[place].capture.info.id for folder in folders for place in folder.kept
    ]
    count = sum(len(folder.evaluations) for folder in folders)
    if names:
        named = bounded(list(dict.fromkeys(names)))
        whole = "complete" if len(names) == count else f"{len(names)} of {count} were there"
        notice(f"kept, because nothing that decides a score differs: {named} ({whole})")


def refuse_other(
    root: Path,
    head: Results,
    evaluations: Sequence[CaptureEvaluation] = (),
    *,
    overwrite: bool = False,
) -> list[str]:
    """Refuse a folder with results of another evaluation, or say what these differ in."""
    problems = differences(root, head, evaluations)
    if problems and not overwrite:
        raise UsageError(
            f"holds results of another evaluation: {'; '.join(problems)}",
            where=root,
            remedy="Choose another folder with -o, or replace them with --overwrite.",
        )
    return problems


def differences(root: Path, head: Results, evaluations: Sequence[CaptureEvaluation]) -> list[str]:
    """Return in words what results in a folder differ in from those that are to come.

    Captures on which the method failed do not count: nothing of them could be lost.
    """
    problems = []
    stored = None
    if (root / RESULTS).is_file():
        try:
            stored = read_results(root / RESULTS)
        except HwpError as error:
            return [f"{RESULTS} cannot be read ({error.problem})"]
    if stored is not None and any(capture.failure is None for capture in stored.captures):
        problems = _head_differences(stored, head)
    if problems or not evaluations:
        return problems
    names = {evaluation.capture.info.id for evaluation in evaluations}
    finished = [] if stored is None else stored.captures
    others = [one.id for one in finished if one.failure is None and one.id not in names]
    if others:
        problems.append(f"data: it is of {bounded(others)} too")
    for evaluation in evaluations:
        folder = root / "captures" / evaluation.capture.info.id
        with contextlib.suppress(HwpError):
            result = read_result(folder)
            if result.failure is None and result.key != evaluation.key:
                problems.append(_capture_difference(result, evaluation))
    return problems


def _head_differences(stored: Results, head: Results) -> list[str]:
    problems = []
    if stored.method.name != head.method.name:
        problems.append(f"method {stored.method.name}, now {head.method.name}")
    elif stored.method.digest != head.method.digest:
        digests = f"{stored.method.digest[:8]}, now {head.method.digest[:8]}"
        problems.append(f"the method's files have changed (digest {digests})")
    pairs: dict[str, tuple[Any, Any]] = {
        "preset": (stored.method.preset, head.method.preset),
        **{name: (stored.budget.get(name), head.budget.get(name)) for name in ("seconds", "steps")},
        **{n: (getattr(stored, n), getattr(head, n)) for n in ("seed", "frames", "suite")},
    }
    old, new = (dict(flattened(one.method.settings)) for one in (stored, head))
    for name in sorted({*old, *new}):
        pairs[f"setting {name}"] = old.get(name, "default"), new.get(name, "default")
    for name, (before, now) in pairs.items():
        if before != now:
            problems.append(f"{name} {_value(before)}, now {_value(now)}")
    if stored.protocols != head.protocols:
        problems.append("it was scored by other protocols")
    return problems


def _capture_difference(result: CaptureResult, evaluation: CaptureEvaluation) -> str:
    pairs = {
        "data: it has changed": (result.digest, evaluation.capture.digest),
        "data: it is split otherwise": (result.split_digest, evaluation.split.digest),
        "other files are exposed": (result.exposed, evaluation.exposed),
    }
    found = [text for text, (before, now) in pairs.items() if before != now]
    if found and result.exact_masks != evaluation.capture.has_true_masks:
        found.append("other masks are scored")
    otherwise = "method, settings, seed, budget, free-view clip, protocol or metrics differ"
    return f"{result.id}: {', '.join(found) or otherwise}"


def _value(value: Any) -> str:
    if value is None:
        return "none"
    text = value if isinstance(value, str) else canonical_json(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _clean(root: Path) -> None:
    """Finish or undo what a killed process left between two places, and remove the rest."""
    captures = root / "captures"
    for path in captures.glob(".*"):
        retired = _RETIRED.fullmatch(path.name)
        if retired is None or not path.is_dir() or path.is_symlink():
            continue
        if (captures / retired[1]).exists():
            remove_tree(path)
        else:
            os.rename(path, captures / retired[1])
    if (captures / UNFINISHED / RESULTS).is_file():
        _replace(root, tables=True)
        remove_tree(captures / UNFINISHED)


def _replace(root: Path, *, tables: bool) -> None:
    """Put a whole new evaluation in the place of an old one; can be done again from any state."""
    captures = root / "captures"
    results = read_results(captures / UNFINISHED / RESULTS)
    new = {capture.id for capture in results.captures}
    for name in sorted(new):
        if (captures / UNFINISHED / name).is_dir():
            _take_place(captures / UNFINISHED / name, captures / name)
    old = None
    with contextlib.suppress(HwpError):
        old = read_results(root / RESULTS)
    _write(root, results, tables=tables)
    if old is not None:
        for capture in old.captures:
            if capture.id not in new and "/" not in capture.id:
                _remove_ours(captures / capture.id)
        for name in _tables(old).keys() - _tables(results).keys():
            for ending in FORMATS:
                (root / "tables" / f"{name}.{ending}").unlink(missing_ok=True)


def _write(root: Path, results: Results, *, tables: bool) -> None:
    if tables:
        write_tables(root / "tables", _tables(results))
    write_results(root / RESULTS, results)


def _tables(results: Results) -> dict[str, Any]:
    return {**all_tables([results]), **free_view_tables([results])}


def _take_place(new: Path, old: Path) -> None:
    """Rename a folder to where another may be, whose files of a person's own it gets."""
    if not old.is_dir():
        os.rename(new, old)
        return
    _copy_own(old, new)
    retired = temporary_name(old)
    os.rename(old, retired)
    try:
        os.rename(new, old)
    except BaseException:
        os.rename(retired, old)
        raise
    remove_tree(retired)


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield (name below the folder, path) of every file and link, and of empty folders."""
    for place, folders, files in os.walk(folder):
        linked = [name for name in folders if os.path.islink(os.path.join(place, name))]
        names = [*files, *linked] if files or folders else [""]
        for name in names:
            path = Path(place, name)
            if path != folder:
                yield path.relative_to(folder).as_posix(), path


def _copy_own(old: Path, new: Path) -> None:
    for name, path in _files(old):
        copy = new / name
        if _OURS.fullmatch(name) or os.path.lexists(copy):
            continue
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            os.symlink(os.readlink(path), copy)
        elif path.is_dir():
            copy.mkdir()
        elif path.is_file():
            # Not linked: the old folder is made writable and emptied afterwards.
            shutil.copy2(path, copy)


def _remove_ours(folder: Path) -> None:
    """Remove what an evaluation wrote of a capture; a person's own files stay."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for name, path in list(_files(folder)):
        if _OURS.fullmatch(name) and not path.is_dir():
            path.unlink()
    for place, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(place)


@contextlib.contextmanager
def _interrupts_later() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM until the end of a short block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = {kind: signal.signal(kind, lambda kind, _: caught.append(kind)) for kind in kinds}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
    if caught:
        raise KeyboardInterrupt
