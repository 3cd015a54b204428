"""Pages of avatars that a person has put into a results folder, for reports to lead to.

An evaluation writes no such page: whatever a method leaves, none of its scripts gets into a report.
A person makes them (`wildghand page`), or takes them with results of somebody else whom they trust.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import atomic_write
from hwp_bench.report.sources import ResultsSource

#: Name of a page within `captures/ID/` of a results folder.
AVATAR_PAGE = "avatar.html"
#: Largest page, bytes.
MAX_PAGE_BYTES = 32 << 20

#: Addresses by number of the result and id of the capture.
AvatarPages = dict[tuple[int, str], str]


def copy_avatar_pages(folder: Path, sources: Sequence[ResultsSource]) -> AvatarPages:
    """Copy pages of avatars next to a report.

    Args:
        folder: of the report; pages go into `avatars/`, under numbers.
        sources: the evaluations.

    Returns:
        Addresses within `folder`; results without pages have none.

    Raises:
        BadResult: a file in this place is too large, a link, or something else than a page.
    """
    found: AvatarPages = {}
    for index, source in enumerate(sources):
        for number, capture in enumerate(source.results.captures):
            path = source.place(capture.id, AVATAR_PAGE)
            if path is None or not path.exists():
                continue
            address = f"avatars/{index}-{number}.html"
            atomic_write(folder / address, _read(path))
            found[index, capture.id] = address
    return found


def _read(path: Path) -> str:
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_PAGE_BYTES:
        raise BadResult(f"must be a file of at most {MAX_PAGE_BYTES >> 20} MiB", where=path)
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        text = ""
    if not text.lstrip()[:15].lower().startswith("<!doctype html"):
        raise BadResult("is not an HTML page", where=path, remedy="Make it with `wildghand page`.")
    return text
