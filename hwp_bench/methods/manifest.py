"""Method directories: finding them, reading and checking `method.toml`."""

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
from hwp_bench.methods.settings import check_plain

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

#: Kinds of switch by the key that holds its settings.
SWITCH_KINDS = ("settings_off", "settings_on")

_LINES = ("name", "title", "description", "authors", "licence", "url")
_KEYS = {"schema", *_LINES, "entry", "presets", "switches"}
_SWITCH_KEYS = {"title", "description", *SWITCH_KINDS}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_PYTHON = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_SWITCH_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_SETTING = re.compile(r"[A-Za-z_]\w{0,63}(\.[A-Za-z_]\w{0,63}){0,7}")


@dataclass(frozen=True)
class Switch:
    """One component of a method that can be taken out, or one alternative to how it works."""

    #: Short name: lower-case letters, digits, `-`.
    name: str
    #: Name in tables.
    title: str
    #: One sentence.
    description: str
    #: Settings that override the preset in the switch's variant.
    settings: Mapping[str, Any]
    #: False: the variant lacks a component (`settings_off`). True: an alternative takes the place
    #: of what the method does otherwise (`settings_on`).
    alternative: bool

    @property
    def variant_name(self) -> str:
        """Name of the variant that this switch makes: `no-dpd`, `binary-mask`."""
        return self.name if self.alternative else f"no-{self.name}"


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
    #: Who made it; empty where the file does not say.
    authors: str = ""
    #: Terms of use; empty where the file does not say.
    licence: str = ""
    #: Its page; empty where the file does not say.
    url: str = ""

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
        BadMethod: there is no such directory.
    """
    if (Path(text) / MANIFEST).is_file():
        return Path(text)
    name = Path(text).as_posix().removeprefix("baselines/")
    for folder in _shipped_folders():
        if folder.name == name:
            return folder
    raise BadMethod(
        f"is not a method directory: it has no {MANIFEST}",
        where=text,
        remedy="`hwp-bench list methods` shows the ones that ship with the toolkit.",
    )


def shipped_methods() -> list[MethodManifest]:
    """Return the methods that ship with the toolkit: the reference method and the baselines."""
    return [read_manifest(folder) for folder in _shipped_folders()]


def _shipped_folders() -> list[Path]:
    folders = [PACKAGES / "wildghand", *sorted(data_folder("baselines").iterdir())]
    return [folder for folder in folders if (folder / MANIFEST).is_file()]


def read_manifest(path: str | os.PathLike[str]) -> MethodManifest:
    """Read and check the `method.toml` of a method directory.

    Raises:
        BadMethod: it is missing, too large or not TOML, or a field is unknown, missing or wrong.
    """
    root = Path(path)
    where = root / MANIFEST
    if not where.is_file():
        raise BadMethod(f"is not a method directory: it has no {MANIFEST}", where=root)
    if where.stat().st_size > MAX_BYTES:
        raise BadMethod(f"is larger than {MAX_BYTES} bytes", where=where)
    try:
        value = tomllib.loads(where.read_text(encoding="utf-8"))
    # Not only TOMLDecodeError: numbers of thousands of digits raise ValueError.
    except (ValueError, RecursionError) as error:
        raise BadMethod(f"is not valid TOML ({error})", where=where) from error
    except OSError as error:
        raise BadMethod(f"cannot be read ({error.strerror})", where=where) from error
    _known_keys(value, _KEYS, where)
    if value.get("schema") != SCHEMA:
        raise BadMethod(
            f"is {value.get('schema')!r} where {SCHEMA!r} is read", where=where, field="schema"
        )
    name = _text(value, "name", where)
    if not _NAME.fullmatch(name):
        raise BadMethod(f"{name!r} is not a method name", where=where, field="name")
    kind, entry = _entry(value.get("entry"), root, where)
    return MethodManifest(
        root=root,
        name=name,
        title=_text(value, "title", where, default=name),
        description=_text(value, "description", where, default=""),
        kind=kind,
        entry=entry,
        presets=_presets(value.get("presets", {}), where),
        switches=_switches(value.get("switches", {}), where),
        authors=_authors(value, where),
        licence=_text(value, "licence", where, default=""),
        url=_text(value, "url", where, default=""),
    )


def _text(
    value: Mapping[str, Any], key: str, where: Path, default: str | None = None, prefix: str = ""
) -> str:
    text = value.get(key, default)
    if not isinstance(text, str) or len(text) > 1000 or "\n" in text or has_odd_characters(text):
        raise BadMethod(
            "must be one line of at most 1,000 characters", where=where, field=prefix + key
        )
    return text


def _authors(value: Mapping[str, Any], where: Path) -> str:
    """One line, or a list of names, which becomes one."""
    names = value.get("authors", "")
    if isinstance(names, list) and all(isinstance(name, str) for name in names):
        names = ", ".join(names)
    return _text({"authors": names}, "authors", where)


def _known_keys(
    value: Mapping[str, Any], known: set[str], where: Path, prefix: str = "", kind: str = "a method"
) -> None:
    for key in value:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            raise BadMethod(
                f"is not a field of {kind}",
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
        raise BadMethod("must be text", where=where, field=field)
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


def _switches(value: Any, where: Path) -> dict[str, Switch]:
    if not isinstance(value, dict):
        raise BadMethod("must be a table of switches", where=where, field="switches")
    switches = {name: _switch(name, item, where) for name, item in value.items()}
    names = [switch.variant_name for switch in switches.values()]
    for name in names:
        if names.count(name) > 1:
            raise BadMethod(f"two switches make a variant {name!r}", where=where, field="switches")
    return switches


def _switch(name: str, value: Any, where: Path) -> Switch:
    place = f"switches.{name}"
    if not _SWITCH_NAME.fullmatch(name):
        raise BadMethod(
            "is not a name of a switch",
            where=where,
            field=place,
            remedy="Use lower-case letters, digits and hyphens.",
        )
    if not isinstance(value, dict):
        raise BadMethod("must be a table", where=where, field=place)
    _known_keys(value, _SWITCH_KEYS, where, f"{place}.", "a switch")
    kinds = [kind for kind in SWITCH_KINDS if kind in value]
    if len(kinds) != 1:
        raise BadMethod(
            f"must have exactly one of {' and '.join(SWITCH_KINDS)}",
            where=where,
            field=place,
            remedy="settings_off takes a component out; settings_on puts an alternative in.",
        )
    settings = value[kinds[0]]
    if not isinstance(settings, dict) or not settings:
        raise BadMethod(
            "must be a table of at least one setting", where=where, field=f"{place}.{kinds[0]}"
        )
    for setting in settings:
        if not _SETTING.fullmatch(setting):
            raise BadMethod(
                f"{setting!r} is not a name of a setting", where=where, field=f"{place}.{kinds[0]}"
            )
    check_plain(settings, where, f"{place}.{kinds[0]}")
    return Switch(
        name=name,
        title=_text(value, "title", where, name, f"{place}."),
        description=_text(value, "description", where, "", f"{place}."),
        settings=settings,
        alternative=kinds[0] == "settings_on",
    )
