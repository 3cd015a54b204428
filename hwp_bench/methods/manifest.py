"""Method directories: reading and checking `method.toml`."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.files import inside
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.base.text import has_odd_characters
from hwp_bench.methods.contents import method_digest
from hwp_bench.methods.json_values import check_plain
from hwp_bench.methods.switches import Switch, read_switches

#: Version of the method contract.
SCHEMA = "hwp-method/1"
#: Name of the file that makes a folder a method directory.
MANIFEST = "method.toml"
#: Largest `method.toml`, in bytes.
MAX_BYTES = 64 * 1024
#: Preset that is used when none is asked for.
DEFAULT_PRESET = "default"
#: Ways to enter a method; a manifest has exactly one.
ENTRY_KINDS = ("python", "command", "predictions")

_KEYS = {
    "schema",
    "name",
    "title",
    "description",
    "authors",
    "licence",
    "url",
    "entry",
    "presets",
    "switches",
}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_PYTHON = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class MethodManifest:
    """A checked `method.toml`."""

    #: The method directory.
    root: Path
    #: Short name: letters, digits, `.`, `_`, `-`.
    name: str
    #: Name in tables.
    title: str
    #: One sentence about the method.
    description: str
    #: `python`, `command` or `predictions`.
    kind: str
    #: `module:callable`; or the words of a command; or the folder of predictions.
    entry: str | tuple[str, ...]
    #: Settings by preset.
    presets: Mapping[str, Mapping[str, Any]]
    #: What can be taken out or put in place of something, by name, in the order of the file.
    switches: Mapping[str, Switch] = field(default_factory=dict)

    def preset(self, name: str | None, suite: str = "") -> str:
        """Return the name of the preset to use.

        Args:
            name: what was asked for; None takes the one named like the suite where the method
                has it, else `default`.
            suite: name of the suite.

        Raises:
            BadMethod: there is no such preset.
        """
        if name is None:
            return suite if suite in self.presets else DEFAULT_PRESET
        if name not in self.presets and name != DEFAULT_PRESET:
            raise BadMethod(
                f"has no preset {name!r}",
                where=self.root / MANIFEST,
                field="presets",
                remedy=f"It has: {', '.join(self.presets) or DEFAULT_PRESET}.",
            )
        return name

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the method's own code, settings and weights: what was run."""
        return method_digest(self.root)


def find_method(text: str) -> Path:
    """Find a method directory by path, or by the name of one that ships with the toolkit.

    Args:
        text: a path such as `my_method/`; or `plain`, `baselines/plain`, `wildghand`.

    Raises:
        BadMethod: there is none.
    """
    if (Path(text) / MANIFEST).is_file():
        return Path(text)
    name = text.rstrip("/").removeprefix("baselines/")
    for folder in _shipped_folders():
        if folder.name == name:
            return folder
    raise BadMethod(
        f"is no method directory: it has no {MANIFEST}",
        where=text,
        remedy="`hwp-bench list methods` shows the ones that ship with the toolkit.",
    )


def read_manifest(path: str | os.PathLike[str]) -> MethodManifest:
    """Read and check the `method.toml` of a method directory.

    Raises:
        BadMethod: missing, too large, no TOML, an unknown, missing or wrong field.
    """
    root = Path(path)
    where = root / MANIFEST
    if not where.is_file():
        raise BadMethod(f"is no method directory: it has no {MANIFEST}", where=root)
    if where.stat().st_size > MAX_BYTES:
        raise BadMethod(f"is larger than {MAX_BYTES} bytes", where=where)
    try:
        value = tomllib.loads(where.read_text(encoding="utf-8"))
    # Not only TOMLDecodeError: numbers of thousands of digits raise ValueError.
    except (ValueError, RecursionError) as error:
        raise BadMethod(f"is no valid TOML ({error})", where=where) from error
    except OSError as error:
        raise BadMethod(f"cannot be read ({error.strerror})", where=where) from error
    _known_keys(value, _KEYS, where, "")
    if value.get("schema") != SCHEMA:
        raise BadMethod(
            f"is {value.get('schema')!r} where {SCHEMA!r} is read", where=where, field="schema"
        )
    name = _text(value, "name", where)
    if not _NAME.fullmatch(name):
        raise BadMethod(f"{name!r} is no method name", where=where, field="name")
    kind, entry = _entry(value.get("entry"), root, where)
    return MethodManifest(
        root=root,
        name=name,
        title=_text(value, "title", where, default=name),
        description=_text(value, "description", where, default=""),
        kind=kind,
        entry=entry,
        presets=_presets(value.get("presets", {}), where),
        switches=read_switches(value.get("switches", {}), where),
    )


def _text(value: Mapping[str, Any], key: str, where: Path, default: str | None = None) -> str:
    text = value.get(key, default)
    if not isinstance(text, str) or len(text) > 1000 or "\n" in text or has_odd_characters(text):
        raise BadMethod("must be one line of at most 1,000 characters", where=where, field=key)
    return text


def _known_keys(value: Mapping[str, Any], known: set[str], where: Path, prefix: str) -> None:
    for key in value:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            raise BadMethod(
                "is no field of a method",
                where=where,
                field=prefix + key,
                remedy=f"Did you mean {close[0]!r}?" if close else f"Known: {sorted(known)}.",
            )


def _entry(value: Any, root: Path, where: Path) -> tuple[str, str | tuple[str, ...]]:
    if not isinstance(value, dict) or len(value) != 1:
        raise BadMethod(
            f"must have exactly one of {', '.join(ENTRY_KINDS)}", where=where, field="entry"
        )
    _known_keys(value, set(ENTRY_KINDS), where, "entry.")
    kind, entry = next(iter(value.items()))
    field = f"entry.{kind}"
    if kind == "command":
        if not isinstance(entry, list) or not entry or not all(isinstance(w, str) for w in entry):
            raise BadMethod("must be a list of words", where=where, field=field)
        return kind, tuple(entry)
    if not isinstance(entry, str):
        raise BadMethod("must be a text", where=where, field=field)
    if kind == "python" and not _PYTHON.fullmatch(entry):
        raise BadMethod(f"{entry!r} is not module:callable", where=where, field=field)
    if kind == "predictions":
        inside(root, entry)
    return kind, entry


def _presets(value: Any, where: Path) -> dict[str, dict[str, Any]]:
    if not isinstance(value, dict) or not all(isinstance(item, dict) for item in value.values()):
        raise BadMethod("must be tables of settings", where=where, field="presets")
    check_plain(value, where, "presets")
    return value


def shipped_methods() -> list[MethodManifest]:
    """Return the methods that ship with the toolkit: the reference entry and the baselines."""
    return [read_manifest(folder) for folder in _shipped_folders()]


def _shipped_folders() -> list[Path]:
    folders = [PACKAGES / "wildghand", *sorted(data_folder("baselines").iterdir())]
    return [folder for folder in folders if (folder / MANIFEST).is_file()]
