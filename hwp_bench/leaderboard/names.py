"""Names of methods that ship belong to the toolkit: which entries may carry them.

Anybody can write any name, title and digest into an entry. So the entries under the name or title
of a method that ships are listed by their digests in `names.json`, next to the folder of entries;
maintainers of a board add to it with `leaderboard add` and `leaderboard register`. A pull request
that changes this file asks for a name that is not its author's, in plain sight.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import data_folder
from hwp_bench.base.records import Digest, Line, parse_record, without_schema
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.methods.manifest import shipped_methods

#: Version of the file.
SCHEMA = "hwp-leaderboard-names/1"
#: Its name, next to the folder of entries.
NAME = "names.json"
# Signs that look like others.
_ALIKE = str.maketrans({"0": "o", "1": "l", "i": "l", "|": "l", "5": "s"})


@dataclass(frozen=True)
class Names:
    """Entries that may carry the names of methods that ship."""

    #: Their digests by the name of the method, sorted.
    entries: dict[Line, Annotated[list[Digest], Meta(max_length=10_000)]]


def read_names(folder: Path) -> frozenset[str]:
    """Return the digests that are listed for a folder of entries: there, and where the toolkit is.

    Raises:
        BadInput, BadResult: a file is damaged.
    """
    found: set[str] = set()
    for file in {folder.parent / NAME, data_folder("leaderboard") / NAME}:
        if file.is_file():
            found |= {digest for own in _read(file).entries.values() for digest in own}
    return frozenset(found)


def register(folder: Path, entries: Iterable[Entry]) -> list[Entry]:
    """List the entries under names of methods that ship; returns those that were not listed.

    For the maintainers of a board, who know where these entries come from.
    """
    known = read_names(folder)
    added = [e for e in entries if e.digest not in known and _taken(e) is not None]
    if added:
        file = folder.parent / NAME
        listed = _read(file).entries if file.is_file() else {}
        for entry in added:
            name = _taken(entry) or ""
            listed[name] = sorted({*listed.get(name, []), entry.digest})
        write_json(file, {"schema": SCHEMA, **asdict(Names(dict(sorted(listed.items()))))})
    return added


def check_names(entries: Iterable[Entry], listed: frozenset[str]) -> None:
    """Refuse an entry under the name or title of a method that ships, unless it is listed.

    Raises:
        UsageError: an entry carries, or seems to carry, the name of a method that ships.
    """
    for entry in entries:
        name = _taken(entry)
        if name is not None and entry.digest not in listed:
            raise UsageError(
                f"carries the name of {name}, a method that ships with the toolkit",
                where=entry.name,
                field="method.name",
                remedy="Give the method a name and title of its own in its method.toml. Rows of "
                "methods that ship come from the maintainers (`hwp-bench leaderboard register`).",
            )


@cache
def _shipped() -> dict[str, str]:
    """Names of methods by their names and titles, as these look."""
    found: dict[str, str] = {}
    for manifest in shipped_methods():
        found |= {_look(manifest.name): manifest.name, _look(manifest.title): manifest.name}
    return found


def is_shipped(name: str) -> bool:
    """Whether a method of that name ships with the toolkit."""
    return name in _shipped().values()


def _taken(entry: Entry) -> str | None:
    """Return the method that ships whose name or title an entry seems to carry, or None."""
    method = entry.results.method
    if is_shipped(method.name):
        return method.name
    return _shipped().get(_look(method.name)) or _shipped().get(_look(method.title))


def _look(text: str) -> str:
    """Return a text as it looks at a glance: without case, accents, spaces and signs."""
    plain = unicodedata.normalize("NFKD", text).casefold()
    return "".join(c for c in plain if c.isalnum()).translate(_ALIKE)


def _read(file: Path) -> Names:
    value = without_schema(read_json(file), SCHEMA, where=file, error=BadResult)
    return parse_record(Names, value, where=file)
